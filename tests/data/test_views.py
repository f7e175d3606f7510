"""An image, a camera and the rays of a view."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxnerf


@pytest.mark.parametrize(
    "kind, background", [(np.uint8, (1.0, 1.0, 1.0)), (np.uint16, (0.2, 0.4, 0.6)), (np.uint8, None)]
)
def test_an_image_is_in_0_to_1_over_the_background(kind, background):
    views = jaxnerf.load_dataset("", split="test", format="synthetic", size=20)
    pixels = (views.pixels.astype(np.int64) * np.iinfo(kind).max // np.iinfo(views.pixels.dtype).max).astype(kind)
    views = dataclasses.replace(views, pixels=pixels, background=background)
    image = views.image(3)
    alpha = pixels[1200:1600, 3:].reshape(20, 20, 1) / np.iinfo(kind).max
    want = pixels[1200:1600, :3].reshape(20, 20, 3) / np.iinfo(kind).max * alpha
    np.testing.assert_allclose(image, want + (1 - alpha) * np.float32(background or (0, 0, 0)), atol=1e-6)
    assert image.dtype == jnp.float32
    opaque = dataclasses.replace(views, pixels=pixels[:, :3], background=None)
    np.testing.assert_allclose(opaque.image(0), pixels[:400, :3].reshape(20, 20, 3) / np.iinfo(kind).max, atol=1e-6)


def test_the_scene_looks_like_its_image_along_a_views_rays():
    views = jaxnerf.load_dataset("", split="test", format="synthetic", size=48)
    rays, camera = views.rays(2), views.camera(2)
    assert rays.near.shape == (48, 48) and camera.to_world.shape == (3, 4) and camera.height == 48
    expected = jaxnerf.rays_from_pixels(camera, jaxnerf.pixel_grid(48, 48), near=views.near[2], far=views.far[2])
    np.testing.assert_array_equal(rays.directions, expected.directions)
    render = functools.partial(jaxnerf.render_rays, None, jaxnerf.still_life, num_samples=256, background=jnp.ones(3))
    image = jax.jit(render)(rays)
    assert jaxnerf.psnr(image.rgb, views.image(2)) > 30


def test_the_cameras_of_all_views_have_the_rays_of_each():
    views = jaxnerf.load_dataset("", split="test", format="synthetic", size=8)  # as many views as pixels in a row
    views = dataclasses.replace(views, near=views.near + np.arange(8, dtype=np.float32) / 8, time=np.linspace(0, 1, 8))
    rays_of = jax.jit(jaxnerf.rays_from_pixels)
    rays = rays_of(views.cameras, jaxnerf.pixel_grid(8, 8), near=views.near, far=views.far)
    for index in (0, 5, -1):
        alone = views.rays(index)
        assert (alone.time == np.float32(views.time[index])).all() and rays.time is None
        for name in ("origins", "directions", "near", "far"):
            np.testing.assert_allclose(getattr(rays, name)[index], getattr(alone, name), atol=1e-6)


@pytest.mark.parametrize("index", [8, -9, 99])
def test_there_is_nothing_behind_the_last_view(index):
    views = jaxnerf.load_dataset("", split="test", format="synthetic", size=20)
    for of_view in (views.image, views.camera, views.rays):
        with pytest.raises(IndexError, match=f"the index is {index}, expected one of 0 to 7, as there are 8 views"):
            of_view(index)
