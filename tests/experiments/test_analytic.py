"""The closed forms against adaptive quadrature of their own scenes, and against special functions.

Everything here runs in float64.
"""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.integrate
import scipy.special

from helpers import all_finite, assert_batch_is_vmap_is_jit, compiled
from jaxnerf import Rays
from test_scenes import analytic

SLOPE = ((0.1, -0.05, 0.2), (0.0, 0.1, -0.1), (-0.2, 0.0, 0.05))
RGB = (0.4, 0.5, 0.6)
CENTER, RADIUS = (0.1, -0.2, 0.3), 1.1
COLOURED = {"rgb": RGB, "rgb_slope": SLOPE}

# density -> Medium, and the heights or the sphere where its scene has an edge.
MEDIA = {
    "slab": lambda s: analytic.slab(s, lower=-0.6, upper=0.9, **COLOURED),
    "ball": lambda s: analytic.ball(s, center=CENTER, radius=RADIUS, **COLOURED),
    "two_colours": lambda s: analytic.two_colors(s, height=0.25, below=RGB, above=(0.9, 0.1, 0.3)),
    "atmosphere": lambda s: analytic.atmosphere(s, scale_height=1.5, **COLOURED),
    "linear": lambda s: analytic.linear(s, **COLOURED),
    "blob": lambda s: analytic.blob(s, center=CENTER, deviation=0.7, **COLOURED),
}
PLANES = {"slab": (-0.6, 0.9), "two_colours": (0.25,), "linear": (0.0,)}
SHARP = ("slab", "ball", "two_colours")

# origin, direction, near, far
RAYS = {
    "hits": ((-3.0, 0.2, -1.0), (0.8, -0.1, 0.4), 0.5, 7.0),
    "from above": ((0.3, -2.0, 2.5), (0.0, 0.6, -0.7), 0.0, 8.0),
    "straight up": ((0.2, 0.1, -2.0), (0.0, 0.0, 1.0), 1.0, 5.0),
    "misses": ((-3.0, 5.0, 4.0), (1.0, 0.2, 0.3), 0.5, 4.0),
    "behind": ((0.0, 3.0, 2.0), (0.1, 1.0, 0.6), 0.0, 3.0),
    "grazes": ((-3.0, -0.2 + 0.999 * RADIUS, 0.3), (1.0, 0.0, 0.0), 0.0, 6.0),
    "starts inside": ((0.1, 0.0, 0.4), (0.5, 0.5, 0.2), 0.0, 4.0),
    "stays inside": ((0.1, 0.0, 0.4), (0.5, 0.5, 0.2), 0.1, 0.6),
    "level": ((-2.0, -0.4, 0.7), (0.6, 0.1, 0.0), 0.0, 6.0),
    "level on an edge": ((-2.0, -0.4, 0.25), (0.6, 0.1, 0.0), 0.0, 6.0),
    "level below": ((-2.0, -0.4, -1.0), (0.6, 0.1, 0.0), 0.0, 6.0),
    "short direction": ((-3.0, 0.2, -1.0), (0.08, -0.01, 0.04), 5.0, 70.0),
    "long direction": ((-3.0, 0.2, -1.0), (80.0, -10.0, 40.0), 0.005, 0.07),
    "no length": ((0.1, 0.0, 0.4), (0.5, 0.5, 0.2), 1.0, 1.0),
}


@pytest.fixture(autouse=True)
def float64():
    with jax.enable_x64(True):
        yield


def make_rays(names=tuple(RAYS)):
    origins, directions, near, far = (
        np.array(part, np.float64) for part in zip(*(RAYS[n] for n in names), strict=True)
    )
    viewdirs = directions / np.linalg.norm(directions, axis=-1, keepdims=True)
    return Rays(origins=origins, directions=directions, viewdirs=viewdirs, near=near, far=far)


@functools.cache
def exact_of(name):
    """Returns (density, rays) -> Exact, compiled once."""
    return compiled(lambda density, rays: MEDIA[name](density).exact(rays))


@functools.cache
def evaluated(name):
    """Returns (density, x [N, 3]) -> (density [N], rgb [N, 3]) of the scene, compiled once."""
    run = jax.jit(lambda density, x: MEDIA[name](density).scene(x, x[:1]))
    return lambda density, x: [np.asarray(part) for part in run(density, x)]


def edges_on(name, origin, direction):
    """Returns every t where the scene may jump, or bend, on a ray."""
    if name == "ball":
        offset = origin - np.array(CENTER)
        found = np.roots([direction @ direction, 2 * offset @ direction, offset @ offset - RADIUS**2])
        return [root.real for root in found if abs(root.imag) < 1e-12]
    return [(plane - origin[2]) / direction[2] for plane in PLANES.get(name, ()) if direction[2]]


def reference(name, density, origin, direction, near, far):
    """Returns rgb, opacity, transmittance and depth by nested quadrature of the scene along one ray."""
    places, gauss_weights = np.polynomial.legendre.leggauss(16)
    panels = 8
    places = ((np.arange(panels)[:, None] + 0.5 + places / 2) / panels).reshape(-1)
    gauss_weights = np.tile(gauss_weights, panels) / (2 * panels)
    size = np.linalg.norm(direction)
    cuts = [t for t in edges_on(name, origin, direction) if near < t < far]
    cuts = np.array(sorted([*cuts, *np.linspace(near, far, 5)]))

    def optical_depth(start, t):
        """Returns that of [start, t], which holds no edge, and the scene's values at t."""
        at = np.append(start + places * (t - start), t)
        sigma, rgb = evaluated(name)(density, origin + at[:, None] * direction)
        return size * (t - start) * (gauss_weights @ sigma[:-1]), sigma[-1], rgb[-1]

    inner = [optical_depth(a, np.nextafter(b, a))[0] for a, b in zip(cuts[:-1], cuts[1:], strict=True)]
    before = np.concatenate([[0.0], np.cumsum(inner)])
    total = np.zeros(5)
    for start, end, above in zip(cuts[:-1], cuts[1:], before, strict=False):
        if end > start:

            def stopping(t, start=start, above=above):
                tau, sigma, rgb = optical_depth(start, t)
                return sigma * size * np.exp(-above - tau) * np.array([*rgb, 1.0, t])

            total += scipy.integrate.quad_vec(stopping, start, end, epsabs=1e-12, epsrel=1e-11)[0]
    transmitted = np.exp(-before[-1])
    return total[:3], total[3], transmitted, total[4] + transmitted * far


@pytest.mark.slow
@pytest.mark.parametrize("density", [1e-9, 3.0])
@pytest.mark.parametrize("name", MEDIA)
def test_exact_is_the_integral_of_the_scene(name, density):
    rays = make_rays()
    got = exact_of(name)(density, rays)
    for i, ray in enumerate(RAYS):
        expected = reference(name, density, *(part[i] for part in one_ray_each(rays)))
        for part, value in zip(got._fields, expected, strict=True):
            np.testing.assert_allclose(getattr(got, part)[i], value, rtol=1e-9, atol=1e-9, err_msg=ray)
        # Also in thin fog to its own digits.
        np.testing.assert_allclose(got.opacity[i], expected[1], rtol=1e-9, atol=1e-30, err_msg=ray)
    assert (got.opacity >= 0).all() and (got.opacity <= 1).all()
    np.testing.assert_allclose(got.opacity + got.transmittance, 1, atol=1e-15)


def one_ray_each(rays):
    return rays.origins, rays.directions, rays.near, rays.far


@pytest.mark.parametrize("name", MEDIA)
def test_a_medium_without_density_is_empty(name):
    rays = make_rays()
    got = exact_of(name)(0.0, rays)
    np.testing.assert_array_equal(got.opacity, 0)
    np.testing.assert_array_equal(got.transmittance, 1)
    np.testing.assert_allclose(got.depth, rays.far, rtol=1e-14)
    np.testing.assert_allclose(got.rgb, 0, atol=1e-14)


@pytest.mark.parametrize("name", SHARP)
def test_homogeneous_media_are_exact_however_thick(name):
    """The expected depth is one mean free path behind the start of the fog."""
    rays = make_rays(["starts inside"])
    density = 1e9
    got = exact_of(name)(density, rays)
    np.testing.assert_array_equal(got.opacity, 1)
    free_path = 1 / (density * np.linalg.norm(rays.directions[0]))
    np.testing.assert_allclose(got.depth - rays.near, free_path, rtol=1e-9)
    color = evaluated(name)(density, rays.origins)[1]
    np.testing.assert_allclose(got.rgb, color, atol=1e-9)


def upward(z, near, far):
    at = np.array([[0.0, 0.0, 1.0]])
    return Rays(origins=z * at, directions=at, viewdirs=at, near=np.array([near * 1.0]), far=np.array([far * 1.0]))


@pytest.mark.parametrize("density, height", [(0.3, 1.0), (2.0, 0.4), (9.0, 2.0)])
def test_the_depth_of_an_atmosphere_is_an_exponential_integral(density, height):
    near, far, z = 0.5, 6.0, -0.3
    got = compiled(analytic.atmosphere(density, scale_height=height).exact)(upward(z, near, far))
    first, last = (density * height * np.exp(-(z + t) / height) for t in (near, far))
    expi = scipy.special.expi
    free = height * np.exp(-first) * (expi(first) - expi(last))
    np.testing.assert_allclose(got.opacity, -np.expm1(last - first), rtol=1e-12)
    np.testing.assert_allclose(got.depth, near + free, rtol=1e-12)


@pytest.mark.parametrize("rate", [0.02, 1.0, 7.0])
def test_the_depth_of_a_linear_medium_is_an_error_function(rate):
    below, far = 1.5, 4.0  # of the way to where it begins, and of the ray
    got = compiled(analytic.linear(rate).exact)(upward(-below, 0.0, far))
    inside = far - below
    free = np.sqrt(np.pi / (2 * rate)) * scipy.special.erf(inside * np.sqrt(rate / 2))
    np.testing.assert_allclose(got.opacity, -np.expm1(-rate * inside**2 / 2), rtol=1e-12)
    np.testing.assert_allclose(got.depth, below + free, rtol=1e-12)


def test_the_transmittance_of_a_blob_is_that_of_error_functions():
    density, deviation, far = 2.0, 0.4, 6.0

    def transmitted(t):
        unit = np.sqrt(2) * deviation
        erf = scipy.special.erf
        return np.exp(-density * deviation * np.sqrt(np.pi / 2) * (erf((t - 3) / unit) + erf(3 / unit)))

    got = compiled(analytic.blob(density, deviation=deviation).exact)(upward(-3.0, 0.0, far))
    np.testing.assert_allclose(got.transmittance, transmitted(far), rtol=1e-12)
    np.testing.assert_allclose(got.depth, scipy.integrate.quad(transmitted, 0, far)[0], rtol=1e-9)


@pytest.mark.parametrize("name", [*SHARP, "atmosphere"])
def test_a_batch_is_its_rays(name):
    medium = MEDIA[name](0.7)
    rays = make_rays()
    assert_batch_is_vmap_is_jit(medium.exact, rays, rtol=1e-13, atol=1e-14)


@pytest.mark.parametrize("name", MEDIA)
def test_the_outputs_have_the_shapes_of_a_scene(name):
    scene = MEDIA[name](0.7).scene
    for lead in [(5,), (2, 5), (2, 3, 5)]:
        for dtype in (jnp.float32, jnp.float64):
            x = jax.ShapeDtypeStruct((*lead, 3), dtype)
            viewdirs = jax.ShapeDtypeStruct((*lead[:-1], 1, 3), dtype)
            density, rgb = jax.eval_shape(scene, x, viewdirs)
            assert (density.shape, rgb.shape) == (lead, (*lead, 3))
            assert (density.dtype, rgb.dtype) == (dtype, dtype)


def moved(rays, origin, direction):
    origins, directions = rays.origins + origin[None], rays.directions + direction[None]
    return dataclasses.replace(rays, origins=origins, directions=directions)


@functools.cache
def slopes(name):
    """Returns (at [N, 7], rays [R]) -> Jacobian [N, R, 6, 7] of exact and its numbers [N, R, 6]."""

    def numbers(at, rays):
        got = MEDIA[name](at[0]).exact(moved(rays, at[1:4], at[4:]))
        return jnp.concatenate([got.rgb, jnp.stack(got[1:], axis=-1)], axis=-1)

    backward = jax.vmap(jax.jacrev(numbers), in_axes=(0, None))
    return compiled(backward), compiled(jax.vmap(numbers, in_axes=(0, None)))


@pytest.mark.slow
@pytest.mark.parametrize("name", MEDIA)
def test_gradients_are_finite_and_those_of_central_differences(name):
    """Finite everywhere; equal where a derivative exists: not along a tangent, or on an edge."""
    rays, step = make_rays(), 1e-5
    at = np.array([0.0, 1e-9, 0.7, 12.0])[:, None] * np.eye(7)[0]
    backward, numbers = slopes(name)
    got = backward(at, rays)
    assert all_finite(got)
    edgeless = name not in SHARP and name != "linear"
    kept = [i for i, ray in enumerate(RAYS) if edgeless or not ("level" in ray or ray == "grazes")]
    for i, move in enumerate(step * np.eye(7)):
        expected = (numbers(at + move, rays) - numbers(at - move, rays)) / (2 * step)
        np.testing.assert_allclose(got[..., i][:, kept], expected[:, kept], rtol=1e-6, atol=1e-6)
