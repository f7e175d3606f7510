"""Normals of densities against closed forms."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxnerf import density_normals, still_life

RADIUS = 0.8
VIEW = np.float32([[[0, 0, 1]]])


def ball(x, viewdirs):
    """Returns a soft ball, whose density rises by e^2 in a length of 0.05."""
    return 50 * jax.nn.sigmoid((RADIUS - jnp.linalg.norm(x, axis=-1)) / 0.025), jnp.zeros_like(x)


def solid(x, viewdirs):
    return jnp.where(jnp.linalg.norm(x, axis=-1) < RADIUS, jnp.inf, 0), jnp.zeros_like(x)


def on_ball(count, radius=RADIUS):
    vectors = np.random.default_rng(0).normal(size=(1, count, 3))
    outward = vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)
    return np.float32(radius * outward), outward


def degrees(normals, truth):
    cosine = np.clip((np.float64(normals) * truth).sum(axis=-1), -1, 1)
    return np.degrees(np.arccos(cosine))


@pytest.mark.parametrize("spacing, bound", [(None, 0.05), (1e-3, 0.5), (0.02, 7.0)])
def test_normals_of_a_ball_are_its_radii(spacing, bound):
    x, outward = on_ball(200)
    normals = jax.jit(lambda x: density_normals(ball, x, VIEW, spacing=spacing))(x)
    np.testing.assert_allclose(np.linalg.norm(normals, axis=-1), 1, atol=1e-6)
    assert degrees(normals, outward).max() < bound


def test_each_sample_has_a_spacing_of_its_own():
    x, outward = on_ball(6)
    normals = jax.jit(lambda spacing: density_normals(ball, x, VIEW, spacing=spacing))
    one = normals(np.float32([[1e-3, 0.1, 1e-3, 0.1, 0.1, 0.1]]))
    for index, spacing in ((0, 1e-3), (1, 0.1)):
        expected = normals(np.full((1, 6), spacing, np.float32))
        np.testing.assert_allclose(one[0, index], expected[0, index], atol=1e-6)


@pytest.mark.parametrize("spacing", [None, 0.01])
def test_where_the_density_does_not_change_the_normal_is_zero(spacing):
    far, _ = on_ball(4, radius=1e4)

    def scaled(scale):
        return density_normals(lambda x, v: (scale * ball(x, v)[0], x), far, VIEW, spacing=spacing)

    np.testing.assert_array_equal(jax.jit(scaled)(1.0), 0)
    assert jax.jit(jax.grad(lambda scale: scaled(scale).sum()))(1.0) == 0


def test_an_infinite_density_has_normals_at_its_surface_and_none_inside():
    x, outward = on_ball(50)
    x[:, 25:] *= 0.1
    normals = jax.jit(lambda x: density_normals(solid, x, VIEW, spacing=0.05))(x)
    assert degrees(normals[:, :25], outward[:, :25]).max() < 60
    np.testing.assert_array_equal(normals[:, 25:], 0)


def test_normals_of_the_still_life_face_the_camera():
    """At the first surfaces along rays, from any side."""
    x = np.float32([[[-0.38, -0.82, -0.18], [-0.38, -0.38, 0.26], [-0.40, 0.22, 0.0]]])  # of the ball and the pillar
    normals = jax.jit(lambda x: density_normals(still_life, x, VIEW))(x)
    np.testing.assert_allclose(normals[0], [[0, -1, 0], [0, 0, 1], [0, -1, 0]], atol=0.05)


def test_inputs_reach_the_scene_at_all_corners():
    x, outward = on_ball(5)

    def wide(x, viewdirs, *, radius):
        return ball(x, viewdirs)[0] * radius, x

    for radius in (0.5, np.full((1, 5), 0.5, np.float32)):
        got = jax.jit(lambda radius: density_normals(wide, x, VIEW, spacing=1e-3, radius=radius))(radius)
        assert degrees(got, outward).max() < 0.5


def test_wrong_shapes_are_reported():
    with pytest.raises(ValueError, match="density_normals: viewdirs has shape"):
        density_normals(ball, np.zeros((2, 5, 3)), np.zeros((2, 4, 3)))
