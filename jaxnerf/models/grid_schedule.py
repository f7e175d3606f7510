"""The occupancy grid of a model: its box, and when training updates which cells."""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxnerf.core.loops import is_cpu
from jaxnerf.core.occupancy.grid import NUM_TIMES, OccupancyGrid, create_grid, update_grid
from jaxnerf.core.scene import needs_of
from jaxnerf.fields.base import Field, field_scene

_FEWEST_UPDATES = 5  # that empty a cell which is ten times as dense as the threshold

Corner = tuple[float, float, float]


class InitialCells(NamedTuple):
    """What is known of the cells of a grid before training.

    Attributes:
        valid: [X, Y, Z] bool, the cells that may hold matter.
        empty: [X, Y, Z] bool, those that are likely to be empty: they become occupied once an update finds matter in
            them; None: nothing is known.
    """

    valid: Any
    empty: Any = None


class GridSchedule(NamedTuple):
    """The box of a model with an occupancy grid, and how the grid is kept up to date.

    Attributes:
        lower, upper: [3] world units, the box.
        shape: cells along x, y and z.
        step_size: world units between samples.
        min_opacity: of one step, below which a cell is empty.
        create: (valid, empty=None) -> OccupancyGrid, see InitialCells.
        update: (key, step, params, OccupancyGrid, cells [L] int32, radii=None) -> OccupancyGrid, see `update_grid`.
        contracted: see OccupancyGrid.
        min_views: training views that must see a valid cell; 0: no limit.
    """

    lower: Corner
    upper: Corner
    shape: tuple[int, int, int]
    step_size: float
    min_opacity: float
    create: Callable[..., OccupancyGrid]
    update: Callable[..., OccupancyGrid]
    contracted: bool = False
    min_views: int = 0

    @property
    def cell(self) -> Corner:
        """The size of a cell [3], world units."""
        sides = zip(self.lower, self.upper, self.shape, strict=True)
        return tuple((high - low) / count for low, high, count in sides)

    @property
    def threshold(self) -> float | np.ndarray:
        """The density below which a cell is empty, 1 / world unit, or that of each cell [X, Y, Z]."""
        parts = [self.min_opacity / part for part in _spacings(self.step_size, self.shape, self.contracted)]
        return functools.reduce(np.minimum, parts)

    def box(self) -> dict[str, Any]:
        """Returns the arguments with which `visible_grid` creates a grid of the same box."""
        names = ("lower", "upper", "shape", "step_size", "threshold", "contracted")
        return {name: getattr(self, name) for name in names}


def make_grid_schedule(
    lower: Corner,
    upper: Corner,
    *,
    resolution: int,
    step_size: float,
    field: Field | None,
    threshold: float,
    update_every: int,
    contracted: bool = False,
    min_views: int = 0,
    cells_per_update: int = 2**18,
    initial_passes: int = 8,
    update_chunk: int | None = None,
) -> GridSchedule:
    """Makes the GridSchedule of a box.

    Args:
        lower, upper: [3] world units.
        resolution: cells along the longest side; the numbers along the other sides make them cubes.
        step_size: world units between samples, where space is not contracted.
        field: Field whose density with params["fine"] updates the grid. None if the grid is never updated.
        threshold: opacity of one step below which a cell is empty.
        update_every: training steps between updates.
        contracted: whether the box holds all of space, see OccupancyGrid.
        min_views: see GridSchedule.
        cells_per_update: cells in one update. If there are more cells, updates are more frequent at first, until each
            cell has been updated initial_passes times; until then neighbours of dense cells are occupied, too.
        initial_passes: see cells_per_update.
        update_chunk: cells of an update that are evaluated at once; None: as many as suit the device.

    Raises:
        ValueError: if threshold or step_size is not above 0.
    """
    if threshold <= 0 or step_size <= 0:
        raise ValueError(
            f"occupancy.threshold is {threshold} and occupancy.step_size {step_size}, expected both above 0"
        )
    if update_chunk is None:
        # On a CPU a little under a power of two, so that activations do not collide in the cache.
        update_chunk = 8160 if is_cpu() else 2**18
    sides = [high - low for low, high in zip(lower, upper, strict=True)]
    shape = tuple(max(round(side / max(sides) * resolution), 1) for side in sides)
    density, spacings = threshold / step_size, _spacings(step_size, shape, contracted)

    def create(valid, empty=None):
        # A cell starts at ten times the threshold, so about half a dozen updates empty it.
        initial = 10 * density if empty is None else jnp.where(jnp.asarray(empty), 0, 10 * density)
        return create_grid(
            jnp.asarray(lower, jnp.float32),
            jnp.asarray(upper, jnp.float32),
            valid,
            initial_density=initial,
            contracted=contracted,
        )

    def update(key, step, params, grid, cells, radii=None):
        if cells.size == 0:
            return grid
        rounds = -(-cells.size // cells_per_update)  # updates that visit all cells
        count = -(-cells.size // rounds)
        often = max(update_every // rounds, 1)
        young = step < initial_passes * update_every
        interval = jnp.where(young, often, update_every)
        num_updates = jnp.where(young, step // often, step // update_every)
        first = initial_passes * update_every // often // rounds  # of later updates of a cell
        later = first + (step // update_every - initial_passes) // rounds
        visits, decay = jnp.where(young, step // often // rounds, later), {}
        if "time" in needs_of(field.apply):
            # What was ten times as dense as the threshold stays occupied for as many updates of the cell as there are
            # times; at first for half as many as there have been, as the fog of early steps would stay, too.
            decay["decay"] = 10 ** (-1 / jnp.clip(visits / 2, _FEWEST_UPDATES, NUM_TIMES + 1))

        def updated():
            # Whole chunks, as a remainder of another size would have to be compiled, too.
            place = jnp.arange(count + (-count % update_chunk if count > update_chunk else 0))
            index = num_updates % rounds * count + place
            beyond = (place >= count) | (index >= cells.size)
            chosen = jnp.where(beyond, grid.valid.size, cells[jnp.minimum(index, cells.size - 1)])
            return update_grid(
                key,
                grid,
                field_scene(field, params),
                chosen,
                threshold=functools.reduce(jnp.minimum, [threshold / part for part in spacings]),
                spacing=functools.reduce(jnp.maximum, spacings),
                spread=young,
                chunk=update_chunk,
                radii=radii,
                index=visits,
                **decay,
            )

        return jax.lax.cond(step % interval == interval - 1, updated, lambda: grid)

    return GridSchedule(tuple(lower), tuple(upper), shape, step_size, threshold, create, update, contracted, min_views)


def _spacings(step_size, shape, contracted):
    """Returns [X, 1, 1], [1, Y, 1] and [1, 1, Z], whose largest is the spacing of samples in a cell; or one number.

    As one array for all cells it would be a constant of the training step, of which the compiler makes many copies.
    """
    if not contracted:
        return [step_size]
    along = [np.abs(4 * (np.arange(size) + 0.5) / size - 2) for size in shape]
    return np.ix_(*(step_size * np.float32(1 / np.minimum(2 - each, 1) ** 2) for each in along))
