"""What training changes: arrays only, all that a bit-exact resume needs."""

from typing import Any

import jax
import jax.numpy as jnp

from jaxnerf.core.types import pytree


@pytree()
class TrainState:
    """The state of a run; functions stay outside it."""

    step: jax.Array  # int32, steps taken
    params: Any  # {"coarse": ..., "fine": ...}, float32
    opt_state: Any  # of optax
    grid: Any  # core.occupancy.Grid; None where all of space is asked
    counters: dict[str, jax.Array]  # int32, see step.make_train_step


def create_state(model, optimizer, seed, valid=None):
    """Returns the TrainState at step 0, the same for the same seed.

    possible: [X, Y, Z] bool, of a model with a space: what of it is not known to be empty. None: all.
    """
    if model.grid_schedule is not None and valid is None:
        valid = jnp.ones(model.grid_schedule.shape, bool)

    @jax.jit  # run op by op, initialisation would take longer than compiling it
    def create(key, valid):
        params = model.init(key)
        zero = jnp.zeros((), jnp.int32)
        names = ("nonfinite", "nonfinite_in_a_row", "num_reinits", *(f"dead_{name}" for name in params))
        counters = dict.fromkeys(names, zero)
        if model.grid_schedule is not None:
            counters["rays_dropped"] = zero
        grid = None if model.grid_schedule is None else model.grid_schedule.create(valid)
        return TrainState(step=zero, params=params, opt_state=optimizer.init(params), grid=grid, counters=counters)

    return create(jax.random.key(seed), valid)
