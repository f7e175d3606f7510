"""Which pixels of a lens's image have a ray: beyond its reach, or where its model folds, there is none."""

import dataclasses
import functools
from collections.abc import Sequence

import jax
import numpy as np
from jaxtyping import Bool

from jaxnerf.core.cameras import rays_from_pixels
from jaxnerf.core.types import Camera
from jaxnerf.core.views import Views
from jaxnerf.runtime import cores

_CHUNK = 2**12  # pixels that are tested at a time
_TILES = 32  # along each side of an image
_SIDE = 64  # points along each side that stand for the pixels


def pixels_with_rays(cameras: Sequence[Camera]) -> list[Bool[np.ndarray, "H W"] | None]:
    """Returns for each camera, which has a height and width, which pixels have a ray through their centre; None: all.

    What a lens shows is taken to have no holes and no details finer than a tile, whose corners are tested first.
    """
    return _of_lenses(cameras, _with_rays, None)


def fractions_of_pixels(cameras: Sequence[Camera]) -> tuple[float, float]:
    """Returns which fraction of the pixels of cameras has no ray, and which one 90 degrees or more from the axis."""
    return tuple(np.mean(_of_lenses(cameras, _fractions, (0.0, 0.0)), axis=0).tolist())


def rays_line(cameras: Sequence[Camera]) -> str:
    """Returns the `fractions_of_pixels` in words; "" if both are 0."""
    without, beside = fractions_of_pixels(cameras)
    found = f"{100 * without:.2g} % of the pixels have no ray: the lens sees in no direction there; they are masked"
    sideways = f"{100 * beside:.2g} % of the pixels are 90 degrees or more from the axis"
    return "; ".join([found] * (without > 0) + [sideways] * (beside > 0))


def sees_sideways(views: Views) -> bool:
    """Returns whether any view shows what is 90 degrees or more from its camera's axis."""
    sizes = np.asarray(views.size).tolist() if views.cameras.lens == "fisheye" else []
    sized = [dataclasses.replace(views.camera(index), height=h, width=w) for index, (h, w) in enumerate(sizes)]
    return bool(sized) and fractions_of_pixels(sized)[1] > 0


def _of_lenses(cameras, function, pinhole):
    """Returns function(lens, height, width) for each camera, called once for equal ones; pinhole without a lens."""
    lenses, keys = {}, []
    for camera in cameras:
        arrays = {name: np.float32(getattr(camera, name)) for name in ("focal", "center", "distortion")}
        size = camera.height, camera.width
        keys.append((camera.lens, *size, *(each.tobytes() for each in arrays.values())))
        if camera.distortion is not None:
            # In float32, as in training, and without size and pose, so that few are compiled.
            lens = Camera(to_world=np.eye(3, 4, dtype=np.float32), **arrays, lens=camera.lens)
            lenses[keys[-1]] = lens, *size
    values = cores.map_on_cores(lambda arguments: function(*arguments), lenses.values(), compiles=True)
    found = dict(zip(lenses, values, strict=True))
    return [found.get(key, pinhole) for key in keys]


def _with_rays(lens, height, width):
    columns, rows = (np.unique(np.linspace(0, side - 1, _TILES + 1).astype(int)) for side in (width, height))
    found = _exist(lens, np.stack(np.meshgrid(columns, rows), axis=-1) + 0.5)[0]
    if found.all():
        return None
    # The border of what a lens shows is only looked for in tiles between corners that differ.
    wide = np.pad(found, ((0, 1), (0, 1)), mode="edge")
    four = np.stack([wide[:-1, :-1], wide[:-1, 1:], wide[1:, :-1], wide[1:, 1:]])
    sides = np.diff(rows, append=height), np.diff(columns, append=width)
    mask, unknown = (each.repeat(sides[0], 0).repeat(sides[1], 1) for each in (four.all(0), four.any(0) & ~four.all(0)))
    mask[unknown] = _exist(lens, np.argwhere(unknown)[:, ::-1] + 0.5)[0]
    return mask


def _fractions(lens, height, width):
    places = np.stack(np.meshgrid(*[(np.arange(_SIDE) + 0.5) / _SIDE] * 2), axis=-1)
    exist, beside = _exist(lens, places * [width, height])
    return 1 - float(exist.mean()), float(beside.mean())


def _exist(lens, pixels):
    """Returns which pixels [..., 2] have a ray, and which of these one at 90 degrees or more from the axis."""
    flat, parts = np.float32(pixels).reshape(-1, 2), []
    for start in range(0, len(flat), _CHUNK):
        index = np.minimum(np.arange(start, start + _CHUNK), len(flat) - 1)  # a single compiled shape
        rays = _rays(lens, flat[index])
        exist = np.asarray(rays.far) > 0
        parts.append([exist, exist & (np.asarray(rays.directions)[:, 2] >= 0)])
    return np.concatenate(parts, axis=1)[:, : len(flat)].reshape(2, *pixels.shape[:-1])


_rays = jax.jit(functools.partial(rays_from_pixels, near=0.0, far=1.0))
