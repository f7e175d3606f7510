"""The error of training's choice of samples, for renderings whose error and spread are known."""

import math
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np

from helpers import rays_past_origin
from jaxnerf import Batch
from studies import study

sampling_error = study("speed/sampling_error")


def test_the_spread_of_draws_is_not_counted_as_error_of_their_mean():
    rays = rays_past_origin(0, 256)
    batch = Batch(rays=rays, rgb=np.full((256, 3), 0.5, np.float32))
    keys = jax.random.split(jax.random.key(0), 256)

    def render(keys, params, grid, rays, step):
        spread = jax.vmap(lambda key: jax.random.normal(key, (3,)))(keys)
        used = jnp.arange(512) < 384
        return (SimpleNamespace(rgb=0.5 + params + grid * spread, samples=SimpleNamespace(used=used)),)

    model = SimpleNamespace(render=render)
    found = sampling_error.measure(model, (jnp.float32(0.03), jnp.float32(0.1)), [(keys, batch)] * 2, 7, 20)
    assert found["samples"] == 1.5
    np.testing.assert_allclose(found["noise"], -20 * math.log10(0.1), atol=0.1)
    np.testing.assert_allclose(found["psnr"], -10 * math.log10(0.1**2 + 0.03**2), atol=0.1)
    np.testing.assert_allclose(found["psnr_of_mean"], -20 * math.log10(0.03), atol=1)
