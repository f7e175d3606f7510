"""Images are rendered in chunks that fit into memory."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from helpers import out_of_memory, random_rays
from jaxnerf import Rendering
from jaxnerf.core.occupancy.ray_culling import render_background
from jaxnerf.evaluation.image_renderer import image_renderer
from jaxnerf.runtime import memory


def test_chunk_that_does_not_fit_is_halved_and_the_image_is_the_same(monkeypatch, capsys):
    rays, tried = jax.tree.map(jnp.asarray, random_rays(0, (6, 7))), []

    @jax.jit
    def colors(scale, rays):
        values = scale * rays.viewdirs
        zero = jnp.zeros(rays.near.shape)
        names = [field.name for field in dataclasses.fields(Rendering) if field.name not in ("rgb", "weights")]
        return Rendering(rgb=values, weights=None, **dict.fromkeys(names, zero))

    def render(scale, rays):
        tried.append(rays.near.size)
        if rays.near.size > 16:
            raise out_of_memory()
        return colors(scale, rays)

    render.lower = colors.lower
    image = image_renderer(render, 40)
    expected = 2 * np.asarray(rays.viewdirs)
    np.testing.assert_allclose(image(jnp.float32(2), rays).rgb, expected, rtol=1e-6)
    assert tried[:2] == [40, 20] and set(tried[2:]) == {10}
    assert "out of memory in the image with 40 rays per chunk (--chunk)" in capsys.readouterr().err
    image(jnp.float32(3), rays)
    assert set(tried[2:]) == {10} and not capsys.readouterr().err, "the fitting chunk is remembered"
    tried.clear()
    np.testing.assert_allclose(image(jnp.float32(2), rays, chunk=1000).rgb, expected, rtol=1e-6)
    assert tried[0] == 64  # all rays, in one padded shape
    monkeypatch.setattr(memory, "available", lambda: 12 * 16 + 100)
    tried.clear()
    image_renderer(colors, 40)(jnp.float32(2), rays)
    assert "image with 40 rays per chunk (--chunk): needs 0.0 MB" in capsys.readouterr().err


@pytest.mark.parametrize("chunk", [16, 64])
@pytest.mark.parametrize("placed", [False, True])  # parameters that are bound to a device, as those of a checkpoint
@pytest.mark.parametrize("culled", [False, True])
def test_an_image_is_compiled_once(chunk, placed, culled):
    rays, compiled = jax.tree.map(jnp.asarray, random_rays(0, (6, 7))), []

    @jax.jit
    def colors(scale, rays):
        empty = render_background(rays)
        return dataclasses.replace(empty, rgb=scale * rays.viewdirs)

    def cull(scale, rays):
        return scale * rays.viewdirs[..., 0] > 0, render_background(rays)

    def listen(event, seconds, fun_name="", **_):
        if event.endswith("backend_compile_duration") and fun_name == "jit(colors)":
            compiled.append(seconds)

    scale = jax.device_put(jnp.float32(2), jax.devices()[0] if placed else None)
    image = image_renderer(colors, chunk, cull if culled else None)
    jax.monitoring.register_event_duration_secs_listener(listen)
    try:
        for _ in range(2):
            rendered = np.asarray(rays.viewdirs[..., :1]) > (0 if culled else -2)
            np.testing.assert_allclose(image(scale, rays).rgb, rendered * 2 * rays.viewdirs, rtol=1e-6)
    finally:
        jax.monitoring.unregister_event_duration_listener(listen)
    assert len(compiled) == 1
