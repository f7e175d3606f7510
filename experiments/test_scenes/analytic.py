"""Media with known solutions, for tests of this renderer or of any other.

Each function makes a Medium, a scene with its exact rendering. Densities are in 1 / world unit. The colour is
affine in position, rgb + rgb_slope x, so that it varies inside the medium and the colour of a ray follows from
its expected depth:

    T = exp(-tau(far)),   D = near + integral of exp(-tau(t)) dt,   C = (1 - T) c(o) + rgb_slope d (D - T far)

tau has a closed form everywhere. So has the integral in homogeneous media; in the others Gauss-Legendre panels
sum exp(-tau), within 1e-9 in float64 up to optical depths of some hundreds. Parameters may be traced: the
results are differentiable with respect to them and to the rays.
"""

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from jaxnerf.core.safe_math import norm
from jaxnerf.core.types import Rays, SceneFn, Vector

GREY = (0.5, 0.5, 0.5)


Color = ArrayLike | Sequence[float]
Slope = ArrayLike | Sequence[Sequence[float]]


class Exact(NamedTuple):
    """The exact rendering of rays [...] whose far is finite.

    Attributes:
        rgb: [..., 3] on a black background.
        opacity: [...] without cancellation also in thin fog, except in the tail of a blob.
        transmittance: [...].
        depth: [...] in t; the transmitted fraction counts at far.
    """

    rgb: Float[Array, "*batch 3"]
    opacity: Float[Array, "*batch"]
    transmittance: Float[Array, "*batch"]
    depth: Float[Array, "*batch"]


class Medium(NamedTuple):
    """A scene and its exact rendering.

    Attributes:
        scene: see render_samples.
        exact: Rays [...] -> Exact [...].
    """

    scene: SceneFn
    exact: Callable[[Rays], Exact]


def slab(
    density: ArrayLike, *, lower: float, upper: float, rgb: Color = GREY, rgb_slope: Slope | None = None
) -> Medium:
    """Makes fog of constant density where lower <= z < upper."""

    def inside(x):
        return (x[..., 2] >= lower) & (x[..., 2] < upper)

    def interval(rays):
        return _between_planes(rays, lower, upper)

    return _homogeneous(density, inside, interval, rgb, rgb_slope)


def ball(
    density: ArrayLike,
    *,
    center: Vector = (0.0, 0.0, 0.0),
    radius: ArrayLike = 1.0,
    rgb: Color = GREY,
    rgb_slope: Slope | None = None,
) -> Medium:
    """Makes fog of constant density inside a ball."""

    def inside(x):
        return ((x - _like(center, x)) ** 2).sum(axis=-1) < radius**2

    def interval(rays):
        middle, square, size = _closest(rays, center)
        hits = square < radius**2
        half = jnp.where(hits, jnp.sqrt(jnp.where(hits, radius**2 - square, 1)), 0) / size
        return middle - half, middle + half

    return _homogeneous(density, inside, interval, rgb, rgb_slope)


def two_colors(
    density: ArrayLike,
    *,
    height: ArrayLike = 0.0,
    below: Color = (1.0, 0.0, 0.0),
    above: Color = (0.0, 0.0, 1.0),
) -> Medium:
    """Makes fog of constant density everywhere, of one colour where z < height and another elsewhere."""

    def scene(x, viewdirs):
        high = (x[..., 2] >= height)[..., None]
        return jnp.full_like(x[..., 0], density), jnp.where(high, _like(above, x), _like(below, x))

    def exact(rays):
        rise, size = rays.directions[..., 2], norm(rays.directions)
        crossing = (height - rays.origins[..., 2]) / jnp.where(rise == 0, 1, rise)
        # A ray that crosses before near, or never, keeps its first colour to the end.
        crossing = jnp.where((rise == 0) | (crossing <= rays.near), rays.far, jnp.minimum(crossing, rays.far))
        grey = _exact_homogeneous(density, rays, rays.near, rays.far, GREY, None)
        begin = rays.origins[..., 2] + rays.near * rise
        first_is_high = ((begin > height) | ((begin == height) & (rise >= 0)))[..., None]
        low, high = _like(below, rays.origins), _like(above, rays.origins)
        first, second = jnp.where(first_is_high, high, low), jnp.where(first_is_high, low, high)
        opacity = -jnp.expm1(-density * size * (crossing - rays.near))[..., None]  # up to the crossing
        return grey._replace(rgb=first * opacity + second * (grey.opacity[..., None] - opacity))

    return Medium(scene, exact)


def atmosphere(
    density: ArrayLike, *, scale_height: ArrayLike = 1.0, rgb: Color = GREY, rgb_slope: Slope | None = None
) -> Medium:
    """Makes an atmosphere of density * exp(-z / scale_height)."""

    def local(x):
        return density * jnp.exp(-x[..., 2] / scale_height)

    def interval(rays):
        return rays.near, rays.far

    def optical_depth(rays, start, t):
        rise = rays.directions[..., 2] / scale_height
        begin = jnp.exp(-(rays.origins[..., 2] / scale_height + rise * start))
        return density * norm(rays.directions) * begin * (t - start) * _mean_decay(rise * (t - start))

    return _heterogeneous(local, interval, optical_depth, rgb, rgb_slope)


def linear(rate: ArrayLike, *, rgb: Color = GREY, rgb_slope: Slope | None = None) -> Medium:
    """Makes a medium of density rate * z where z > 0, and empty space below."""

    def local(x):
        return rate * jnp.maximum(x[..., 2], 0)

    def interval(rays):
        return _between_planes(rays, 0.0, jnp.inf)

    def optical_depth(rays, start, t):
        height = rays.origins[..., 2] + 0.5 * (start + t) * rays.directions[..., 2]
        return rate * norm(rays.directions) * height * (t - start)

    return _heterogeneous(local, interval, optical_depth, rgb, rgb_slope)


def blob(
    density: ArrayLike,
    *,
    center: Vector = (0.0, 0.0, 0.0),
    deviation: ArrayLike = 1.0,
    rgb: Color = GREY,
    rgb_slope: Slope | None = None,
) -> Medium:
    """Makes a Gaussian cloud, density * exp(-|x - center|^2 / (2 deviation^2))."""

    def local(x):
        return density * jnp.exp(-((x - _like(center, x)) ** 2).sum(axis=-1) / (2 * deviation**2))

    def interval(rays):
        return rays.near, rays.far

    def optical_depth(rays, start, t):
        middle, square, size = _closest(rays, center)
        unit = size / (np.sqrt(2) * deviation)
        peak = density * jnp.exp(-square / (2 * deviation**2)) * deviation * np.sqrt(np.pi / 2)
        erf = jax.scipy.special.erf
        return peak * (erf(unit * (t - middle)) - erf(unit * (start - middle)))

    return _heterogeneous(local, interval, optical_depth, rgb, rgb_slope)


def _homogeneous(density, inside, interval, rgb, rgb_slope):
    def scene(x, viewdirs):
        return jnp.where(inside(x), jnp.asarray(density, x.dtype), 0), _affine(x, rgb, rgb_slope)

    def exact(rays):
        start, end = (jnp.clip(t, rays.near, rays.far) for t in interval(rays))
        return _exact_homogeneous(density, rays, start, jnp.maximum(start, end), rgb, rgb_slope)

    return Medium(scene, exact)


def _exact_homogeneous(density, rays, start, end, rgb, rgb_slope):
    depth = density * norm(rays.directions) * (end - start)
    return _exact(rays, start, end, depth, (end - start) * _mean_decay(depth), rgb, rgb_slope)


def _heterogeneous(local, interval, optical_depth, rgb, rgb_slope, panels=32, nodes=16):
    def scene(x, viewdirs):
        return local(x), _affine(x, rgb, rgb_slope)

    def exact(rays):
        start, end = (jnp.clip(t, rays.near, rays.far) for t in interval(rays))
        end = jnp.maximum(start, end)
        places, node_weights = np.polynomial.legendre.leggauss(nodes)
        places = ((np.arange(panels)[:, None] + 0.5 + places / 2) / panels).reshape(-1)

        def transmittance(place):
            return jnp.exp(-optical_depth(rays, start, start + place * (end - start)))

        values = jax.vmap(transmittance)(jnp.asarray(places, start.dtype))
        node_weights = jnp.asarray(np.tile(node_weights, panels) / (2 * panels), start.dtype)
        integral = (end - start) * jnp.tensordot(node_weights, values, axes=1, precision="highest")
        return _exact(rays, start, end, optical_depth(rays, start, end), integral, rgb, rgb_slope)

    return Medium(scene, exact)


def _exact(rays, start, end, optical_depth, integral, rgb, rgb_slope):
    """Returns Exact from the optical depth of [start, end] and the integral of the transmittance there."""
    opacity, transmittance = -jnp.expm1(-optical_depth), jnp.exp(-optical_depth)
    depth = start + integral + transmittance * (rays.far - end)
    color = opacity[..., None] * _affine(rays.origins, rgb, rgb_slope)
    if rgb_slope is not None:
        absorbed = start + integral - transmittance * end  # the integral of t over the absorbed light
        change = (_like(rgb_slope, rays.origins, 2) * rays.directions[..., None, :]).sum(axis=-1)
        color = color + change * absorbed[..., None]
    return Exact(color, opacity, transmittance, depth)


def _affine(x, rgb, rgb_slope):
    """Returns the colour [..., 3] at x: rgb [3] at the world's origin, rgb_slope [3, 3] one row per channel."""
    constant = jnp.broadcast_to(_like(rgb, x), x.shape)
    if rgb_slope is None:
        return constant
    return constant + (_like(rgb_slope, x, 2) * x[..., None, :]).sum(axis=-1)


def _between_planes(rays, lower, upper):
    """Returns the t at which rays enter lower <= z < upper and leave it; the same t where they miss it."""
    height, rise = rays.origins[..., 2], rays.directions[..., 2]
    level = rise == 0

    def crossing(plane):
        endless = jnp.isinf(plane)
        place = (jnp.where(endless, 0, plane) - height) / jnp.where(level, 1, rise)
        return jnp.where(endless, jnp.where(rise > 0, plane, -plane), place)

    ends = [crossing(lower), crossing(upper)]
    within = (height >= lower) & (height < upper)
    start = jnp.where(level, rays.near, jnp.minimum(*ends))
    return start, jnp.where(level, jnp.where(within, rays.far, rays.near), jnp.maximum(*ends))


def _closest(rays, center):
    """Returns the t [...] nearest to center, the square of the distance there, and the directions' length."""
    size = norm(rays.directions)
    offset = _like(center, rays.origins) - rays.origins
    middle = (offset * rays.directions).sum(axis=-1) / size**2
    return middle, ((offset - middle[..., None] * rays.directions) ** 2).sum(axis=-1), size


def _mean_decay(x):
    """Returns (1 - exp(-x)) / x, by its series near 0, where the derivative cancels."""
    small = jnp.abs(x) < 0.1
    terms = [(-1) ** n / math.factorial(n + 1) for n in range(10)]
    series = jnp.polyval(jnp.asarray(terms[::-1], x.dtype), jnp.where(small, x, 0))
    return jnp.where(small, series, -jnp.expm1(-x) / jnp.where(small, 1, x))


def _like(value, x, axes=1):
    """Returns a small array in x's type, with leading axes that broadcast over x's."""
    value = jnp.asarray(value, x.dtype)
    return value.reshape(*(1,) * (x.ndim - 1), *value.shape[value.ndim - axes :])
