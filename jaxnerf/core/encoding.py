"""Encodings: of positions by sines and cosines at octaves, or their means; of directions by spherical harmonics."""

import functools
import math
from collections.abc import Sequence

import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float

from jaxnerf.core.safe_math import at_least_float32, clamp
from jaxnerf.core.types import check_shapes

# A fraction of a turn in two floats has digits for this many octaves; the next group begins with a new reduction.
_GROUP = 16
_MAX_FREQS = 64
_MAX_DEGREE = 16  # float32 loses three digits in the recurrence of the harmonics up to there
_MAX_EXTENT = 1e18  # of a frustum, whose square is finite in float32
# 1 / (2 pi) = 0x0.28BE60DB9391... as pieces of 12 bits, so that a product with half the digits of a float32 is exact.
# Six pieces resolve |x| 2^k, up to 1e6 * 2^15, to 2^-27 of a turn; each further group of octaves needs 16 bits more.
_TURNS = 0x28BE60DB9391054A7F09D5F47D4D37
_PIECES = [((_TURNS >> (108 - 12 * j)) & 0xFFF) * 2.0 ** (-12 * (j + 1)) for j in range(10)]
_SIN = [(-1) ** n / math.factorial(2 * n + 1) for n in range(5)]
_COS = [(-1) ** n / math.factorial(2 * n) for n in range(6)]


def positional_encoding(
    x: Float[ArrayLike, "*batch D"], *, num_freqs: int, include_input: bool = True
) -> Float[Array, "*batch features"]:
    """Encodes positions or directions by sines and cosines at octaves of their frequency.

        gamma(x) = (x, sin x, cos x, ..., sin 2^(F-1) x, cos 2^(F-1) x)      (Eq. 4)

    As in the released code there is no factor pi and x itself comes first. In float32 every
    entry is within 3e-7 of the exact sine for |x| <= 1e6: x is reduced, once for every 16 octaves, to a
    fraction of a turn in two floats, whose octaves are exact products with powers of two.

    Args:
        x: [..., D] positions or directions, any unit.
        num_freqs: F octaves, 0 to 64.
        include_input: whether x itself comes first.

    Returns:
        [..., D (1 + 2F)], or [..., D 2F] without the input, ordered as in Eq. 4, each entry D
        wide and at least float32. Infinite x gives NaN in its sines and cosines. Where 2^k x overflows float32, with
        2^k the first octave of 16, those of these 16 are NaN; those of other x beyond 1e6 are in [-1, 1] and lose
        their digits. In float64 the octaves are NaN whose 2^k x overflows. The gradient of sin 2^k x is 2^k cos 2^k x,
        to the same accuracy.

    Raises:
        ValueError: on a scalar or integer x, if F is outside [0, 64], or if there are no features.
    """
    (x,) = _checked("positional_encoding", x, num_freqs, include_input)
    return _features(x.shape, encode_planes(planes_of(x), num_freqs=num_freqs, include_input=include_input))


def integrated_encoding(
    x: Float[ArrayLike, "*batch D"],
    variance: Float[ArrayLike, "*batch D"],
    *,
    num_freqs: int,
    include_input: bool = True,
) -> Float[Array, "*batch features"]:
    """Computes the mean of the positional encoding over a Gaussian (arXiv:2103.13415, Eq. 14).

        E[sin 2^k x] = sin(2^k x) exp(-4^k variance / 2),   and so for cosines

    An octave whose waves are shorter than the Gaussian is averaged away. Only the diagonal of a covariance matters,
    as each wave is one of a single coordinate.

    Args:
        x: [..., D] means, any unit.
        variance: [..., D] of each coordinate, in the square of that unit, at least 0.
        num_freqs: see `positional_encoding`.
        include_input: see `positional_encoding`.

    Returns:
        [..., D (1 + 2F)] or [..., D 2F], ordered as in `positional_encoding`, which it equals exactly where the
        variance is 0. An infinite variance leaves no waves: they are 0, and their gradients, too.

    Raises:
        ValueError: see `positional_encoding`; if the shapes differ.
    """
    x, variance = _checked("integrated_encoding", x, num_freqs, include_input, variance)
    check_shapes("integrated_encoding", x=(x, "... D"), variance=(variance, "... D"))
    options = {"num_freqs": num_freqs, "include_input": include_input, "variance": planes_of(variance)}
    return _features(x.shape, encode_planes(planes_of(x), **options))


def frustum_variance(
    viewdirs: Float[ArrayLike, "*batch #samples 3"],
    radius: Float[ArrayLike, "*batch samples"],
    length: Float[ArrayLike, "*batch samples"],
) -> Float[Array, "*batch samples 3"]:
    """Computes the variance, along each axis, of the part of a cone that a sample stands for.

        length^2 / 12 d^2 + radius^2 / 4 (1 - d^2)      for the direction d

    This is the diagonal of arXiv:2103.13415, Eq. 16, for a frustum far from its apex, a cylinder: the mean is then
    the sample's position. With h half the length over the distance from the apex, that paper's Eq. 7 differs by
    2/3 h^2 of the distance in the mean, and by 16/15 h^2 and 5/3 h^2 of both terms, up to order h^4; h is 0.008 for 64
    segments between 2 and 6.

    Args:
        viewdirs: [..., 1 or S, 3] unit vectors.
        radius: [..., S] of the cone at the sample, at least 0. More than 1e18 counts as 1e18, as for the length.
        length: [..., S] of the interval that the sample stands for, in the same unit, at least 0.

    Returns:
        [..., S, 3] at least 0, in the square of that unit; exactly 0, with gradient 0, for a radius and a length of 0.
    """
    check_shapes("frustum_variance", viewdirs=(viewdirs, "... R 3"), radius=(radius, "... S"), length=(length, "... S"))
    viewdirs, radius, length = at_least_float32(viewdirs, radius, length)
    along = viewdirs**2
    across = along[..., (1, 2, 0)] + along[..., (2, 0, 1)]  # 1 - d^2, which rounding would make negative
    radius, length = (clamp(each, 0.0, _MAX_EXTENT)[..., None] for each in (radius, length))
    return length**2 / 12 * along + radius**2 / 4 * across


def _checked(function, x, num_freqs, include_input, *others):
    """Returns x and others in their common type, which is at least float32."""
    x = jnp.asarray(x)
    if num_freqs < 0 or (num_freqs == 0 and not include_input):
        raise ValueError(
            f"{function}: num_freqs={num_freqs}, include_input={include_input} leaves no "
            "features; use num_freqs >= 1, or 0 with include_input=True"
        )
    if x.ndim == 0 or not jnp.issubdtype(x.dtype, jnp.floating):
        raise ValueError(f"{function}: x is {x.dtype}{list(x.shape)}, expected floating [..., D]")
    return at_least_float32(x, *others)


def planes_of(x: Float[ArrayLike, "*batch D"]) -> Float[Array, "D N"]:
    """Returns vectors [..., D] as [D, N]."""
    return jnp.moveaxis(x, -1, 0).reshape(x.shape[-1], math.prod(x.shape[:-1]))


def _features(shape, planes):
    """Returns encoded planes [features, N] of x of a shape [..., D] as [..., features]."""
    return jnp.moveaxis(planes.reshape(len(planes), *shape[:-1]), 0, -1)


def encode_planes(
    x: Float[Array, "D N"],
    *,
    num_freqs: int,
    include_input: bool = True,
    variance: Float[Array, "D N"] | None = None,
) -> Float[Array, "features N"]:
    """Computes the same encodings for x [D, N] as [D (1 + 2F), N], one row per feature; with a variance, the mean.

    The computation uses this layout because its inner loops are long and a matrix product reads it without a
    transposition.
    """
    if num_freqs > _MAX_FREQS:
        raise ValueError(
            f"positional_encoding: num_freqs is {num_freqs}, expected at most {_MAX_FREQS}, up to which sines have "
            "correct digits; use fewer octaves (the paper uses 10 and 4)"
        )
    parts = [x] if include_input else []
    if num_freqs:
        waves = _octaves(x.reshape(-1), num_freqs)
        if variance is not None:
            scales = _scales(num_freqs, variance.dtype)
            waves = waves * jnp.exp(-0.5 * scales**2 * variance.reshape(1, -1))[:, None]
        parts.append(waves.reshape(2 * num_freqs * x.shape[0], x.shape[1]))
    return jnp.concatenate(parts, axis=0)


@functools.partial(jax.custom_jvp, nondiff_argnums=(1,))
def _octaves(x, num_freqs):
    """Computes sine and cosine of 2^k x [N] for k < F: [F, 2, N]."""
    if x.dtype != jnp.float32:
        angles = _scales(num_freqs, x.dtype) * x[None]
        return jnp.stack([jnp.sin(angles), jnp.cos(angles)], axis=1)
    groups = [
        jax.lax.scan(_next_octave, _fraction_of_turn(x, first), length=min(_GROUP, num_freqs - first))[1]
        for first in range(0, num_freqs, _GROUP)
    ]
    return groups[0] if len(groups) == 1 else jnp.concatenate(groups)


@_octaves.defjvp
def _octaves_jvp(num_freqs, primals, tangents):
    waves = _octaves(primals[0], num_freqs)
    slopes = _scales(num_freqs, waves.dtype) * tangents[0][None]
    return waves, jnp.stack([waves[:, 1] * slopes, -waves[:, 0] * slopes], axis=1)


def _scales(num_freqs, dtype):
    return jnp.array([[2.0**k] for k in range(num_freqs)], dtype)


def _next_octave(turns, _):
    """Returns the angle (in turns) doubled, and the sine and cosine [2, N] of the given angle.

    Plain arithmetic is vectorised; library calls for sine and cosine are not. The octaves are computed in a loop
    because the compiler would otherwise reduce x again for each one.
    """
    high, low = turns
    quarters = 4 * high
    nearest = jnp.round(quarters)
    angle = (quarters - nearest + 4 * low) * (math.pi / 2)  # within pi / 4
    quadrant = nearest.astype(jnp.int32)
    square = angle * angle
    sine, cosine = angle * _polynomial(_SIN, square), _polynomial(_COS, square)
    swap = (quadrant & 1) == 1
    sine, cosine = jnp.where(swap, cosine, sine), jnp.where(swap, sine, cosine)
    sine = jnp.where((quadrant & 2) == 2, -sine, sine)
    cosine = jnp.where(((quadrant + 1) & 2) == 2, -cosine, cosine)
    doubled = 2 * high
    return (doubled - jnp.round(doubled), 2 * low), jnp.stack([sine, cosine])  # both exact


def _fraction_of_turn(x, octave):
    """Returns 2^octave x / (2 pi) minus an integer, as two floats (Payne and Hanek 1983, shortened)."""
    x, count = x * 2.0**octave, 6 + math.ceil(octave / 12)
    bits = jax.lax.bitcast_convert_type(x, jnp.uint32) & jnp.uint32(0xFFFFF000)
    leading = jax.lax.bitcast_convert_type(bits, jnp.float32)
    high, low = jnp.zeros_like(x), jnp.zeros_like(x)
    for part, pieces in ((leading, _PIECES[:count]), (x - leading, _PIECES[: count - 1])):
        for piece in pieces:
            product = part * piece  # exact: 12 by 12 bits
            term = product - jnp.round(product)
            total = high + term
            rest = total - high
            low = low + ((high - (total - rest)) + (term - rest))  # Knuth's exact sum
            high = total
    return high, low


def _polynomial(coefficients, x):
    value = jnp.full_like(x, coefficients[-1])
    for coefficient in coefficients[-2::-1]:
        value = value * x + coefficient
    return value


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
    rows, components = [], [directions[..., axis] for axis in range(3)]
    for degree, harmonics in zip(degrees, _harmonics(*components, degrees), strict=True):
        left = jnp.exp(-degree * (degree + 1) / 2 * roughness)
        rows += [left * each for each in harmonics]
    return jnp.stack(rows, axis=-1)


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
