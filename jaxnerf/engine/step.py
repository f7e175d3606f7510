"""One training step: draw rays, render them, descend on the squared error."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optax

from jaxnerf.core.structs import Views
from jaxnerf.data import batches
from jaxnerf.data.runs import Runs
from jaxnerf.engine.revival import count_dead
from jaxnerf.engine.state import TrainState


class TrainData(NamedTuple):
    """What a run's steps read and never change. The seed is among it: runs that differ by it compile once."""

    seed: Any  # uint32
    views: Views
    live: Runs | None  # the pixels to draw from; None: all
    cells: Any  # [L] int32, those that the grid is looked at in; None of a model without a space


def make_train_step(model, optimizer, draw):
    """Returns the pure training step.

    Args:
        model: models.Model. Of its Renderings in training the last one counts.
        optimizer: an optax gradient transformation.
        draw: (step, positions [B], data) -> (keys [B], Batch [B]); see data.batches.draw_batch.

    Returns:
        train_step(state, data, positions, *, axis_name=None) -> (state, metrics). data is TrainData,
        or of a model without a space whatever draw takes. positions is [N, B] int32, the places of
        this device's rays in the whole batch: N blocks that are run one after the other and whose
        gradients add up, so that B rays' activations stay in the cache (or in the memory) whatever
        the batch. With an axis_name all sums are also over that axis of devices. metrics are
        scalars: "loss", "mse" (last rendering), "mse_coarse" (first), "grad_norm", "rays" that
        counted, and the counters.

        The counters: "nonfinite" steps, whose loss or gradient was not finite; they leave parameters,
        optimiser and grid as they were. "nonfinite_in_a_row". "dead_<name>" of each network, see
        revival.count_dead, and "revived", which revival alone changes. And, of a model with a space,
        "left_out" rays: a full pool had no room for some of their samples, so they count for nothing.
    """

    def loss_fn(params, grid, step, keys, batch):
        renderings = model.render(keys, params, grid, batch.rays, step)
        whole = renderings[-1].dropped == 0
        errors = [_sum_where(whole, (rendering.rgb - batch.rgb) ** 2) for rendering in renderings]
        return sum(errors), {"mse_coarse": errors[0], "mse": errors[-1], "rays": whole.sum(dtype=jnp.int32)}

    def block(state, data, positions):
        keys, batch = draw(state.step, positions, data)
        (loss, sums), grads = jax.value_and_grad(loss_fn, has_aux=True)(
            state.params, state.grid, state.step, keys, batch
        )
        return {"loss": loss, **sums}, grads

    def train_step(state, data, positions, *, axis_name=None):
        drawn = positions.size * (1 if axis_name is None else jax.lax.axis_size(axis_name))
        total = _sum_over_blocks(lambda part: block(state, data, part), positions)
        if axis_name is not None:
            total = jax.lax.psum(total, axis_name)
        metrics, grads, rays = _per_value(*total)
        metrics["grad_norm"] = optax.tree.norm(grads)
        finite = jnp.isfinite(metrics["loss"]) & jnp.isfinite(metrics["grad_norm"])

        def descend():
            updates, opt_state = optimizer.update(grads, state.opt_state, state.params)
            return optax.apply_updates(state.params, updates), opt_state

        # A branch: to select between old and new, array by array, takes about as long as the update itself.
        params, opt_state = jax.lax.cond(finite, descend, lambda: (state.params, state.opt_state))
        missed = (~finite).astype(jnp.int32)
        errors = (metrics["mse_coarse"], metrics["mse"])[-len(grads) :]
        counters = {
            **count_dead(state.counters, grads, errors, model.entrances),
            "revived": state.counters["revived"],
            "nonfinite": state.counters["nonfinite"] + missed,
            "nonfinite_in_a_row": (state.counters["nonfinite_in_a_row"] + 1) * missed,
        }
        grid = state.grid
        if model.space is not None:
            counters["left_out"] = state.counters["left_out"] + drawn - rays
            # No ray has this position, so the key is the step's own.
            key = jax.random.fold_in(batches.step_key(data.seed, state.step), 2**32 - 2)
            grid = model.space.update(key, state.step, params, grid, data.cells)
        state = TrainState(
            step=state.step + 1,
            params=params,
            opt_state=opt_state,
            grid=grid,
            counters=counters,
        )
        return state, {**metrics, "rays": rays, **counters}

    return train_step


def _sum_where(whole, errors):
    """Returns the sum of the errors [B, 3] of the rays [B] that are whole."""
    return jnp.where(whole[:, None], errors, 0).sum()


def _per_value(sums, grads):
    """Returns means over all colour values that counted: metrics, gradient; and how many rays those were."""
    rays = sums.pop("rays")
    share = 1 / (3 * jnp.maximum(rays, 1))
    return *jax.tree.map(lambda leaf: leaf * share, (sums, grads)), rays


def _sum_over_blocks(function, positions):
    if positions.shape[0] == 1:
        return function(positions[0])

    def add(total, part):
        return jax.tree.map(jnp.add, total, function(part)), None

    zeros = jax.tree.map(jnp.zeros_like, jax.eval_shape(function, positions[0]))
    return jax.lax.scan(add, zeros, positions)[0]
