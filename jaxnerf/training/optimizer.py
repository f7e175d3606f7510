"""The optimizer: Adam as in the paper, or Muon for the matrices of layers and AdamW for the rest; averaging."""

import dataclasses
import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optax

from jaxnerf.core.loops import is_cpu
from jaxnerf.options import BELOW_ONE, POSITIVE, Ablation, Changes, Options, at_least, option
from jaxnerf.training.camera_parameters import CAMERAS, CameraOptions
from jaxnerf.training.state import PROGRESS, TrainState

_BETA1 = 0.9  # decay of Adam's first moment, as in the paper
_MIN_SIDE = 8  # least inputs and outputs of a layer that Muon updates; smaller layers gain nothing
# Root mean square of a matrix's entries at which weight decay is as large as an update by Muon. The size of such an
# update does not depend on the gradient's; without decay, matrices grew until training diverged after 7,000 steps of
# fern.
_MAX_RMS = 3.0
# AdamW's decay of all other parameters. Without it a hash grid's entries and the weights of the colour's output grew
# steadily at a constant learning rate, until lego collapsed after 16,000 to 22,000 steps.
_DECAY = 0.05
# Up to the first number of steps the average takes the parameters of every step, and then those of every eighth: adding
# them is a pass over the whole table.
_POSE_DECAY = 1e-2  # of the learning rate of poses over training, as in arXiv:2104.06405
_FOCAL_RATE = 0.1  # of that of poses: it is one number, on which all images act
_AVERAGE_ALL, _AVERAGE_EVERY = 256, 8
_ITERATIONS = ((3.4445, -4.775, 2.0315),) * 5  # optax's own; listed one by one, they compile once, as a loop


@dataclasses.dataclass(frozen=True)
class OptimizerOptions(Options):
    """The options of the optimizer."""

    changes = Changes.TRAINING

    lr_init: float = option(5e-4, "initial learning rate", range=POSITIVE)
    lr_final: float = option(5e-5, "learning rate that is reached at `lr_steps`", range=POSITIVE)
    lr_decay_power: float = option(
        1.0,
        "The rate is lr_init (lr_final / lr_init)^((step / lr_steps)^lr_decay_power). 1: exponential decay, as in the "
        "paper; larger: the rate stays high for most of the run and then decreases quickly.",
        range=POSITIVE,
    )
    lr_steps: int = option(
        200_000, "steps of the decay; the run may end earlier or later; auto: `max_steps`", range=at_least(1), auto=True
    )
    warmup_steps: int = option(0, "steps in which the learning rate rises linearly from 0", range=at_least(0))
    beta2: float = option(0.999, "decay of Adam's second moment", range=BELOW_ONE)
    epsilon: float = option(1e-8, "added to the denominator of Adam", range=POSITIVE)
    muon: float = option(
        0.0,
        "Above 0: Muon (arXiv:2502.16982) updates the matrices of the layers instead of Adam. Its updates have this "
        "root mean square times the learning rate; those of Adam have about 0.2.",
        range=at_least(0),
    )
    table_momentum: bool = option(
        True,
        "whether Adam keeps a first moment of the gradient of a hash grid's table, too. Without it, a step takes less "
        "time and memory, as most rows have no gradient in most steps.",
    )
    averaging_power: float = option(
        0.0,
        "Above 0: evaluation uses parameters averaged over about the last 1 / power of all steps (arXiv:1212.1824).",
        range=at_least(0),
        ablations=(Ablation("averaged parameters", without=0.0, more=lambda power, *_: None if power else 10.0),),
    )


def make_optimizer(
    train: OptimizerOptions, cameras: CameraOptions | None = None
) -> tuple[optax.GradientTransformation, Callable[[Any], Any]]:
    """Makes the optimizer that options describe.

    Args:
        train: the options.
        cameras: those of the parameters of images; None where none are trained.

    Returns:
        The optimizer, whose update takes `decay`, DecayData in place of what the options say; and the learning rate of
        the networks: step -> float.
    """
    moments = {"b1": _BETA1, "b2": train.beta2, "eps": train.epsilon}

    def optimizer_with(decay_data=None):
        schedule = learning_rate(train, decay_data)
        decay = _DECAY if train.muon else 0.0
        optimizer = optax.adamw(schedule, **moments, weight_decay=decay) if decay else optax.adam(schedule, **moments)
        if not train.table_momentum:
            table = _without_momentum(schedule, train.beta2, train.epsilon, decay)
            optimizer = optax.partition({"table": table, "other": optimizer}, _tables)
        if train.muon:
            optimizer = with_muon(optimizer, schedule, train.muon)
        return optimizer if cameras is None else _with_cameras(optimizer, train, decay_data, cameras)

    def update(grads, state, params=None, *, decay=None):
        return optimizer_with(decay).update(grads, state, params)

    optimizer = optax.GradientTransformationExtraArgs(optimizer_with().init, update)
    if train.averaging_power:
        optimizer = with_averaging(optimizer, train.averaging_power)
    return optimizer, learning_rate(train)


def _with_cameras(optimizer, train, decay, cameras):
    """Returns an optimizer that updates the entry "cameras" of the parameters by Adam with learning rates of its own.

    That of exposures decays as that of the networks, that of poses exponentially. Cameras do not move before
    refine_start_step.
    """

    def adam(initial, final, power, first_step=0):
        rates = {"lr_init": initial, "lr_final": final, "lr_decay_power": power, "warmup_steps": 0}
        rate = learning_rate(dataclasses.replace(train, **rates), decay)
        return optax.adam(
            lambda step: jnp.where(step < first_step, 0.0, rate(step)), _BETA1, train.beta2, train.epsilon
        )

    def of_poses(rate):
        return adam(rate, _POSE_DECAY * rate, 1.0, cameras.refine_start_step)

    last_exposure = cameras.exposure_lr * train.lr_final / train.lr_init
    updates = {
        "networks": optimizer,
        "log_gains": adam(cameras.exposure_lr, last_exposure, train.lr_decay_power),
        "twists": of_poses(cameras.refine_lr),
        "log_focal": of_poses(_FOCAL_RATE * cameras.refine_lr),
    }

    def label(path, _):
        return "networks" if path[0].key != CAMERAS else path[1].key

    return optax.partition(updates, lambda params: jax.tree_util.tree_map_with_path(label, params))


def _without_momentum(schedule, beta2, epsilon, decay):
    """Returns AdamW with beta1 = 0, which keeps no first moment."""
    return optax.chain(
        optax.scale_by_rms(beta2, epsilon, eps_in_sqrt=False, bias_correction=True),
        *([optax.add_decayed_weights(decay)] if decay else []),
        optax.scale_by_learning_rate(schedule),
    )


def with_muon(
    optimizer: optax.GradientTransformation, schedule: Callable[[Any], Any], size: float
) -> optax.GradientTransformation:
    """Returns an optimizer that updates the matrices of layers by Muon and all other parameters by another one.

    Muon's updates have the same length in each direction of a matrix, so directions along which the gradient
    is small are learned as fast as the others (arXiv:2502.16982). This does not apply to the rows of a hash grid's
    table, nor to outputs of one or three features: the other optimizer updates these. The matrices decay, which
    bounds their entries, whatever the size is.

    Args:
        optimizer: updates the other parameters.
        schedule: step -> learning rate.
        size: root mean square of a matrix's update over the learning rate.
    """
    scale = optax.contrib.scale_by_muon(_ITERATIONS, weight_dimension_numbers=_sides_of_matrices)
    if not is_cpu():
        scale = scale._replace(update=_scale_together)
    muon = optax.chain(
        scale,
        optax.stateless(lambda directions, _: jax.tree.map(functools.partial(_scaled_by_shape, size), directions)),
        optax.add_decayed_weights(size / _MAX_RMS),
        optax.scale_by_learning_rate(schedule),
    )
    # As in optax.contrib.muon, whose checkpoints have the state of an Adam for what is no matrix, here for nothing.
    every = functools.partial(jax.tree.map, lambda _: "muon")
    muon = optax.partition({"muon": muon, "adam": optax.adamw(schedule)}, every)
    return optax.partition({"muon": muon, "other": optimizer}, _labels)


def _sides_of_matrices(params):
    return jax.tree.map(lambda _: optax.contrib.MuonDimensionNumbers(), params)


def _scaled_by_shape(size, direction):
    """Returns the update by an orthogonal matrix with a root mean square of `size`, whatever its shape."""
    return jnp.sqrt(jnp.maximum(*direction.shape)) * size * direction


def _scale_together(grads, state, params=None):
    """Does what the update of optax.contrib.scale_by_muon does, in products of all matrices at once.

    One by one, the products of small matrices take an accelerator longer to start than to compute. The matrices are
    padded with zeros to one shape; the padding of their singular vectors stays zero.
    """
    leaves, structure = jax.tree.flatten(grads)
    wide = [min(leaf.shape) for leaf in leaves], [max(leaf.shape) for leaf in leaves]

    def stack(tree):
        matrices = [leaf.T if leaf.shape[0] > leaf.shape[1] else leaf for leaf in structure.flatten_up_to(tree)]
        shape = max(wide[0]), max(wide[1])
        return jnp.stack([jnp.pad(x, [(0, a - b) for a, b in zip(shape, x.shape, strict=True)]) for x in matrices])

    def unstack(stacked):
        parts = [x[:rows, :columns] for x, rows, columns in zip(stacked, *wide, strict=True)]
        turned = [x.T if leaf.shape[0] > leaf.shape[1] else x for x, leaf in zip(parts, leaves, strict=True)]
        return jax.tree.unflatten(structure, turned)

    # Without a loop: its iterations are launches, too.
    sides = optax.contrib.MuonDimensionNumbers(reduction_axis=1, output_axis=2)
    once = optax.contrib.scale_by_muon(_ITERATIONS[0], len(_ITERATIONS), weight_dimension_numbers=sides)
    stacked = state._replace(mu=stack(state.mu), ns_coeffs=state.ns_coeffs[0])
    directions, stacked = once.update(stack(grads), stacked)
    return unstack(directions), state._replace(mu=unstack(stacked.mu), count=stacked.count)


def _labels(params):
    def label(path, leaf):
        matrix = getattr(path[-1], "key", None) == "kernel" and leaf.ndim == 2
        return "muon" if matrix and min(leaf.shape) >= _MIN_SIDE else "other"

    return jax.tree_util.tree_map_with_path(label, params)


def _tables(params):
    def label(path, _):
        return "table" if getattr(path[-1], "key", None) == "table" else "other"

    return jax.tree_util.tree_map_with_path(label, params)


class DecayData(NamedTuple):
    """How fast the learning rate decays; data, so that a run of another length has the same compiled step.

    Attributes:
        steps: float32 [], in place of `lr_steps`.
        scale: float32 [], a factor of the learning rate, which changes in a run of limited time.
    """

    steps: Any
    scale: Any


def learning_rate(train: OptimizerOptions, decay: DecayData | None = None) -> Callable[[Any], Any]:
    """Returns the learning rate of the networks, step -> float; decay: in place of what the options say."""
    ratio, power = train.lr_final / train.lr_init, train.lr_decay_power
    steps, scale = (train.lr_steps, 1.0) if decay is None else decay

    def rate(step):
        value = train.lr_init * ratio ** (jnp.minimum(step / steps, 1.0) ** power)
        if train.warmup_steps:
            value *= jnp.minimum(1.0, (step + 1) / train.warmup_steps)
        return value * scale

    return rate


class Averaging(NamedTuple):
    """The state of an optimizer with averaging.

    Attributes:
        count: int32 [], updates so far.
        average: like the parameters.
        inner: the state of the optimizer itself.
    """

    count: jax.Array
    average: Any
    inner: Any


def with_averaging(optimizer: optax.GradientTransformation, power: float) -> optax.GradientTransformation:
    """Returns an optimizer that makes the same updates and also averages the parameters.

    The average has polynomial decay (arXiv:1212.1824): after step t the parameters of step s have a weight of
    about (s / t)^power. It thus spans about the last 1 / power of all steps, however many there are. After the
    first update it equals the parameters. After 256 steps the parameters of every eighth step count for the
    seven before it, too.

    Args:
        optimizer: makes the updates.
        power: > 0.
    """

    def init(params):
        return Averaging(jnp.zeros((), jnp.int32), jax.tree.map(jnp.array, params), optimizer.init(params))

    def update(grads, state, params, **options):
        updates, inner = optimizer.update(grads, state.inner, params, **options)
        count = state.count + 1
        each = count <= _AVERAGE_ALL
        steps = count - jnp.arange(_AVERAGE_EVERY)  # for which these parameters count, only the first if `each`
        kept = jnp.where((steps < count) & each, 1, (steps - 1) / (steps + power))

        due = each | (count % _AVERAGE_EVERY == 0)

        def add(average, fraction):
            new = optax.apply_updates(params, updates)
            return jax.tree.map(lambda old, new: old + fraction.astype(old.dtype) * (new - old), average, new)

        def if_due(average, fraction):
            # A loop of at most one iteration changes the average in place; a branch would copy it.
            return jax.lax.fori_loop(0, due.astype(jnp.int32), lambda _, average: add(average, fraction), average)

        def always(average, fraction):  # on an accelerator the host reads the condition of a loop, which takes longer
            return add(average, jnp.where(due, fraction, 0))

        average = jax.lax.platform_dependent(state.average, 1 - kept.prod(), cpu=if_due, default=always)
        return updates, Averaging(count, average, inner)

    return optax.GradientTransformationExtraArgs(init, update)


def averaged_params(state: TrainState) -> Any:
    """Returns the parameters that evaluation uses: the averaged ones, or the last ones without averaging."""
    return state.opt_state.average if isinstance(state.opt_state, Averaging) else state.params


def image_params(state: TrainState) -> dict[str, Any]:
    """Returns the parameters with which images of a state are rendered.

    They are averaged, see `averaged_params`. Where the model asks for it, "progress" is that of the state.
    """
    progress = {PROGRESS: state.counters[PROGRESS]} if PROGRESS in state.counters else {}
    return {**averaged_params(state), **progress}
