"""The pose of an image in a closed-form scene: convergence, what else is estimated, degenerate images."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest
from jax.scipy.spatial.transform import Rotation

from helpers import compiled
from jaxnerf.core import cameras, poses, rendering
from jaxnerf.core.pose_estimation import estimate_pose, moved
from jaxnerf.core.types import Camera

SIZE, NEAR, FAR = 24, 1.5, 4.5
RENDERED = {"near": NEAR, "far": FAR, "num_samples": 24, "num_pixels": 400, "max_iterations": 15, "chunk": 400}
CAMERA = Camera(
    to_world=poses.look_at((2.0, 1.5, 1.6), (0, 0, 0), (0, 0, 1)), focal=jnp.full(2, 26.0), center=jnp.full(2, SIZE / 2)
)


def blobs(x, viewdirs):
    """A smooth ball with colours that vary in all directions."""
    density = 8 * jnp.exp(-2 * (x**2).sum(axis=-1))
    return density, 0.5 + 0.4 * jnp.sin(3 * x + x[..., ::-1])


def grey(x, viewdirs):
    """Fills space, so that every pose shows the same colour."""
    return jnp.full(x.shape[:-1], 4.0), jnp.full(x.shape, 0.5)


@compiled
def image_of(camera):
    rays = cameras.rays_from_pixels(camera, cameras.pixel_grid(SIZE, SIZE), near=NEAR, far=FAR)
    return rendering.render_rays(None, blobs, rays, num_samples=RENDERED["num_samples"]).rgb


def start(degrees, seed=0):
    """Returns the true camera after a turn and a translation that together move the scene in the image."""
    turn, move = np.random.default_rng(seed).normal(size=(2, 3))
    turn *= np.radians(degrees) / np.linalg.norm(turn)
    move *= np.radians(degrees) * 3 / np.linalg.norm(move)
    return moved(CAMERA, jnp.float32([*turn, *move])).to_world


def twist(pose):
    """Returns the twist [6] from the true pose to another one nearby."""
    turn = Rotation.from_matrix(pose[:, :3] @ CAMERA.to_world[:, :3].T).as_rotvec()
    return np.array([*turn, *(pose - CAMERA.to_world)[:, 3]])


@pytest.mark.parametrize("degrees", [1, 12])
def test_it_finds_the_pose(degrees):
    found = estimate_pose(blobs, image_of(CAMERA), CAMERA, start(degrees), **RENDERED)
    assert found.converged and found.residual < 1e-4 and found.iterations < 60
    np.testing.assert_allclose(twist(found.pose), 0, atol=2e-4)
    np.testing.assert_array_equal(found.gains, 1)
    np.testing.assert_array_equal(found.focal, CAMERA.focal)


def test_focal_length_and_gains_are_estimated_from_given_pixels_by_another_renderer():
    pixels = np.stack(np.meshgrid(np.arange(2, 22, 2), np.arange(3, 23, 2)), axis=-1).reshape(-1, 2)
    gains = np.float32([0.7, 1.0, 1.2])
    zoomed = dataclasses.replace(CAMERA, focal=CAMERA.focal / 1.03)

    def render(scene, rays):
        return rendering.render_rays(None, blobs, rays, num_samples=RENDERED["num_samples"])

    options = {**RENDERED, "pixels": pixels, "render": render, "with_focal": True, "with_gains": True}
    found = estimate_pose(lambda x, viewdirs: None, image_of(CAMERA) * gains, zoomed, start(2), **options)
    np.testing.assert_allclose(twist(found.pose), 0, atol=2e-3)
    np.testing.assert_allclose(found.focal, CAMERA.focal, rtol=1e-3)
    np.testing.assert_allclose(found.gains, gains, rtol=1e-3)
    assert found.converged and found.covariance.shape == (6, 6)


def test_rays_that_see_nothing_leave_the_pose_open():
    found = estimate_pose(blobs, image_of(CAMERA), CAMERA, start(1), **{**RENDERED, "near": FAR})
    assert not found.converged and np.isinf(found.covariance).all()
    np.testing.assert_allclose(found.pose, start(1), atol=1e-6)


@pytest.mark.slow
def test_an_image_without_texture_leaves_the_pose_open():
    image = jnp.full((SIZE, SIZE, 3), 0.5)
    found = estimate_pose(grey, image, CAMERA, start(1), **RENDERED)
    assert not found.converged and not np.isnan(found.covariance).any() and np.isfinite(found.pose).all()
    assert (np.diagonal(found.covariance) > 1).all()


def test_nan_in_the_image_is_visible():
    found = estimate_pose(blobs, np.full((SIZE, SIZE, 3), np.nan), CAMERA, start(1), **RENDERED)
    assert not found.converged and np.isnan(found.residual) and np.isinf(found.covariance).all()


@pytest.mark.parametrize("name, image, pose", [("image", jnp.ones((4, 4)), start(1)), ("start", None, jnp.eye(4))])
def test_wrong_shapes_are_named(name, image, pose):
    image = jnp.ones((4, 4, 3)) if image is None else image
    with pytest.raises(ValueError, match=f"estimate_pose: {name} has shape"):
        estimate_pose(blobs, image, CAMERA, pose, **RENDERED)
