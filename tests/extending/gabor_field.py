"""An example of a field: density and colour are linear functions of Gabor features.

A Gabor feature is a wave under a Gaussian window, sin(f . x + p) exp(-|x - m|^2 / (2 w^2)), whose frequency f,
phase p, centre m and width w are learned.

Train with it by

    jaxnerf-train --plugins=gabor_field --config=embedded_small --config.field=gabor --workdir=runs/gabor

where gabor_field.py is in the current folder or on PYTHONPATH. The options below may also be set in a config
file: `config.gabor = {"num_features": 128}`.
"""

import functools

import jax
import jax.numpy as jnp

import jaxnerf
from jaxnerf.fields.base import Field


def make_gabor_field(options, box):
    """Makes the field from a config's section `gabor`; box: (lower, upper) corner of the scene, or None."""
    lower, upper = jnp.array(box if box is not None else ((-1.5,) * 3, (1.5,) * 3))
    return Field(functools.partial(init, lower=lower, upper=upper, **options), apply)


def init(key, *, lower, upper, num_features=64, max_frequency=8.0):
    """Draws the parameters: any pytree of float arrays. `key` is the only source of randomness."""
    keys = jax.random.split(key, 5)
    return {
        "center": jax.random.uniform(keys[0], (num_features, 3), minval=lower, maxval=upper),
        "log_width": jnp.full(num_features, jnp.log((upper - lower).max() / 4)),
        "frequency": max_frequency * jax.random.normal(keys[1], (num_features, 3)),
        "phase": jax.random.uniform(keys[2], (num_features,), maxval=2 * jnp.pi),
        "to_density": jax.random.normal(keys[3], (num_features,)),
        "to_rgb": 0.1 * jax.random.normal(keys[4], (num_features + 3, 3)),
    }


def apply(params, x, viewdirs):
    """Evaluates the field: x [..., S, 3], viewdirs [..., 1 or S, 3] -> density [..., S], rgb [..., S, 3]."""
    at_points = jnp.vectorize(functools.partial(at_point, params), signature="(d),(d)->(),(c)")
    return at_points(x, jnp.broadcast_to(viewdirs, x.shape))


def at_point(params, x, viewdir):
    squares = ((x[None] - params["center"]) ** 2).sum(axis=-1)
    windows = jnp.exp(-squares / (2 * jnp.exp(2 * params["log_width"])))
    features = windows * jnp.sin(params["frequency"] @ x + params["phase"])
    rgb = jnp.concatenate([features, viewdir]) @ params["to_rgb"]
    # Density is at least 0, in 1 / world unit, and colours are in [0, 1].
    return jax.nn.softplus(features @ params["to_density"]), jax.nn.sigmoid(rgb)


jaxnerf.register_field("gabor", make_gabor_field)
