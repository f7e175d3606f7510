"""Contraction of unbounded space into a cube (after arXiv:2111.12077, Eq. 10).

The largest component replaces the Euclidean length of that equation, so that the image is a cube.
"""

import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float

from jaxnerf.core.types import check_shapes


def contract(x: Float[ArrayLike, "*batch 3"]) -> Float[Array, "*batch 3"]:
    """Maps all of space into the cube [-2, 2]^3 and leaves the cube [-1, 1]^3 unchanged.

    Args:
        x: [..., 3], in units of half the side of the unchanged cube.

    Returns:
        [..., 3]; x with m = max |x_i| > 1 is scaled to 2 - 1 / m and keeps its direction. Components beyond 1e30
        count as 1e30, so that infinity maps to 2.
    """
    check_shapes("contract", x=(x, "... 3"))
    x = jnp.clip(x, -1e30, 1e30)
    largest = _largest(x)
    outside = largest > 1
    safe = jnp.where(outside, largest, 1)
    return jnp.where(outside, x / safe * (2 - 1 / safe), x)


def length_scale(x: Float[ArrayLike, "*batch 3"]) -> Float[Array, "*batch"]:
    """Computes the factor by which `contract` scales lengths at x, alike in all directions (arXiv:2304.06706).

    It is the cube root of the determinant of the Jacobian: 1 where m = max |x_i| is at most 1, and
    ((2 m - 1) / m^3)^(2/3) outside.

    Args:
        x: [..., 3], see `contract`.

    Returns:
        [...] in [0, 1]; 0 at infinity.
    """
    check_shapes("length_scale", x=(x, "... 3"))
    largest = _largest(jnp.clip(x, -1e30, 1e30))[..., 0]
    inverse = 1 / jnp.maximum(largest, 1)
    # Roots of factors, as the inverse of m^3 would underflow.
    return jnp.where(largest > 1, (jnp.cbrt(2 - inverse) * jnp.cbrt(inverse) ** 2) ** 2, 1)


def expand(y: Float[ArrayLike, "*batch 3"]) -> Float[Array, "*batch 3"]:
    """Inverts `contract`: returns x with contract(x) = y, for components |y_i| < 2."""
    check_shapes("expand", y=(y, "... 3"))
    largest = _largest(y)
    outside = largest > 1
    safe = jnp.where(outside, largest, 1)
    return jnp.where(outside, y / safe / (2 - safe), y)


def _largest(x):
    return jnp.abs(x).max(axis=-1, keepdims=True)
