"""The renderer of the embedded scene: its bits, its accuracy, and that the images that ship are what it renders."""

import dataclasses
import hashlib

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxnerf.core import rendering
from jaxnerf.data import synthetic
from jaxnerf.tools.embedded_scene import portable_math, render
from jaxnerf.tools.embedded_scene.still_life import still_life

CHECKSUMS = {  # SHA-256 of two test views of 24 px, by finish
    "usual": "f23365e7db10496c13017d8999e0d3dfc04ca98a87da3ee98ea2a0c7f3b90fb7",
    "matt": "5d3f3035ff40c76731a24441b323290614c15a39b69d7c749c3563726aae7595",
}


def _over_white(pixels):
    values = pixels / 65535
    return values[..., :3] * values[..., 3:] + 1 - values[..., 3:]


@pytest.mark.parametrize("finish", ["usual", "matt"])
def test_the_pixels_are_the_same_on_every_machine(finish):
    """Whatever XLA's flags, the processor and the number of rays at once: only arithmetic that IEEE 754 defines."""
    stack = jax.tree.map(lambda leaf: leaf[::4], synthetic._cameras("test", 24))
    pixels = render.render_views(stack, finish)
    np.testing.assert_array_equal(render.render_views(stack, finish, chunk=100), pixels)
    assert hashlib.sha256(pixels.tobytes()).hexdigest() == CHECKSUMS[finish]


@pytest.mark.parametrize("split", ["train", "test"])
def test_the_images_that_ship_with_the_package_are_those_that_are_rendered(split, monkeypatch):
    """If this fails after a change of the scene, run experiments/embedded/write_images.py."""
    views = synthetic.load_synthetic(split=split, size=synthetic.SHIPPED_SIZE)
    rays = render.scene_rays(views.cameras)
    longest = (rays.far - rays.near).argmax()  # it determines the number of segments
    chosen = np.append(np.arange(0, len(views.pixels), 1999), longest)
    some = jax.tree.map(lambda leaf: leaf[chosen], rays)
    monkeypatch.setattr(render, "scene_rays", lambda stack: some)
    np.testing.assert_array_equal(render.render_views(views.cameras), views.pixels[chosen])


def test_the_pixels_are_those_of_the_scene():
    """As the renderer of this package renders the scene that code outside sees."""
    stack = jax.tree.map(lambda leaf: leaf[:2], synthetic._cameras("val", 20))
    rays = jax.tree.map(np.float32, render.scene_rays(stack))
    rays = dataclasses.replace(rays, far=np.maximum(rays.near, rays.far))
    options = {"num_samples": 384, "background": jnp.ones(3)}
    seen = jax.jit(lambda rays: rendering.render_rays(None, still_life, rays, **options))(rays)
    np.testing.assert_allclose(_over_white(render.render_views(stack)), seen.rgb, atol=5e-4)


def test_exponentials_have_their_digits():
    x = np.linspace(-86, 86, 20001, dtype=np.float32)
    np.testing.assert_allclose(portable_math.exp(x), np.exp(np.float64(x)), rtol=3e-7)
    np.testing.assert_allclose(portable_math.sigmoid(x), 1 / (1 + np.exp(-np.float64(x))), rtol=5e-7)
    np.testing.assert_array_equal(portable_math.exp(np.float32([-np.inf, -1e30])), portable_math.exp(x[:1] * 2)[0])
    with np.errstate(invalid="ignore"):  # its power of two is no integer
        assert np.isnan(portable_math.exp(np.float32([np.nan]))).all()


def test_doubling_the_segments_changes_less_than_a_thousandth():
    stack = jax.tree.map(lambda leaf: leaf[::4], synthetic._cameras("test", 32))
    once, twice = (_over_white(render.render_views(stack, num_segments=n)) for n in (256, 512))
    assert np.abs(once - twice).max() < 1e-3
