"""A model that compiles in no time, for tests of everything around the model."""

import jax
import jax.numpy as jnp
import optax

from jaxnerf import Batch, Rendering
from jaxnerf.models.base import Model
from jaxnerf.runtime import devices
from jaxnerf.training.build import build_losses

OPTIMIZER = optax.adam(0.1)
LOSSES = build_losses({"mse": 1.0})
NETWORKS = ("coarse", "fine")


def toy_rendering(rgb, num_dropped=None):
    """Returns a Rendering of these colours [B, 3]; everything else is 0."""
    zero, none = jnp.zeros(rgb.shape[:-1]), jnp.zeros(rgb.shape[:-1], jnp.int32)
    num_dropped = none if num_dropped is None else num_dropped
    return Rendering(rgb=rgb, opacity=zero, depth=zero, disparity=zero, weights=None, num_dropped=num_dropped)


def toy_model(trouble=lambda params: 0.0):
    """Returns a Model of colours that are linear in the direction, coarse and fine, plus trouble(params)."""

    def render(keys, params, grid, rays, step):
        return {name: toy_rendering(rays.viewdirs @ params[name]["w"] + trouble(params)) for name in NETWORKS}

    def init(key):
        return {name: {"w": jax.random.normal(key, (3, 3))} for name in NETWORKS}

    return Model(init, render, view=None, scene=None, samples_per_ray=1.0, image_networks=NETWORKS)


def toy_draw(step, positions, data):
    """Returns the rays at the positions; their colours are NaN at the steps in data."""
    rays, bad_steps = data
    rays = jax.tree.map(lambda leaf: jnp.asarray(leaf)[positions], rays)
    rgb = rays.viewdirs @ jnp.array([[0.1, 0.2, 0.3], [0.3, 0.1, 0.0], [0.0, 0.4, 0.2]])
    return None, Batch(rays=rays, rgb=jnp.where((bad_steps == step).any(), jnp.nan, rgb))


def run_steps(step, state, data, num_steps, num_devices, **options):
    """Returns the last state, in numpy, and all metrics."""
    used = jax.devices()[:num_devices]
    run, state, data = devices.compile_step(step, state, data, devices=used, **options)
    rows = []
    for _ in range(num_steps):
        state, metrics = run(state, data)
        rows.append(jax.device_get(metrics))
    return jax.device_get(state), rows
