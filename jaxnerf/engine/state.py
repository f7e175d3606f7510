"""What training changes: arrays only, all that a bit-exact resume needs."""

from typing import Any

import jax
import jax.numpy as jnp

from jaxnerf.core.structs import pytree


@pytree()
class TrainState:
    """The state of a run; functions stay outside it."""

    step: jax.Array  # int32, steps taken
    params: Any  # {"coarse": ..., "fine": ...}, float32
    opt_state: Any  # of optax
    grid: Any  # occupancy, None without
    counters: dict[str, jax.Array]  # int32: "nonfinite" steps left out, "nonfinite_in_a_row"


def create_state(model, optimizer, seed):
    """Returns the TrainState at step 0, the same for the same seed."""

    @jax.jit  # run op by op, initialisation would take longer than compiling it
    def create():
        params = model.init(jax.random.key(seed))
        zero = jnp.zeros((), jnp.int32)
        counters = {"nonfinite": zero, "nonfinite_in_a_row": zero}
        return TrainState(
            step=zero, params=params, opt_state=optimizer.init(params), grid=None, counters=counters
        )

    return create()
