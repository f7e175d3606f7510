"""Training losses: each maps the renderings of a step and its batch to one value per ray.

`outputs` are all renderings of a step, the one that counts last. The training step sums the losses with the
weights of the config's `losses`, over the rays whose samples were all evaluated.
"""

from collections.abc import Sequence

import jax
import jax.numpy as jnp

from jaxnerf.core.types import Batch, PackedSamples, Rays, Rendering, Samples, check_shapes
from jaxnerf.core.volume_rendering import exclusive_sum, running_sum, running_sum_since
from jaxnerf.registry import Loss


def squared_error(rendering: Rendering, batch: Batch) -> jax.Array:
    """Computes the squared error of each ray's colour, averaged over the channels [B]."""
    return ((rendering.rgb - batch.rgb) ** 2).mean(axis=-1)


def mse_loss(outputs: Sequence[Rendering], batch: Batch) -> jax.Array:
    """Computes the sum of all renderings' squared errors [B] (Eq. 6 of arXiv:2003.08934, per channel)."""
    return sum(squared_error(rendering, batch) for rendering in outputs)


def distortion_loss(outputs: Sequence[Rendering], batch: Batch) -> jax.Array:
    """Computes the distortion of the last rendering's weights along each ray (arXiv:2111.12077, Eq. 15).

        sum_ij w_i w_j |s_i - s_j| + 1/3 sum_i w_i^2 d_i

    s_i is the position of sample i and d_i its length, both as fractions of the ray between near and far, or
    of its range of disparity where far is infinite. The sum over pairs takes linear time: it is
    2 sum_i w_i D_i, where D_i = D_(i-1) + (w_1 + ... + w_(i-1)) (s_i - s_(i-1)) adds only what is not
    negative, so that nothing cancels.

    Args:
        outputs: Renderings [B] with samples; those of a packed rendering may be PackedSamples.
        batch: Batch [B], for near and far of its rays.

    Returns:
        [B], at least 0. An empty ray has loss 0 and gradient 0; so has a ray whose near equals its far.
        Samples of length 0 are ignored, whatever their t.

    Raises:
        ValueError: if the last rendering carries no samples.
    """
    rendering, rays = outputs[-1], batch.rays
    samples = rendering.samples
    if samples is None or (rendering.weights is None and not isinstance(samples, PackedSamples)):
        raise ValueError(
            "distortion_loss: the rendering has no samples, expected those of a training step; do not drop them"
        )
    if isinstance(samples, PackedSamples):
        return _packed_distortion(samples, rays)
    return _dense_distortion(rendering.weights, samples, rays)


def _dense_distortion(weights: jax.Array, samples: Samples, rays: Rays) -> jax.Array:
    check_shapes("distortion_loss", weights=(weights, "... S"), t=(samples.t, "... S"), near=(rays.near, "..."))
    near, far = rays.near[..., None], rays.far[..., None]
    used = samples.delta > 0
    # An unused sample takes the position of the nearest used one before it, so that it adds no gap.
    s, length = _fractions(samples.t, samples.delta, used, near, far, samples.rule)
    s = jax.lax.cummax(jnp.where(used, s, 0), axis=s.ndim - 1)
    weights = jnp.where(used, weights, 0)
    gaps = jnp.diff(s, axis=-1, prepend=s[..., :1])
    before = exclusive_sum(weights)
    return (weights * (2 * running_sum(before * gaps) + weights * length / 3)).sum(axis=-1)


def _packed_distortion(samples: PackedSamples, rays: Rays) -> jax.Array:
    near, far = rays.near.reshape(-1), rays.far.reshape(-1)
    ray, count = samples.ray_index, near.size
    s, length = _fractions(samples.t, samples.delta, samples.used, near[ray], far[ray], "segments")
    starts = ray != jnp.roll(ray, 1).at[0].set(-1)
    previous = jnp.roll(s, 1)
    gaps = jnp.where(starts | ~samples.used, 0, s - previous)
    weights = jnp.where(samples.used, samples.weights, 0)
    before = jnp.where(starts, 0, jnp.roll(running_sum_since(starts, weights, weights.size), 1))
    spread = running_sum_since(starts, before * gaps, weights.size)
    values = weights * (2 * spread + weights * length / 3)
    return jax.ops.segment_sum(values, ray, count, indices_are_sorted=True).reshape(rays.near.shape)


def _fractions(t, delta, used, near, far, rule):
    """Returns the positions and lengths of samples as fractions of their rays; all arrays broadcast."""
    if rule == "points":  # a point stands for the gap that follows it, and the last gap may leave the ray
        delta = jnp.minimum(delta, jnp.maximum(far - t, 0))
    endless = jnp.isinf(far)
    span = jnp.where(endless | (far <= near), 1, far - near)
    inside = used & (far > near)
    t = jnp.where(inside, t, near)
    delta = jnp.where(inside, delta, 0)
    linear = (t - near) / span, delta / span
    start = jnp.where(endless & (near > 0), near, 1)
    place = jnp.where(endless, jnp.maximum(t, start), start)
    half = jnp.where(jnp.isfinite(delta), delta / 2, 0)
    length = start / jnp.maximum(place - half, start) - start / (place + half)
    # A segment without an end has its sample at twice its lower edge, see sampling.samples_from_edges.
    inverse = 1 - start / place, jnp.where(jnp.isinf(delta), jnp.minimum(2 * start / place, 1), length)
    return tuple(jnp.where(endless, a, b) for a, b in zip(inverse, linear, strict=True))


MSE = Loss(mse_loss, "renderings", ())
DISTORTION = Loss(distortion_loss, "renderings", ())
