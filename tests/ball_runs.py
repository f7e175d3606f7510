"""Runs of a ball that need no training: a field of one parameter under any sampler, and one that compiles at once."""

import dataclasses
import functools
from types import SimpleNamespace

import jax.numpy as jnp
import numpy as np

import captures
import jaxnerf
from jaxnerf.core.types import Rendering
from jaxnerf.core.views import Views
from jaxnerf.evaluation.restore import TrainedRun
from jaxnerf.fields.base import Field
from jaxnerf.models.base import Model
from jaxnerf.training import auto_config, build, workdir
from jaxnerf.training.checkpoint import Checkpoints
from jaxnerf.training.config import RunConfig
from jaxnerf.training.state import create_state
from runs import PACKED, smoke_config

# The fields of a config for each kind of scene, and what its cameras are.
KINDS = {
    "packed": {**PACKED, "occupancy.step_size": 0.05},
    "dense": {"sampling.num_fine": 0, "occupancy.resolution": 16, "occupancy.step_size": 0.05},
    "contracted": {**PACKED, "occupancy.step_size": 0.05, "scene.contracted": True},
    "ndc": {**PACKED, "occupancy.step_size": 0.02, "scene.contracted": False},
}


def make_ball(options, box):
    """Makes the field: a ball at (0.1, 0, 0.2), or in the middle of NDC, whose colours are its positions."""
    center = jnp.array(options.get("center", (0.1, 0.0, 0.2)))

    def apply(params, x, viewdirs):
        away = jnp.sqrt(((x - center.reshape(*(1,) * (x.ndim - 1), 3)) ** 2).sum(axis=-1))
        return 40 / (1 + jnp.exp(40 * (away - params["radius"]))), 1 / (1 + jnp.exp(-3 * x))

    return Field(lambda key: {"radius": jnp.float32(0.7)}, apply)


jaxnerf.register_field("ball", make_ball)


def make_run(folder, kind, *, radii=((20, 0.7),), size=32):
    """Makes a workdir of a kind with a checkpoint for each (step, radius); its dataset, of noise, lies beside it."""
    config = smoke_config()
    config.update_from_flattened_dict({**KINDS[kind], "field": "ball", "eval.early_stop_eps": 1e-3})
    shots = captures.noise(captures.front(4) if kind == "ndc" else captures.orbit(6, height=size, width=size))
    data = folder.with_name(f"{folder.name}-data")
    data.mkdir(parents=True)
    if kind == "ndc":
        captures.write_llff(data, shots)
        config.data.world, config.data.ndc = "forward", True
    else:
        captures.write_transforms(data, shots)
        config.data.world = "file"
    config.data.format, config.data.dir, config.data.background = "auto", str(data), "white"
    resolved = auto_config.resolve(config).config
    workdir.save_config(folder, resolved)
    _save(folder, resolved, radii)
    return folder


def _save(folder, config, radii):
    """Adds a checkpoint for each (step, radius) of a ball to a workdir."""
    experiment = build.build(auto_config.resolve_for_device(config)[0])
    state, checkpoints = create_state(experiment.model, experiment.optimizer, 0), Checkpoints(folder)
    for step, radius in radii:
        params = {name: {"radius": jnp.float32(radius)} for name in state.params}
        checkpoints.save(dataclasses.replace(state, params=params, step=jnp.int32(step)))
    checkpoints.close()


CENTER = np.float32([0.1, 0.0, 0.2])


def solid_run():
    """Returns the parts of a TrainedRun that a FrameRenderer reads, of a solid ball on white; and its Views."""

    def view(params, grid, rays):
        away = rays.origins - CENTER.reshape(*(1,) * rays.near.ndim, 3)
        squares = (rays.directions**2).sum(axis=-1)
        along = (away * rays.directions).sum(axis=-1) / squares
        root = along**2 - ((away**2).sum(axis=-1) - params["radius"] ** 2) / squares
        enter, leave = (-along + sign * jnp.sqrt(jnp.maximum(root, 0)) for sign in (-1, 1))
        t = jnp.maximum(enter, rays.near)
        hit = (root > 0) & (t < jnp.minimum(leave, rays.far))
        x = rays.origins + t[..., None] * rays.directions
        rgb, zero = jnp.where(hit[..., None], 1 / (1 + jnp.exp(-3 * x)), 1.0), jnp.zeros(t.shape)
        depth = jnp.where(hit, t, rays.far)
        options = {"weights": None, "num_dropped": zero.astype(int)}
        return Rendering(rgb=rgb, opacity=hit.astype(jnp.float32), depth=depth, disparity=zero, **options)

    model = Model(init=None, render=None, view=view, scene=None, samples_per_ray=1.0)
    experiment = SimpleNamespace(model=model, config=RunConfig(), cameras=None, background=(1.0, 1.0, 1.0))
    functions = dict.fromkeys(TrainedRun._fields) | {"steps": lambda: [20], "model_with": lambda settings: model}
    return TrainedRun(**{**functions, "experiment": experiment}), solid_views()


@functools.cache
def solid_views():
    """Returns Views of noise around the ball of solid_run."""
    cameras = captures.orbit(6, height=24, width=24)
    pixels = np.random.default_rng(0).integers(0, 65536, (6 * 24 * 24, 4), np.uint16)
    size, offset = np.full((6, 2), 24, np.int32), np.arange(6, dtype=np.int32) * 24 * 24
    bounds = {"near": np.full(6, 2.0, np.float32), "far": np.full(6, 6.0, np.float32)}
    names = tuple(f"view{index}" for index in range(6))
    return Views(pixels=pixels, offset=offset, size=size, cameras=cameras, names=names, background=(1, 1, 1), **bounds)
