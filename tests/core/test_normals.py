"""Normals of densities against closed forms, and the loss that ties predicted ones to them."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from helpers import compiled
from jaxnerf import PackedSamples, Rays, Rendering, Samples, density_normals, still_life
from jaxnerf.core.normals import normal_loss, surface_samples

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

    np.testing.assert_array_equal(scaled(1.0), 0)
    assert jax.grad(lambda scale: scaled(scale).sum())(1.0) == 0


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
        got = density_normals(wide, x, VIEW, spacing=1e-3, radius=radius)
        assert degrees(got, outward).max() < 0.5


def test_wrong_shapes_are_reported():
    with pytest.raises(ValueError, match="density_normals: viewdirs has shape"):
        density_normals(ball, np.zeros((2, 5, 3)), np.zeros((2, 4, 3)))


def rays(count):
    ends = np.float32([1.0] * count), np.float32([4.0] * count)
    origins, directions = np.zeros((count, 3), np.float32), np.tile(np.float32([0, 0, 2]), (count, 1))
    return Rays(origins=origins, directions=directions, viewdirs=directions / 2, near=ends[0], far=ends[1])


def rendering(weights, samples):
    count = 3
    plain = np.zeros(count, np.float32)
    return Rendering(
        rgb=np.zeros((count, 3)), opacity=plain, depth=plain, disparity=plain, weights=weights, num_dropped=plain,
        samples=samples,
    )  # fmt: skip


def dense_and_packed():
    """Returns two renderings of three rays with the same samples; the last ray has none."""
    weights = np.float32([[0.1, 0.6, 0.3], [0.5, 0.2, 0.0], [0, 0, 0]])
    t, delta = np.tile(np.float32([1.5, 2.5, 3.5]), (3, 1)), np.float32([[1, 0.5, 1], [1, 1, 0], [0, 0, 0]])
    dense = rendering(weights, Samples(t=t, delta=delta))
    used = np.arange(8) < 5
    flat = {name: np.pad(each[delta > 0], (0, 3)) for name, each in (("weights", weights), ("t", t), ("delta", delta))}
    packed = PackedSamples(**flat, ray_index=np.int32([0, 0, 0, 1, 1, 2, 2, 2]), used=used)
    return dense, rendering(None, packed)


@pytest.mark.parametrize("kind", ["dense", "packed"])
def test_the_sample_of_a_surface_is_the_heaviest(kind):
    made = dict(zip(("dense", "packed"), dense_and_packed(), strict=True))[kind]
    found = surface_samples(ball, rays(3), made)
    np.testing.assert_allclose(found.weights, [0.6, 0.5, 0])
    np.testing.assert_allclose(found.x[:, 0, 2], [5, 3, 2])  # the last at its near end
    np.testing.assert_allclose(found.length, [1, 2, 0])
    np.testing.assert_allclose(surface_samples(ball, rays(3), made, every=2).weights, [0.6, 0])


def test_the_loss_is_zero_for_true_normals_and_grows_to_4():
    x, outward = on_ball(6)
    samples = surface_samples(ball, rays(3), dense_and_packed()[0])
    samples = samples._replace(x=np.swapaxes(x[:, :3], 0, 1), length=np.full(3, 1e-3))
    truth = np.swapaxes(outward[:, :3], 0, 1)
    loss = compiled(lambda factor: normal_loss(ball, lambda x, v: factor * truth, samples))
    np.testing.assert_allclose(loss(1.0), 0, atol=1e-4)
    np.testing.assert_allclose(loss(-1.0), [4 * 0.6, 4 * 0.5, 0], rtol=1e-3)
    np.testing.assert_allclose(loss(0.0), [0.6, 0.5, 0], rtol=1e-3)  # of a normal that is 0
    with pytest.raises(ValueError, match="expected those that the field predicts"):
        normal_loss(ball, None, samples)


def test_the_loss_does_not_move_the_density():
    samples = surface_samples(ball, rays(3), dense_and_packed()[0])

    def loss(scale):
        scaled = lambda x, v: (ball(x, v)[0] ** scale, x)  # noqa: E731
        return normal_loss(scaled, lambda x, v: jnp.ones_like(x), samples).sum()

    assert jax.grad(loss)(1.0) == 0
