"""Several rays a pixel where a pixel covers more of the scene than a ray of training: in small images, and from afar.

A field that is trained on pixels of one size knows the colours along their rays. One ray through the centre of a
larger pixel shows a point of what the pixel should average; rays as dense as those of training show all of it.
"""

import dataclasses
import functools
import math
import os
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float, Int, Num

from jaxnerf.core.types import Rendering
from jaxnerf.core.views import Views
from jaxnerf.data.facts import LookAt
from jaxnerf.evaluation.restore import TrainedRun, refined_views
from jaxnerf.training.stored_cameras import training_views

MAX_RAYS = 16  # per pixel: at an eighth of the size of training they are a quarter of the rays of a full image
_SMALLER = 0.9  # times the pixels of the smallest training image
_RAYS_PER_CALL = 2**20  # a small image's are rendered together, as a chunk is mostly empty otherwise


class Footprint(NamedTuple):
    """What pixels of the training images cover.

    Attributes:
        focal: px, of the images; the median.
        center: [3] world units, what the cameras look at.
        distance: world units, of the farthest camera from it; infinite in normalised device coordinates.
        covered: the side of what a ray of training stands for, over that of the usual pixel; where the field knows the
            size of its samples, of the largest pixels but for outliers.
    """

    focal: float
    center: Float[np.ndarray, "3"]
    distance: float
    covered: float

    def rays_per_side(
        self, poses: Float[np.ndarray, "N 3 4"], focal: Float[np.ndarray, "N 2"], *, max_rays: int = MAX_RAYS
    ) -> Int[np.ndarray, " N"]:
        """Computes how many rays along each side of a pixel are as dense as those of training.

        A frame closer than the farthest training camera counts as being there, as training has seen such footprints.

        Args:
            poses: [N, 3, 4] of the frames, in the run's world.
            focal: [N, 2] px.
            max_rays: per pixel, at least 1.

        Returns:
            [N] at least 1, at most the root of max_rays.
        """
        away = np.linalg.norm(np.asarray(poses, np.float64)[:, :, 3] - self.center, axis=1)
        sides = self.focal / _mean_focal(focal) * np.maximum(away / self.distance, 1) / self.covered
        return np.clip(np.rint(sides), 1, math.isqrt(max_rays)).astype(int)


def trained_footprint(run: Any, views: Views) -> Footprint:
    """Returns the Footprint of the training images of a TrainedRun; no pixels of the Views are read."""
    config, look_at = run.experiment.config, LookAt(views)
    sized = "radius" in run.experiment.model.needs  # the field knows the size of its sample
    per_ray = 1 / config.train.rays_per_side  # of a pixel's side
    focal = _mean_focal(views.cameras.focal)
    usual = float(np.median(focal))
    return Footprint(
        focal=usual,
        center=look_at.center,
        distance=math.inf if config.data.ndc else float(look_at.distance.max()),
        covered=per_ray * usual / float(np.quantile(focal, 0.05)) if sized else per_ray,
    )


def training_cameras(run: TrainedRun, workdir: str | os.PathLike, params: Any) -> Views:
    """Returns the Views that a run was trained on, with refined cameras, also if it now has another --data_dir."""
    read = functools.partial(run.experiment.load_split, "train", images=False)
    return refined_views(run, training_views(workdir, read), "train", params)


def rays_per_side_of_views(run: TrainedRun, views: Views, trained: Views) -> Int[np.ndarray, " V"]:
    """Returns how many rays along each side of a pixel score views: those of training, as published protocols have.

    Images that are smaller than all of training have as many as frames of a camera path.

    Args:
        run: TrainedRun.
        views: that are scored.
        trained: see `training_cameras`.
    """
    own, (size, least) = run.experiment.config.train.rays_per_side, (np.prod(each.size, 1) for each in (views, trained))
    sides = trained_footprint(run, trained).rays_per_side(views.cameras.to_world, views.cameras.focal)
    return np.where(size < _SMALLER * least.min(), np.maximum(sides, own), own)


def render_pixels(
    run: TrainedRun,
    variables: Any,
    views: Views,
    index: int,
    pixels: Num[ArrayLike, "H W 2"],
    *,
    side: int | None = None,
    size: float = 1.0,
) -> tuple[Rendering, Float[Array, "H W"]]:
    """Renders pixels of a view, each as the mean over side x side rays on a regular grid.

    Args:
        run: TrainedRun.
        variables: of a checkpoint.
        views: with the camera.
        index: of the view.
        pixels: [H, W, 2] px of the view's camera, the middle of each pixel.
        side: rays along a side of a pixel; None: as many as in training.
        size: px of the view's camera, the side of a pixel.

    Returns:
        Rendering [H, W], and the mean distance [H, W] in the units of the dataset's files, see `world_depth`.
    """
    experiment, pixels = run.experiment, np.asarray(pixels)
    side = side or experiment.config.train.rays_per_side
    places = (np.arange(side) + 0.5) / side - 0.5
    offsets = np.float32(size * np.stack(np.meshgrid(places, places, indexing="xy"), axis=-1).reshape(-1, 1, 1, 2))
    fitting = [each for each in (side**2, side) if each * pixels[..., 0].size <= _RAYS_PER_CALL]
    per_call, total = (fitting or [1])[0], None
    for start in range(0, len(offsets), per_call):
        at = pixels + offsets[start : start + per_call]
        rays = experiment.view_rays(views, index, at)
        if rays.radius is not None:
            rays = dataclasses.replace(rays, radius=rays.radius * (size / side))
        image = run.render_image(variables, rays)
        part = image, experiment.world_depth(views, index, at, image.depth)
        part = jax.tree.map(lambda plane: plane.sum(axis=0), part)
        total = part if total is None else jax.tree.map(jnp.add, total, part)
    return jax.tree.map(lambda plane: plane / side**2, total)


def _mean_focal(focal):
    """Returns the geometric mean of the focal lengths [N, 2] along x and y."""
    return np.sqrt(np.prod(np.asarray(focal, np.float64), axis=-1))
