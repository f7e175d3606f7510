"""The occupancy grid of a scene that was trained without one: the cells that are dense and visible."""

import jax
import jax.numpy as jnp
from jax.typing import ArrayLike

from jaxnerf.core.occupancy.grid import (
    OccupancyGrid,
    drop_thin_density,
    grid_from_scene,
    keep_cells,
    mark_cells,
)
from jaxnerf.core.occupancy.packed import visible_samples
from jaxnerf.core.occupancy.ray_marching import march_rays
from jaxnerf.core.scene import needs_of
from jaxnerf.core.types import Background, Rays, SceneFn, Vector
from jaxnerf.core.varying import vary_like

_CHUNK = 2**11  # rays
_NUM_TIMES = 32  # at which the density of a scene that moves is evaluated in each cell
_MAX_ERROR = 1 / 512  # of a colour: half a step of 8 bits


def num_visibility_rays(shape: tuple[int, int, int]) -> int:
    """Returns how many rays visible_grid needs for a grid of a shape, so that several hit each cell on a surface."""
    return -(-16 * max(shape) ** 2 // _CHUNK) * _CHUNK


def visible_grid(
    scene: SceneFn,
    rays: Rays,
    *,
    lower: Vector,
    upper: Vector,
    shape: tuple[int, int, int],
    step_size: float,
    threshold: ArrayLike,
    contracted: bool = False,
    max_samples: int,
    background: Background | None = None,
) -> OccupancyGrid:
    """Creates the grid of the cells of a box in which a scene is dense and visible.

    A cell is occupied if the rays need it for colours within half a step of 8 bits, or if it lies between two
    such cells. A network that was trained along whole rays has white fog in front of white surfaces, fog thinner
    than the threshold in front of everything dense, and matter inside objects; none of these is kept. In a scene that
    asks for time, a cell is dense if it is at one of 32 random times, and visible at the times of the rays.

    Args:
        scene: see render_samples.
        rays: Rays [N] of the training views; N is a multiple of 2048.
        lower, upper: [3] world units, the box.
        shape: cells along x, y and z.
        step_size: world units between samples.
        threshold, contracted: see grid_from_scene.
        max_samples: samples evaluated at once.
        background: see render_samples.
    """
    bounds = (jnp.asarray(bound, jnp.float32) for bound in (lower, upper))
    options = {"threshold": threshold, "contracted": contracted}
    if "time" in needs_of(scene):
        options["num_updates"] = _NUM_TIMES
    grid = grid_from_scene(jax.random.key(0), scene, *bounds, shape, **options)
    dense = drop_thin_density(scene, grid, threshold)
    cell = tuple((high - low) / count for low, high, count in zip(lower, upper, shape, strict=True))

    def mark(marked, rays):
        samples = march_rays(None, grid, rays, step_size=step_size, cell=cell)
        options = {"error": _MAX_ERROR, "max_samples": max_samples, "background": background}
        needed = visible_samples(dense, grid, rays, samples, **options)
        return mark_cells(marked, grid, rays, samples.t, needed), None

    parts = jax.tree.map(lambda leaf: leaf.reshape(-1, _CHUNK, *leaf.shape[1:]), rays)
    marked = vary_like(jnp.zeros(shape, bool), grid, rays)
    marked = jax.lax.scan(mark, marked, parts)[0]
    return keep_cells(grid, marked)


def crop_grid(grid: OccupancyGrid) -> OccupancyGrid:
    """Returns the grid of the smallest box that holds the occupied cells; the same grid if it is contracted."""
    occupied, lower, upper = jax.device_get((grid.occupied, grid.lower, grid.upper))
    if grid.contracted or not occupied.any():
        return grid
    first, end = zip(*((index.min(), index.max() + 1) for index in occupied.nonzero()), strict=True)
    lower = lower.astype("float64")
    cell = (upper - lower) / occupied.shape
    inside = tuple(slice(*ends) for ends in zip(first, end, strict=True))
    return OccupancyGrid(
        lower=jnp.float32(lower + first * cell),
        upper=jnp.float32(lower + end * cell),
        **{name: getattr(grid, name)[inside] for name in ("valid", "density_max", "density_mean", "occupied")},
    )
