"""Training losses: each maps the renderings of a step and its batch to one value per ray.

`outputs` are all renderings of a step; the last one is the final rendering. The training step sums the losses with
the weights of the config's `losses`, over the rays whose samples were all evaluated.
"""

from collections.abc import Sequence

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxnerf.core.types import Batch, PackedSamples, Rendering, Samples, check_shapes
from jaxnerf.core.volume_rendering import exclusive_sum, running_sum
from jaxnerf.registry import Loss


def squared_error(rendering: Rendering, batch: Batch) -> Float[Array, "*batch"]:
    """Computes the squared error of each ray's colour, averaged over the channels."""
    return ((rendering.rgb - batch.rgb) ** 2).mean(axis=-1)


def mse_loss(outputs: Sequence[Rendering], batch: Batch) -> Float[Array, "*batch"]:
    """Computes the sum of the squared errors of all renderings (Eq. 6 of arXiv:2003.08934, per channel)."""
    return sum(squared_error(rendering, batch) for rendering in outputs)


def distortion_loss(outputs: Sequence[Rendering], batch: Batch) -> Float[Array, "*batch"]:
    """Computes the distortion of the last rendering's weights along each ray (arXiv:2111.12077, Eq. 15).

        sum_ij w_i w_j |s_i - s_j| + 1/3 sum_i w_i^2 d_i

    s_i is the position of sample i and d_i its length, both as fractions of the ray between near and far, or
    of its range of disparity where far is infinite. The sum over pairs takes linear time: it is
    2 sum_i w_i D_i, where D_i = D_(i-1) + (w_1 + ... + w_(i-1)) (s_i - s_(i-1)) adds only terms >= 0, so
    there is no cancellation.

    Args:
        outputs: Renderings [B] with samples; those of a packed rendering may be PackedSamples.
        batch: Batch [B], for near and far of its rays.

    Returns:
        [B], at least 0. An empty ray has loss 0 and gradient 0; so has a ray whose near equals its far.
        Samples of length 0 are ignored, whatever their t. Where near is 0 and far is infinite, disparity has no
        upper end: positions below t = 1 then count as t = 1.

    Raises:
        ValueError: if the last rendering carries no samples.
    """
    rendering, rays = outputs[-1], batch.rays
    samples = rendering.samples
    if samples is None or (rendering.weights is None and not isinstance(samples, PackedSamples)):
        raise ValueError(
            "distortion_loss: the rendering has no samples, expected those of a training step; do not drop them"
        )
    near, far = jnp.asarray(rays.near), jnp.asarray(rays.far)
    if isinstance(samples, PackedSamples):
        return _packed_distortion(samples, near, far)
    return _dense_distortion(rendering.weights, samples, near, far)


def _dense_distortion(weights: jax.Array, samples: Samples, near: jax.Array, far: jax.Array) -> jax.Array:
    check_shapes("distortion_loss", weights=(weights, "... S"), t=(samples.t, "... S"), near=(near, "..."))
    used = ~(samples.delta <= 0)  # NaN is used, so that it is visible
    s, length = _fractions(samples.t, samples.delta, used, near[..., None], far[..., None], samples.rule)
    # An unused sample takes the position of the nearest used one before it, so that it adds no gap.
    s = jax.lax.cummax(jnp.where(used, s, 0), axis=s.ndim - 1)
    weights = jnp.where(used, weights, 0)
    gaps = jnp.diff(s, axis=-1, prepend=s[..., :1])
    spread = running_sum(exclusive_sum(weights) * gaps)
    return (weights * (2 * spread + weights * length / 3)).sum(axis=-1)


def _packed_distortion(samples: PackedSamples, near: jax.Array, far: jax.Array) -> jax.Array:
    shape, near, far = near.shape, near.reshape(-1), far.reshape(-1)
    ray = samples.ray_index
    s, length = _fractions(samples.t, samples.delta, samples.used, near[ray], far[ray], samples.rule)
    starts = ray != jnp.roll(ray, 1).at[0].set(-1)
    gaps = jnp.where(starts | ~samples.used, 0, s - jnp.roll(s, 1))
    weights = jnp.where(samples.used, samples.weights, 0)
    before = jnp.where(starts, 0, jnp.roll(_sum_since(starts, weights), 1))
    values = weights * (2 * _sum_since(starts, before * gaps) + weights * length / 3)
    return jax.ops.segment_sum(values, ray, near.size, indices_are_sorted=True).reshape(shape)


def _sum_since(starts: jax.Array, values: jax.Array) -> jax.Array:
    """Computes the sum of the values [K] from the last start up to each, in linear time."""

    def add(first, second):
        return first[0] | second[0], jnp.where(second[0], second[1], first[1] + second[1])

    return jax.lax.associative_scan(add, (starts, values))[1]


def _fractions(t, delta, used, near, far, rule):
    """Returns the positions and lengths of samples as fractions of their rays; broadcasts all arrays."""
    if rule == "points":  # a point represents the gap behind it; the last gap may end beyond far
        delta = jnp.minimum(delta, jnp.maximum(far - t, 0))
    infinite = jnp.isinf(far)
    span = jnp.where(infinite | (far <= near), 1, far - near)
    inside = used & (far > near)
    t, delta = jnp.where(inside, t, near), jnp.where(inside, delta, 0)
    # For infinite rays, in disparity. A segment is [t - delta / 2, t + delta / 2]; one of infinite length has its
    # sample at twice its lower edge, see sampling.samples_from_edges.
    start = jnp.where(infinite & (near > 0), near, 1)
    position, unbounded = jnp.where(infinite, jnp.maximum(t, start), start), jnp.isinf(delta)
    finite = jnp.where(unbounded, 0, delta)
    lower = position if rule == "points" else position - jnp.where(unbounded, position, finite) / 2
    clipped = jnp.maximum(lower, start)
    # start / lower - start / upper, without cancellation.
    visible = (finite - (clipped - lower)) / jnp.where(unbounded, 1, lower + finite)
    inverse = 1 - start / position, start / clipped * jnp.where(unbounded, 1, visible)
    linear = (t - near) / span, jnp.where(infinite, 0, delta) / span
    return tuple(jnp.where(infinite, a, b) for a, b in zip(inverse, linear, strict=True))


MSE = Loss(mse_loss)
DISTORTION = Loss(distortion_loss)
