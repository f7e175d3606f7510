"""Reflected directions, and their encoding at a roughness (arXiv:2112.03907)."""

import functools
import math
from collections.abc import Sequence

import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float

from jaxnerf.core.safe_math import at_least_float32


def reflect(
    viewdirs: Float[ArrayLike, "*#batch 3"], normals: Float[ArrayLike, "*#batch 3"]
) -> Float[Array, "*batch 3"]:
    """Computes the directions in which surfaces are seen to reflect: d - 2 (d . n) n (arXiv:2112.03907, Eq. 4).

    Args:
        viewdirs: d, [..., 3] unit length, from the camera into the scene.
        normals: n, [..., 3] unit length; the sign has no effect. 0 leaves the direction as it is.

    Returns:
        [..., 3] unit length, away from the surface: the direction that the light of a mirror comes from.
    """
    viewdirs, normals = at_least_float32(viewdirs, normals)
    return viewdirs - 2 * (viewdirs * normals).sum(axis=-1, keepdims=True) * normals


def integrated_directional_encoding(
    directions: Float[ArrayLike, "*batch 3"],
    roughness: Float[ArrayLike, "*batch"],
    *,
    degrees: Sequence[int] = (1, 2, 4, 8),
) -> Float[Array, "*batch harmonics"]:
    """Encodes directions by the mean of real spherical harmonics over a lobe around each (arXiv:2112.03907, Eq. 8).

        exp(-l (l + 1) roughness / 2) Y_lm(direction)        for each degree l, and m from -l to l

    The lobe is a von Mises-Fisher distribution of concentration kappa = 1 / roughness, whose mean of Y_lm is
    attenuated by nearly this factor. With the roughness in place of kappa, a mirror is an ordinary value, 0.

    Args:
        directions: [..., 3] unit length.
        roughness: [...] at least 0: 0 for a mirror, whose harmonics are not attenuated; infinite for a lobe of all
            directions, whose harmonics are 0.
        degrees: l, each at least 1, ascending.

    Returns:
        [..., sum of 2 l + 1], degree by degree, m ascending, at least float32. They are polynomials, so the gradient
        is finite for all finite inputs, and 0 where the roughness is infinite.

    Raises:
        ValueError: if a degree is below 1, above 16, or not larger than the one before it.
    """
    degrees = tuple(degrees)
    if not degrees or list(degrees) != sorted({*degrees}) or degrees[0] < 1 or degrees[-1] > _MAX_DEGREE:
        raise ValueError(
            f"integrated_directional_encoding: degrees are {degrees}, expected ascending whole numbers from 1 to "
            f"{_MAX_DEGREE}"
        )
    directions, roughness = at_least_float32(directions, roughness)
    rows = encode_rows([directions[..., axis] for axis in range(3)], roughness, degrees=degrees)
    return jnp.stack(rows, axis=-1)


def encode_rows(
    direction: Sequence[Float[Array, "*shape"]], roughness: Float[Array, "*shape"], *, degrees: Sequence[int]
) -> list[Float[Array, "*shape"]]:
    """Computes the same encoding for the components x, y and z of directions, each [...], as a list of arrays [...]."""
    rows = []
    for degree, harmonics in zip(degrees, _harmonics(*direction, degrees), strict=True):
        left = jnp.exp(-degree * (degree + 1) / 2 * roughness)
        rows += [left * each for each in harmonics]
    return rows


_MAX_DEGREE = 16  # float32 loses three digits in the recurrence up to there


def _harmonics(x, y, z, degrees):
    """Returns the 2 l + 1 real spherical harmonics of each degree l, as lists of arrays.

    Y_lm = N_lm Q_l^|m|(z) Re or Im (x + i y)^|m|, where Q = P_l^m / sin^m is a polynomial, so that no pole is special.
    """
    highest = degrees[-1]
    cosines, sines = [jnp.ones_like(x)], [jnp.zeros_like(x)]
    for _ in range(highest):
        a, b = cosines[-1], sines[-1]
        cosines.append(x * a - y * b)
        sines.append(x * b + y * a)
    columns = [_associated(z, m, highest) for m in range(highest + 1)]
    return [
        [
            _normalization(degree, abs(m)) * columns[abs(m)][degree - abs(m)] * (cosines if m >= 0 else sines)[abs(m)]
            for m in range(-degree, degree + 1)
        ]
        for degree in degrees
    ]


def _associated(z, order, highest):
    """Returns the associated Legendre polynomials of an order over sin^order, of the degrees from the order on."""
    values = [jnp.full_like(z, math.prod(range(1, 2 * order, 2)))]
    if highest > order:
        values.append((2 * order + 1) * z * values[0])
    for degree in range(order + 2, highest + 1):
        last, before = values[-1], values[-2]
        values.append(((2 * degree - 1) * z * last - (degree + order - 1) * before) / (degree - order))
    return values


@functools.cache
def _normalization(degree, order):
    """Returns the factor that gives a real harmonic a mean square of 1 / (4 pi) over the sphere."""
    ratio = math.factorial(degree - order) / math.factorial(degree + order)
    return math.sqrt((2 * degree + 1) / (4 * math.pi) * ratio * (2 if order else 1))
