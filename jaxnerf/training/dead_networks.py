"""Dead networks: detected by the gradient that no longer reaches their input, and reinitialized."""

import dataclasses
import os
from collections.abc import Callable, Mapping
from typing import Any

import jax
import jax.numpy as jnp
import optax

from jaxnerf.fields.base import Field
from jaxnerf.models.base import Model
from jaxnerf.training.state import TrainState

CHECK_EVERY = 50  # steps
PATIENCE = 100  # steps: momentum alone can revive a network, which takes a dozen steps at most
_ERROR = 1e-3  # mean square (30 dB): a network that renders better than this can hardly be dead
_GRADIENT = 1e-5  # norm over the root of that error; a healthy network has 1e-2, and 1e-4 in the first steps
# The same of colour's layers. A healthy network has less than 1e-5 while it is almost empty; a saturated sigmoid's
# derivative is below the resolution of float32.
_COLOR_GRADIENT = 1e-7


def count_dead_steps(
    counters: Mapping[str, Any],
    grads: Mapping[str, Any],
    errors: Mapping[str, Any],
    fields: Mapping[str, Field],
    scale: Any = 1.0,
) -> dict[str, Any]:
    """Counts for how many steps in a row each network that renders images has been dead, as counters "dead_<name>".

    A network is dead when its rays have an error and no gradient reaches the layers that take the position, or none
    reaches the first layers that serve colour alone. In the first case its density is 0 everywhere, as the input of
    a ReLU is negative everywhere (an empty image); or it is an opaque wall in front of the camera whose colour is
    saturated; or a layer of ReLUs is 0 everywhere, which leaves the same fog at all positions. In the second case
    density may still learn, while colour is exactly 0 or 1 everywhere, where a sigmoid has no derivative, or a layer
    of ReLUs is 0 everywhere. Adam's momentum can still bring a network back for a dozen steps; later nothing can. A
    batch without an error, as in an empty part of the scene, leaves the count unchanged.

    The gradient is a better criterion than opacity or density, and costs nothing: an image of one colour that
    training is about to leave is not dead, and a dead network is dead whatever its image looks like.

    Args:
        counters: of the step before; int32 [].
        grads: network name -> gradient over the whole batch, of the mean squared error after it is scaled.
        errors: network name -> mean squared error of its rendering, of those that render images.
        fields: network name -> Field, for its layers; all layers take the position where none are known.
        scale: factor of the gradients.
    """
    dead = {}
    for name, error in errors.items():
        grad, field = grads[name], fields.get(name)
        layers = ((), ()) if field is None else (field.input_layers, field.color_layers)
        inputs, color = ([grad[layer] for layer in names] for names in layers)
        still = scale * optax.tree.norm(inputs or grad) <= _GRADIENT * jnp.sqrt(error)
        if color:
            still |= scale * optax.tree.norm(color) <= _COLOR_GRADIENT * jnp.sqrt(error)
        before = counters[f"dead_{name}"]
        dead[f"dead_{name}"] = jnp.where(error > _ERROR, (before + 1) * still.astype(jnp.int32), before)
    return dead


def dead_networks(metrics: Mapping[str, Any]) -> tuple[str, ...]:
    """Returns the names of the networks that stay dead, from the metrics of a step or a row."""
    names = sorted(name for name in metrics if name.startswith("dead_"))
    return tuple(name.removeprefix("dead_") for name in names if int(metrics[name]) >= PATIENCE)


def make_reinitializer(experiment: Any, folder: str | os.PathLike) -> Callable[..., tuple]:
    """Makes the function (step, state, metrics) -> (state, metrics) that reinitializes dead networks.

    It checks every CHECK_EVERY steps. The decision depends only on the state and the step, not on when rows are
    logged or checkpoints saved, so a resumed run decides the same.

    Raises:
        ValueError: from that function, if more networks have died than train.max_reinits allows.
    """
    reinitialize = make_reinitialize(experiment.model, experiment.optimizer, experiment.config.seed)
    allowed = experiment.config.train.max_reinits

    def check(step, state, metrics):
        names = dead_networks(state.counters) if allowed and step % CHECK_EVERY == 0 else ()
        if not names:
            return state, metrics
        done = int(state.counters["num_reinits"])
        if done + len(names) > allowed:
            raise ValueError(
                f"{folder}: at step {step} the {' and the '.join(names)} network has had no gradient for {PATIENCE} "
                f"steps, after {done} reinitializations (learning rate {float(experiment.schedule(step - 1)):.2g}), "
                "so its image is empty or of one colour; lower train.lr_init, raise train.warmup_steps, or set "
                "density_activation to 'softplus' and density_bias to -1; train.max_reinits=0 continues regardless"
            )
        state = reinitialize(state, names)
        # Copies, as the next step consumes the state.
        return state, {**metrics, **jax.tree.map(lambda counter: counter.item(), state.counters)}

    return check


def make_reinitialize(model: Model, optimizer: optax.GradientTransformation, seed: int) -> Callable[..., TrainState]:
    """Makes the function (state, names) -> TrainState that reinitializes the networks of these names.

    Their parameters are drawn again, from the seed and the step; their optimizer moments become 0 and
    averages restart from the new parameters; all valid cells of the model's grid become occupied. The other
    networks, other parameters, and the schedule of the learning rate stay as they are.
    """

    def reinitialize(state, names):
        # No ray has this position in the batch, so the key is unused otherwise.
        key = jax.random.fold_in(jax.random.fold_in(jax.random.key(seed), state.step), 2**32 - 3)
        fresh = {**state.params, **model.init(key)}
        is_new = {name: jax.tree.map(lambda _, name=name: name in names, tree) for name, tree in fresh.items()}
        replaced = optax.tree.map_params(
            optimizer,
            lambda old, new: old if _is_masked(old) else new,
            state.opt_state,
            is_new,
            transform_non_params=lambda _: False,
            is_leaf=_is_masked,
        )
        reset = dict.fromkeys((f"dead_{name}" for name in names), jnp.zeros((), jnp.int32))
        num_reinits = state.counters["num_reinits"] + len(names)
        return dataclasses.replace(
            state,
            params={name: (fresh if name in names else state.params)[name] for name in fresh},
            opt_state=jax.tree.map(
                lambda old, new, replace: new if replace else old, state.opt_state, optimizer.init(fresh), replaced
            ),
            grid=None if model.grid_schedule is None else model.grid_schedule.create(state.grid.valid),
            counters={**state.counters, **reset, "num_reinits": num_reinits},
        )

    def placed(state, names):
        shardings = jax.tree.map(lambda leaf: leaf.sharding, state)
        return jax.jit(reinitialize, static_argnums=1, out_shardings=shardings)(state, names)

    return placed


def _is_masked(part):
    """Returns whether a part of the optimizer's state stands for parameters that another optimizer updates."""
    return isinstance(part, optax.MaskedNode)
