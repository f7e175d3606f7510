import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from helpers import all_finite, assert_batch_is_vmap_is_jit, assert_same, compiled
from jaxnerf import (
    Camera,
    Rays,
    look_at,
    ndc_rays,
    ndc_to_t,
    pixel_grid,
    pixel_radius,
    points_on_rays,
    rays_from_pixels,
    undistort,
)
from jaxnerf.core.cameras import _brown, project
from jaxnerf.core.safe_math import norm, normalize

OPENCV = [[0.0] * 4, [0.08, -0.02, 0.004, -0.003], [-0.25, 0.06, 0.002, 0.001], [-0.3, 0.0, 0.0, 0.0]]
FISHEYE = [[0.0] * 4, [0.03, -0.01, 0.004, -0.001], [-0.04, 0.01, -0.003, 0.0005]]


def a_camera(lens="pinhole", distortion=None):
    pose = fast_look_at(np.array([1.0, -2.0, 1.5]), np.zeros(3), np.array([0.0, 0.0, 1.0]))
    return Camera(
        to_world=pose,
        focal=jnp.array([50.0, 60.0]),
        center=jnp.array([41.0, 29.0]),
        distortion=None if distortion is None else jnp.array(distortion, jnp.float32),
        lens=lens,
        height=60,
        width=80,
    )


def opencv(points, k1, k2, p1, p2):
    x, y = points[..., 0], points[..., 1]
    r2 = x * x + y * y
    radial = 1 + k1 * r2 + k2 * r2**2
    x2 = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
    return np.stack([x2, y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y], axis=-1)


def fisheye(points, *k):
    r = np.linalg.norm(points, axis=-1, keepdims=True)
    angle = np.arctan(r)
    bent = angle * (1 + sum(c * angle ** (2 * i + 2) for i, c in enumerate(k)))
    return points * np.where(r > 0, bent / np.where(r > 0, r, 1), 1)


fast_undistort, fast_rays, fast_look_at = map(compiled, (undistort, rays_from_pixels, look_at))
fast_ndc, fast_back, fast_positions, fast_project = map(compiled, (ndc_rays, ndc_to_t, points_on_rays, project))
fast_gradient = compiled(lambda camera, x: jax.jacrev(lambda x: project(camera, x)[0])(x))


def test_pixels_are_x_then_y_through_their_centres():
    grid = pixel_grid(2, 3)
    np.testing.assert_array_equal(grid[:, :, 0], [[0.5, 1.5, 2.5]] * 2)
    np.testing.assert_array_equal(grid[:, :, 1], [[0.5] * 3, [1.5] * 3])
    np.testing.assert_array_equal(pixel_grid(2, 3, offset=0), grid - 0.5)


def test_without_a_lens_points_are_pixels_on_the_plane_at_distance_one():
    points, converged = undistort(a_camera(), jnp.array([[41.0, 29.0], [91.0, 89.0]]))
    np.testing.assert_allclose(points, [[0, 0], [1, 1]], atol=1e-6)
    assert converged.all()


@pytest.mark.parametrize("lens, k", [("opencv", k) for k in OPENCV] + [("fisheye", k) for k in FISHEYE], ids=str)
def test_undistort_inverts_the_lens(lens, k):
    camera, forward = a_camera(lens, k), opencv if lens == "opencv" else fisheye
    points = np.random.default_rng(0).uniform(-0.5, 0.5, (300, 2)) * (1 if lens == "opencv" else 3)
    points[0] = 0
    pixels = forward(points, *k) * np.asarray(camera.focal) + np.asarray(camera.center)
    got, converged = fast_undistort(camera, jnp.asarray(pixels, jnp.float32))
    assert converged.all()
    np.testing.assert_allclose(got, points, atol=1e-5 if lens == "opencv" else 3e-5)


def test_a_pixel_without_a_preimage_is_flagged_and_has_an_empty_ray():
    """r (1 - r^2 / 2) never exceeds 0.5443; plain Newton iterations return a point beyond the fold."""
    camera = a_camera("opencv", [-0.5, 0.0, 0.0, 0.0])
    radius = np.append(np.linspace(0, 0.53, 150), np.linspace(0.56, 3, 150))
    pixels = radius[:, None] * np.array([[30.0, 48.0]]) + np.array([[41.0, 29.0]])
    points, converged = fast_undistort(camera, jnp.asarray(pixels, jnp.float32))
    np.testing.assert_array_equal(converged, radius < 0.544)
    np.testing.assert_allclose(np.linalg.norm(points, axis=-1)[radius > 0.544], 0)
    back = opencv(np.asarray(points[:150]), -0.5, 0, 0, 0)
    np.testing.assert_allclose(np.linalg.norm(back, axis=-1), radius[:150], atol=1e-5)
    rays = fast_rays(camera, jnp.asarray(pixels, jnp.float32), near=2.0, far=6.0)
    np.testing.assert_array_equal(rays.near, np.full(300, 2.0))
    np.testing.assert_array_equal(rays.far, np.where(converged, 6, 2))
    assert all_finite(rays)


@pytest.mark.parametrize(
    "k", [[0, 0, 0.2, 0.1], [0, 0, 0.3, -0.3], [-0.2, 0.02, 0.15, 0.1], [0.1, 0, 0.5, 0], [0, 0, 0, 0.4, 0.01]], ids=str
)
def test_a_lens_that_folds_across_the_ray_has_no_two_points_in_a_pixel(k):
    """With tangential terms the Jacobian changes its sign where the image still grows along the ray."""
    camera = a_camera("opencv", k)
    points = np.stack(np.meshgrid(*[np.linspace(-2, 2, 41)] * 2), axis=-1).reshape(-1, 2)
    with jax.enable_x64(True):
        jacobian = jax.vmap(jax.jacfwd(lambda at: _brown(jnp.array(k), at)))(points)
        folded = np.linalg.det(jacobian) < 0
        rotation = np.asarray(camera.to_world, float)
        x = rotation[:, 3] + np.concatenate([points * [1, -1], -np.ones((len(points), 1))], axis=1) @ rotation[:, :3].T
    pixels = np.asarray(fast_project(camera, np.float32(x))[0])
    seen = np.isfinite(pixels).all(axis=-1)
    assert folded.any() and not seen[folded].any() and seen.sum() > 500
    found, converged = fast_undistort(camera, np.where(seen[:, None], pixels, 0))
    assert converged[seen].all()
    np.testing.assert_allclose(found[seen], points[seen], atol=2e-3)  # the inverse is steep near a fold


@pytest.mark.parametrize("lens, k", [("pinhole", None), ("opencv", OPENCV[1]), ("fisheye", FISHEYE[1])])
@pytest.mark.parametrize("depth", [1e-10, 1e-20, 1e-30, 1e-37, 1e-40])
def test_the_gradient_of_a_projection_is_finite_however_near_the_point(lens, k, depth):
    camera = dataclasses.replace(a_camera(lens, k), to_world=jnp.eye(3, 4))
    for x in (np.float32([0.5 * depth, -0.5 * depth, -depth]), np.float32([1, 1, -depth])):
        pixel = fast_project(camera, x)[0]
        gradient = np.asarray(fast_gradient(camera, x))
        assert np.isfinite(gradient).all() and gradient.any() == np.isfinite(pixel).all()
        if x[0] < 1 and depth > 1e-35:
            at_one = np.asarray(fast_gradient(camera, x / np.float32(depth)), np.float64)
            np.testing.assert_allclose(gradient * np.float64(depth), at_one, rtol=1e-4)


def test_undistort_gradient_is_that_of_the_inverse():
    k, pixel = [-0.2, 0.05, 0.003, -0.002], jnp.array([60.0, 10.0])
    camera = a_camera("opencv", k)

    def point(pixel, k):
        return (undistort(dataclasses.replace(camera, distortion=k), pixel)[0],) * 2

    (to_pixel, to_lens), at = jax.jit(jax.jacrev(point, argnums=(0, 1), has_aux=True))(pixel, jnp.array(k))
    at, steps = np.asarray(at, np.float64), 1e-6 * np.eye(2)
    forward = np.stack([(opencv(at + s, *k) - opencv(at - s, *k)) / 2e-6 for s in steps], axis=-1)
    inverse = np.linalg.inv(forward)
    np.testing.assert_allclose(to_pixel, inverse / np.array([50.0, 60.0]), rtol=1e-4, atol=1e-6)
    bends = np.eye(4) * 1e-6
    slope = np.stack([(opencv(at, *(k + b)) - opencv(at, *(k - b))) / 2e-6 for b in bends], axis=-1)
    np.testing.assert_allclose(to_lens, -inverse @ slope, rtol=1e-4, atol=1e-6)


def test_rays_go_through_their_pixels():
    camera, rng = a_camera(), np.random.default_rng(1)
    pixels = rng.uniform(0, 60, (7, 2)).astype(np.float32)
    rays = fast_rays(camera, pixels, near=2.0, far=np.linspace(3, 9, 7))
    rotation, eye = np.asarray(camera.to_world[:, :3]), np.asarray(camera.to_world[:, 3])
    local = ((rays.origins + 3 * rays.directions) - eye) @ rotation
    np.testing.assert_allclose(local[:, 2], -3, atol=1e-5)
    seen = local[:, :2] / 3 * [50, -60] + [41, 29]
    np.testing.assert_allclose(seen, pixels, atol=1e-4)
    np.testing.assert_array_equal(rays.near, np.full(7, 2.0))
    np.testing.assert_allclose(rays.far, np.linspace(3, 9, 7), rtol=1e-6)
    norms = np.linalg.norm(rays.directions, axis=-1, keepdims=True)
    np.testing.assert_allclose(rays.viewdirs, rays.directions / norms, atol=1e-6)


@pytest.mark.parametrize("lens, k", [("pinhole", None), ("opencv", OPENCV[1]), ("fisheye", FISHEYE[1])])
def test_points_on_rays_project_to_their_pixels(lens, k):
    camera, pixels = a_camera(lens, k), pixel_grid(60, 80)[::7, ::9]
    rays = fast_rays(camera, pixels, near=2.0, far=6.0)
    depth = np.random.default_rng(2).uniform(2, 6, rays.near.shape).astype(np.float32)
    found, along = fast_project(camera, fast_positions(rays, depth[..., None])[..., 0, :])
    np.testing.assert_allclose(found, pixels, atol=2e-3)
    np.testing.assert_allclose(along, depth, rtol=1e-5)


def test_a_point_behind_the_camera_has_no_pixel():
    camera = a_camera()
    behind = camera.to_world[:, 3] + camera.to_world[:, 2]
    pixel, depth = fast_project(camera, behind)
    assert np.isinf(pixel).all() and depth == pytest.approx(-1, abs=1e-5)
    assert not jax.jit(jax.jacrev(lambda x: project(camera, x)[0]))(behind).any()


def test_the_zero_vector_has_no_direction():
    assert not jax.jit(normalize)(jnp.zeros((2, 3))).any()
    assert not jax.jit(jax.jacrev(normalize))(jnp.zeros(3)).any()


@pytest.mark.parametrize("size", [1e-37, 1.0, 1e20, 1.1e38])
def test_lengths_and_directions_up_to_the_largest_numbers(size):
    vector = np.float32(size) * np.float32([1, -2, 2])
    for length, direction in ((norm, normalize), (jax.jit(norm), jax.jit(normalize))):
        np.testing.assert_allclose(length(vector), 3 * size, rtol=1e-6)
        np.testing.assert_allclose(direction(vector), [1 / 3, -2 / 3, 2 / 3], rtol=1e-6)


def test_rays_of_an_image_and_of_one_pixel():
    camera = a_camera("opencv", OPENCV[1])
    image = fast_rays(camera, pixel_grid(3, 4), near=2.0, far=6.0)
    assert image.origins.shape == (3, 4, 3) and image.far.shape == (3, 4)
    single = fast_rays(camera, pixel_grid(3, 4)[1, 2], near=2.0, far=6.0)
    assert_same(single, jax.tree.map(lambda leaf: leaf[1, 2], image))


def forward_rays():
    """Returns a camera that looks along -z, and its rays."""
    pose = jnp.array([[1.0, 0, 0, 0.2], [0, 1, 0, -0.1], [0, 0, 1, 0.3]])
    size = {"center": jnp.array([4.0, 3.0]), "height": 6, "width": 8}
    camera = Camera(to_world=pose, focal=jnp.array([7.0, 8.0]), **size)
    return camera, fast_rays(camera, pixel_grid(6, 8), near=0.0, far=np.inf)


@pytest.mark.parametrize("near_plane", [1.0, 0.4])
def test_ndc_rays_meet_the_same_points(near_plane):
    """A point of the world, projected to NDC by hand, lies on the NDC ray at the t of ndc_to_t."""
    camera, rays = forward_rays()
    ndc = fast_ndc(rays, camera, near_plane=near_plane)
    np.testing.assert_array_equal(ndc.near, 0)
    np.testing.assert_array_equal(ndc.far, 1)
    np.testing.assert_array_equal(ndc.viewdirs, rays.viewdirs)
    for t in (0.0, 0.25, 0.9, 0.99):
        t = np.full(rays.near.shape, t, np.float32)
        world = fast_positions(rays, fast_back(t, rays, near_plane=near_plane)[..., None])[..., 0, :]
        x, y, z = np.moveaxis(np.asarray(world, np.float64), -1, 0)
        by_hand = [-7 / 4 * x / z, -8 / 3 * y / z, 1 + 2 * near_plane / z]
        np.testing.assert_allclose(fast_positions(ndc, t[..., None])[..., 0, :], np.stack(by_hand, -1), atol=1e-5)
    first = fast_back(np.zeros((6, 8), np.float32), rays, near_plane=near_plane)
    np.testing.assert_allclose(fast_positions(rays, first[..., None])[..., 2], -near_plane, atol=1e-6)
    assert (fast_back(np.ones((6, 8), np.float32), rays, near_plane=near_plane) == np.inf).all()


def test_ndc_of_a_ray_that_looks_back_is_empty():
    camera, rays = forward_rays()
    back = fast_ndc(jax.tree.map(lambda x: -x, rays), camera)
    np.testing.assert_array_equal(back.near, back.far)
    assert all_finite(back)


def test_look_at():
    eye, target = np.array([3.0, -4.0, 2.0]), np.array([0.0, 1.0, 0.5])
    pose = fast_look_at(eye, target, np.array([0.0, 0.0, 2.0]))
    assert pose.shape == (3, 4)
    np.testing.assert_array_equal(pose[:, 3], eye)
    np.testing.assert_allclose(pose[:, :3].T @ pose[:, :3], np.eye(3), atol=1e-6)
    np.testing.assert_allclose(np.linalg.det(pose[:, :3]), 1, atol=1e-6)
    local = pose[:, :3].T @ (target - eye)
    np.testing.assert_allclose(local, [0, 0, -np.linalg.norm(target - eye)], atol=1e-5)
    up = pose[:, :3].T @ np.array([0.0, 0.0, 1.0])
    assert up[1] > 0 and abs(up[0]) < 1e-6
    assert all_finite(fast_look_at(np.array([0.0, 0.0, 4.0]), np.zeros(3), np.array([0.0, 0.0, 1.0])))


DIRECTIONS = [np.array(each) - 1.0 for each in np.ndindex(3, 3, 3) if each != (1, 1, 1)]


@pytest.mark.parametrize("aside", [0, 1e-8, 1e-7, 5e-7, 1e-6, 2e-6, 1e-5, 1e-3, 0.02])
def test_look_at_along_up_is_orthonormal(aside):
    """Along (1, 1, 1), another axis was (1, 1, 1), too; just beside up, rounding bent the axes."""
    rng, slope = np.random.default_rng(0), compiled(jax.jacrev(look_at, argnums=(0, 1, 2)))
    for direction in (*DIRECTIONS, *rng.normal(size=(10, 3))):
        up = direction * rng.choice([-2, 2]) + aside * rng.normal(size=3)
        places = np.float32(direction), np.zeros(3, np.float32), np.float32(up)
        pose = fast_look_at(*places)
        np.testing.assert_allclose(pose[:, :3].T @ pose[:, :3], np.eye(3), atol=2e-6)
        assert np.linalg.det(pose[:, :3]) > 0.99
        np.testing.assert_allclose(pose[:, 2], direction / np.linalg.norm(direction), atol=1e-6)
        assert all_finite(slope(*places))


def test_batch_is_vmap_is_jit():
    camera, rays = forward_rays()
    bent = a_camera("fisheye", FISHEYE[1])
    pixels = pixel_grid(3, 4).reshape(12, 2)
    assert_batch_is_vmap_is_jit(lambda p: rays_from_pixels(bent, p, near=1.0, far=2.0), pixels)
    assert_batch_is_vmap_is_jit(lambda rays: ndc_rays(rays, camera), rays)
    assert_batch_is_vmap_is_jit(ndc_to_t, jnp.full((6, 8), 0.3), rays)


@pytest.mark.parametrize("k", [(0.0, 0.0, 0.0, 0.0), (0.02, -0.001, 0.0, 0.0)])
def test_a_fisheye_sees_beside_and_behind_itself(k):
    """Equidistant up to 179 degrees from the axis; the plane at distance 1 ends at 90."""
    camera = a_camera("fisheye", k)
    angle, around = np.radians([0, 30, 79.9, 80.1, 89, 91, 120, 160, 179]), np.linspace(0, 2 * np.pi, 9)
    bent = angle * (1 + k[0] * angle**2 + k[1] * angle**4)
    spread = np.stack([np.cos(around), np.sin(around)], axis=-1)
    pixels = np.float32(bent[:, None] * spread * [50, 60] + [41, 29])
    rays = fast_rays(camera, pixels, near=2.0, far=6.0)
    rotation, eye = np.asarray(camera.to_world[:, :3]), np.asarray(camera.to_world[:, 3])
    expected = np.stack([*(np.sin(angle) * spread.T * [[1], [-1]]), -np.cos(angle)], axis=-1)
    np.testing.assert_allclose(rays.viewdirs @ rotation, expected, atol=3e-6)
    np.testing.assert_array_equal(rays.far, 6)
    lengths = 1 / np.cos(np.minimum(angle, np.radians(80)))
    np.testing.assert_allclose(np.linalg.norm(rays.directions, axis=-1), lengths, rtol=2e-4)
    found, t = fast_project(camera, rays.origins + 3 * rays.directions)
    np.testing.assert_allclose(found, pixels, atol=2e-3)
    np.testing.assert_allclose(t, 3, rtol=1e-5)
    np.testing.assert_array_equal(fast_undistort(camera, pixels)[1], angle < np.pi / 2)
    axes = dataclasses.replace(camera, to_world=np.eye(3, 4, dtype=np.float32))
    behind = fast_project(axes, np.float32([0, 0, 1]))[0]
    all_around = np.pi * (1 + k[0] * np.pi**2 + k[1] * np.pi**4)
    beyond = fast_rays(camera, np.float32([[41 + 50 * 1.02 * all_around, 29]]), near=2.0, far=6.0)
    assert not np.isfinite(behind).any() and beyond.far == beyond.near and all_finite(beyond)
    # A pixel's solid angle is that of its cone: its radius over the ray's length, 2 / sqrt(12) of its side.
    stretch = (np.sin(angle[1:]) / bent[1:]) / (1 + 3 * k[0] * angle[1:] ** 2 + 5 * k[1] * angle[1:] ** 4)
    slant = np.where(angle[1:] < np.radians(80), np.cos(angle[1:]), 1)
    radius = np.asarray(compiled(pixel_radius)(camera, pixels))[1:] / lengths[1:]
    np.testing.assert_allclose(radius, np.sqrt(stretch / 3000 / slant / 3), rtol=3e-3)

    def total(x):
        pixels, t = project(camera, x)
        return jnp.where(jnp.isfinite(pixels), pixels, 0).sum() + t.sum()

    inside = np.asarray(rays.origins + 3 * rays.directions)
    slopes = jax.jit(jax.vmap(jax.grad(total)))(np.float32([*inside, eye, eye + rotation @ [0, 0, 1]]))
    assert all_finite(slopes)


def test_wrong_arguments():
    camera, rays = forward_rays()
    with pytest.raises(ValueError, match="pixels"):
        undistort(camera, jnp.ones((4, 3)))
    with pytest.raises(ValueError, match="pixels"):
        jax.eval_shape(lambda p: rays_from_pixels(camera, p, near=1.0, far=2.0), jnp.ones(3))
    with pytest.raises(ValueError, match="lens"):
        undistort(a_camera("mirror", [0.0] * 4), jnp.ones(2))
    with pytest.raises(ValueError, match="2 coefficients"):
        undistort(a_camera("opencv", [0.0] * 2), jnp.ones(2))
    with pytest.raises(ValueError, match="height and width"):
        ndc_rays(rays, Camera(to_world=camera.to_world, focal=camera.focal, center=camera.center))
    with pytest.raises(ValueError, match="ndc_to_t: "):
        ndc_to_t(jnp.ones(3), rays)
    with pytest.raises(ValueError, match="target"):
        look_at(jnp.zeros(3), jnp.ones(2), jnp.ones(3))


@pytest.mark.parametrize("d", [(0.0, 0.0, -1e-20), (1e-3, 0.0, -1e-20), (1.0, 0.0, -1e-25), (0.3, 0.1, -1e-3)])
def test_gradients_of_grazing_ndc_rays_are_finite(d):
    given, camera = (jnp.array([[0.1, 0.2, 0.5]]), jnp.array([d])), a_camera()

    @jax.jit
    def slopes(origins, directions):
        def total(origins, directions):
            ends = jnp.ones(1)
            rays = Rays(origins=origins, directions=directions, viewdirs=directions, near=ends, far=ends)
            got = ndc_rays(rays, camera)
            return got.origins.sum() + got.directions.sum()

        return jax.grad(total, argnums=(0, 1))(origins, directions)

    assert all_finite(slopes(*given))
