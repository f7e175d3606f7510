"""An example of a field: density and colour are linear functions of Gabor features.

A Gabor feature is a wave under a Gaussian window, sin(f . x + p) exp(-|x - m|^2 / (2 w^2)), whose frequency f,
phase p, centre m and width w are learned.

Train with it by

    jaxnerf-train --plugins=gabor_field --config=embedded_small --config.field=gabor --workdir=runs/gabor

where gabor_field.py is in the current folder or on PYTHONPATH. `--config.gabor.num_features=128` sets an option, and
so does a config file: `config.gabor.num_features = 128`.
"""

import dataclasses
import functools

import jax
import jax.numpy as jnp

import jaxnerf
from jaxnerf.extend import POSITIVE, Field, Options, at_least, infer, option


@dataclasses.dataclass(frozen=True)
class GaborOptions(Options):
    """The options of the field: the config's section `gabor`, with flags, checks and help."""

    num_features: int = option(64, "Gabor features", range=at_least(1))
    max_frequency: float = option(
        "auto", "standard deviation of the initial frequencies", unit="1 / world unit", range=POSITIVE, auto=True
    )

    def resolve(self, facts, device):
        """Infers what is "auto" from plain numbers about the dataset; the line is printed when a run starts."""
        frequency = min(1 / (8 * facts.footprint), 8.0)
        return infer(self, max_frequency=(frequency, f"gabor         frequencies of about {frequency:.2g}"))


def make_gabor_field(options, box):
    """Makes the field from GaborOptions; box: (lower, upper) corner of the scene, or None."""
    lower, upper = jnp.array(box if box is not None else ((-1.5,) * 3, (1.5,) * 3))
    return Field(functools.partial(init, lower=lower, upper=upper, **dataclasses.asdict(options)), apply)


def init(key, *, lower, upper, num_features, max_frequency):
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


jaxnerf.register_field("gabor", make_gabor_field, options=GaborOptions)
