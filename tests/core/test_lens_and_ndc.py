"""Whole images through a real lens, and one scene through plain and through NDC rays."""

import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxnerf import Camera, ndc_rays, pixel_grid, rays_from_pixels, render_rays, undistort


def opencv_distort(x, y, k1, k2, p1, p2):
    """OpenCV's formula, written out from its documentation, in numpy."""
    r2 = x * x + y * y
    radial = 1 + k1 * r2 + k2 * r2**2
    return (
        x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x),
        y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y,
    )


def solve(u, v, coefficients):
    """Inverts the lens by fixed-point iteration, as OpenCV does, until it converges."""
    x, y = u, v
    for _ in range(200):
        dx, dy = opencv_distort(x, y, *coefficients)
        x, y = x - (dx - u), y - (dy - v)
    assert max(np.abs(dx - u).max(), np.abs(dy - v).max()) < 1e-13
    return x, y


@pytest.mark.slow
@pytest.mark.scenes("fox")
def test_the_whole_image_of_the_fox_is_undistorted(scenes_dir):
    """To 1e-4 px in float64, and to 1e-6 of the plane at distance 1 in float32."""
    file = json.loads((scenes_dir / "fox" / "transforms.json").read_text())
    focal, center = (np.array([file[a], file[b]]) for a, b in (("fl_x", "fl_y"), ("cx", "cy")))
    coefficients = [file[name] for name in ("k1", "k2", "p1", "p2")]
    # The lens bends over hundreds of pixels: every fourth, and the last, leave nothing out.
    columns, rows = (np.append(np.arange(0, size, 4), size - 1) + 0.5 for size in (1080, 1920))
    pixels = np.stack(np.meshgrid(columns, rows), axis=-1)
    expected = np.stack(solve(*np.moveaxis((pixels - center) / focal, -1, 0), coefficients), axis=-1)
    run = jax.jit(undistort)
    with jax.enable_x64(True):
        camera = Camera(
            to_world=np.eye(3, 4),
            focal=focal,
            center=center,
            distortion=np.array(coefficients),
            lens="opencv",
        )
        points, converged = run(camera, pixels)
        assert points.dtype == np.float64 and converged.all()
        assert np.abs((np.asarray(points) - expected) * focal).max() < 1e-4
    camera = jax.tree.map(np.float32, camera)
    points, converged = run(camera, np.float32(pixels))
    assert points.dtype == np.float32 and converged.all()
    assert np.abs(np.asarray(points) - expected).max() < 1e-6


@pytest.mark.slow
def test_ndc_and_plain_rays_render_the_same_scene():
    """Coloured fog with a denser ball in world space; its density in NDC is divided by the stretch."""
    focal, height, width = 20.0, 12, 16
    pose = jnp.array([[1.0, 0, 0, 0.1], [0, 1, 0, -0.05], [0, 0, 1, 0.2]])
    camera = Camera(to_world=pose, focal=jnp.full(2, focal), center=jnp.array([8.0, 6.0]), height=height, width=width)

    def scene(x, viewdirs):
        place = x - jnp.array([0.3, -0.2, -3.0]).reshape(1, 1, 3)
        ball = jnp.exp(-2 * (place**2).sum(axis=-1))
        fade = jnp.exp(-0.02 * (x**2).sum(axis=-1))  # nothing is left at infinity
        return (0.05 + 2 * ball) * fade, 0.5 + 0.4 * jnp.sin(x + 2 * viewdirs)

    def to_ndc(x):
        return jnp.stack([-2 * focal / width * x[0] / x[2], -2 * focal / height * x[1] / x[2], 1 + 2 / x[2]])

    def to_world(y):
        z = 2 / (y[2] - 1)
        return jnp.stack([-y[0] * z * width / (2 * focal), -y[1] * z * height / (2 * focal), z])

    def stretch(x, direction):
        return jnp.sqrt((jax.jvp(to_ndc, (x,), (direction,))[1] ** 2).sum())

    def scene_in_ndc(y, viewdirs):
        x = jax.vmap(jax.vmap(to_world))(y)
        density, rgb = scene(x, viewdirs)
        directions = jnp.broadcast_to(viewdirs, x.shape)
        return density / jax.vmap(jax.vmap(stretch))(x, directions), rgb

    # Plain rays begin at the near plane z = -1, as NDC does; 60 further on nothing is left.
    rays = rays_from_pixels(camera, pixel_grid(height, width).reshape(-1, 2), near=1.2, far=60.0)
    plain = jax.jit(lambda r: render_rays(None, scene, r, num_samples=4096))(rays)
    ndc = jax.jit(lambda r: render_rays(None, scene_in_ndc, r, num_samples=2048))(ndc_rays(rays, camera))
    assert 0.2 < float(plain.opacity.min()) and float(plain.opacity.max()) > 0.9
    np.testing.assert_allclose(ndc.rgb, plain.rgb, atol=1e-3)
    np.testing.assert_allclose(ndc.opacity, plain.opacity, atol=1e-3)
