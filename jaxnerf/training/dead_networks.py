"""Networks that have died: found by the gradient that no longer goes through them, and begun anew."""

import dataclasses

import jax
import jax.numpy as jnp
import optax

LOOK_EVERY = 50  # steps
PATIENCE = 100  # steps: momentum alone can bring a network back, which takes it a dozen at most
_ERROR = 1e-3  # mean square (30 dB): below it there is next to nothing that a network could miss
_GRADIENT = 1e-5  # its norm over the root of that error; healthy: 1e-2 and more, 1e-4 in the first steps


def count_dead_steps(counters, grads, errors, input_layers):
    """Returns for how many steps in a row each network has been dead, as counters "dead_<name>".

    A network is dead when its rays show an error and no gradient reaches what the position enters. Either
    its density is 0 wherever it is asked, as a ReLU's input is negative everywhere (an empty image); or it
    is a wall before the camera whose colour is saturated; or a layer of ReLUs is 0 everywhere, and what is
    left is the same fog at all places. Adam's momentum can still bring it back for a dozen steps; later
    nothing can. A batch without an error, of a scene that is empty there, says nothing and leaves the
    count as it was.

    The gradient tells more than opacity and density do, and is at hand: an image of one colour from which
    training is still on its way out is not dead, and what is dead is so whatever it looks like.

    Args:
        counters: those of before; int32 [].
        grads: network name -> gradient, over the whole batch.
        errors: [networks], in the order of grads, the mean squared error of each network's rendering.
        entrances: network name -> names of the parameters that the position enters; none: all.
    """
    dead = {}
    for (name, grad), error in zip(grads.items(), errors, strict=True):
        seeing = [grad[layer] for layer in input_layers.get(name) or grad]
        still = optax.tree.norm(seeing) <= _GRADIENT * jnp.sqrt(error)
        before = counters[f"dead_{name}"]
        dead[f"dead_{name}"] = jnp.where(error > _ERROR, (before + 1) * still.astype(jnp.int32), before)
    return dead


def dead_networks(metrics):
    """Returns the names of the networks that will not come back, of a step's metrics or of a row."""
    names = sorted(name for name in metrics if name.startswith("dead_"))
    return tuple(name.removeprefix("dead_") for name in names if int(metrics[name]) >= PATIENCE)


def make_reinitializer(experiment, folder):
    """Returns look(step, state, metrics) -> (state, metrics), which begins dead networks anew now and then.

    It decides by what the state holds, at steps that do not depend on what is logged or saved when, so that
    a resumed run does the same.

    Raises:
        ValueError: from look, where more networks have died than train.max_reinits allows to begin anew.
    """
    reinitialize = make_reinitialize(experiment.model, experiment.optimizer, experiment.seed)
    allowed = experiment.train.max_reinits

    def look(step, state, metrics):
        names = dead_networks(metrics) if allowed and step % LOOK_EVERY == 0 else ()
        if not names:
            return state, metrics
        if int(metrics["num_reinits"]) + len(names) > allowed:
            raise ValueError(
                f"{folder}: no gradient has gone through the {' and the '.join(names)} network for "
                f"{PATIENCE} steps up to {step}, after {int(metrics['num_reinits'])} new beginnings (learning "
                f"rate {float(experiment.schedule(step - 1)):.2g}): what it shows is empty or of one "
                "colour; lower train.lr_init, raise train.warmup_steps, or set "
                "density_activation to 'softplus' and density_bias to -1; train.max_reinits=0 lets it be"
            )
        state = reinitialize(state, names)
        # Copies, as the next step consumes the state.
        return state, {**metrics, **jax.tree.map(int, state.counters)}

    return look


def make_reinitialize(model, optimizer, seed):
    """Returns revive(state, names) -> TrainState, where the networks of these names begin anew.

    Their parameters are drawn again, from the seed and the step, and the optimiser forgets them; a model's
    grid holds all that is possible. The others stay as they are, and so does the learning rate's schedule.
    """

    def reinitialize(state, names):
        # No ray has this position, so the key is the step's own.
        key = jax.random.fold_in(jax.random.fold_in(jax.random.key(seed), state.step), 2**32 - 3)
        fresh = model.init(key)
        anew = {name: jax.tree.map(lambda _, name=name: name in names, tree) for name, tree in fresh.items()}
        # As init makes it: moments of 0, but an average begins at the parameters.
        begins = optax.tree.map_params(
            optimizer,
            lambda old, anew: old if _is_masked(old) else anew,
            state.opt_state,
            anew,
            transform_non_params=lambda _: False,
            is_leaf=_is_masked,
        )
        forgotten = dict.fromkeys((f"dead_{name}" for name in names), jnp.zeros((), jnp.int32))
        num_reinits = state.counters["num_reinits"] + len(names)
        return dataclasses.replace(
            state,
            params={name: (fresh if name in names else state.params)[name] for name in fresh},
            opt_state=jax.tree.map(
                lambda old, new, anew: new if anew else old, state.opt_state, optimizer.init(fresh), begins
            ),
            grid=None if model.grid_schedule is None else model.grid_schedule.create(state.grid.valid),
            counters={**state.counters, **forgotten, "num_reinits": num_reinits},
        )

    def placed(state, names):
        places = jax.tree.map(lambda leaf: leaf.sharding, state)
        return jax.jit(reinitialize, static_argnums=1, out_shardings=places)(state, names)

    return placed


def _is_masked(part):
    """Returns whether this stands for parameters that another part of the optimiser moves."""
    return isinstance(part, optax.MaskedNode)
