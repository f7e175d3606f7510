"""How parameters descend: by Adam, as the paper's, or the matrices of layers by Muon and the rest by Adam."""

import jax
import jax.numpy as jnp
import optax

from jaxnerf.training.averaging import with_averaging

_FEWEST = 8  # inputs and outputs of a layer whose matrix has directions enough to make alike
_ITERATIONS = ((3.4445, -4.775, 2.0315),) * 5  # optax's own; given one by one they compile once, as a loop


def make_optimizer(train):
    """Returns the optimiser that a train section describes, and its learning rate: step -> float.

    Raises:
        ValueError: names the field that is below 0.
    """
    power, muon = (train.get(name, 0.0) for name in ("averaging_power", "muon"))
    for name, value in (("averaging_power", power), ("muon", muon)):
        if value < 0:
            raise ValueError(f"train.{name} is {value}, wanted more than 0, or 0 for none")
    schedule = _schedule(train)
    optimizer = optax.adam(schedule, train.beta1, train.beta2, train.epsilon)
    if muon:
        optimizer = with_muon(optimizer, schedule, muon)
    return with_averaging(optimizer, power) if power else optimizer, schedule


def with_muon(optimizer, schedule, size):
    """Returns an optimiser that moves the matrices of layers by Muon, and all else as another does.

    Muon's steps are as long in each direction of a matrix, so that those along which the gradient is small
    are learned as soon as the others (arXiv:2502.16982). A table of features has rows, not directions, and
    an output of one or three features hardly any: they are left to the other.

    Args:
        optimizer: an optax gradient transformation.
        schedule: step -> learning rate.
        size: root mean square of a matrix's step, in learning rates.
    """
    muon = optax.contrib.muon(schedule, _ITERATIONS, consistent_rms=size)
    return optax.partition({"muon": muon, "other": optimizer}, _labels)


def _labels(params):
    def label(path, leaf):
        matrix = getattr(path[-1], "key", None) == "kernel" and leaf.ndim == 2
        return "muon" if matrix and min(leaf.shape) >= _FEWEST else "other"

    return jax.tree_util.tree_map_with_path(label, params)


def _schedule(train):
    ratio = train.lr_final / train.lr_init
    decay = optax.exponential_decay(train.lr_init, train.lr_steps, ratio, end_value=train.lr_final)
    if not train.warmup_steps:
        return decay
    return lambda step: decay(step) * jnp.minimum(1.0, (step + 1) / train.warmup_steps)
