"""From densities to what a ray sees: weights, colour, depth (Eq. 3 and its sums)."""

import functools
import math

import jax
import jax.numpy as jnp

from jaxnerf.core.safe_math import at_least_float32, divide
from jaxnerf.core.types import check_shapes

# Beyond this optical depth exp(-x) is 0 in every float type, so that nothing changes where a depth
# that is larger, or infinite, is replaced by it: sums and products then stay finite.
_OPAQUE = 1e4


def weights_from_density(density, length, *, rule="segments"):
    """Returns the share of the pixel's colour that each sample contributes.

    Density is constant inside a segment, which makes the quadrature exact:

        w_i = T_i (1 - exp(-sigma_i l_i)),   T_i = exp(-sum_{j<i} sigma_j l_j)      (Eq. 3)

    What the weights leave over passes through to the background: see transmittance.

    Args:
        density: [..., S] sigma >= 0, in 1 / world unit, ordered near to far.
        length: [..., S] l >= 0, in world units. Zero removes the sample: neither the value nor
            the gradient sees its density, even where that is NaN or infinite.
        rule: the rule of the samples, see samples_from_edges. "gauss" moves a part of each cell's
            second weight to its first, which makes the colour, too, of fourth order.

    Returns:
        [..., S] weights in [0, 1], at least float32. An infinite density over a positive length is
        opaque. The gradient is that of Eq. 3 to rounding, also in fog so thick that it cancels.

    Raises:
        ValueError: if the shapes differ (nothing is broadcast here), the rule is unknown, or "gauss" has
            an odd S.
    """
    depth = _optical_depth("weights_from_density", density, length)
    weights = _weights(depth)
    if rule in ("segments", "points"):
        return weights
    if rule != "gauss" or depth.shape[-1] % 2:
        raise ValueError(
            f"weights_from_density: rule {rule!r} with {depth.shape[-1]} samples, wanted 'segments', "
            "'points', or 'gauss' with two samples a cell"
        )
    return _follow_transmittance(weights, depth)


def transmittance(density, length):
    """Returns what passes through all segments, T = exp(-sum_i sigma_i l_i).

    Args:
        density: [..., S] in 1 / world unit.
        length: [..., S] in world units; zero removes the segment.

    Returns:
        [...] in [0, 1]; keeps its digits where 1 - sum of weights has lost them.

    Raises:
        ValueError: if the shapes differ.
    """
    return jnp.exp(-_optical_depth("transmittance", density, length).sum(axis=-1))


def opacity(density, length):
    """Returns the share of light from behind that is stopped, 1 - T, with all its digits also in thin fog.

    Arguments and errors as transmittance; [...] in [0, 1], the sum of the weights.
    """
    return _absorbed(_optical_depth("opacity", density, length).sum(axis=-1))


def exclusive_sum(values):
    """Returns [..., S], the sum of all values [..., S] before each, which must be finite.

    Of optical depths it is the one in the exponent of T_i (Eq. 3).
    """
    return _previous(running_sum(values))


def composite(weights, values, *, background=None, transmittance=None):
    """Returns the weighted sum of values along each ray, over a background.

        C = sum_i w_i c_i + T c_background      (Eq. 3, and the background behind it)

    Args:
        weights: [..., S].
        values: [..., S, C], colours or anything else a sample has, finite also where the weight is 0.
        background: None for black (nothing is added), [C], or [..., C] one a ray.
        transmittance: [...] what passes through; 1 - sum of weights when not given.

    Returns:
        [..., C], at least float32.

    Raises:
        ValueError: on other shapes.
    """
    weights, values = at_least_float32(weights, values)
    check_shapes("composite", weights=(weights, "... S"), values=(values, "... S C"))
    colour = _sum_over_samples(weights, values)
    if background is None:
        return colour
    background = jnp.asarray(background, colour.dtype)
    if background.shape not in (colour.shape, colour.shape[-1:]):
        raise ValueError(
            f"composite: background has shape {background.shape}, wanted {colour.shape[-1:]} or {colour.shape}"
        )
    passing = 1 - weights.sum(axis=-1) if transmittance is None else jnp.asarray(transmittance)
    check_shapes("composite", transmittance=(passing, "..."), colour=(colour, "... C"))
    return colour + passing[..., None] * jnp.broadcast_to(background, colour.shape)


def expected_depth(weights, t, transmittance, *, far):
    """Returns the expected place where light stops, sum_i w_i t_i + T far.

    Args:
        weights: [..., S].
        t: [..., S] in t, where the samples are.
        transmittance: [...] what passes through, counted as stopping at far.
        far: [...] in t, may be inf: a ray that lets anything through is then infinitely deep.

    Returns:
        [...] in t. An empty ray has depth far; never NaN, as nothing is added where nothing passes.
        What multiplies an infinite t or far gets no gradient from it.

    Raises:
        ValueError: on other shapes.
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


def expected_disparity(weights, t):
    """Returns the expected inverse depth, sum_i w_i / t_i.

    Args:
        weights: [..., S].
        t: [..., S] in t, > 0 where a weight is.

    Returns:
        [...] in 1 / t; 0 for an empty ray, also with samples at t = 0. A weight at t = 0 makes it
        inf, with gradient 0.

    Raises:
        ValueError: if the shapes differ.
    """
    weights, t = at_least_float32(weights, t)
    check_shapes("expected_disparity", weights=(weights, "... S"), t=(t, "... S"))
    return divide_or_zero(weights, t).sum(axis=-1)


def packed_weights(density, length, starts, *, longest):
    """Returns the weights of samples of many rays in one row, ray after ray.

    Args:
        density, length: [K], as in weights_from_density.
        starts: [K] bool, the first sample of each ray.
        longest: no ray has more samples.

    Returns:
        [K] weights, and [K] optical depths sigma l, of which none exceeds what lets nothing through.

    Raises:
        ValueError: if the shapes differ.
    """
    depth = _optical_depth("packed_weights", density, length)
    check_shapes("packed_weights", density=(density, "K"), starts=(starts, "K"))
    return _packed_weights(depth, starts, longest), depth


def divide_or_zero(weight, t):
    """Returns weight over t, where 0 / 0 is 0 and an infinite quotient by 0 has no gradient."""
    touching = t == 0
    quotient = divide(jnp.where(touching, 0, weight), jnp.where(touching, 1, t))
    return jnp.where(touching & (weight != 0), jnp.inf * jax.lax.stop_gradient(weight), quotient)


def multiply_or_zero(weight, place):
    """Returns weight times place, where 0 times inf is 0 and an infinite product has no gradient."""
    endless = jnp.isinf(place)
    return jnp.where(endless & (weight > 0), place, weight * jnp.where(endless, 0, place))


def _sum_over_samples(weights, values):
    """Returns the weighted sums; few channels one by one, as an inner axis of 3 fills no vector register."""
    if values.shape[-1] > 4:
        return (weights[..., None] * values).sum(axis=-2)
    return jnp.stack([(weights * values[..., i]).sum(axis=-1) for i in range(values.shape[-1])], axis=-1)


def _optical_depth(function, density, length):
    """Returns sigma l, with what has no length or lets nothing through selected out of the product.

    Both operands are replaced there, as the derivative of a product multiplies by them. Empty space
    without an end (0 times inf) counts for nothing.
    """
    density, length = at_least_float32(density, length)
    check_shapes(function, density=(density, "... S"), length=(length, "... S"))
    opaque = density * length > _OPAQUE
    empty = (length <= 0) | (jnp.isinf(length) & (density == 0))
    plain = ~(opaque | empty)
    depth = jnp.where(plain, density, 0) * jnp.where(plain, length, 0)
    return jnp.where(opaque & ~empty, _OPAQUE, depth)


@jax.custom_jvp
def _weights(depth):
    return _previous(jnp.exp(-running_sum(depth)), first=1) * _absorbed(depth)


@_weights.defjvp
def _weights_jvp(primals, tangents, *, long_ray=4096):
    """Differentiates w_i = T_i - T_{i+1} as it stands.

    In reverse the colours of neighbours are then subtracted before they are summed. The derivative of the
    product subtracts the sum behind a sample from its own colour: in thick fog of one colour nothing is
    left of that. Roundings of the differences add up, so that rays of more than long_ray samples go another
    way to the same end.
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
    return jnp.where(starts, 1, _previous(behind)) * _absorbed(depth)


@_packed_weights.defjvp
def _packed_weights_jvp(longest, primals, tangents):
    """As _weights_jvp."""
    depth, starts = primals
    behind = jnp.exp(-running_sum_since(starts, depth, longest))
    change = behind * running_sum_since(starts, tangents[0], longest)
    weights = jnp.where(starts, 1, _previous(behind)) * _absorbed(depth)
    return weights, change - jnp.where(starts, 0, _previous(change))


def _change_of_long_ray(weights, behind, tangent):
    """Differentiates Eq. 3, and takes the heaviest weight's share from the sum of all, which is known.

    In reverse, the heaviest sample's colour comes off all others before they are summed.
    """
    plain = behind * tangent - weights * _previous(running_sum(tangent))
    total = behind[..., -1:] * tangent.sum(axis=-1, keepdims=True)
    heaviest = _places(weights) == weights.argmax(axis=-1, keepdims=True)
    others = jnp.where(heaviest, 0, plain)
    return jnp.where(heaviest, total - others.sum(axis=-1, keepdims=True), others)


def _follow_transmittance(weights, depth):
    """Returns the weights of half cells, turned into those of the Gauss points in them.

    At the points the integrand is sigma exp(-tau), and of a cell's optical depth tau 1 / sqrt(3) lies
    between them, where half cells have 1 / 2. So the ratio of the first weight to the second grows by
    exp((1 / sqrt(3) - 1 / 2) tau); their sum stays, and with it the fourth order of the opacity. The growth
    ends at tau = 4: in a cell that a wall begins in, the little there is before it must not take its place.
    """
    following = jnp.concatenate([depth[..., 1:], jnp.zeros_like(depth[..., :1])], axis=-1)
    rate = 1 / math.sqrt(3) - 1 / 2
    both = depth + following
    thin = both < 1e-12  # the derivative squares it, and the square must not underflow
    held = jnp.where(thin, 1, both)
    ratio = jnp.where(thin, rate, jnp.expm1(rate * jnp.minimum(held, 4)) / _absorbed(held))
    grown = _absorbed(depth) * ratio
    share = grown / (1 + grown)
    second = jnp.concatenate([weights[..., 1:], jnp.zeros_like(weights[..., :1])], axis=-1)
    moved = jnp.where(_places(depth) % 2 == 0, share * second, 0)
    return weights + moved - _previous(moved)


def running_sum(x, block=16):
    """Returns the sum of all entries up to each.

    By products with a triangle of ones, block by block: faster on a CPU than jnp.cumsum, and as close.
    Entries must be finite, or a whole block is NaN.
    """
    size = x.shape[-1]
    if size <= block:
        ones = jnp.triu(jnp.ones((size, size), x.dtype))
        return jnp.matmul(x, ones, precision="highest")
    count = -(-size // block)
    padding = [(0, 0)] * (x.ndim - 1) + [(0, count * block - size)]
    blocks = jnp.pad(x, padding).reshape(*x.shape[:-1], count, block)
    inside = running_sum(blocks, block)
    total = inside + _previous(running_sum(inside[..., -1], block))[..., None]
    return total.reshape(*x.shape[:-1], -1)[..., :size]


def running_sum_since(starts, x, longest):
    """Returns the sum of all entries [K] from the last start up to each (Hillis and Steele 1986)."""
    step = 1
    while step < min(longest, x.size):
        nothing, closed = jnp.zeros(step, x.dtype), jnp.ones(step, bool)
        x, starts = (
            jnp.where(starts, x, x + jnp.concatenate([nothing, x[:-step]])),
            starts | jnp.concatenate([closed, starts[:-step]]),
        )
        step *= 2
    return x


def _places(x):
    return jnp.arange(x.shape[-1]).reshape((1,) * (x.ndim - 1) + (-1,))


def _previous(x, first=0):
    return jnp.concatenate([jnp.full_like(x[..., :1], first), x[..., :-1]], axis=-1)


@jax.custom_jvp
def _absorbed(depth):
    """1 - exp(-x) without cancellation, in the value (thin) and in the derivative (opaque)."""
    return -jnp.expm1(-depth)


@_absorbed.defjvp
def _absorbed_jvp(primals, tangents):
    return _absorbed(primals[0]), jnp.exp(-primals[0]) * tangents[0]
