"""The cells of an occupancy grid that the training cameras see, and those that they see through."""

import dataclasses
from collections.abc import Iterator

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool

from jaxnerf.core.occupancy.grid import OccupancyGrid, cells_along, create_grid, widen
from jaxnerf.core.occupancy.ray_marching import march_rays
from jaxnerf.core.sampling import samples_from_edges, uniform_edges
from jaxnerf.core.types import Rays, Views
from jaxnerf.data.geometry.free_space import surface_range
from jaxnerf.data.ray_batches import view_rays
from jaxnerf.models.grid_schedule import GridSchedule

_CHUNK = 2**13  # rays
_COARSE = 4  # cells of the grid along a side of a cell that is tested for being seen
_FREE_SAMPLES = 16  # between a camera and the depth up to which the space in front of it is free


def seen_cells(
    views: Views, schedule: GridSchedule, *, min_views: int, ndc: bool = False, pixel_offset: float = 0.5
) -> Bool[np.ndarray, "X Y Z"]:
    """Returns the cells that at least min_views views see between near and far; nothing is known about the others.

    Rays mark the cells of a grid that is a quarter as fine, and their neighbours count as seen, too. This is nerfacc's
    `mark_invisible_cells` with lenses, masks and contracted space.

    Args:
        views: of the split that is trained on.
        schedule: of the box.
        min_views: at least 1.
        ndc, pixel_offset: see `draw_batch`.
    """
    shape = tuple(-(-size // _COARSE) for size in schedule.shape)
    grid = _grid(schedule, shape)
    cell = tuple(size * fine / coarse for size, fine, coarse in zip(schedule.cell, schedule.shape, shape, strict=True))

    @jax.jit
    def cells_on_rays(rays):
        return cells_along(grid, rays, march_rays(None, grid, rays, step_size=min(cell), cell=cell))

    num_views = np.zeros(shape, np.int32)
    for view in range(len(views.offset)):
        marked = np.zeros(grid.valid.size + 1, bool)
        for _, rays in _rays_of(views, view, 2 * max(shape), ndc, pixel_offset):
            marked[np.asarray(cells_on_rays(rays))] = True
        num_views += np.asarray(widen(marked[:-1].reshape(shape)))
    seen = num_views >= min_views
    for axis, (fine, coarse) in enumerate(zip(schedule.shape, shape, strict=True)):
        seen = seen.take(np.arange(fine) * coarse // fine, axis=axis)
    return seen


def free_cells(
    views: Views, schedule: GridSchedule, *, min_views: int = 2, pixel_offset: float = 0.5
) -> tuple[Bool[np.ndarray, "X Y Z"], Bool[np.ndarray, "X Y Z"]]:
    """Returns the cells that are free, and those that are likely to be empty.

    Args:
        views: of the split that is trained on.
        schedule: of the box.
        min_views: number of views that must tell that a cell is in front of what they show.
        pixel_offset: see `draw_batch`.

    Returns:
        The cells in front of `Views.free_until` of min_views views; and those in front of the surfaces that min_views
        views see, or where no view sees a surface, as far as `surface_range` tells.
    """
    grid = _grid(schedule, schedule.shape)

    @jax.jit
    def cells_between(rays, near, far):
        edges = uniform_edges(rays.near, jnp.maximum(rays.near, near), num_segments=_FREE_SAMPLES)
        rays = dataclasses.replace(rays, near=jnp.maximum(rays.near, near), far=jnp.clip(far, rays.near, rays.far))
        samples = march_rays(None, grid, rays, step_size=min(schedule.cell), cell=schedule.cell)
        return cells_along(grid, rays, samples_from_edges(None, edges)), cells_along(grid, rays, samples)

    surface = np.zeros(grid.valid.size + 1, bool)
    num_free, num_in_front = np.zeros((2, surface.size), np.int32)
    for view in range(len(views.offset)):
        free, in_front = np.zeros((2, surface.size), bool)
        for pixels, rays in _rays_of(views, view, max(schedule.shape) // 2, False, pixel_offset):
            near, far = surface_range(views, view, pixels)
            before, between = cells_between(rays, near, far)
            in_front[np.asarray(before)] = surface[np.asarray(between)] = True
            if views.free_until is not None:
                near = np.full_like(near, views.free_until[view])
                free[np.asarray(cells_between(rays, near, near)[0])] = True
        num_free += free
        num_in_front += in_front
    surface, free, in_front = (
        cells[:-1].reshape(schedule.shape) for cells in (surface, num_free >= min_views, num_in_front >= min_views)
    )
    return free, ~np.asarray(widen(surface)) | in_front


def _grid(schedule: GridSchedule, shape: tuple[int, int, int]) -> OccupancyGrid:
    lower, upper = (jnp.asarray(bound, jnp.float32) for bound in (schedule.lower, schedule.upper))
    return create_grid(lower, upper, np.ones(shape, bool), initial_density=0.0, contracted=schedule.contracted)


def _rays_of(views: Views, view: int, number: int, ndc: bool, pixel_offset: float) -> Iterator[tuple[np.ndarray, Rays]]:
    """Yields pixels and Rays [_CHUNK], about number x number unmasked pixels of a view; the last are repeated."""
    cameras = dataclasses.replace(views, pixels=np.zeros((1, 1), np.uint8), mask=None, sparse=None)
    height, width = np.asarray(views.size)[view]
    side = max(int(np.sqrt(height * width) / number), 1)
    y, x = (places.reshape(-1) for places in np.mgrid[side // 2 : height : side, side // 2 : width : side])
    if views.mask is not None:
        first = views.offset[view]
        unmasked = np.asarray(views.mask[first : first + height * width]).reshape(height, width)[y, x]
        y, x = y[unmasked], x[unmasked]
    for start in range(0, y.size, _CHUNK):
        index = np.minimum(np.arange(start, start + _CHUNK), y.size - 1)  # a single compiled shape
        pixels = (np.stack([x[index], y[index]], axis=-1) + pixel_offset).astype(np.float32)
        yield pixels, _view_rays(cameras, view, pixels, ndc)


_view_rays = jax.jit(lambda views, view, pixels, ndc: view_rays(views, view, pixels, ndc=ndc), static_argnums=3)
