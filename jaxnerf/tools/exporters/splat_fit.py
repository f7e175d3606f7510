"""Fits Gaussians to images of a run by gradient descent through a rasterizer (arXiv:2308.04079).

Which Gaussians reach which pixel, and in which order, is found without derivatives, and kept for a few steps, in which
they move by little. What is drawn of these pairs is differentiated by JAX.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Float

from jaxnerf.core.safe_math import norm
from jaxnerf.core.types import Camera, Vector
from jaxnerf.runtime import stages
from jaxnerf.tools.exporters.gaussians import MAX_ALPHA, Gaussians, colors_at, project, visible_pairs
from jaxnerf.tools.exporters.surfaces import DepthImage, inside

RATES = {  # of Adam, for the first step; those of `mean` are in standard deviations along the surface
    "mean": 0.03,
    "rotation": 0.02,
    "log_scale": 0.02,
    "logit": 0.05,
    "color": 0.02,
    "harmonics": 0.005,
}
_LAST_RATE = 0.05  # of the first
_BETA2, _EPSILON = 0.99, 1e-15
_GROUP, _VISITS = 16, 2  # images whose pairs are found at once, and the steps for each before they are found again
_MIN_TRANSMITTANCE = 1e-3  # pairs of a pixel and a Gaussian behind so little light are skipped
_PADDING = 2**16  # pairs are padded to a multiple of it, so that images share a compiled step
_OPACITY = (0.005, 0.995)  # the range to begin with


class _Pairs(NamedTuple):
    """Pairs [P] of a pixel and a Gaussian, by pixel and then by depth; pixel is height * width in padding."""

    pixel: np.ndarray
    source: np.ndarray


def fit_gaussians(
    gaussians: Gaussians,
    images: Sequence[DepthImage],
    background: Vector | None,
    *,
    box: Float[np.ndarray, "2 3"] | None = None,
    steps: int,
    seed: int = 0,
) -> Gaussians:
    """Fits Gaussians to the colours of images, by Adam on the mean squared error of one image a step.

    Their number stays as it is.

    Args:
        gaussians: to begin with.
        images: all of one size.
        background: [3] behind the Gaussians; None: black.
        box: pixels that show a surface outside it do not count, as no Gaussian is there; None: all count.
        steps: of Adam; its rates decay exponentially.
        seed: of the order of the images.
    """
    if not len(gaussians.mean):
        return gaussians
    initial = np.float32(gaussians.mean), np.float32(gaussians.scale.max(axis=1, keepdims=True))
    parameters = _parameters(gaussians)
    behind = np.zeros(3, np.float32) if background is None else np.float32(background)
    rates = optax.exponential_decay(1.0, max(steps, 1), _LAST_RATE)
    adam = optax.chain(optax.scale_by_adam(b2=_BETA2, eps=_EPSILON), optax.scale_by_learning_rate(rates))

    @jax.jit
    def step(parameters, state, initial, camera, pairs, rgb, weight):
        def error(parameters):
            image = _draw(_gaussians(parameters, *initial), camera, pairs, rgb.shape[:2], behind)
            squares = ((image - rgb.reshape(-1, 3) / 255.0) ** 2).sum(axis=-1)
            return (weight.reshape(-1) * squares).mean()

        updates, state = adam.update(jax.grad(error)(parameters), state)
        updates = {name: RATES[name] * update for name, update in updates.items()}
        return optax.apply_updates(parameters, updates), state

    state, rng = adam.init(parameters), np.random.default_rng(seed)
    weights = [_weights(image, box) for image in images]
    count, order = 0, []
    with stages.stage("fitting splats, by steps") as stage:
        while count < steps:
            order = order or rng.permutation(len(images)).tolist()
            group, order = order[:_GROUP], order[_GROUP:]
            now = jax.tree.map(np.asarray, _gaussians(parameters, *initial))
            listed = {index: _listed(now, images[index].camera) for index in group}
            for index in rng.permutation(group * _VISITS)[: steps - count]:
                camera = [np.float32(getattr(images[index].camera, name)) for name in ("to_world", "focal", "center")]
                parameters, state = step(
                    parameters, state, initial, camera, listed[index], images[index].rgb, weights[index]
                )
                count += 1
                stage.update(count, steps)
        jax.block_until_ready(parameters)
    return jax.tree.map(np.asarray, _gaussians(parameters, *initial))


def _weights(image, box):
    """Returns [H, W] float32, 0 for the pixels that show a surface outside of the box, and otherwise 1."""
    outside = np.isfinite(image.depth) & (image.depth > 0) & ~inside(image.points(), box)
    return np.float32(~outside)


def _parameters(gaussians):
    """Returns what is fitted: numbers without limits."""
    opacity = np.clip(gaussians.opacity, *_OPACITY)
    values = {
        "mean": np.zeros_like(gaussians.mean),
        "rotation": gaussians.rotation,
        "log_scale": np.log(gaussians.scale),
        "logit": np.log(opacity / (1 - opacity)),
        "color": gaussians.harmonics[:, :1],
        "harmonics": gaussians.harmonics[:, 1:],
    }
    return {name: jnp.float32(value) for name, value in values.items()}


def _gaussians(parameters, mean, width) -> Gaussians:
    """Returns the Gaussians of parameters; mean [N, 3] and width [N, 1] are those to begin with."""
    return Gaussians(
        mean=mean + width * parameters["mean"],
        rotation=parameters["rotation"] / norm(parameters["rotation"])[:, None],
        scale=jnp.exp(parameters["log_scale"]),
        opacity=jax.nn.sigmoid(parameters["logit"]),
        harmonics=jnp.concatenate([parameters["color"], parameters["harmonics"]], axis=1),
    )


def _listed(gaussians: Gaussians, camera: Camera) -> _Pairs:
    """Lists the pairs of an image that light reaches."""
    pixels, sources, start = [], [], 0
    for pairs in visible_pairs(gaussians, camera):
        kept = pairs.transmittance > _MIN_TRANSMITTANCE
        pixels.append(pairs.pixel[kept] + start)
        sources.append(pairs.source[kept])
        start += pairs.size
    count = sum(map(len, pixels))
    more = (0, -count % _PADDING if count else _PADDING)
    return _Pairs(
        np.pad(np.concatenate(pixels).astype(np.int32), more, constant_values=start),
        np.pad(np.concatenate(sources).astype(np.int32), more),
    )


def _draw(gaussians: Any, camera: Any, pairs: _Pairs, shape: tuple[int, int], background) -> Float[Array, "pixels 3"]:
    """Draws the listed pairs as `rasterize` does, but for its cut-offs; camera: pose, focal length and center."""
    # Those behind the camera are in no pair.
    seen = project(gaussians, camera, shape, jnp)
    columns = [seen.center, seen.conic, gaussians.opacity[:, None], colors_at(gaussians, camera[0][:, 3])]
    each = jnp.concatenate(columns, axis=1)[pairs.source]
    x, y, a, b, c, opacity = each[:, :6].T
    dx, dy = pairs.pixel % shape[1] + 0.5 - x, pairs.pixel // shape[1] + 0.5 - y
    alpha = jnp.minimum(opacity * jnp.exp(-0.5 * (a * dx * dx + c * dy * dy) - b * dx * dy), MAX_ALPHA)
    # Without the barrier, XLA computes them again in each of the scan's levels.
    alpha, depth = jax.lax.optimization_barrier((alpha, -jnp.log1p(-alpha)))
    first = jnp.concatenate([jnp.ones(1, bool), pairs.pixel[1:] != pairs.pixel[:-1]])
    weight = alpha * jnp.exp(depth - _sums_within(depth, first))
    planes = jnp.concatenate([weight[:, None] * each[:, 6:], depth[:, None]], axis=1)
    image = jax.ops.segment_sum(planes, pairs.pixel, shape[0] * shape[1] + 1, indices_are_sorted=True)[:-1]
    return image[:, :3] + jnp.exp(-image[:, 3:]) * background[None]


def _sums_within(values, first):
    """Returns the running sums [P] of values, each begun again where `first` is True."""

    def join(left, right):
        return jnp.where(right[1], right[0], left[0] + right[0]), left[1] | right[1]

    return jax.lax.associative_scan(join, (values, first))[0]
