"""The exponential of SE(3) against the matrix exponential, and its derivatives at 0."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg

from helpers import compiled
from jaxnerf.core import poses

se3_exponential = compiled(poses.se3_exponential)


def generator(twist):
    """Returns the matrix [4, 4] whose exponential is the rigid motion of a twist."""
    x, y, z = twist[:3]
    matrix = np.zeros((4, 4))
    matrix[:3, :3] = [[0, -z, y], [z, 0, -x], [-y, x, 0]]
    matrix[:3, 3] = twist[3:]
    return matrix


def twist_of_angle(angle, seed=0):
    twist = np.random.default_rng(seed).normal(size=6)
    twist[:3] *= angle / np.linalg.norm(twist[:3])
    return twist


@pytest.mark.parametrize("angle", [0, 1e-9, 1e-3, 0.5, 0.999, 1.001, 3.0, 7.0])
def test_it_is_the_matrix_exponential(angle):
    twist = twist_of_angle(angle)
    expected = scipy.linalg.expm(generator(twist))[:3]
    np.testing.assert_allclose(se3_exponential(np.float32(twist)), expected, atol=1e-6)


@jax.jit
def derivatives(twist):
    """Returns the first and the second derivative."""
    first = jax.jacrev(poses.se3_exponential)
    return first(twist), jax.jacfwd(first)(twist)


@pytest.mark.slow
@pytest.mark.parametrize("angle", [0, 1e-9, 0.9, 1.1])
def test_its_derivatives_are_finite_differences(angle):
    twist, step = twist_of_angle(angle), 1e-6
    slopes, curvature = derivatives(jnp.float32(twist))
    for axis, offset in enumerate(step * np.eye(6)):
        ends = [scipy.linalg.expm(generator(twist + sign * offset))[:3] for sign in (1, -1)]
        np.testing.assert_allclose(slopes[..., axis], (ends[0] - ends[1]) / (2 * step), atol=2e-6)
    assert np.isfinite(curvature).all()


def test_a_batch_is_its_rows():
    twists = np.float32([twist_of_angle(angle, seed) for seed, angle in enumerate((0, 0.1, 2))]).reshape(3, 1, 6)
    whole = se3_exponential(twists)
    assert whole.shape == (3, 1, 3, 4)
    for row, twist in zip(whole, twists, strict=True):
        np.testing.assert_allclose(row[0], se3_exponential(twist[0]), atol=1e-6)
