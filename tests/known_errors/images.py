"""Rows of encodings, metrics and losses; exact values by their definitions."""

import functools
import math

import jax.numpy as jnp
import numpy as np

import jaxnerf
from jaxnerf import Batch, Rays, Rendering, Samples
from known_errors.rows import Input, Row, ascending

OCTAVES, SIZE = 10, 6
IMAGE = Input((3, 4, 3), "uniform", 0, 1)
WINDOW = Input((11, 12, 1), "uniform", 0, 1)


def rows() -> list[Row]:
    """Returns the rows."""
    place = {"x": Input((3,), "signed0", 1e-6, 1e6)}
    pair = {"a": IMAGE, "scale": Input((), "signed0", 1e-6, 1), "noise": IMAGE}
    near = {"prepare": _beside}
    return [
        Row(
            "positional_encoding",
            "",
            place,
            lambda **given: _waves(jaxnerf.positional_encoding(**given, num_freqs=OCTAVES)),
            _encoding,
            whole=True,
        ),
        Row(
            "integrated_encoding",
            "",
            place | {"variance": Input((3,), "log0", 1e-9, 1e3)},
            lambda **given: _waves(jaxnerf.integrated_encoding(**given, num_freqs=OCTAVES)),
            _encoding,
            whole=True,
        ),
        Row(
            "frustum_variance",
            "",
            {
                "viewdirs": Input((1, 3), "signed", 1e-3, 1),
                "radius": Input((2,), "log0", 1e-6, 1e6),
                "length": Input((2,), "log0", 1e-6, 1e6),
            },
            jaxnerf.frustum_variance,
            lambda viewdirs, radius, length: (
                length[:, None] ** 2 / 12 * viewdirs**2 + radius[:, None] ** 2 / 4 * ((viewdirs**2).sum() - viewdirs**2)
            ),
            prepare=_unit,
        ),
        Row(
            "integrated_directional_encoding",
            "",
            {"directions": Input((3,), "signed0", 1e-3, 1), "roughness": Input((), "log0", 1e-6, 10)},
            functools.partial(jaxnerf.integrated_directional_encoding, degrees=(1, 2, 4)),
            _harmonics,
            prepare=_unit,
            whole=True,
        ),
        Row("mse", "", pair, jaxnerf.mse, lambda a, b: ((a - b) ** 2).mean(), **near),
        Row("psnr", "", pair, jaxnerf.psnr, _psnr, **near),
        Row("ssim", "", pair | {"a": WINDOW, "noise": WINDOW}, jaxnerf.ssim, _ssim, **near),
        Row(
            "round_to_8_bits",
            "",
            {"image": Input((8,), "uniform", -0.1, 1.1)},
            jaxnerf.round_to_8_bits,
            lambda image: jnp.floor(jnp.clip(image, 0, 1) * 255 + 0.5) / 255,
            gradient=False,
            jumps=True,
        ),
        Row(
            "distortion_loss",
            "",
            {
                "weights": Input((SIZE,), "log0", 1e-9, 1),
                "edges": Input((SIZE + 1,), "log", 1e-2, 1e2),
            },
            _distortion,
            _exact_distortion,
            prepare=lambda given: given | {"edges": ascending(given["edges"])},
            bfloat16=False,  # weights of renderings are float32
        ),
    ]


def _beside(given):
    """Returns two images, the second with noise of a scale."""
    scale = given["scale"].reshape(-1, 1, 1, 1)
    return {"a": given["a"], "b": np.clip(given["a"] + scale * (given["noise"] - 0.5), 0, 1)}


def _unit(given):
    """Returns the inputs with directions of length 1."""
    name = "viewdirs" if "viewdirs" in given else "directions"
    length = np.linalg.norm(given[name], axis=-1, keepdims=True)
    fallback = np.broadcast_to([0.0, 0.0, 1.0], given[name].shape)
    return given | {name: np.where(length > 0, given[name] / np.where(length > 0, length, 1), fallback)}


def _waves(encoded):
    """Returns the input, and its sines and cosines."""
    return encoded[:3], encoded[3:]


def _encoding(x, variance=None):
    parts = []
    for k in range(OCTAVES):
        left = 1 if variance is None else jnp.exp(-(4.0**k) * variance / 2)
        parts += [jnp.sin(2.0**k * x) * left, jnp.cos(2.0**k * x) * left]
    return x, jnp.concatenate(parts)


def _harmonics(directions, roughness):
    """Rodrigues' formula: the derivatives of (z^2 - 1)^l, by their coefficients."""
    x, y, z = directions
    found = []
    for degree in (1, 2, 4):
        for m in range(-degree, degree + 1):
            order = abs(m)
            power = np.polynomial.Polynomial([-1, 0, 1]) ** degree
            coefficients = power.deriv(degree + order).coef / (2**degree * math.factorial(degree))
            legendre = sum(c * z**i for i, c in enumerate(coefficients))
            real, imaginary = jnp.ones_like(x), jnp.zeros_like(x)
            for _ in range(order):
                real, imaginary = x * real - y * imaginary, x * imaginary + y * real
            ratio = math.factorial(degree - order) / math.factorial(degree + order)
            norm = math.sqrt((2 * degree + 1) / (4 * math.pi) * ratio * (2 if order else 1))
            left = jnp.exp(-degree * (degree + 1) / 2 * roughness)
            found.append(left * norm * legendre * (real if m >= 0 else imaginary))
    return jnp.stack(found)


def _psnr(a, b):
    error = ((a - b) ** 2).mean()
    decibels = -10 * jnp.log10(jnp.where(error > 0, error, 1))
    return jnp.where(error > 0, decibels, jnp.inf)


def _ssim(a, b):
    line = np.exp(-((np.arange(11) - 5) ** 2) / 4.5)
    window = jnp.asarray(np.outer(line, line) / line.sum() ** 2)[..., None]
    values = []
    for j in range(a.shape[1] - 10):
        p, q = a[:, j : j + 11], b[:, j : j + 11]
        mp, mq = (window * p).sum(), (window * q).sum()
        vp, vq = (window * (p - mp) ** 2).sum(), (window * (q - mq) ** 2).sum()
        cov = (window * (p - mp) * (q - mq)).sum()
        values.append((2 * mp * mq + 1e-4) * (2 * cov + 9e-4) / ((mp**2 + mq**2 + 1e-4) * (vp + vq + 9e-4)))
    return sum(values) / len(values)


def _distortion(weights, edges):
    samples = jaxnerf.samples_from_edges(None, edges[None])
    zero, ends = jnp.zeros(1), (edges[:1].astype(samples.t.dtype), edges[-1:].astype(samples.t.dtype))
    vectors = jnp.zeros((1, 3))
    rays = Rays(origins=vectors, directions=vectors, viewdirs=vectors, near=ends[0], far=ends[1])
    seen = Rendering(
        rgb=vectors,
        opacity=zero,
        depth=zero,
        disparity=zero,
        weights=weights[None],
        num_dropped=jnp.zeros(1, int),
        samples=Samples(t=samples.t, delta=samples.delta),
    )
    return jaxnerf.distortion_loss([seen], Batch(rays=rays, rgb=vectors))


def _exact_distortion(weights, edges):
    span = edges[-1] - edges[0]
    weights = jnp.where(edges[1:] > edges[:-1], weights, 0)
    s = (edges[1:] + edges[:-1]) / 2 / span
    pairs = sum(weights[i] * weights[j] * 2 * (s[j] - s[i]) for i in range(SIZE) for j in range(i + 1, SIZE))
    return pairs + (weights**2 * (edges[1:] - edges[:-1])).sum() / 3 / span
