"""Parameters averaged over the last steps, which are what is rendered: less noise than those of the last."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optax


class Averaging(NamedTuple):
    """The state of an averaged optimiser."""

    count: jax.Array  # int32, updates so far
    average: Any  # like the parameters
    inner: Any  # the state of the optimiser itself


def with_averaging(optimizer, power):
    """Returns an optimiser that does what another does, and averages the parameters beside it.

    The average is the one of polynomial decay (arXiv:1212.1824): after step t the parameters
    of step s have a weight of about (s / t)^power, so that it reaches over the last power-th or so of all
    steps, however many these are. The first update makes it the parameters themselves.

    Args:
        optimizer: an optax gradient transformation.
        power: > 0.
    """

    def init(params):
        return Averaging(jnp.zeros((), jnp.int32), jax.tree.map(jnp.array, params), optimizer.init(params))

    def update(grads, state, params):
        updates, inner = optimizer.update(grads, state.inner, params)
        count = state.count + 1
        share = (power + 1) / (power + count)
        new = optax.apply_updates(params, updates)
        average = jax.tree.map(lambda old, new: old + share * (new - old), state.average, new)
        return updates, Averaging(count, average, inner)

    return optax.GradientTransformation(init, update)


def averaged_params(state):
    """Returns the parameters of a TrainState that are rendered: the averaged ones where there are such."""
    return state.opt_state.average if isinstance(state.opt_state, Averaging) else state.params
