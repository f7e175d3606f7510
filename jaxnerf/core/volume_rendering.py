"""Volume rendering integrals of a ray: weights, transmittance, colour and depth (Eq. 3)."""

import functools
import math
from collections.abc import Sequence

import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Bool, Float, Num

from jaxnerf.core.loops import short_loop, vary_like
from jaxnerf.core.safe_math import at_least_float32, clamp, divide
from jaxnerf.core.types import check_shapes

# Beyond this optical depth exp(-x) is 0 in every float type. Larger or infinite depths are replaced by it, so that
# sums and products stay finite.
OPAQUE = 1e4


def weights_from_density(
    density: Num[ArrayLike, "*batch samples"], length: Num[ArrayLike, "*batch samples"], *, rule: str = "segments"
) -> Float[Array, "*batch samples"]:
    """Computes the weight of each segment in the colour of its ray.

        w_i = T_i (1 - exp(-sigma_i l_i)),   T_i = exp(-sum_{j<i} sigma_j l_j)      (Eq. 3)

    This is exact if the density is constant inside each segment. The weights and the `transmittance` of the ray
    sum to 1.

    Args:
        density: [..., S] sigma >= 0, in 1 / world unit, ordered near to far.
        length: [..., S] l >= 0, in world units. Length 0 removes the sample: neither the value nor
            the gradient depends on its density, even if that is NaN or infinite.
        rule: the rule of the samples, see samples_from_edges. "gauss" moves a part of the second weight of each
            segment to the first, which makes the colour of fourth order, too.

    Returns:
        [..., S] weights in [0, 1], at least float32. An infinite density over a positive length is
        opaque. The gradient equals that of Eq. 3 up to rounding, even in dense media, where the terms of Eq. 3 cancel.

    Raises:
        ValueError: if the shapes differ (they are not broadcast), the rule is unknown, or S is odd for "gauss".
    """
    depth = optical_depth("weights_from_density", density, length)
    weights = _weights(depth)
    if rule in ("segments", "points"):
        return weights
    if rule != "gauss" or depth.shape[-1] % 2:
        raise ValueError(
            f"weights_from_density: rule {rule!r} with {depth.shape[-1]} samples, expected 'segments', "
            "'points', or 'gauss' with two samples per segment"
        )
    return _follow_transmittance(weights, depth)


def transmittance(
    density: Num[ArrayLike, "*batch samples"], length: Num[ArrayLike, "*batch samples"]
) -> Float[Array, "*batch"]:
    """Computes the transmittance of all segments, T = exp(-sum_i sigma_i l_i).

    Args:
        density: [..., S] in 1 / world unit.
        length: [..., S] in world units; length 0 removes the segment.

    Returns:
        [...] in [0, 1]; accurate even where 1 - sum of weights would cancel.
    """
    return jnp.exp(-optical_depth("transmittance", density, length).sum(axis=-1))


def opacity(
    density: Num[ArrayLike, "*batch samples"], length: Num[ArrayLike, "*batch samples"]
) -> Float[Array, "*batch"]:
    """Computes the opacity 1 - T in [0, 1], the sum of the weights, accurate even in thin media.

    Takes the arguments of `transmittance` and raises its errors.
    """
    return absorbed(optical_depth("opacity", density, length).sum(axis=-1))


def exclusive_sum(values: Float[ArrayLike, "*batch samples"]) -> Float[Array, "*batch samples"]:
    """Computes the sum of all values before each one, as in the exponent of T_i (Eq. 3).

    The values must be finite, see `running_sum`.
    """
    return _previous(running_sum(values))


def composite(
    weights: Num[ArrayLike, "*batch samples"],
    values: Num[ArrayLike, "*batch samples channels"],
    *,
    background: Num[ArrayLike, "*#batch #channels"] | Sequence[float] | None = None,
    transmittance: Num[ArrayLike, "*batch"] | None = None,
) -> Float[Array, "*batch channels"]:
    """Computes the weighted sum of values along each ray, over a background.

        C = sum_i w_i c_i + T c_background      (Eq. 3, and the background behind it)

    Args:
        weights: [..., S].
        values: [..., S, C], colours or other values; they must be finite even where the weight is 0.
        background: None for black (nothing is added), [C], or [..., C], one per ray; [1] or [..., 1] has the same value
            in all channels.
        transmittance: [...] weight of the background; None for 1 - sum of weights.

    Returns:
        [..., C], at least float32.
    """
    weights, values = at_least_float32(weights, values)
    check_shapes("composite", weights=(weights, "... S"), values=(values, "... S C"))
    color = _sum_over_samples(weights, values)
    if background is None:
        return color
    background = broadcast_background("composite", background, color)
    behind = 1 - weights.sum(axis=-1) if transmittance is None else jnp.asarray(transmittance)
    check_shapes("composite", transmittance=(behind, "..."), color=(color, "... C"))
    return color + behind[..., None] * background


def broadcast_background(
    function: str, background: Num[ArrayLike, "..."] | Sequence[float], color: Float[ArrayLike, "*batch channels"]
) -> Float[Array, "*batch channels"]:
    """Broadcasts a background, one value or C, for all rays or one per ray, to colours [..., C]; or ValueError."""
    background = jnp.asarray(background, color.dtype)
    if background.shape[:-1] not in ((), color.shape[:-1]) or background.shape[-1:] not in ((1,), color.shape[-1:]):
        raise ValueError(
            f"{function}: background has shape {background.shape}, expected {color.shape[-1:]} or {color.shape}"
        )
    return jnp.broadcast_to(background, color.shape)


def expected_depth(
    weights: Num[ArrayLike, "*batch samples"],
    t: Num[ArrayLike, "*batch samples"],
    transmittance: Num[ArrayLike, "*batch"],
    *,
    far: Num[ArrayLike, "*batch"],
) -> Float[Array, "*batch"]:
    """Computes the expected depth of each ray, sum_i w_i t_i + T far.

    Args:
        weights: [..., S].
        t: [..., S] in t, positions of the samples.
        transmittance: [...] T of the whole ray.
        far: [...] in t; may be inf: the depth is then inf unless T is 0.

    Returns:
        [...] in t. An empty ray has depth far. 0 times an infinite t or far is 0, not NaN, and an infinite t or
        far gives its factor gradient 0.
    """
    weights, t, transmittance, far = at_least_float32(weights, t, transmittance, far)
    check_shapes(
        "expected_depth",
        weights=(weights, "... S"),
        t=(t, "... S"),
        transmittance=(transmittance, "..."),
        far=(far, "..."),
    )
    return multiply_or_zero(weights, t).sum(axis=-1) + multiply_or_zero(transmittance, far)


def median_depth(
    density: Num[ArrayLike, "*batch samples"],
    length: Num[ArrayLike, "*batch samples"],
    t: Num[ArrayLike, "*batch samples"],
    delta: Num[ArrayLike, "*batch samples"],
    *,
    far: Num[ArrayLike, "*batch"],
    rule: str = "segments",
) -> Float[Array, "*batch"]:
    """Computes the depth at which the transmittance of each ray falls to one half.

    Behind an edge or in front of a second surface the expected depth lies between surfaces; the median lies on one.
    It is exact if the density is constant inside each segment and each t is in the middle of its segment; for
    "gauss" it is exact within 0.08 delta.

    Args:
        density: [..., S], as in weights_from_density.
        length: as density.
        t: [..., S] in t, the fields of Samples.
        delta: as t.
        far: [...] in t.
        rule: the rule of the samples. With "points", a segment begins at its sample.

    Returns:
        [...] in t, at most far; far where the transmittance stays above one half. A segment of infinite delta counts
        as opaque where it begins. The depth jumps where another surface reaches one half, so that its gradient
        describes only the surface that it lies on.
    """
    depth = optical_depth("median_depth", density, length)
    t, delta, far = at_least_float32(t, delta, far)
    shapes = {"density": (density, "... S"), "t": (t, "... S"), "delta": (delta, "... S"), "far": (far, "...")}
    check_shapes("median_depth", **shapes)
    places = half_depths(depth, running_sum(depth), t, delta, rule=rule)
    return jnp.minimum(first_finite(places), far)


def half_depths(
    depth: Float[Array, "*batch samples"],
    behind: Float[Array, "*batch samples"],
    t: Float[ArrayLike, "*batch samples"],
    delta: Float[ArrayLike, "*batch samples"],
    *,
    rule: str,
    before: Float[ArrayLike, "*#batch #samples"] = 0.0,
) -> Float[Array, "*batch samples"]:
    """Computes the t in each segment from which on the transmittance is at most one half; the first is the median.

    Args:
        depth: [..., S] optical depth of each segment.
        behind: [..., S] its sum up to and including the segment.
        t, delta, rule: see median_depth.
        before: optical depth in front of the first segment.

    Returns:
        [..., S] in t; inf for segments at whose end the transmittance is above one half and for empty ones, NaN where
        depth is.
    """
    behind = behind + before
    positive = jnp.where(depth > 0, depth, 1)
    fraction = divide(clamp(math.log(2) - (behind - depth), 0, positive), positive)
    fraction = fraction if rule == "points" else fraction - 0.5
    place = t + fraction * jnp.where(jnp.isinf(delta), 0, delta)
    return jnp.where((behind < math.log(2)) | (depth <= 0), jnp.inf, place)


def first_finite(places: Float[Array, "*batch samples"]) -> Float[Array, "*batch"]:
    """Returns the first value [...] that is not inf; NaN counts, and without any the result is inf."""
    places = places if places.shape[-1] else jnp.full((*places.shape[:-1], 1), jnp.inf, places.dtype)
    first = (~jnp.isinf(places)).argmax(axis=-1)
    return jnp.take_along_axis(places, first[..., None], axis=-1)[..., 0]


def expected_disparity(
    weights: Num[ArrayLike, "*batch samples"], t: Num[ArrayLike, "*batch samples"]
) -> Float[Array, "*batch"]:
    """Computes the expected inverse depth, sum_i w_i / t_i.

    Args:
        weights: [..., S].
        t: [..., S] in t, > 0 where the weight is.

    Returns:
        [...] in 1 / t; 0 for an empty ray, also with samples at t = 0. A weight at t = 0 makes it
        inf, with gradient 0.
    """
    weights, t = at_least_float32(weights, t)
    check_shapes("expected_disparity", weights=(weights, "... S"), t=(t, "... S"))
    return divide_or_zero(weights, t).sum(axis=-1)


def packed_weights(
    density: Num[ArrayLike, " K"], length: Num[ArrayLike, " K"], starts: Bool[ArrayLike, " K"], *, longest: int
) -> tuple[Float[Array, " K"], Float[Array, " K"]]:
    """Computes the weights of the samples of many rays in one buffer, ray after ray.

    Args:
        density, length: [K], as in weights_from_density.
        starts: [K] bool, the first sample of each ray.
        longest: upper bound of the number of samples of a ray.

    Returns:
        [K] weights, and [K] optical depths sigma l, capped where exp(-sigma l) is 0.
    """
    depth = optical_depth("packed_weights", density, length)
    check_shapes("packed_weights", density=(density, "K"), starts=(starts, "K"))
    return _packed_weights(depth, starts, longest), depth


def divide_or_zero(weight: Float[ArrayLike, "*#shape"], t: Float[ArrayLike, "*#shape"]) -> Float[Array, "*#shape"]:
    """Computes weight / t with 0 / 0 = 0; an infinite quotient has gradient 0."""
    zero = t == 0
    quotient = divide(jnp.where(zero, 0, weight), jnp.where(zero, 1, t))
    infinite = zero & (weight != 0)
    return jnp.where(infinite, jnp.inf * jnp.where(infinite, jax.lax.stop_gradient(weight), 1), quotient)


def multiply_or_zero(weight: Float[ArrayLike, "*#shape"], t: Float[ArrayLike, "*#shape"]) -> Float[Array, "*#shape"]:
    """Computes weight * t with 0 * inf = 0; an infinite product has gradient 0."""
    infinite = jnp.isinf(t)
    return jnp.where(infinite & (weight > 0), t, weight * jnp.where(infinite, 0, t))


def _sum_over_samples(weights, values):
    """Computes the weighted sums; a few channels one by one, as an inner axis of 3 would not be vectorised."""
    if values.shape[-1] > 4:
        return (weights[..., None] * values).sum(axis=-2)
    return jnp.stack([(weights * values[..., i]).sum(axis=-1) for i in range(values.shape[-1])], axis=-1)


def optical_depth(
    function: str, density: Num[ArrayLike, "*batch samples"], length: Num[ArrayLike, "*batch samples"]
) -> Float[Array, "*batch samples"]:
    """Computes sigma l, at most OPAQUE; 0 for segments of length 0 and for empty segments of infinite length.

    In these cases both factors are replaced, because the derivative of a product multiplies by them. The name of the
    calling function is for errors.
    """
    density, length = at_least_float32(density, length)
    check_shapes(function, density=(density, "... S"), length=(length, "... S"))
    empty = (length <= 0) | (jnp.isinf(length) & (density == 0))
    opaque = jnp.where(empty, 0, density) * jnp.where(empty, 0, length) > OPAQUE  # 0 times infinity would be NaN
    plain = ~(opaque | empty)
    depth = jnp.where(plain, density, 0) * jnp.where(plain, length, 0)
    return jnp.where(opaque & ~empty, OPAQUE, depth)


@jax.custom_jvp
def _weights(depth):
    return _previous(jnp.exp(-running_sum(depth)), first=1) * absorbed(depth)


@_weights.defjvp
def _weights_jvp(primals, tangents, *, long_ray=4096):
    """Differentiates w_i = T_i - T_{i+1} term by term.

    In reverse mode, this subtracts the colours of neighbours before it sums them. The derivative of the product
    T_i (1 - exp(-sigma_i l_i)) would subtract the sum behind a sample from the sample's own colour, which cancels
    in a dense medium of one colour. The rounding errors of the differences add up, so that rays of more than
    long_ray samples use _change_of_long_ray.
    """
    (depth,), (tangent,) = primals, tangents
    weights, behind = _weights(depth), jnp.exp(-running_sum(depth))
    if depth.shape[-1] > long_ray:
        return weights, _change_of_long_ray(weights, behind, tangent)
    change = behind * running_sum(tangent)
    return weights, change - _previous(change)


@functools.partial(jax.custom_jvp, nondiff_argnums=(2,))
def _packed_weights(depth, starts, longest):
    behind = jnp.exp(-running_sum_since(starts, depth, longest))
    return jnp.where(starts, 1, _previous(behind)) * absorbed(depth)


@_packed_weights.defjvp
def _packed_weights_jvp(longest, primals, tangents):
    """Differentiates like _weights_jvp."""
    depth, starts = primals
    behind = jnp.exp(-running_sum_since(starts, depth, longest))
    change = behind * running_sum_since(starts, tangents[0], longest)
    weights = jnp.where(starts, 1, _previous(behind)) * absorbed(depth)
    return weights, change - jnp.where(starts, 0, _previous(change))


def _change_of_long_ray(weights, behind, tangent):
    """Differentiates Eq. 3, except that the change of the largest weight is the total minus all others.

    In reverse mode, this subtracts the colour of the heaviest sample from all others before they are summed.
    """
    plain = behind * tangent - weights * _previous(running_sum(tangent))
    total = behind[..., -1:] * tangent.sum(axis=-1, keepdims=True)
    heaviest = _sample_index(weights) == weights.argmax(axis=-1, keepdims=True)
    others = jnp.where(heaviest, 0, plain)
    return jnp.where(heaviest, total - others.sum(axis=-1, keepdims=True), others)


def _follow_transmittance(weights, depth):
    """Converts the weights of half segments to those of the two Gauss points.

    The integrand at the points is sigma exp(-tau). A fraction 1 / sqrt(3) of the segment's optical depth tau lies
    between the points, compared with 1 / 2 between the centres of the halves. The ratio of the first weight to the
    second therefore grows by exp((1 / sqrt(3) - 1 / 2) tau); their sum, and with it the fourth order of the opacity,
    is unchanged. The growth is capped at tau = 4: in a segment in which a wall begins, thin matter in front of the
    wall must not take over its weight.
    """
    following = jnp.concatenate([depth[..., 1:], jnp.zeros_like(depth[..., :1])], axis=-1)
    rate = 1 / math.sqrt(3) - 1 / 2
    both = depth + following
    thin = both < 1e-12  # the derivative squares it, which would underflow
    safe = jnp.where(thin, 1, both)
    ratio = jnp.where(thin, rate, jnp.expm1(rate * jnp.minimum(safe, 4)) / absorbed(safe))
    growth = absorbed(depth) * ratio
    fraction = growth / (1 + growth)
    second = jnp.concatenate([weights[..., 1:], jnp.zeros_like(weights[..., :1])], axis=-1)
    moved = jnp.where(_sample_index(depth) % 2 == 0, fraction * second, 0)
    return weights + moved - _previous(moved)


def running_sum(x: Float[ArrayLike, "*batch samples"], part_size: int = 16) -> Float[Array, "*batch samples"]:
    """Computes the cumulative sum along the last axis by matrix products with triangles of ones.

    On a CPU this is faster than jnp.cumsum and as accurate. The values must be finite: a single
    one that is not makes its whole part NaN.
    """
    size = x.shape[-1]
    if size <= part_size:
        ones = jnp.triu(jnp.ones((size, size), x.dtype))
        return jnp.matmul(x, ones, precision="highest")
    count = -(-size // part_size)
    padding = [(0, 0)] * (x.ndim - 1) + [(0, count * part_size - size)]
    parts = jnp.pad(x, padding).reshape(*x.shape[:-1], count, part_size)
    inside = running_sum(parts, part_size)
    total = inside + _previous(running_sum(inside[..., -1], part_size))[..., None]
    return total.reshape(*x.shape[:-1], -1)[..., :size]


def running_sum_since(starts: Bool[ArrayLike, " K"], x: Num[Array, " K"], longest: int) -> Num[Array, " K"]:
    """Computes the cumulative sum since the last start, for runs of at most longest (Hillis and Steele 1986)."""
    rounds = max(min(longest, x.size) - 1, 0).bit_length()

    def add_before(level, state):
        x, starts = state
        at = x.size - (1 << level)
        before = jnp.concatenate([jnp.zeros_like(x), x]), jnp.concatenate([jnp.ones_like(starts), starts])
        before = [jax.lax.dynamic_slice_in_dim(leaf, at, x.size) for leaf in before]
        return jnp.where(starts, x, x + before[0]), starts | before[1]

    return short_loop(rounds, add_before, vary_like((x, starts), x, starts))[0]


def _sample_index(x):
    return jnp.arange(x.shape[-1]).reshape((1,) * (x.ndim - 1) + (-1,))


def _previous(x, first=0):
    return jnp.concatenate([jnp.full_like(x[..., :1], first), x[..., :-1]], axis=-1)


@jax.custom_jvp
def absorbed(depth: Float[ArrayLike, "*shape"]) -> Float[Array, "*shape"]:
    """Computes 1 - exp(-x) without cancellation, in the value for small x and in the derivative for large x."""
    return -jnp.expm1(-depth)


@absorbed.defjvp
def _absorbed_jvp(primals, tangents):
    return absorbed(primals[0]), jnp.exp(-primals[0]) * tangents[0]
