"""Patches of rays from poses between those of the training cameras."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxnerf
from jaxnerf.core.views import Views
from jaxnerf.data.patch_rays import PATCH_SIDE, draw_patches, in_patches, pose_between

pytest_plugins = ["run_fixtures"]
pytestmark = pytest.mark.usefixtures("unoptimized")
RADIUS = 4.0
draw = functools.partial(jax.jit, static_argnames=("count", "ndc"))(draw_patches)


def circle(count, *, turn):
    """Returns the poses of cameras on a circle that look at its centre, `turn` radians apart."""
    angles = turn * np.arange(count)
    eyes = RADIUS * np.stack([np.cos(angles), np.sin(angles), 0 * angles], axis=-1)
    return jnp.stack([jaxnerf.look_at(eye, (0.0, 0.0, 0.0), (0.0, 0.0, 1.0)) for eye in np.float32(eyes)])


def make_views(poses):
    count, side = len(poses), 12
    cameras = jaxnerf.Camera(
        to_world=poses, focal=jnp.full((count, 2), 15.0), center=jnp.full((count, 2), side / 2), height=side, width=side
    )
    sizes = np.full((count, 2), side)
    pixels, offset = np.zeros((count * side**2, 3), np.uint8), np.arange(count) * side**2
    bounds = {"near": jnp.full(count, 2.0), "far": jnp.full(count, 6.0)}
    return Views(pixels=pixels, offset=offset, size=sizes, cameras=cameras, **bounds)


def test_poses_lie_between_cameras_that_look_the_same_way():
    poses = circle(3, turn=0.8)
    keys = jax.random.split(jax.random.key(0), 200)
    found = np.asarray(jax.jit(jax.vmap(lambda key: pose_between(key, jnp.int32(1), poses)))(keys))
    np.testing.assert_allclose(
        found[:, :, :3].swapaxes(1, 2) @ found[:, :, :3], np.eye(3) * np.ones((200, 1, 1)), atol=1e-5
    )
    np.testing.assert_allclose(np.linalg.det(found[:, :, :3]), 1, atol=1e-5)
    center = found[:, :, 3]
    assert np.linalg.norm(center, axis=1).max() < RADIUS + 1e-4  # inside the triangle of the three
    assert np.std(center, axis=0)[:2].min() > 0.1 and np.abs(center[:, 2]).max() < 1e-5
    np.testing.assert_allclose(found[:, :, 2], center / np.linalg.norm(center, axis=1, keepdims=True), atol=0.05)


def test_a_camera_that_looks_another_way_is_not_mixed_in():
    poses = circle(2, turn=np.pi)
    found = pose_between(jax.random.key(0), jnp.int32(0), poses)
    np.testing.assert_allclose(found, poses[0], atol=1e-5)


@pytest.mark.parametrize("ndc", [False, True])
def test_patches_are_neighbouring_pixels_of_one_camera(ndc):
    poses = jnp.tile(jnp.eye(4)[:3], (3, 1, 1)) if ndc else circle(3, turn=0.5)
    keys, rays = draw(jnp.uint32(0), jnp.int32(5), make_views(poses), count=6, ndc=ndc)
    assert keys.shape == rays.near.shape == (6 * PATCH_SIDE**2,)
    patches = jax.tree.map(in_patches, rays)
    directions = np.asarray(patches.directions)
    for axis in (1, 2):
        steps = np.diff(directions, axis=axis)
        np.testing.assert_allclose(steps, np.broadcast_to(steps[:, :1, :1], steps.shape), atol=1e-5)
        moved = np.diff(np.asarray(patches.origins), axis=axis) if ndc else steps  # NDC rays of one camera are parallel
        assert np.abs(moved).max() > 1e-3
    if not ndc:
        np.testing.assert_allclose(np.ptp(np.asarray(patches.origins), axis=(1, 2)), 0, atol=1e-6)


def test_patches_depend_on_seed_and_step_alone():
    views = make_views(circle(3, turn=0.5))
    first, again, other, seed = (
        draw(jnp.uint32(seed), jnp.int32(step), views, count=6)[1].origins
        for seed, step in ((0, 1), (0, 1), (0, 2), (1, 1))
    )
    np.testing.assert_array_equal(first, again)
    assert not np.allclose(first, other) and not np.allclose(first, seed)
