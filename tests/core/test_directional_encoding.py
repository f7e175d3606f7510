"""The encoding of directions: against scipy's harmonics and the exact mean over a lobe, in float64."""

import functools

import jax
import numpy as np
import pytest
from scipy.special import ive, sph_harm_y

from helpers import assert_batch_is_vmap_is_jit, compiled
from jaxnerf import integrated_directional_encoding

encode = compiled(integrated_directional_encoding, "degrees")


def directions(count, seed=0):
    vectors = np.random.default_rng(seed).normal(size=(count, 3))
    vectors[:6] = np.concatenate([np.eye(3), -np.eye(3)])  # with the poles
    return np.float32(vectors / np.linalg.norm(vectors, axis=-1, keepdims=True))


def exact(vectors, degree):
    """Returns the 2 l + 1 real harmonics [N, 2 l + 1] in float64, without the phase (-1)^m."""
    x, y, z = np.float64(vectors).T
    polar, azimuth = np.arctan2(np.hypot(x, y), z), np.arctan2(y, x)
    found = []
    for order in range(-degree, degree + 1):
        value = (-1.0) ** order * sph_harm_y(degree, abs(order), polar, azimuth)
        found.append(value.real if order == 0 else np.sqrt(2) * (value.real if order > 0 else value.imag))
    return np.stack(found, axis=-1)


@pytest.mark.parametrize("degrees", [(1, 2, 4, 8), pytest.param((16,), marks=pytest.mark.slow)], ids=str)
def test_without_roughness_the_harmonics_are_scipys(degrees):
    vectors = directions(300)
    got = encode(vectors, np.zeros(300, np.float32), degrees=degrees)
    expected = np.concatenate([exact(vectors, degree) for degree in degrees], axis=-1)
    assert got.shape == expected.shape == (300, sum(2 * degree + 1 for degree in degrees))
    np.testing.assert_allclose(got, expected, atol=2e-6 if degrees[-1] < 16 else 2e-5)


@pytest.mark.parametrize("concentration", [0.0, 1e-30, 0.3, 1.0, 10.0, 1e4, 1e30, np.inf])
def test_harmonics_are_attenuated_by_the_roughness(concentration):
    """From no concentration, a lobe of all directions, to a mirror."""
    vectors, degrees = directions(50), (1, 2, 4, 8)
    roughness = np.float32(np.inf if concentration < 1e-30 else 1 / concentration)
    got = encode(vectors, np.full(50, roughness), degrees=degrees)
    inverse = np.float64(roughness)
    left = [np.exp(-degree * (degree + 1) / 2 * inverse) for degree in degrees]
    expected = np.concatenate([a * exact(vectors, degree) for a, degree in zip(left, degrees, strict=True)], axis=-1)
    np.testing.assert_allclose(got, expected, atol=2e-6, rtol=2e-5)


def test_the_attenuation_is_nearly_the_mean_over_a_lobe():
    """Of a von Mises-Fisher distribution the mean is I_(l + 1/2)(kappa) / I_(1/2)(kappa) times the harmonic."""
    concentration = np.geomspace(1, 1e3, 40)
    for degree in (1, 2, 4):
        mean = ive(degree + 0.5, concentration) / ive(0.5, concentration)
        ratio = encode(np.tile(np.float32([[0, 0, 1]]), (40, 1)), np.float32(1 / concentration), degrees=(degree,))
        got = ratio[:, degree] / np.sqrt((2 * degree + 1) / (4 * np.pi))
        assert 0 < np.abs(got - mean).max() < 0.11


@pytest.mark.parametrize("roughness", [0.0, 1e-30, 0.1, 5.0, 1e30, np.inf])
def test_gradients_are_those_of_float64(roughness):
    vectors, weights = directions(20), np.random.default_rng(1).normal(size=(20, 8))

    def total(vectors, roughness):
        return (weights * integrated_directional_encoding(vectors, roughness, degrees=(1, 2))).sum()

    given = vectors, np.full(20, roughness, np.float32)
    got = jax.jit(jax.grad(total, argnums=(0, 1)))(*given)
    x, y, z = np.float64(vectors).T
    one, two = (np.exp(-factor * np.float64(given[1])) for factor in (1, 3))
    first, second = np.split(weights, [3], axis=-1)
    c1, c2, c3, c4 = 0.4886025119, 1.0925484306, 0.6307831305, 0.5462742153
    zero = np.zeros_like(x)
    # Columns: derivatives of y, z, x; and of x y, y z, the zonal one, x z, x^2 - y^2 (with x, y, z independent).
    slopes = np.moveaxis(
        np.array(
            [
                [zero, zero, zero + c1, c2 * y, zero, zero, c2 * z, 2 * c4 * x],
                [zero + c1, zero, zero, c2 * x, c2 * z, zero, zero, -2 * c4 * y],
                [zero, zero + c1, zero, zero, c2 * y, 3 * c3 * z, c2 * x, zero],
            ]
        ),
        -1,
        0,
    )
    scaled = np.concatenate([one[:, None] * first, two[:, None] * second], axis=-1)
    np.testing.assert_allclose(got[0], np.einsum("nah,nh->na", slopes, scaled), atol=1e-5)
    parts = exact(vectors, 1), exact(vectors, 2)
    by_roughness = -(one * (first * parts[0]).sum(-1) + 3 * two * (second * parts[1]).sum(-1))
    np.testing.assert_allclose(got[1], by_roughness, atol=1e-5)


def test_nan_stays_visible():
    got = encode(np.float32([[0, 0, np.nan], [0, 0, 1]]), np.float32([0.1, np.nan]), degrees=(1,))
    assert np.isnan(got).any(axis=-1).all()


@pytest.mark.parametrize("degrees", [(), (0, 1), (2, 1), (1, 1), (17,)], ids=str)
def test_wrong_degrees_are_reported(degrees):
    with pytest.raises(ValueError, match="expected ascending whole numbers from 1 to 16"):
        integrated_directional_encoding(directions(8), np.zeros(8), degrees=degrees)


def test_batch_is_vmap_is_jit():
    function = functools.partial(integrated_directional_encoding, degrees=(2,))
    assert_batch_is_vmap_is_jit(function, directions(6), np.float32(np.linspace(0, 2, 6)))
