"""Training losses: each maps the renderings of a step and its batch to one value per ray.

`outputs` are the renderings of a step whose colours are compared with the batch; the last one is the final rendering.
The training step sums the losses with the weights of the config's `losses`, over the rays whose samples were all
evaluated.
"""

import functools
from collections.abc import Sequence

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxnerf.core.types import Batch, PackedSamples, Rendering, Samples, check_shapes
from jaxnerf.core.volume_rendering import exclusive_sum, running_sum, running_sum_since


def squared_error(rendering: Rendering, batch: Batch) -> Float[Array, "*batch"]:
    """Computes the squared error of each ray's colour, averaged over the channels; ValueError on other shapes."""
    check_shapes("squared_error", rgb=(rendering.rgb, "... C"), batch=(batch.rgb, "... C"))
    return ((rendering.rgb - batch.rgb) ** 2).mean(axis=-1)


def mse_loss(outputs: Sequence[Rendering], batch: Batch) -> Float[Array, "*batch"]:
    """Computes the sum of the squared errors of all renderings (Eq. 6 of arXiv:2003.08934, per channel)."""
    return sum(squared_error(rendering, batch) for rendering in outputs)


def opacity_loss(outputs: Sequence[Rendering], batch: Batch) -> Float[Array, "*batch"]:
    """Computes the squared difference between the last rendering's opacity and the alpha of the pixel."""
    return (outputs[-1].opacity - batch.alpha) ** 2


def distortion_loss(outputs: Sequence[Rendering], batch: Batch) -> Float[Array, "*batch"]:
    """Computes the distortion of the last rendering's weights along each ray (arXiv:2111.12077, Eq. 15).

        sum_ij w_i w_j |s_i - s_j| + 1/3 sum_i w_i^2 d_i

    s_i is the position of sample i and d_i its length, both as fractions of the ray between near and far, or
    of its range of disparity where far is infinite. The sum over pairs takes linear time, for K packed samples
    O(K log K), and adds only terms >= 0, so there is no cancellation. With dense samples it is 2 sum_i w_i D_i, where
    D_i = D_(i-1) + (w_1 + ... + w_(i-1)) (s_i - s_(i-1)). With packed samples each gap s_i - s_(i-1) counts twice the
    weight in front of it times the weight behind it.

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
    samples = _samples("distortion_loss", rendering)
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
    if not ray.size:
        return jnp.zeros(shape)
    s, length = _fractions(samples.t, samples.delta, samples.used, near[ray], far[ray], samples.rule)
    starts = ray != jnp.roll(ray, 1).at[0].set(-1)
    gaps = jnp.where(starts | ~samples.used, 0, s - jnp.roll(s, 1))  # without NaN of the ray before
    weights = jnp.where(samples.used, samples.weights, 0)
    lengths = jax.ops.segment_sum(weights**2 * length / 3, ray, near.size, indices_are_sorted=True)
    return (_distances(near.size, ray, weights, gaps) + lengths).reshape(shape)


@functools.partial(jax.custom_jvp, nondiff_argnums=(0,))
def _distances(num_rays, ray, weights, gaps):
    """Computes sum_ij w_i w_j |s_i - s_j| of each ray; a sample's gap is that to the sample before it."""
    before, behind = _sums_around(ray, weights, weights)
    values = gaps * before * (weights + behind)
    return 2 * jax.ops.segment_sum(values, ray, num_rays, indices_are_sorted=True)


@_distances.defjvp
def _distances_jvp(num_rays, primals, tangents):
    """Differentiates by cumulative sums; the transpose of the loops in the value would take longer to compile."""
    (ray, weights, gaps), (_, change, moved) = primals, tangents
    before, behind = _sums_around(ray, weights, weights)
    from_here = weights + behind  # of the sample and all behind it
    nearer, farther = _sums_around(ray, gaps * before, gaps * from_here)
    by_weight, by_gap = nearer + gaps * before + farther, before * from_here
    values = gaps * by_gap, change * by_weight + moved * by_gap
    return tuple(2 * jax.ops.segment_sum(each, ray, num_rays, indices_are_sorted=True) for each in values)


def _sums_around(ray, first, second):
    """Returns [K], for each sample, the sums of the first values before it and of the second behind it on its ray."""
    starts, ends = ray != jnp.roll(ray, 1).at[0].set(-1), ray != jnp.roll(ray, -1).at[-1].set(-1)
    sums = running_sum_since(
        jnp.concatenate([starts, ends[::-1]]), jnp.concatenate([first, second[::-1]]), longest=ray.size
    )
    before, behind = jnp.split(sums, 2)
    return jnp.where(starts, 0, jnp.roll(before, 1)), jnp.where(ends, 0, jnp.roll(behind[::-1], -1))


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
    lower = t if rule == "points" else t - jnp.where(unbounded, t, finite) / 2
    # The length of the part beyond start, as start / lower - start / upper, without cancellation.
    clipped, upper = jnp.maximum(lower, start), jnp.maximum(lower + finite, start)
    visible = jnp.maximum(finite - (clipped - lower), 0) / jnp.where(unbounded, 1, upper)
    inverse = 1 - start / position, start / clipped * jnp.where(unbounded, 1, visible)
    linear = (t - near) / span, jnp.where(infinite, 0, delta) / span
    return tuple(jnp.where(infinite, a, b) for a, b in zip(inverse, linear, strict=True))


def depth_loss(outputs: Sequence[Rendering], batch: Batch) -> Float[Array, "*batch"]:
    """Computes how far the last rendering's weights lie from the known depth D of each ray.

        depth_weight * (1 - sum_k w_k 2 min(t_k, D) / (t_k + D))

    This is the earth mover's distance between the distribution of where the ray ends, to which the transmitted
    fraction contributes infinity, and the depth D, under the distance |t - D| / (t + D). As in DS-NeRF
    (arXiv:2107.02791), the weights are supervised, not their mean, which matter in front of and behind a surface also
    has. In place of DS-NeRF's KL divergence, whose gradient vanishes away from D and needs a known width, the gradient
    pulls matter towards D from everywhere. The distance is relative, as the errors of triangulated depths are, and at
    most 1, so that wrong depths have a bounded effect.

    Args:
        outputs: Renderings [B] with samples; those of a packed rendering may be PackedSamples.
        batch: Batch [B] with depth in t and depth_weight. A depth <= 0 is far from all matter.

    Returns:
        [B] in [0, depth_weight]. It is 0 where depth_weight is 0, with gradient 0.

    Raises:
        ValueError: if the last rendering carries no samples.
    """
    rendering = outputs[-1]
    samples = _samples("depth_loss", rendering)
    depth, confidence = jnp.asarray(batch.depth), jnp.asarray(batch.depth_weight)
    if isinstance(samples, PackedSamples):
        flat, ray = depth.reshape(-1), samples.ray_index
        nearness = jnp.where(samples.used, samples.weights, 0) * _nearness(samples.t, flat[ray])
        reached = jax.ops.segment_sum(nearness, ray, flat.size, indices_are_sorted=True).reshape(depth.shape)
    else:
        check_shapes("depth_loss", weights=(rendering.weights, "... S"), t=(samples.t, "... S"), depth=(depth, "..."))
        used = ~(samples.delta <= 0)
        nearness = _nearness(jnp.where(used, samples.t, 0), depth[..., None])
        reached = (jnp.where(used, rendering.weights, 0) * nearness).sum(axis=-1)
    return jnp.where(confidence > 0, confidence * (1 - reached), 0)


def _nearness(t, depth):
    """Returns 1 - |t - depth| / (t + depth) for t >= 0; 0 where the depth is not positive."""
    known = depth > 0
    return jnp.where(known, 2 * jnp.minimum(t, depth) / jnp.where(known, t + depth, 1), 0)


def _samples(function, rendering):
    """Returns a Rendering's samples; ValueError if it has none, or no weights for them."""
    samples = rendering.samples
    if samples is None or (rendering.weights is None and not isinstance(samples, PackedSamples)):
        raise ValueError(
            f"{function}: the rendering has no samples, expected those of a training step; do not drop them"
        )
    return samples
