"""Finds alpha that contradicts other images: a matte that cuts away a part of the object removes it from the scene.

Training takes matter to be where no image has alpha 0, so a hole in the mattes of a few images empties the cells behind
it, although all others show matter there. A hole with other matter behind it on all rays is not found.
"""

import dataclasses

import cv2
import jax
import numpy as np
from jaxtyping import Bool, Float

from jaxnerf.core.cameras import project, rays_from_pixels
from jaxnerf.data.images.downscaled_copies import with_size
from jaxnerf.data.readers.base import Capture
from jaxnerf.tools.capture_check.findings import Finding, named, percent

_MAX_VIEWS = 60  # that are compared, evenly spread
_RAYS, _DEPTHS = 60, 96  # of each view
_MARGIN = 2  # px of the reduced matte around opaque pixels: poses and depths are not exact
_CUT = 0.005  # fraction of opaque pixels that other images cut away; at most 0.001 in lego, mic and the embedded scene
_BLAMED = 0.2  # of these pixels, which an image that is named cuts away


def judge_mattes(
    capture: Capture, mattes: list[Float[np.ndarray, "h w"] | None], bounds: Float[np.ndarray, "V 2"]
) -> list[Finding]:
    """Returns a Finding if some mattes cut away what others show as opaque.

    Args:
        capture: whose poses fit the images.
        mattes: the mean alpha in [0, 1] of the pixels of each reduced image; None without alpha.
        bounds: (near, far) of each view along its axis, world units.
    """
    chosen = np.unique(np.linspace(0, len(mattes) - 1, _MAX_VIEWS).round().astype(int))
    chosen = [int(index) for index in chosen if mattes[index] is not None]
    if len(chosen) < 3:
        return []
    cameras = [_reduced(capture.frames[index], mattes[index].shape) for index in chosen]
    points = _points(cameras, [mattes[index] for index in chosen], bounds[chosen])
    if not len(points):
        return []
    cut = np.stack([_cut_away(camera, mattes[k], points) for camera, k in zip(cameras, chosen, strict=True)])
    votes = cut.sum(axis=0)  # [N, depths]
    lost = votes.min(axis=1) > 0
    if lost.mean() < _CUT:
        return []
    best = votes[lost].argmin(axis=1)  # where matter contradicts the fewest images
    blame = np.take_along_axis(cut[:, lost], best[None, :, None], axis=2)[..., 0].mean(axis=1)
    order = np.argsort(-blame, kind="stable")
    guilty = [chosen[k] for k in order if blame[k] >= _BLAMED] or [chosen[order[0]]]
    where = f"{capture.source}: {percent(lost.mean(), 1)} of the opaque pixels lie where the alpha of other images is 0"
    found = f"{where}, most often in {named(capture, sorted(guilty))}, so training finds no matter there"
    change = "the alpha of these images, or train with --config.scene.use_alpha=False"
    return [Finding("warning", "mask", found, "alpha that keeps the whole object", change, tuple(guilty))]


def _reduced(frame, size):
    """Returns a frame's camera for its matte."""
    camera = with_size(frame).camera
    scale = np.float32([size[1] / camera.width, size[0] / camera.height])
    focal, center = (np.float32(value) * scale for value in (camera.focal, camera.center))
    return dataclasses.replace(camera, focal=focal, center=center, height=None, width=None)


def _points(cameras, mattes, bounds):
    """Returns points [N, depths, 3] on rays through opaque pixels, whose neighbours are opaque, too."""
    rng, cast = np.random.default_rng(0), jax.jit(rays_from_pixels)
    steps = (np.arange(_DEPTHS) + 0.5) / _DEPTHS
    points = []
    for camera, matte, (near, far) in zip(cameras, mattes, bounds, strict=True):
        inside = cv2.erode(np.uint8(matte > 0.99), np.ones((3, 3), np.uint8), borderValue=0)
        places = np.argwhere(inside)
        if not len(places):
            continue
        pixels = rng.choice(places, _RAYS)[:, ::-1] + 0.5  # a fixed number, which is compiled once
        rays = cast(camera, np.float32(pixels), near=float(near), far=float(far))
        t = near + (far - near) * steps
        points.append(np.asarray(rays.origins)[:, None] + t[:, None] * np.asarray(rays.directions)[:, None])
    return np.concatenate(points) if points else np.zeros((0, _DEPTHS, 3))


def _cut_away(camera, matte, points) -> Bool[np.ndarray, "N D"]:
    """Returns which points [N, D, 3] a view shows where its alpha, and that around, is 0."""
    near = cv2.dilate(np.uint8(matte > 0), np.ones((2 * _MARGIN + 1,) * 2, np.uint8), borderValue=1)
    place, depth = (np.asarray(value) for value in _project(camera, np.float32(points)))
    height, width = matte.shape
    with np.errstate(invalid="ignore"):
        shown = (depth > 0) & (place >= 0).all(axis=-1) & (place < [width, height]).all(axis=-1)
    x, y = np.moveaxis(np.where(shown[..., None], place, 0).astype(int), -1, 0)
    return shown & (near[y, x] == 0)


_project = jax.jit(project)
