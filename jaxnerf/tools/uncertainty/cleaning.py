"""Renders a run without the cells in which it is uncertain, so that floaters go; see docs/guides/uncertainty.md."""

import dataclasses
import functools
import itertools
import os
import sys

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxnerf.core import contraction
from jaxnerf.core.occupancy.grid import OccupancyGrid
from jaxnerf.core.views import check_pixels
from jaxnerf.data.ray_batches import draw_batch
from jaxnerf.evaluation.restore import TrainedRun
from jaxnerf.options import is_auto
from jaxnerf.runtime import stages
from jaxnerf.tools.uncertainty.base import UncertaintySource
from jaxnerf.tools.uncertainty.one_at_a_time import one_at_a_time
from jaxnerf.tools.uncertainty.registration import ESTIMATORS

MAX_UNCERTAINTY = "max_uncertainty"  # in the settings of a run that is cleaned
ESTIMATOR = "laplace"  # whose estimate is a function of position
_LIMITS = (0.99, 0.97, 0.95, 0.9, 0.85, 0.8, 0.75, 0.7, 0.6, 0.5)  # that "auto" tries
_MOST_LOSS = 0.02  # dB, that "auto" may cost
_NUM_RAYS = 2**14  # by which "auto" measures it
_LEAST_ERROR = 1 / (12 * 255**2)  # mean square of rounding to 8 bits


def cleaned(run: TrainedRun, workdir: str | os.PathLike, limit: float | str | None) -> TrainedRun:
    """Returns a run whose occupancy grids lack the cells that are more uncertain than a limit.

    The estimate of a cell is that of its centre. It is computed when the variables of a checkpoint are read, from the
    grid that training left, and kept in <workdir>/uncertainty/STEP/. Only the content of the grid changes, so
    nothing is compiled that would not be without it. The uncertainty of a cell is how far the training images let it be
    displaced, over how far it could be without them.

    Args:
        run: as it is restored.
        workdir: the run's folder.
        limit: above 0; 1 is what a cell has without any image. "auto": as low as the PSNR of training rays, which
            it may lower by 0.02 dB, allows at each checkpoint; 1 or None: the run is returned as it is.

    Returns:
        The run. Its `variables` raise a ValueError if it renders without an occupancy grid.

    Raises:
        ValueError: on a limit that is out of range.
    """
    if limit is None or limit == 1:
        return run
    if not (is_auto(limit) or 0 < limit < 1):
        raise ValueError(f"max_uncertainty is {limit}, expected more than 0 and at most 1, or auto; correct it")

    @functools.lru_cache(maxsize=1)
    def variables(step):
        params, grid = run.variables(step)
        if grid is None:
            raise ValueError(
                f"max_uncertainty is {limit} and the run renders without an occupancy grid, whose cells it "
                "removes; give --bake_occupancy, or drop --max_uncertainty"
            )
        source = UncertaintySource.of(run, workdir, step, (params, grid), say=_say)
        # Not the lock of a predictor: one that reads the members of an ensemble holds that of the run itself.
        with one_at_a_time(source.folder / "cleaning.lock", lambda: _say("waits for another process")):
            estimate = ESTIMATORS.get(ESTIMATOR)(source)
        uncertainty = jax.jit(lambda planes: jax.lax.map(estimate.uncertainty_at, planes))(cell_centers(grid))
        used = _lowest_limit(source, uncertainty) if is_auto(limit) else limit
        if used == 1:
            _say("no limit leaves the PSNR of training rays as it is, and no cell is removed")
            return params, grid
        found = _without(grid, uncertainty > used)
        removed = 1 - float(found.occupied.sum()) / max(float(grid.occupied.sum()), 1)
        _say(f"{100 * removed:.1f} % of the occupied cells are more uncertain than {used:g}, and removed")
        return params, found

    return run._replace(variables=variables, settings={**run.settings, MAX_UNCERTAINTY: limit})


def _lowest_limit(source, uncertainty):
    """Returns the lowest of `_LIMITS` down to which none costs training rays more than _MOST_LOSS dB of PSNR; 1: none.

    Rays through masked pixels count, too.
    """
    check_pixels(source.views, "max_uncertainty='auto'")
    run, (params, grid) = source.run, source.variables
    given, positions = run.experiment.config.data, jnp.arange(_NUM_RAYS)
    options = {"pixel_offset": given.pixel_offset, "ndc": given.ndc, "needs": run.experiment.model.needs}
    draw = jax.jit(functools.partial(draw_batch, **options))
    batch = draw(np.uint32(0), jnp.int32(0), positions, dataclasses.replace(source.views, mask=None, sparse=None))[1]

    def error(grid):
        rgb = run.render_image((params, grid), batch.rays).rgb
        return float(((rgb - batch.rgb) ** 2).mean())

    most = max(error(grid), _LEAST_ERROR) * 10 ** (_MOST_LOSS / 10)
    with stages.stage("comparing limits of the uncertainty"):
        held = itertools.takewhile(lambda limit: error(_without(grid, uncertainty > limit)) <= most, _LIMITS)
        return min(held, default=1.0)


def _without(grid, removed):
    """Returns a grid whose removed cells [X, Y, Z] are empty."""
    occupied, valid = grid.occupied & ~removed, grid.valid & ~removed
    density_mean = jnp.where(occupied, grid.density_mean, -1)
    return dataclasses.replace(grid, valid=valid, occupied=occupied, density_mean=density_mean)


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
