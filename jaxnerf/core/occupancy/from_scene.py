"""A grid for a scene that was trained without one: where it is dense, and where anybody would see that."""

import jax
import jax.numpy as jnp
import numpy as np

from jaxnerf.core.occupancy.grid import (
    OccupancyGrid,
    drop_thin_density,
    grid_from_scene,
    keep_cells,
    mark_cells,
)
from jaxnerf.core.occupancy.packed import visible_samples
from jaxnerf.core.occupancy.ray_marching import march_rays

_AT_ONCE = 2**11  # rays
_INVISIBLE = 1 / 512  # half a step of 8 bits


def num_visibility_rays(schedule):
    """Returns how many rays visible_grid should have: some for each cell that a surface may have."""
    return -(-16 * max(schedule.shape) ** 2 // _AT_ONCE) * _AT_ONCE


def visible_grid(scene, schedule, rays, *, max_samples, background):
    """Returns the Grid of the cells of a Space where a scene is dense and that shows.

    Kept is what the rays need to differ by less than half a step of 8 bits, and what lies between two such
    cells. A network trained along whole rays has plenty of white fog before white, of fog thinner than the
    threshold before all that is dense, and of matter inside of things.

    Args:
        scene: see render_samples.
        space: Space.
        rays: Rays [N], a multiple of 2048: what the training views see.
        samples_at_once: samples in flight.
        background: see render_samples.
    """
    bounds = (jnp.asarray(bound, jnp.float32) for bound in (schedule.lower, schedule.upper))
    options = {"threshold": schedule.threshold, "contracted": schedule.contracted}
    grid = grid_from_scene(jax.random.key(0), scene, *bounds, schedule.shape, **options)
    clear = drop_thin_density(scene, grid, schedule.threshold)

    def look(marked, rays):
        samples = march_rays(None, grid, rays, step_size=schedule.step_size, cell=schedule.cell)
        options = {"error": _INVISIBLE, "max_samples": max_samples, "background": background}
        needed = visible_samples(clear, grid, rays, samples, **options)
        return mark_cells(marked, grid, rays, samples.t, needed), None

    parts = jax.tree.map(lambda leaf: leaf.reshape(-1, _AT_ONCE, *leaf.shape[1:]), rays)
    marked = jax.lax.scan(look, jnp.zeros(schedule.shape, bool), parts)[0]
    return keep_cells(grid, marked)


def crop_grid(grid):
    """Returns the Grid of the smallest box of cells that holds the occupied ones; all if it is contracted."""
    occupied = np.asarray(grid.occupied)
    if grid.contracted or not occupied.any():
        return grid
    places = np.argwhere(occupied)
    first, end = places.min(axis=0), places.max(axis=0) + 1
    lower, upper = np.asarray(grid.lower, np.float64), np.asarray(grid.upper, np.float64)
    cell = (upper - lower) / occupied.shape
    inside = tuple(slice(*ends) for ends in zip(first, end, strict=True))
    return OccupancyGrid(
        lower=jnp.float32(lower + first * cell),
        upper=jnp.float32(lower + end * cell),
        **{name: getattr(grid, name)[inside] for name in ("valid", "density_max", "density_mean", "occupied")},
    )
