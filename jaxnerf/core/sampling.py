"""Where to ask along a ray: edges of segments, points in them, and points where the weight is."""

import math

import jax
import jax.numpy as jnp

from jaxnerf.core.safe_math import at_least_float32, clamp, divide
from jaxnerf.core.types import Samples, check_shapes


def uniform_edges(near, far, *, num_segments, in_disparity=False):
    """Returns the edges of segments of equal length, in t or in 1 / t.

    Args:
        near, far: [...] in t, near <= far. Where they are equal all edges are.
        num_segments: S >= 1.
        in_disparity: equal steps in 1 / t instead: 1 / t = (1 - s) / near + s / far, which may
            reach far = inf and needs near > 0.

    Returns:
        [..., S + 1] ascending edges; the first is near and the last is far, exactly.

    Raises:
        ValueError: on other shapes, S < 1, or disparity with a near <= 0 that is known at trace time.
    """
    near, far = jnp.asarray(near), jnp.asarray(far)
    check_shapes("uniform_edges", near=(near, "..."), far=(far, "..."))
    if num_segments < 1:
        raise ValueError(f"uniform_edges: num_segments is {num_segments}, wanted at least 1")
    dtype = jnp.result_type(jnp.float32, near.dtype, far.dtype)
    near, far = near[..., None].astype(dtype), far[..., None].astype(dtype)
    s = (jnp.arange(1, num_segments, dtype=dtype) / num_segments).reshape((1,) * (near.ndim - 1) + (-1,))
    if in_disparity:
        if _is_known(~(near > 0).all()):
            raise ValueError(f"uniform_edges: near has {near.min()}, disparity 1 / t wants near > 0; raise near")
        inner = near / ((1 - s) + s * (near / far))
    else:
        inner = near + (far - near) * s
    inner = clamp(inner, near, far)  # a rounding past the end would put samples outside
    return jnp.concatenate([near, inner, far], axis=-1)


def stepped_edges(key, near, far, *, step_size, num_segments):
    """Returns the edges of segments of one length, so that a ray has as many as it is long.

    What the marching of arXiv:2201.05989 does with one draw a ray, in place of Eq. 2's one a segment.

    Args:
        key: None, one key, or one key a ray [...]: moves all edges of a ray by one draw of up to a step,
            which costs one number a ray. None moves none.
        near, far: [...] in t, near <= far, both finite.
        step_size: [...] or a number, in t, > 0.
        num_segments: S >= 1. Those past far are empty; where S steps do not reach far, the last is longer.

    Returns:
        [..., S + 1] ascending edges; the first is near and the last is far, exactly.

    Raises:
        ValueError: on other shapes or S < 1.
    """
    near, far = at_least_float32(jnp.asarray(near), jnp.asarray(far))
    check_shapes("stepped_edges", near=(near, "..."), far=(far, "..."))
    if num_segments < 1:
        raise ValueError(f"stepped_edges: num_segments is {num_segments}, wanted at least 1")
    moved = 0.0 if key is None else uniform(key, (*near.shape, 1))
    count = jnp.arange(1, num_segments, dtype=near.dtype).reshape((1,) * near.ndim + (-1,))
    step = jnp.broadcast_to(jnp.asarray(step_size, near.dtype), near.shape)
    inner = near[..., None] + (count - moved) * step[..., None]
    inner = jnp.minimum(inner, far[..., None])
    return jnp.concatenate([near[..., None], inner, far[..., None]], axis=-1)


def samples_from_edges(key, edges, *, rule="segments"):
    """Returns the samples of each segment: one anywhere in it or in its middle, or two Gauss points.

    Args:
        key: None for fixed samples, one key, or one key a ray [...].
        edges: [..., S + 1] ascending, in t. The last may be inf: 1 / t then takes t's place in
            that segment, whose middle is at twice its lower edge (which must be > 0).
        rule: "segments": density and colour count as constant over the segment. A key draws t
            evenly in it (Eq. 2); the midpoint makes the quadrature second order.
            "gauss": two samples in each segment, at (1 -+ 1 / sqrt(3)) / 2 of it, each for half of its
            length: fourth order where the scene is smooth. A key draws the edges instead, each
            between the middles beside it; first and last stay.

    Returns:
        Samples [..., S], or [..., 2 S] for "gauss". A drawn t lies in [edge, next edge), exactly; a
        zero-width segment has t on its edge and delta 0.

    Raises:
        ValueError: on fewer than two edges, other shapes of the key, or another rule.
    """
    (edges,) = at_least_float32(edges)
    _check_edges("samples_from_edges", edges)
    if rule == "gauss":
        return _gauss_samples(edges if key is None else _moved_edges(key, edges))
    if rule != "segments":
        raise ValueError(f"samples_from_edges: rule is {rule!r}, wanted 'segments' or 'gauss'")
    lower, upper = edges[..., :-1], edges[..., 1:]
    return Samples(t=_between(key, lower, upper), delta=_width(lower, upper), rule=rule)


def samples_from_points(t, *, last_delta=1e10):
    """Returns samples that stand for the gap to the next one: the released codes' quadrature.

    delta_i = t_{i+1} - t_i, as below Eq. 3. The last sample stands for last_delta, which closes
    every ray that ends in matter. Segments are the better rule: this one is of first order, and
    with the default it does not converge where the far end lies inside matter.

    Args:
        t: [..., S] ascending, S >= 1.
        last_delta: in t; the 2020 code has 1e10.

    Returns:
        Samples [..., S].

    Raises:
        ValueError: if t has no sample axis.
    """
    (t,) = at_least_float32(t)
    check_shapes("samples_from_points", t=(t, "... S"))
    last = jnp.full_like(t[..., :1], last_delta)
    return Samples(t=t, delta=jnp.concatenate([jnp.diff(t), last], axis=-1), rule="points")


def inverse_cdf(edges, weights, u):
    """Returns where the distribution that is constant between edges reaches the shares u.

    The weights, over their sum, are the probabilities of the segments (the piecewise-constant
    PDF of Section 5.2). Each u is looked up in their running sum and interpolated linearly.

    Args:
        edges: [..., S + 1] ascending, in t.
        weights: [..., S] >= 0, of any scale. Where all are 0 (or below 1.2e-38, the smallest
            normal float) every segment counts the same.
        u: [..., N] in [0, 1].

    Returns:
        [..., N] in t, within [first edge, last edge], ascending where u is. Gradients with respect
        to edges and u are those of the interpolation. In a segment that ends at inf, 1 / t is
        interpolated.

    Raises:
        ValueError: on other shapes.
    """
    edges, weights, u = at_least_float32(edges, weights, u)
    check_shapes("inverse_cdf", edges=(edges, "... E"), weights=(weights, "... S"), u=(u, "... N"))
    if edges.shape[-1] != weights.shape[-1] + 1:
        raise ValueError(
            f"inverse_cdf: weights has shape {weights.shape}, wanted [..., {edges.shape[-1] - 1}] for edges "
            f"{edges.shape}: one weight a segment"
        )
    # Scaling by the largest first keeps the running sum clear of under- and overflow.
    largest = weights.max(axis=-1, keepdims=True)
    empty = largest < jnp.finfo(weights.dtype).tiny
    shares = jnp.where(empty, 1.0, weights / jnp.where(empty, 1.0, largest))
    sums = jax.lax.cummax(jnp.cumsum(shares, axis=-1), axis=shares.ndim - 1)  # a parallel sum can fall
    cdf = jnp.concatenate([jnp.zeros_like(sums[..., :1]), sums], axis=-1)
    target = u * cdf[..., -1:]
    # The segment is the last one that begins at or before the target and has weight.
    index = _count_below(sums, target)
    lower_sum, upper_sum = _take(cdf, index), _take(cdf, index + 1)
    lower, upper = _take(edges, index), _take(edges, index + 1)
    width = upper_sum - lower_sum
    share = jnp.where(width > 0, divide(target - lower_sum, jnp.where(width > 0, width, 1)), 0)
    return clamp(_part_way(lower, upper, share), lower, upper)


def importance_points(key, edges, weights, *, num_points, padding=0.0):
    """Returns points that lie dense where the weight is (Section 5.2).

    Stratified: one uniform draw in each of N equal shares of the weight, which keeps the
    points in order without a sort.

    Args:
        key: None for the middle of each share, one key, or one key a ray [...].
        edges: [..., S + 1] ascending, in t.
        weights: [..., S] >= 0. Where all are 0 the points spread evenly over the segments.
        num_points: N >= 1.
        padding: added to every weight. The released codes use 1e-5 against division by zero, which
            pulls samples into empty space wherever a ray is nearly empty; here it is for parity.

    Returns:
        [..., N] ascending points in t, within the edges. No gradient flows through them.

    Raises:
        ValueError: on other shapes, or N < 1.
    """
    edges, weights = jax.lax.stop_gradient(at_least_float32(edges, weights))
    if num_points < 1:
        raise ValueError(f"importance_points: num_points is {num_points}, wanted at least 1")
    shape = (*weights.shape[:-1], num_points)
    shares = jnp.broadcast_to(
        jnp.arange(num_points + 1, dtype=weights.dtype) / num_points, (*shape[:-1], num_points + 1)
    )
    u = _between(key, shares[..., :-1], shares[..., 1:])
    return inverse_cdf(edges, weights + padding if padding else weights, u)


def merge_edges(edges, points):
    """Returns the edges of the segments that the points cut the old segments into.

    Args:
        edges: [..., S + 1] in t.
        points: [..., N] in t, anywhere.

    Returns:
        [..., S + N + 1] ascending; a repeated edge makes a segment of width 0, which counts for nothing.

    Raises:
        ValueError: if the leading axes differ.
    """
    edges, points = at_least_float32(edges, points)
    check_shapes("merge_edges", edges=(edges, "... E"), points=(points, "... N"))
    return jnp.sort(jnp.concatenate([edges, points], axis=-1), axis=-1)


def stratified_points(key, near, far, *, num_points, in_disparity=False):
    """Returns the 2020 code's coarse points: near to far inclusive, each moved within its half gaps.

    Args:
        key: None for the points themselves, one key, or one key a ray [...].
        near, far: [...] in t.
        num_points: S >= 2.
        in_disparity: equal steps in 1 / t.

    Returns:
        [..., S] ascending, in t.

    Raises:
        ValueError: as uniform_edges.
    """
    if num_points < 2:
        raise ValueError(f"stratified_points: num_points is {num_points}, wanted at least 2")
    if _is_known(jnp.isinf(jnp.asarray(far)).any()):
        raise ValueError("stratified_points: far is inf, where the last point would lie; give a finite far")
    points = uniform_edges(near, far, num_segments=num_points - 1, in_disparity=in_disparity)
    if key is None:
        return points
    middles = midpoints(points)
    lower = jnp.concatenate([points[..., :1], middles], axis=-1)
    upper = jnp.concatenate([middles, points[..., -1:]], axis=-1)
    return _between(key, lower, upper)


def midpoints(edges):
    """Returns [..., S], the middle of each of the segments between edges [..., S + 1]."""
    return _part_way(edges[..., :-1], edges[..., 1:], 0.5)


def split_key(key, num):
    """Returns num independent keys (or Nones) for a key that is None, one key, or one a ray."""
    if key is None:
        return (None,) * num
    key = _typed(key)
    keys = jax.random.split(key, num) if key.ndim == 0 else _per_ray(lambda k: jax.random.split(k, num), key)
    return tuple(keys[..., i] for i in range(num))


def uniform(key, shape):
    """Returns [*shape] draws in [0, 1) from one key, or from one key a ray (key [*shape[:-1]])."""
    return _draw(jax.random.uniform, key, shape)


def normal(key, shape):
    """Returns [*shape] standard normal draws from one key, or from one key a ray (key [*shape[:-1]])."""
    return _draw(jax.random.normal, key, shape)


def _draw(distribution, key, shape):
    key = _typed(key)
    if key.ndim == 0:
        return distribution(key, shape)
    if key.shape != tuple(shape[:-1]):
        raise ValueError(f"key has shape {key.shape}, wanted one key, or one a ray: {tuple(shape[:-1])}")
    return _per_ray(lambda k: distribution(k, shape[-1:]), key)


def _typed(key):
    return key if jnp.issubdtype(key.dtype, jax.dtypes.prng_key) else jax.random.wrap_key_data(key)


def _per_ray(function, keys):
    flat = jax.vmap(function)(keys.reshape(-1))
    return flat.reshape(*keys.shape, *flat.shape[1:])


def _gauss_samples(edges):
    lower, upper = edges[..., :-1], edges[..., 1:]
    shares = [0.5 - math.sqrt(1 / 12), 0.5 + math.sqrt(1 / 12)]
    t = jnp.stack([clamp(_part_way(lower, upper, share), lower, upper) for share in shares], axis=-1)
    half = 0.5 * _width(lower, upper)
    delta = jnp.stack([half, half], axis=-1)
    flat = (*lower.shape[:-1], 2 * lower.shape[-1])
    return Samples(t=t.reshape(flat), delta=delta.reshape(flat), rule="gauss")


def _moved_edges(key, edges):
    middles = midpoints(edges)
    inner = _between(key, middles[..., :-1], middles[..., 1:])
    return jnp.concatenate([edges[..., :1], inner, edges[..., -1:]], axis=-1)


def _between(key, lower, upper):
    """A draw in [lower, upper) or the middle, never past either end by rounding."""
    if key is None:
        return clamp(_part_way(lower, upper, 0.5), lower, upper)
    draw = _part_way(lower, upper, uniform(key, lower.shape).astype(lower.dtype))
    # Edges are rounded themselves: a draw this close to one may lie in the next of the exact bins.
    finite_upper = jnp.where(jnp.isinf(upper), lower, upper)
    rounding = 2 * jnp.finfo(lower.dtype).eps * jnp.maximum(jnp.abs(lower), jnp.abs(finite_upper))
    margin = jnp.minimum(rounding, 0.25 * (finite_upper - lower))
    below = jnp.nextafter(*jax.lax.stop_gradient((upper, lower)))
    return clamp(draw, lower + margin, jnp.minimum(upper - margin, below))


def _part_way(lower, upper, share):
    """Returns the place at a share of the way, in t, or in 1 / t where the way has no end."""
    endless = jnp.isinf(upper)
    beyond = lower / (1 - jnp.where(endless, share, 0))
    return jnp.where(endless, beyond, lower + share * (jnp.where(endless, lower, upper) - lower))


def _width(lower, upper):
    return jnp.where(upper == lower, 0, upper - lower)  # also from inf to inf


def _count_below(sums, target):
    """Returns how many running sums [..., S] are at most target [..., N], but never past the last weight."""

    def row(sums, target):
        found = jnp.searchsorted(sums, target, side="right", method="compare_all")
        return jnp.minimum(found, jnp.searchsorted(sums, sums[-1], method="compare_all"))  # u = 1

    flat = jax.vmap(row)(sums.reshape(-1, sums.shape[-1]), target.reshape(-1, target.shape[-1]))
    return flat.reshape(target.shape)


def _take(values, index):
    return jnp.take_along_axis(values, index, axis=-1)


def _is_known(condition):
    """Returns whether a condition holds already while the program is traced."""
    return not isinstance(condition, jax.core.Tracer) and bool(condition)


def _check_edges(function, edges):
    check_shapes(function, edges=(edges, "... E"))
    if edges.shape[-1] < 2:
        raise ValueError(f"{function}: edges has shape {edges.shape}, wanted [..., S + 1] with S >= 1")
