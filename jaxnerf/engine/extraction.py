"""A grid for a scene that was trained without one: where it is dense, and where anybody would see that."""

import jax
import jax.numpy as jnp
import numpy as np

from jaxnerf.core import occupancy
from jaxnerf.core.packing import needed_samples
from jaxnerf.engine.marching import samples_in_box

_AT_ONCE = 2**11  # rays
_INVISIBLE = 1 / 512  # half a step of 8 bits


def rays_to_look(space):
    """Returns how many rays visible_grid should have: some for each cell that a surface may have."""
    return -(-16 * max(space.shape) ** 2 // _AT_ONCE) * _AT_ONCE


def visible_grid(scene, space, rays, *, samples_at_once, background):
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
    bounds = (jnp.asarray(bound, jnp.float32) for bound in (space.lower, space.upper))
    options = {"threshold": space.threshold, "contracted": space.contracted}
    grid = occupancy.grid_of_scene(jax.random.key(0), scene, *bounds, space.shape, **options)
    clear = occupancy.without_fog(scene, grid, space.threshold)

    def look(marked, rays):
        samples = samples_in_box(None, grid, rays, step=space.step, cell=space.cell)
        options = {"error": _INVISIBLE, "capacity": samples_at_once, "background": background}
        needed = needed_samples(clear, grid, rays, samples, **options)
        return occupancy.mark_cells(marked, grid, rays, samples.t, needed), None

    parts = jax.tree.map(lambda leaf: leaf.reshape(-1, _AT_ONCE, *leaf.shape[1:]), rays)
    marked = jax.lax.scan(look, jnp.zeros(space.shape, bool), parts)[0]
    return occupancy.keep_cells(grid, marked)


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
    return occupancy.Grid(
        lower=jnp.float32(lower + first * cell),
        upper=jnp.float32(lower + end * cell),
        **{name: getattr(grid, name)[inside] for name in ("possible", "peak", "mean", "occupied")},
    )
