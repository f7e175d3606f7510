"""The released codes' forms, as a baseline: a cumulative product and padded weights, with epsilons."""

import jax.numpy as jnp

from jaxnerf import Rendering, points_on_rays


def render_samples(scene, rays, samples, *, background=None):
    """Returns what render_samples of jaxnerf does, as the 2020 code sums it."""
    density, rgb = scene(points_on_rays(rays, samples.t), rays.viewdirs[..., None, :])
    length = samples.delta * jnp.linalg.norm(rays.directions, axis=-1, keepdims=True)
    return composite(density, rgb, samples.t, length, background=background)


def composite(density, rgb, t, length, *, background=None):
    """Returns the Rendering of arrays [..., S], [..., S, 3], [..., S] and [..., S]."""
    alpha = 1.0 - jnp.exp(-density * length)
    transmittance = jnp.cumprod(1.0 - alpha[..., :-1] + 1e-10, axis=-1)
    weights = alpha * jnp.concatenate([jnp.ones_like(alpha[..., :1]), transmittance], axis=-1)
    color, opacity = (weights[..., None] * rgb).sum(axis=-2), weights.sum(axis=-1)
    depth = (weights * t).sum(axis=-1)
    disparity = 1.0 / jnp.maximum(1e-10, depth / opacity)
    if background is not None:
        color = color + (1.0 - opacity)[..., None] * background
    num_dropped = jnp.zeros(opacity.shape, jnp.int32)
    return Rendering(
        rgb=color,
        opacity=opacity,
        depth=depth,
        disparity=disparity,
        weights=weights,
        num_dropped=num_dropped,
    )


def inverse_cdf(edges, weights, u):
    """Inverts the CDF as the 2020 code does."""
    weights = weights + 1e-5
    cdf = jnp.cumsum(weights / weights.sum(axis=-1, keepdims=True), axis=-1)
    cdf = jnp.concatenate([jnp.zeros_like(cdf[..., :1]), cdf], axis=-1)
    above = jnp.vectorize(lambda row, u: jnp.searchsorted(row, u, side="right"), signature="(s),(n)->(n)")(cdf, u)
    below, above = jnp.maximum(above - 1, 0), jnp.minimum(above, cdf.shape[-1] - 1)
    start, low, high = (
        jnp.take_along_axis(values, index, axis=-1) for values, index in ((cdf, below), (edges, below), (edges, above))
    )
    width = jnp.take_along_axis(cdf, above, axis=-1) - start
    return low + (u - start) / jnp.where(width < 1e-5, 1.0, width) * (high - low)
