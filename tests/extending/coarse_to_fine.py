"""An example of a curriculum: octaves of the positional encoding are switched on one after the other while training.

With few views, high octaves let a field explain each image by fog in front of its camera before the cameras agree on a
shape (FreeNeRF, arXiv:2303.07418; the weights are those of BARF, arXiv:2104.06405). Train with it by

    jaxnerf-train --plugins=coarse_to_fine --config=embedded_small --config.field=coarse_to_fine \
        --workdir=runs/curriculum

where coarse_to_fine.py is in the current folder or on PYTHONPATH.
"""

import dataclasses
import functools

import jax
import jax.numpy as jnp

import jaxnerf
from jaxnerf.extend import FRACTION, Field, Options, at_least, between, option


@dataclasses.dataclass(frozen=True)
class CurriculumOptions(Options):
    """The options of the field: the config's section `coarse_to_fine`."""

    width: int = option(64, "outputs of a layer", range=at_least(1))
    depth: int = option(3, "layers", range=at_least(1))
    num_freqs: int = option(7, "octaves of the position's encoding", range=between(1, 16))
    until: float = option(0.5, "fraction of training after which all octaves are on", range=FRACTION)


def make_field(options, box):
    """Makes the field from its options; it needs no box."""
    del box
    apply = functools.partial(evaluate, num_freqs=options.num_freqs, until=options.until)
    return Field(functools.partial(init, options=options), apply)


def init(key, *, options):
    """Draws the layers: kernels and biases."""
    sizes = [3 + 6 * options.num_freqs, *[options.width] * options.depth, 4]
    glorot = jax.nn.initializers.glorot_uniform()
    keys = jax.random.split(key, len(sizes) - 1)
    return [
        {"kernel": glorot(key, (rows, columns)), "bias": jnp.zeros(columns)}
        for key, rows, columns in zip(keys, sizes, sizes[1:], strict=False)
    ]


def evaluate(params, x, viewdirs, *, progress, num_freqs, until):
    """Evaluates the field: density [..., S] and rgb [..., S, 3], which does not depend on viewdirs.

    Args:
        params: of `init`.
        x: [..., S, 3] world units.
        viewdirs: [..., 1 or S, 3].
        progress: [], the fraction of training that is done. A keyword of this name is all that a scene needs to get it:
            in training, in updates of a grid, in evaluation (that of the checkpoint), exports and the viewer.
        num_freqs, until: see CurriculumOptions.
    """
    weights = octave_weights(progress, num_freqs, until)
    return jnp.vectorize(functools.partial(at_point, params, weights), signature="(d)->(),(c)")(x)


def octave_weights(progress, num_freqs, until):
    """Returns the weight [num_freqs] of each octave: they rise from 0 to 1 one after the other."""
    ramp = jnp.clip(progress / until * (num_freqs - 1) + 1 - jnp.arange(num_freqs), 0, 1)
    return (1 - jnp.cos(jnp.pi * ramp)) / 2


def at_point(params, weights, x):
    angles = x[:, None] * 2.0 ** jnp.arange(weights.size)[None]
    waves = weights[None] * jnp.stack([jnp.sin(angles), jnp.cos(angles)]).reshape(-1, weights.size)
    hidden = jnp.concatenate([x, waves.reshape(-1)])
    for layer in params[:-1]:
        hidden = jax.nn.relu(hidden @ layer["kernel"] + layer["bias"])
    outputs = hidden @ params[-1]["kernel"] + params[-1]["bias"]
    return jax.nn.softplus(outputs[0] - 1), jax.nn.sigmoid(outputs[1:])


jaxnerf.register_field("coarse_to_fine", make_field, options=CurriculumOptions)
