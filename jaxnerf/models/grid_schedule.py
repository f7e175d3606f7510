"""The box of a scene, and what training finds to be empty in it."""

import functools
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxnerf.core.occupancy.grid import OccupancyGrid, create_grid, update_grid

_CHUNK = 8160  # cells asked at once: their activations stay in a processor's cache, and do not collide there


class GridSchedule(NamedTuple):
    """The box of a model that asks only where there is something, and how that is kept up to date."""

    lower: tuple[float, float, float]  # world units
    upper: tuple[float, float, float]
    shape: tuple[int, int, int]  # cells
    step_size: float  # world units between samples
    threshold: float | np.ndarray  # 1 / world unit, the density below which a cell is empty; or of each
    create: Callable[..., OccupancyGrid]  # possible [X, Y, Z] bool -> Grid
    update: Callable[..., OccupancyGrid]  # (key, step, params, Grid, cells [L] int32) -> Grid
    contracted: bool = False  # see Grid

    @property
    def cell(self):
        """The size of a cell [3], world units."""
        sides = zip(self.lower, self.upper, self.shape, strict=True)
        return tuple((high - low) / count for low, high, count in sides)


def make_grid_schedule(
    lower,
    upper,
    *,
    resolution,
    step_size,
    field,
    threshold,
    update_every,
    cells_per_update,
    contracted=False,
    initial_passes=8,
):
    """Returns the Space of a box.

    Args:
        lower, upper: [3] world units.
        resolution: cells along the longest side; along the others so many that they are cubes.
        step_size: world units between samples, where space is plain.
        field: Field; its density under params["fine"] is what counts. None where there are no updates.
        threshold: the share of light absorbed in a step below which a cell is empty.
        update_every: steps between two looks.
        look_at_once: cells a look. Where there are more, looks at the start come more often, until all cells
            have been seen passes_from_start times; and that long neighbours of dense cells count, too.
        contracted: whether the box holds all of space, see Grid.
    """
    if threshold <= 0 or step_size <= 0:
        raise ValueError(
            f"occupancy.threshold is {threshold} and occupancy.step_size {step_size}, expected both above 0"
        )
    sides = [high - low for low, high in zip(lower, upper, strict=True)]
    shape = tuple(max(round(side / max(sides) * resolution), 1) for side in sides)
    density = threshold / step_size
    empty_below = density / _stretches(shape) if contracted else density

    def create(valid):
        # What is not looked at yet counts as ten times the threshold: half a dozen looks empty a cell.
        return create_grid(
            jnp.asarray(lower, jnp.float32),
            jnp.asarray(upper, jnp.float32),
            valid,
            initial_density=10 * density,
            contracted=contracted,
        )

    def update(key, step, params, grid, cells):
        if cells.size == 0:
            return grid
        looks = -(-cells.size // cells_per_update)  # that see all cells
        count = -(-cells.size // looks)
        often = max(update_every // looks, 1)
        young = step < initial_passes * update_every
        interval = jnp.where(young, often, update_every)
        look = jnp.where(young, step // often, step // update_every)

        def looked():
            # Whole chunks, as a rest of another size would be compiled too.
            place = jnp.arange(count + (-count % _CHUNK if count > _CHUNK else 0))
            index = look % looks * count + place
            beyond = (place >= count) | (index >= cells.size)
            chosen = jnp.where(beyond, grid.valid.size, cells[jnp.minimum(index, cells.size - 1)])
            return update_grid(
                key,
                grid,
                functools.partial(field.apply, params["fine"]),
                chosen,
                threshold=empty_below,
                spread=young,
                chunk=_CHUNK,
            )

        return jax.lax.cond(step % interval == interval - 1, looked, lambda: grid)

    return GridSchedule(tuple(lower), tuple(upper), shape, step_size, empty_below, create, update, contracted)


def _stretches(shape):
    """Returns [X, Y, Z], how much longer than where space is plain the steps across contracted cells are."""
    along = [np.abs(4 * (np.arange(size) + 0.5) / size - 2) for size in shape]
    largest = np.max(np.meshgrid(*along, indexing="ij"), axis=0)
    return np.float32(1 / np.minimum(2 - largest, 1) ** 2)
