"""One training step: draw rays, render them, descend on the squared error."""

import jax
import jax.numpy as jnp
import optax

from jaxnerf.engine.state import TrainState


def make_train_step(model, optimizer, draw):
    """Returns the pure training step.

    Args:
        model: its render(keys, params, rays) returns a tuple of Renderings; the last one counts.
        optimizer: an optax gradient transformation.
        draw: (step, positions [B], data) -> (keys [B], Batch [B]); see data.batches.draw_batch.

    Returns:
        train_step(state, data, positions, *, axis_name=None) -> (state, metrics). positions is
        [N, B] int32, the places of this device's rays in the whole batch: N blocks that are run
        one after the other and whose gradients add up, so that B rays' activations stay in the
        cache (or in the memory) whatever the batch. With an axis_name the gradient is also the
        mean over that axis of devices. metrics are scalars: "loss", "mse" (last rendering),
        "mse_coarse" (first), "grad_norm" and "nonfinite".

        A step whose loss or gradient is not finite leaves parameters and optimiser as they were
        and is counted.
    """

    def loss_fn(params, keys, batch):
        renderings = model.render(keys, params, batch.rays)
        errors = [((rendering.rgb - batch.rgb) ** 2).mean() for rendering in renderings]
        return sum(errors), {"mse_coarse": errors[0], "mse": errors[-1]}

    def block(params, step, data, positions):
        keys, batch = draw(step, positions, data)
        (loss, metrics), grads = jax.value_and_grad(loss_fn, has_aux=True)(params, keys, batch)
        return {"loss": loss, **metrics}, grads

    def train_step(state, data, positions, *, axis_name=None):
        total = _mean_over_blocks(lambda part: block(state.params, state.step, data, part), positions)
        if axis_name is not None:
            total = jax.lax.pmean(total, axis_name)
        metrics, grads = total
        metrics["grad_norm"] = optax.tree.norm(grads)
        finite = jnp.isfinite(metrics["loss"]) & jnp.isfinite(metrics["grad_norm"])
        updates, opt_state = optimizer.update(grads, state.opt_state, state.params)
        params = optax.apply_updates(state.params, updates)
        keep = lambda new, old: jax.tree.map(lambda a, b: jnp.where(finite, a, b), new, old)  # noqa: E731
        missed = (~finite).astype(jnp.int32)
        counters = {
            "nonfinite": state.counters["nonfinite"] + missed,
            "nonfinite_in_a_row": (state.counters["nonfinite_in_a_row"] + 1) * missed,
        }
        state = TrainState(
            step=state.step + 1,
            params=keep(params, state.params),
            opt_state=keep(opt_state, state.opt_state),
            grid=state.grid,
            counters=counters,
        )
        return state, {**metrics, **counters}

    return train_step


def _mean_over_blocks(function, positions):
    if positions.shape[0] == 1:
        return function(positions[0])

    def add(total, part):
        return jax.tree.map(jnp.add, total, function(part)), None

    zeros = jax.tree.map(jnp.zeros_like, jax.eval_shape(function, positions[0]))
    total, _ = jax.lax.scan(add, zeros, positions)
    return jax.tree.map(lambda leaf: leaf / positions.shape[0], total)
