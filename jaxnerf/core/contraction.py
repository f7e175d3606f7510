"""All of space in a box: plain in its inner half, drawn together outside (after arXiv:2111.12077, Eq. 10).

The largest component takes the place of the length there, so that what comes out fills a cube.
"""

import jax.numpy as jnp

from jaxnerf.core.types import check_shapes


def contract(x):
    """Returns points of all space in the cube from -2 to 2, the cube from -1 to 1 unchanged.

    Args:
        x: [..., 3], in halves of the plain cube's side.

    Returns:
        [..., 3]; m = max |x_i| > 1 becomes 2 - 1 / m, the direction stays. A component beyond 1e30 counts as
        1e30, so that infinity goes to 2.
    """
    check_shapes("contract", x=(x, "... 3"))
    x = jnp.clip(x, -1e30, 1e30)
    largest = _largest(x)
    outside = largest > 1
    safe = jnp.where(outside, largest, 1)
    return jnp.where(outside, x / safe * (2 - 1 / safe), x)


def expand(y):
    """Returns the points x [..., 3] with contract(x) = y [..., 3], whose components are less than 2."""
    check_shapes("expand", y=(y, "... 3"))
    largest = _largest(y)
    outside = largest > 1
    safe = jnp.where(outside, largest, 1)
    return jnp.where(outside, y / safe / (2 - safe), y)


def _largest(x):
    return jnp.abs(x).max(axis=-1, keepdims=True)
