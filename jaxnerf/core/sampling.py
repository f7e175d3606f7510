"""Samples along rays: edges of segments, points in the segments, and importance sampling."""

import math
from collections.abc import Sequence

import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float, Key, Num

from jaxnerf.core.safe_math import at_least_float32, clamp, divide, divide_by_largest
from jaxnerf.core.types import Keys, Samples, broadcast, check_order, check_shapes, is_known


def uniform_edges(
    near: Num[ArrayLike, "*batch"], far: Num[ArrayLike, "*batch"], *, num_segments: int, in_disparity: bool = False
) -> Float[Array, "*batch edges"]:
    """Computes the edges of segments of equal length, in t or in 1 / t.

    Args:
        near: [...] in t.
        far: [...] in t, near <= far. If they are equal, all edges are.
        num_segments: S >= 1.
        in_disparity: equal steps in 1 / t instead: 1 / t = (1 - s) / near + s / far, which may
            reach far = inf and needs near > 0.

    Returns:
        [..., S + 1] ascending edges; the first is near and the last is far, exactly.

    Raises:
        ValueError: on other shapes, S < 1, or near > far or disparity with near <= 0 where known at trace time.
    """
    near, far = jnp.asarray(near), jnp.asarray(far)
    check_shapes("uniform_edges", near=(near, "..."), far=(far, "..."))
    check_order("uniform_edges", near=near, far=far)
    if num_segments < 1:
        raise ValueError(f"uniform_edges: num_segments is {num_segments}, expected at least 1")
    dtype = jnp.result_type(jnp.float32, near.dtype, far.dtype)
    near, far = near[..., None].astype(dtype), far[..., None].astype(dtype)
    s = (jnp.arange(1, num_segments, dtype=dtype) / num_segments).reshape((1,) * (near.ndim - 1) + (-1,))
    if in_disparity:
        if is_known(~(near > 0).all()):
            raise ValueError(f"uniform_edges: near has {near.min()}, expected near > 0 for disparity 1 / t; raise near")
        inner = near / ((1 - s) + s * (near / far))
    else:
        inner = near + (far - near) * s
    inner = clamp(inner, near, far)  # rounding past the end would put samples outside
    return jnp.concatenate([near, inner, far], axis=-1)


def stepped_edges(
    key: Keys | None,
    near: Num[ArrayLike, "*batch"],
    far: Num[ArrayLike, "*batch"],
    *,
    step_size: Num[ArrayLike, "*#batch"],
    num_segments: int,
) -> Float[Array, "*batch edges"]:
    """Computes the edges of segments of fixed length, so that longer rays have more segments.

    This is the ray marching of arXiv:2201.05989 with one random offset per ray instead of one draw per segment
    (Eq. 2).

    Args:
        key: None, one key, or one key per ray [...]. A key shifts all edges of a ray towards near by the same
            random fraction of a step.
        near: [...] in t, finite.
        far: [...] in t, finite, near <= far.
        step_size: [...] or a number, in t, > 0.
        num_segments: S >= 1. Segments beyond far are empty; if S steps do not reach far, the last is longer.

    Returns:
        [..., S + 1] ascending edges; the first is near and the last is far, exactly.

    Raises:
        ValueError: on other shapes or S < 1, or near > far or step_size <= 0 where known at trace time.
    """
    near, far = at_least_float32(near, far)
    check_shapes("stepped_edges", near=(near, "..."), far=(far, "..."))
    check_order("stepped_edges", near=near, far=far)
    if num_segments < 1:
        raise ValueError(f"stepped_edges: num_segments is {num_segments}, expected at least 1")
    shift = 0.0 if key is None else uniform(key, (*near.shape, 1))
    count = jnp.arange(num_segments + 1, dtype=near.dtype).reshape((1,) * near.ndim + (-1,))
    (step,) = broadcast("stepped_edges", near.shape, step_size=jnp.asarray(step_size, near.dtype))
    if is_known((step <= 0).any()):
        raise ValueError(f"stepped_edges: step_size is {step.min()}, expected more than 0")
    return edges_after_steps(count, near[..., None], far[..., None], step[..., None], num_segments, shift)


def edges_after_steps(
    count: Num[ArrayLike, "*#batch #edges"],
    near: Float[ArrayLike, "*#batch 1"],
    far: Float[ArrayLike, "*#batch 1"],
    step: Float[ArrayLike, "*#batch 1"],
    num_segments: int,
    shift: Float[ArrayLike, "*#batch 1"] | float = 0.0,
) -> Float[Array, "*batch edges"]:
    """Computes those edges of stepped_edges that follow a number of steps."""
    inner = jnp.minimum(near + (count - shift) * step, far)
    return jnp.where(count == 0, near, jnp.where(count == num_segments, far, inner))


def samples_from_edges(key: Keys | None, edges: Num[ArrayLike, "*batch edges"], *, rule: str = "segments") -> Samples:
    """Places samples in segments: one per segment, at its midpoint or at random, or two Gauss points.

    Args:
        key: None for fixed samples, one key, or one key per ray [...].
        edges: [..., S + 1] ascending, in t. The last may be inf: the segment is then sampled in 1 / t, and its
            midpoint is at twice its lower edge (which must be > 0).
        rule: "segments": density and colour are assumed constant over the segment. A key draws t
            uniformly in it (Eq. 2); the midpoint makes the quadrature second order.
            "gauss": two samples in each segment, at (1 -+ 1 / sqrt(3)) / 2 of it, each representing
            half of its length; fourth order where the scene is smooth. A key draws the edges instead of the
            samples, each between the adjacent midpoints; the first and last edge stay fixed.

    Returns:
        Samples [..., S], or [..., 2 S] for "gauss". A drawn t lies in [edge, next edge), exactly; a
        segment of width 0 has t on its edge and delta 0.

    Raises:
        ValueError: on fewer than two edges, other shapes of the key, or another rule.
    """
    (edges,) = at_least_float32(edges)
    _check_edges("samples_from_edges", edges)
    if rule == "gauss":
        return _gauss_samples(edges if key is None else _jittered_edges(key, edges))
    if rule != "segments":
        raise ValueError(f"samples_from_edges: rule is {rule!r}, expected 'segments' or 'gauss'")
    lower, upper = edges[..., :-1], edges[..., 1:]
    return Samples(t=_draw_between(key, lower, upper), delta=_width(lower, upper), rule=rule)


def samples_from_points(t: Num[ArrayLike, "*batch samples"], *, last_delta: Num[ArrayLike, ""] = 1e10) -> Samples:
    """Makes samples that each represent the gap to the next one, the released codes' quadrature.

    delta_i = t_{i+1} - t_i, as below Eq. 3. The last sample represents last_delta, which makes every ray
    that ends in matter opaque. The rule "segments" is more accurate: this rule is of first order, and
    with the default last_delta it does not converge where the far end lies inside matter.

    Args:
        t: [..., S] ascending, S >= 1.
        last_delta: in t; the 2020 code uses 1e10.

    Returns:
        Samples [..., S].
    """
    (t,) = at_least_float32(t)
    check_shapes("samples_from_points", t=(t, "... S"))
    last = jnp.full_like(t[..., :1], last_delta)
    return Samples(t=t, delta=jnp.concatenate([jnp.diff(t), last], axis=-1), rule="points")


def inverse_cdf(
    edges: Num[ArrayLike, "*batch edges"],
    weights: Num[ArrayLike, "*batch segments"],
    u: Num[ArrayLike, "*batch points"],
) -> Float[Array, "*batch points"]:
    """Inverts the cumulative distribution of a piecewise-constant density (Section 5.2).

    The weights, divided by their sum, are the probabilities of the segments. The inverse interpolates linearly
    between the values of their cumulative sum.

    Args:
        edges: [..., S + 1] ascending, in t.
        weights: [..., S] >= 0, of any scale. If all are 0 (or below 1.2e-38, the smallest
            normal float), all segments have the same probability.
        u: [..., N] in [0, 1].

    Returns:
        [..., N] in t, within [first edge, last edge], ascending where u is. Gradients with respect
        to edges and u are those of the interpolation. In a segment that ends at inf, 1 / t is
        interpolated. If a weight is NaN, all points are.
    """
    edges, weights, u = at_least_float32(edges, weights, u)
    check_shapes("inverse_cdf", edges=(edges, "... E"), weights=(weights, "... S"), u=(u, "... N"))
    if edges.shape[-1] != weights.shape[-1] + 1:
        raise ValueError(
            f"inverse_cdf: weights has shape {weights.shape}, expected [..., {edges.shape[-1] - 1}] for edges "
            f"{edges.shape}: one weight per segment"
        )
    # Divided by the largest first, so that the cumulative sum neither under- nor overflows.
    largest = weights.max(axis=-1, keepdims=True)
    empty = largest < jnp.finfo(weights.dtype).tiny
    scaled = jnp.where(empty, 1.0, divide_by_largest(weights, jnp.where(empty, 1.0, largest)))
    sums = jax.lax.cummax(jnp.cumsum(scaled, axis=-1), axis=scaled.ndim - 1)  # a parallel sum can decrease
    cdf = jnp.concatenate([jnp.zeros_like(sums[..., :1]), sums], axis=-1)
    target = u * cdf[..., -1:]
    # The segment is the last one that begins at or before the target and has weight.
    index = _count_below(sums, target)
    lower_sum, upper_sum = _take(cdf, index), _take(cdf, index + 1)
    lower, upper = _take(edges, index), _take(edges, index + 1)
    width = upper_sum - lower_sum
    empty = width <= 0  # NaN is not, so that it is visible
    fraction = jnp.where(empty, 0, divide(target - lower_sum, jnp.where(empty, 1, width)))
    return clamp(_interpolate(lower, upper, fraction), lower, upper)


def importance_points(
    key: Keys | None,
    edges: Num[ArrayLike, "*batch edges"],
    weights: Num[ArrayLike, "*batch segments"],
    *,
    num_points: int,
    padding: float = 0.0,
) -> Float[Array, "*batch points"]:
    """Draws points with a density proportional to the weights (Section 5.2).

    The draws are stratified: one uniform draw in each of N equal parts of the total weight. The points are
    therefore in order without a sort.

    Args:
        key: None for the middle of each part, one key, or one key per ray [...].
        edges: [..., S + 1] ascending, in t.
        weights: [..., S] >= 0. If all are 0, the points are spread evenly over the segments.
        num_points: N >= 1.
        padding: added to every weight. The released codes add 1e-5 to avoid a division by zero, which
            moves samples into empty space on nearly empty rays. The argument exists for parity with them.

    Returns:
        [..., N] ascending points in t, within the edges; NaN if a weight is. No gradient flows through them.

    Raises:
        ValueError: on other shapes, or N < 1.
    """
    edges, weights = jax.lax.stop_gradient(at_least_float32(edges, weights))
    if num_points < 1:
        raise ValueError(f"importance_points: num_points is {num_points}, expected at least 1")
    shape = (*weights.shape[:-1], num_points)
    strata = jnp.broadcast_to(
        jnp.arange(num_points + 1, dtype=weights.dtype) / num_points, (*shape[:-1], num_points + 1)
    )
    u = _draw_between(key, strata[..., :-1], strata[..., 1:])
    return inverse_cdf(edges, weights + padding if padding else weights, u)


def merge_edges(
    edges: Num[ArrayLike, "*batch edges"], points: Num[ArrayLike, "*batch points"]
) -> Float[Array, "*batch merged"]:
    """Splits segments at points and returns the new edges.

    Args:
        edges: [..., S + 1] in t.
        points: [..., N] in t, anywhere.

    Returns:
        [..., S + N + 1] ascending; a repeated edge makes a segment of width 0, which has no weight.
    """
    edges, points = at_least_float32(edges, points)
    check_shapes("merge_edges", edges=(edges, "... E"), points=(points, "... N"))
    return jnp.sort(jnp.concatenate([edges, points], axis=-1), axis=-1)


def stratified_points(
    key: Keys | None,
    near: Num[ArrayLike, "*batch"],
    far: Num[ArrayLike, "*batch"],
    *,
    num_points: int,
    in_disparity: bool = False,
) -> Float[Array, "*batch points"]:
    """Draws the 2020 code's coarse points: near to far inclusive, each between its adjacent midpoints.

    Args:
        key: None for evenly spaced points, one key, or one key per ray [...].
        near: [...] in t.
        far: [...] in t.
        num_points: S >= 2.
        in_disparity: equal steps in 1 / t.

    Returns:
        [..., S] ascending, in t.
    """
    if num_points < 2:
        raise ValueError(f"stratified_points: num_points is {num_points}, expected at least 2")
    if is_known(jnp.isinf(jnp.asarray(far)).any()):
        raise ValueError("stratified_points: far is inf, expected a finite far, where the last point lies")
    points = uniform_edges(near, far, num_segments=num_points - 1, in_disparity=in_disparity)
    if key is None:
        return points
    middles = midpoints(points)
    lower = jnp.concatenate([points[..., :1], middles], axis=-1)
    upper = jnp.concatenate([middles, points[..., -1:]], axis=-1)
    return _draw_between(key, lower, upper)


def midpoints(edges: Float[ArrayLike, "*batch edges"]) -> Float[Array, "*batch segments"]:
    """Computes the midpoints [..., S] of the segments between edges [..., S + 1]."""
    return _interpolate(edges[..., :-1], edges[..., 1:], 0.5)


def split_key(key: Keys | None, num: int) -> tuple[Key[Array, "..."] | None, ...]:
    """Splits a key, or one key per ray, into num independent ones; None gives as many None."""
    if key is None:
        return (None,) * num
    key = typed_key(key)
    keys = jax.random.split(key, num) if key.ndim == 0 else _per_ray(lambda k: jax.random.split(k, num), key)
    return tuple(keys[..., i] for i in range(num))


def uniform(key: Keys, shape: Sequence[int]) -> Float[Array, "..."]:
    """Draws [*shape] uniform numbers in [0, 1) from one key, or from one key per ray (key [*shape[:-1]])."""
    return _draw(jax.random.uniform, key, shape)


def normal(key: Keys, shape: Sequence[int]) -> Float[Array, "..."]:
    """Draws [*shape] standard normal numbers from one key, or from one key per ray (key [*shape[:-1]])."""
    return _draw(jax.random.normal, key, shape)


def _draw(distribution, key, shape):
    key = typed_key(key)
    if key.ndim == 0:
        return distribution(key, shape)
    if key.shape != tuple(shape[:-1]):
        raise ValueError(f"key has shape {key.shape}, expected one key, or one per ray: {tuple(shape[:-1])}")
    return _per_ray(lambda k: distribution(k, shape[-1:]), key)


ONE_KEY = "a key such as jax.random.key(0)"


def typed_key(
    key: Keys, expected: str = "a key such as jax.random.key(0), one key per ray, or None"
) -> Key[Array, "..."]:
    """Returns a typed key, or keys, from what a function is given; ValueError, with what is expected, on all else."""
    kind = getattr(key, "dtype", type(key).__name__)
    if hasattr(key, "dtype") and jnp.issubdtype(kind, jax.dtypes.prng_key):
        return key
    if kind != jnp.uint32 or not jnp.ndim(key):
        raise ValueError(f"key is {key!r} ({kind}), expected {expected}")
    return jax.random.wrap_key_data(key)


def _per_ray(function, keys):
    flat = jax.vmap(function)(keys.reshape(-1))
    return flat.reshape(*keys.shape, *flat.shape[1:])


def _gauss_samples(edges):
    lower, upper = edges[..., :-1], edges[..., 1:]
    nodes = [0.5 - math.sqrt(1 / 12), 0.5 + math.sqrt(1 / 12)]
    t = jnp.stack([clamp(_interpolate(lower, upper, node), lower, upper) for node in nodes], axis=-1)
    half = 0.5 * _width(lower, upper)
    delta = jnp.stack([half, half], axis=-1)
    flat = (*lower.shape[:-1], 2 * lower.shape[-1])
    return Samples(t=t.reshape(flat), delta=delta.reshape(flat), rule="gauss")


def _jittered_edges(key, edges):
    middles = midpoints(edges)
    inner = _draw_between(key, middles[..., :-1], middles[..., 1:])
    return jnp.concatenate([edges[..., :1], inner, edges[..., -1:]], axis=-1)


def _draw_between(key, lower, upper):
    """Draws in [lower, upper), or returns the middle; rounding never leaves the interval."""
    if key is None:
        return clamp(_interpolate(lower, upper, 0.5), lower, upper)
    draw = _interpolate(lower, upper, uniform(key, lower.shape).astype(lower.dtype))
    # The edges are rounded, so a draw this close to an edge may lie in the neighbouring bin of exact edges.
    finite_upper = jnp.where(jnp.isinf(upper), lower, upper)
    rounding = 2 * jnp.finfo(lower.dtype).eps * jnp.maximum(jnp.abs(lower), jnp.abs(finite_upper))
    margin = jnp.minimum(rounding, 0.25 * _width(lower, finite_upper))
    below = jnp.nextafter(*jax.lax.stop_gradient((upper, lower)))
    return clamp(draw, lower + margin, jnp.minimum(upper - margin, below))


def _interpolate(lower, upper, fraction):
    """Interpolates linearly in t, or in 1 / t where upper is inf."""
    infinite = jnp.isinf(upper)
    at_end = infinite & (fraction == 1)  # where the gradient is infinite, too
    reciprocal = lower / (1 - jnp.where(infinite & ~at_end, fraction, 0))
    start, end = jnp.where(infinite, 0, lower), jnp.where(infinite, 0, upper)  # both ends may be infinite
    return jnp.where(at_end, upper, jnp.where(infinite, reciprocal, start + fraction * (end - start)))


def _width(lower, upper):
    infinite = jnp.isinf(lower)
    return jnp.where(infinite, 0, upper - jnp.where(infinite, 0, lower))  # inf - inf would be NaN


def _count_below(sums, target):
    """Counts the cumulative sums [..., S] that are at most target [..., N], up to the last positive weight."""

    def row(sums, target):
        found = jnp.searchsorted(sums, target, side="right", method="compare_all")
        return jnp.minimum(found, jnp.searchsorted(sums, sums[-1], method="compare_all"))  # u = 1

    flat = jax.vmap(row)(sums.reshape(-1, sums.shape[-1]), target.reshape(-1, target.shape[-1]))
    return flat.reshape(target.shape)


def _take(values, index):
    return jnp.take_along_axis(values, index, axis=-1)


def _check_edges(function, edges):
    check_shapes(function, edges=(edges, "... E"))
    if edges.shape[-1] < 2:
        raise ValueError(f"{function}: edges has shape {edges.shape}, expected [..., S + 1] with S >= 1")
