"""Renders a run without the cells in which it is uncertain, so that floaters go; see docs/guides/uncertainty.md."""

import dataclasses
import functools
import os
import sys

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxnerf.core import contraction
from jaxnerf.core.occupancy.grid import OccupancyGrid
from jaxnerf.evaluation.trained_run import TrainedRun
from jaxnerf.evaluation.uncertainty.base import UncertaintySource
from jaxnerf.registry import ESTIMATORS
from jaxnerf.runtime import atomic_files

ESTIMATOR = "laplace"  # whose estimate is a function of position


def cleaned(run: TrainedRun, workdir: str | os.PathLike) -> TrainedRun:
    """Returns a run whose occupancy grids lack the cells that are more uncertain than `eval.max_uncertainty`.

    The estimate of a cell is that of its centre. It is computed when the variables of a checkpoint are read, from the
    grid that training left, and kept in <workdir>/uncertainty/STEP/. Only the content of the grid changes, so
    nothing is compiled that would not be without it. With a limit of 1 the run is returned as it is.

    Args:
        run: as it is restored.
        workdir: the run's folder.

    Returns:
        The run. Its `variables` raise a ValueError if it renders without an occupancy grid.
    """
    limit = run.experiment.config.eval.max_uncertainty
    if limit >= 1:
        return run

    @functools.lru_cache(maxsize=1)
    def variables(step):
        params, grid = run.variables(step)
        if grid is None:
            raise ValueError(
                f"eval.max_uncertainty is {limit:g} and the run renders without an occupancy grid, whose cells it "
                "removes; give --bake_occupancy, or drop --max_uncertainty"
            )
        source = UncertaintySource.of(run, workdir, step, (params, grid), say=_say)
        # Not the lock of a predictor: one that reads the members of an ensemble holds that of the run itself.
        with atomic_files.one_at_a_time(source.folder / "cleaning.lock", lambda: _say("waits for another process")):
            estimate = ESTIMATORS.get(ESTIMATOR)(source)
        places = cell_centers(grid)
        uncertain = jax.jit(lambda planes: jax.lax.map(estimate.uncertainty_at, planes))(places) > limit
        occupied = grid.occupied & ~uncertain
        removed = 1 - float(occupied.sum()) / max(float(grid.occupied.sum()), 1)
        _say(f"{100 * removed:.1f} % of the occupied cells are more uncertain than {limit:g}, and removed")
        density_mean = jnp.where(occupied, grid.density_mean, -1)
        grid = dataclasses.replace(grid, valid=grid.valid & ~uncertain, occupied=occupied, density_mean=density_mean)
        return params, grid

    return run._replace(variables=variables)


def cell_centers(grid: OccupancyGrid) -> Float[Array, "X Y Z 3"]:
    """Returns the positions of the centres of a grid's cells, world units."""
    along = [(jnp.arange(count) + 0.5) / count for count in grid.occupied.shape]
    place = jnp.stack(jnp.meshgrid(*along, indexing="ij"), axis=-1)
    if grid.contracted:
        place = (contraction.expand(4 * place - 2) + 2) / 4
    lower, upper = (corner.reshape(1, 1, 1, 3) for corner in (grid.lower, grid.upper))
    return lower + place * (upper - lower)


def _say(line):
    print(f"cleaning      {line}", file=sys.stderr, flush=True)
