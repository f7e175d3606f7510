"""Hard cases of the positional encoding: L = 16, against float64 sines of the float32 input's octaves."""

import functools

import jax
import jax.numpy as jnp
import numpy as np

from hard_cases.checks import Case, Check, absolute, not_finite
from jaxnerf import positional_encoding

OCTAVES, COUNT = 16, 2000


def cases(encode=positional_encoding):
    """Returns the cases; encode has the arguments of positional_encoding."""
    return [Case("encoding", name, functools.partial(_checks, encode, values)) for name, values in inputs().items()]


def inputs():
    """Returns {name: x [COUNT]}."""
    rng = np.random.default_rng(0)
    found = {f"|x| up to {scale:g}": rng.uniform(-scale, scale, COUNT) for scale in (1e-6, 1, 10, 1e3, 1e5, 1e6)}
    whole = np.arange(COUNT) - COUNT // 2
    found["multiples of pi / 2"] = whole * (np.pi / 2)
    found["multiples of pi / 2 up to 1e6"] = np.linspace(-636619, 636619, COUNT).round() * (np.pi / 2)
    found["whole numbers up to 1e6"] = whole * 1000
    found["powers of two"] = np.sign(whole + 0.5) * 2.0 ** rng.integers(-100, 20, COUNT)
    found["zeros and denormals"] = np.where(whole % 2 == 0, whole * 0.0, whole * 1e-42)
    found["beside 1e6"] = 1e6 - 0.0625 * np.arange(COUNT)
    return {name: values.astype(np.float32) for name, values in found.items()}


def exact(x):
    """Returns the sines and cosines [COUNT, 2L] of the octaves of float32 x, and their slopes over 2^k."""
    angles = x.astype(np.float64)[:, None] * 2.0 ** np.arange(OCTAVES)
    sine, cosine = np.sin(angles), np.cos(angles)
    join = functools.partial(np.stack, axis=-1)
    return join([sine, cosine]).reshape(len(x), -1), join([cosine, -sine]).reshape(len(x), -1)


def _checks(encode, x):
    plain, run, slope = _compiled(encode)
    got, slopes = run(x), slope(x)
    waves, turned = exact(x)
    frequency = np.repeat(2.0 ** np.arange(OCTAVES), 2)
    return [
        Check("x itself", absolute(got[:, 0], x), 0),
        Check("sines and cosines", absolute(got[:, 1:], waves), 3e-7),
        Check("jit beside eager", absolute(got, plain(x)), 3e-7),
        Check("not finite", not_finite(got, slopes), 0, "finite"),
        Check("gradient / 2^k", absolute(slopes[:, 1:] / frequency, turned), 3e-7, "gradient"),
        Check("gradient of x", absolute(slopes[:, 0], 1), 0, "gradient"),
    ]


@functools.cache
def _compiled(encode):
    """Returns the encoding of x [N], one by one; the same compiled; and its slopes [N, 1 + 2L], compiled."""

    def rows(x):
        return encode(x[:, None], num_freqs=OCTAVES)

    run = jax.jit(rows)
    slopes = jax.jit(lambda x: jax.jvp(rows, (x,), (jnp.ones_like(x),))[1])
    return (lambda x: np.asarray(rows(x))), (lambda x: np.asarray(run(x))), (lambda x: np.asarray(slopes(x)))
