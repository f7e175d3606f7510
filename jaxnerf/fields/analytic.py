"""Media whose light is known: what the renderer is proved against, and what other renderers may be.

Each function returns a Medium, a scene with its own answer. Densities are in 1 / world unit. The colour is
affine in place, rgb + rgb_slope x, so that it varies inside the medium and the colour of a ray follows
from where its light stops on average:

    T = exp(-tau(far)),   D = near + integral of exp(-tau(t)) dt,   C = (1 - T) c(o) + rgb_slope d (D - T far)

tau is in closed form everywhere. So is the integral in homogeneous media; in the others Gauss-Legendre
panels sum exp(-tau), within 1e-9 in float64 up to optical depths of some hundreds. Parameters may be
traced: the answers are differentiable, in them and in the rays.
"""

import math
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxnerf.core.safe_math import norm
from jaxnerf.core.types import SceneFn

GREY = (0.5, 0.5, 0.5)


class Exact(NamedTuple):
    """What a ray [...] truly sees; far must be finite."""

    rgb: jax.Array  # [..., 3] over a black background
    opacity: jax.Array  # [...] with all its digits also in thin fog, but in the tail of a blob
    transmittance: jax.Array  # [...]
    depth: jax.Array  # [...] in t, what passes through counts at far


class Medium(NamedTuple):
    """A scene and its own answer."""

    scene: SceneFn
    exact: Callable  # Rays [...] -> Exact [...]


def slab(density, *, lower, upper, rgb=GREY, rgb_slope=None):
    """Returns fog of constant density where lower <= z < upper."""

    def inside(x):
        return (x[..., 2] >= lower) & (x[..., 2] < upper)

    def interval(rays):
        return _between_planes(rays, lower, upper)

    return _homogeneous(density, inside, interval, rgb, rgb_slope)


def ball(density, *, center=(0.0, 0.0, 0.0), radius=1.0, rgb=GREY, rgb_slope=None):
    """Returns fog of constant density inside a ball."""

    def inside(x):
        return ((x - _like(center, x)) ** 2).sum(axis=-1) < radius**2

    def interval(rays):
        middle, square, size = _closest(rays, center)
        hits = square < radius**2
        half = jnp.where(hits, jnp.sqrt(jnp.where(hits, radius**2 - square, 1)), 0) / size
        return middle - half, middle + half

    return _homogeneous(density, inside, interval, rgb, rgb_slope)


def two_colours(density, *, height=0.0, below=(1.0, 0.0, 0.0), above=(0.0, 0.0, 1.0)):
    """Returns fog of constant density everywhere, of one colour where z < height and another elsewhere."""

    def scene(x, viewdirs):
        high = (x[..., 2] >= height)[..., None]
        return jnp.full_like(x[..., 0], density), jnp.where(high, _like(above, x), _like(below, x))

    def exact(rays):
        rise, size = rays.directions[..., 2], norm(rays.directions)
        crossing = (height - rays.origins[..., 2]) / jnp.where(rise == 0, 1, rise)
        # A ray that crosses before it begins, or never, keeps its first colour to the end.
        crossing = jnp.where((rise == 0) | (crossing <= rays.near), rays.far, jnp.minimum(crossing, rays.far))
        answer = _exact_homogeneous(density, rays, rays.near, rays.far, GREY, None)
        begin = rays.origins[..., 2] + rays.near * rise
        first_is_high = ((begin > height) | ((begin == height) & (rise >= 0)))[..., None]
        low, high = _like(below, rays.origins), _like(above, rays.origins)
        first, second = jnp.where(first_is_high, high, low), jnp.where(first_is_high, low, high)
        stopped = -jnp.expm1(-density * size * (crossing - rays.near))[..., None]
        return answer._replace(rgb=first * stopped + second * (answer.opacity[..., None] - stopped))

    return Medium(scene, exact)


def atmosphere(density, *, scale_height=1.0, rgb=GREY, rgb_slope=None):
    """Returns an atmosphere of density * exp(-z / scale_height)."""

    def local(x):
        return density * jnp.exp(-x[..., 2] / scale_height)

    def interval(rays):
        return rays.near, rays.far

    def optical_depth(rays, start, t):
        rise = rays.directions[..., 2] / scale_height
        begin = jnp.exp(-(rays.origins[..., 2] / scale_height + rise * start))
        return density * norm(rays.directions) * begin * (t - start) * _mean_decay(rise * (t - start))

    return _heterogeneous(local, interval, optical_depth, rgb, rgb_slope)


def linear(rate, *, rgb=GREY, rgb_slope=None):
    """Returns a medium of density rate * z where z > 0, and empty space below."""

    def local(x):
        return rate * jnp.maximum(x[..., 2], 0)

    def interval(rays):
        return _between_planes(rays, 0.0, jnp.inf)

    def optical_depth(rays, start, t):
        height = rays.origins[..., 2] + 0.5 * (start + t) * rays.directions[..., 2]
        return rate * norm(rays.directions) * height * (t - start)

    return _heterogeneous(local, interval, optical_depth, rgb, rgb_slope)


def blob(density, *, center=(0.0, 0.0, 0.0), deviation=1.0, rgb=GREY, rgb_slope=None):
    """Returns a Gaussian cloud, density * exp(-|x - center|^2 / (2 deviation^2))."""

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
    return _answer(rays, start, end, depth, (end - start) * _mean_decay(depth), rgb, rgb_slope)


def _heterogeneous(local, interval, optical_depth, rgb, rgb_slope, panels=32, nodes=16):
    def scene(x, viewdirs):
        return local(x), _affine(x, rgb, rgb_slope)

    def exact(rays):
        start, end = (jnp.clip(t, rays.near, rays.far) for t in interval(rays))
        end = jnp.maximum(start, end)
        places, shares = np.polynomial.legendre.leggauss(nodes)
        places = ((np.arange(panels)[:, None] + 0.5 + places / 2) / panels).reshape(-1)

        def passing(place):
            return jnp.exp(-optical_depth(rays, start, start + place * (end - start)))

        values = jax.vmap(passing)(jnp.asarray(places, start.dtype))
        shares = jnp.asarray(np.tile(shares, panels) / (2 * panels), start.dtype)
        integral = (end - start) * jnp.tensordot(shares, values, axes=1, precision="highest")
        return _answer(rays, start, end, optical_depth(rays, start, end), integral, rgb, rgb_slope)

    return Medium(scene, exact)


def _answer(rays, start, end, optical_depth, integral, rgb, rgb_slope):
    """Returns Exact from the optical depth of [start, end] and the integral of what passes there."""
    opacity, passing = -jnp.expm1(-optical_depth), jnp.exp(-optical_depth)
    depth = start + integral + passing * (rays.far - end)
    colour = opacity[..., None] * _affine(rays.origins, rgb, rgb_slope)
    if rgb_slope is not None:
        stop = start + integral - passing * end  # the sum of t over what stops
        change = (_like(rgb_slope, rays.origins, 2) * rays.directions[..., None, :]).sum(axis=-1)
        colour = colour + change * stop[..., None]
    return Exact(colour, opacity, passing, depth)


def _affine(x, rgb, rgb_slope):
    """Returns the colour [..., 3] at x: rgb [3] at the world's origin, rgb_slope [3, 3] a row a channel."""
    constant = jnp.broadcast_to(_like(rgb, x), x.shape)
    if rgb_slope is None:
        return constant
    return constant + (_like(rgb_slope, x, 2) * x[..., None, :]).sum(axis=-1)


def _between_planes(rays, lower, upper):
    """Returns where rays enter lower <= z < upper and leave it; the same t where they miss it."""
    height, rise = rays.origins[..., 2], rays.directions[..., 2]
    level = rise == 0

    def meets(plane):
        endless = jnp.isinf(plane)
        place = (jnp.where(endless, 0, plane) - height) / jnp.where(level, 1, rise)
        return jnp.where(endless, jnp.where(rise > 0, plane, -plane), place)

    ends = [meets(lower), meets(upper)]
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
    """Returns (1 - exp(-x)) / x, by its series near 0, where the derivative would cancel."""
    small = jnp.abs(x) < 0.1
    terms = [(-1) ** n / math.factorial(n + 1) for n in range(10)]
    series = jnp.polyval(jnp.asarray(terms[::-1], x.dtype), jnp.where(small, x, 0))
    return jnp.where(small, series, -jnp.expm1(-x) / jnp.where(small, 1, x))


def _like(value, x, axes=1):
    """Returns a small array in x's type, with leading axes to spread over x's."""
    value = jnp.asarray(value, x.dtype)
    return value.reshape(*(1,) * (x.ndim - 1), *value.shape[value.ndim - axes :])
