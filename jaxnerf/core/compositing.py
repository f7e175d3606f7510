"""From densities to what a ray sees: weights, colour, depth (Eq. 3 and its sums)."""

import jax
import jax.numpy as jnp

from jaxnerf.core.structs import check_shapes


def weights_from_density(density, length):
    """Returns the share of the pixel's colour that each segment contributes.

    Density is constant inside a segment, which makes the quadrature exact:

        w_i = T_i (1 - exp(-sigma_i l_i)),   T_i = exp(-sum_{j<i} sigma_j l_j)      (Eq. 3)

    What the weights leave over passes through to the background: see transmittance.

    Args:
        density: [..., S] sigma >= 0, in 1 / world unit, ordered near to far.
        length: [..., S] l >= 0, in world units. Zero removes the segment: neither the value nor
            the gradient sees its density, even where that is NaN or infinite.

    Returns:
        [..., S] weights in [0, 1]. An infinite density in a segment of positive length is opaque.

    Raises:
        ValueError: if the shapes differ; nothing is broadcast here.
    """
    depth = _optical_depth("weights_from_density", density, length)
    before = _sum_before(depth)
    return jnp.exp(-before) * _absorbed(depth)


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


def composite(weights, values, *, background=None, transmittance=None):
    """Returns the weighted sum of values along each ray, over a background.

        C = sum_i w_i c_i + T c_background      (Eq. 3, and the background behind it)

    Args:
        weights: [..., S].
        values: [..., S, C], colours or anything else a sample has.
        background: None for black (nothing is added), [C], or [..., C] one a ray.
        transmittance: [...] what passes through; 1 - sum of weights when not given.

    Returns:
        [..., C].

    Raises:
        ValueError: on other shapes.
    """
    weights, values = jnp.asarray(weights), jnp.asarray(values)
    check_shapes("composite", weights=(weights, "... S"), values=(values, "... S C"))
    colour = (weights[..., None] * values).sum(axis=-2)
    if background is None:
        return colour
    background = jnp.asarray(background, colour.dtype)
    if background.shape not in (colour.shape, colour.shape[-1:]):
        raise ValueError(
            f"composite: background has shape {background.shape}, wanted {colour.shape[-1:]} or "
            f"{colour.shape}"
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

    Raises:
        ValueError: on other shapes.
    """
    weights, t, far = jnp.asarray(weights), jnp.asarray(t), jnp.asarray(far)
    transmittance = jnp.asarray(transmittance)
    check_shapes(
        "expected_depth",
        weights=(weights, "... S"),
        t=(t, "... S"),
        transmittance=(transmittance, "..."),
        far=(far, "..."),
    )
    passing = transmittance > 0
    behind = jnp.where(passing, transmittance * jnp.where(passing, far, 0), 0)
    seen = weights > 0  # a sample at infinity that has no weight has no place either
    return (weights * jnp.where(seen, t, 0)).sum(axis=-1) + behind


def expected_disparity(weights, t):
    """Returns the expected inverse depth, sum_i w_i / t_i.

    Args:
        weights: [..., S].
        t: [..., S] in t, > 0 where a weight is.

    Returns:
        [...] in 1 / t; 0 for an empty ray, also with samples at t = 0.

    Raises:
        ValueError: if the shapes differ.
    """
    weights, t = jnp.asarray(weights), jnp.asarray(t)
    check_shapes("expected_disparity", weights=(weights, "... S"), t=(t, "... S"))
    seen = weights > 0
    return jnp.where(seen, weights / jnp.where(seen, t, 1), 0).sum(axis=-1)


def _optical_depth(function, density, length):
    """Returns sigma l, with what counts for nothing selected out on both sides of the product.

    That is a segment of no length, and empty space without an end (0 times inf).
    """
    density, length = jnp.asarray(density), jnp.asarray(length)
    check_shapes(function, density=(density, "... S"), length=(length, "... S"))
    kept = (length > 0) & ~(jnp.isinf(length) & (density == 0))
    return jnp.where(kept, jnp.where(kept, density, 0) * jnp.where(kept, length, 0), 0)


def _sum_before(x):
    """Returns the sum of all earlier entries; never inf - inf, as a sum less its last term would be."""
    return jnp.concatenate([jnp.zeros_like(x[..., :1]), jnp.cumsum(x[..., :-1], axis=-1)], axis=-1)


@jax.custom_jvp
def _absorbed(depth):
    """1 - exp(-x) without cancellation, in the value (thin) and in the derivative (opaque)."""
    return -jnp.expm1(-depth)


@_absorbed.defjvp
def _absorbed_jvp(primals, tangents):
    return _absorbed(primals[0]), jnp.exp(-primals[0]) * tangents[0]
