"""What training changes: arrays only, everything that a bit-exact resume needs."""

from typing import Any

import jax
import jax.numpy as jnp
import optax

from jaxnerf.core.occupancy.grid import OccupancyGrid
from jaxnerf.core.types import pytree
from jaxnerf.models.base import Model
from jaxnerf.models.grid_schedule import InitialCells

PROGRESS = "progress"  # the entry of the counters, and of the parameters that a model's functions receive


@pytree()
class TrainState:
    """The state of a run; functions stay outside it.

    Attributes:
        step: int32 [], steps taken.
        params: network name -> its parameters, float32; and "cameras" -> those of the training images, if any.
        opt_state: of the optax optimizer.
        grid: OccupancyGrid; None where the model has none.
        counters: name -> int32 [], see `make_train_step`; and where the model asks for it "progress" -> float32 [],
            the fraction of training that is done.
    """

    step: jax.Array
    params: Any
    opt_state: Any
    grid: OccupancyGrid | None
    counters: dict[str, jax.Array]


def create_state(
    model: Model, optimizer: optax.GradientTransformation, seed: jax.typing.ArrayLike, cells: InitialCells | None = None
) -> TrainState:
    """Creates the TrainState at step 0, the same for the same seed.

    Args:
        model: see `Model`.
        optimizer: an optax gradient transformation.
        seed: int [], of the initial parameters.
        cells: of the grid; None: nothing is known of them. Ignored without a grid.
    """
    if model.grid_schedule is not None and cells is None:
        cells = _all_cells(model)

    @jax.jit  # op by op, initialization would take longer than its compilation
    def create(key, cells):
        params, grid = _create(model, key, cells)
        names = ["nonfinite", "nonfinite_in_a_row", "num_reinits", *(f"dead_{name}" for name in model.image_networks)]
        names += [] if grid is None else ["rays_dropped"]
        zero = jnp.zeros((), jnp.int32)
        counters = dict.fromkeys(names, zero)
        if PROGRESS in model.needs:
            counters[PROGRESS] = jnp.zeros((), jnp.float32)
        return TrainState(step=zero, params=params, opt_state=optimizer.init(params), grid=grid, counters=counters)

    return create(jax.random.key(seed), cells)


def rendered_shapes(model: Model) -> tuple[dict[str, Any], OccupancyGrid | None]:
    """Returns the shapes of what renders images, see `image_params`, and of the grid: trees of ShapeDtypeStruct."""
    params, grid = jax.eval_shape(lambda: _create(model, jax.random.key(0), _all_cells(model)))
    progress = {PROGRESS: jax.ShapeDtypeStruct((), jnp.float32)} if PROGRESS in model.needs else {}
    return {**params, **progress}, grid


def _create(model, key, cells):
    """Returns parameters, and the grid or None, before training."""
    params = model.init(key)
    for path, leaf in jax.tree_util.tree_leaves_with_path(params):
        if not jnp.issubdtype(jnp.result_type(leaf), jnp.floating):
            name = f"params{jax.tree_util.keystr(path)}"
            raise ValueError(f"{name} has type {jnp.result_type(leaf)}, expected floats of init; integers do not train")
    return params, None if model.grid_schedule is None else model.grid_schedule.create(*cells)


def _all_cells(model):
    schedule = model.grid_schedule
    return None if schedule is None else InitialCells(jnp.ones(schedule.shape, bool))
