"""A training of a toy by several processes, as test_hosts starts each: python tests/two_hosts.py FOLDER."""

import functools
import pathlib
import sys
import types

import jax
import jax.numpy as jnp
import numpy as np
from test_step import toy_draw, toy_model

from helpers import random_rays
from jaxnerf.fields.base import Field
from jaxnerf.models.grid_schedule import make_grid_schedule
from jaxnerf.runtime import processes, shards
from jaxnerf.training import loop
from jaxnerf.training.build import build
from jaxnerf.training.checkpoint import Checkpoints
from jaxnerf.training.step import TrainData
from runs import smoke_config

STEPS, RAYS = 6, 64


def toy_experiment():
    """Returns an Experiment of colours linear in the direction, with cells to look at and a full pool."""
    experiment = build(smoke_config(max_steps=STEPS, save_every=3, log_every=3, batch_size=RAYS))
    plain, rays = toy_model(), random_rays(0, (RAYS,))

    def render(keys, params, grid, rays, step):
        seen = plain.render(keys, params, grid, rays, step)
        full = (rays.origins[:, 0] > 1.0).astype(jnp.int32)
        return tuple(types.SimpleNamespace(rgb=one.rgb, num_dropped=full) for one in seen)

    def density(params, x, viewdirs):
        return jax.nn.relu(x @ params["w"])[..., 0], x

    schedule = make_grid_schedule(
        (-1.0, -1.0, -1.0),
        (1.0, 1.0, 1.0),
        resolution=4,
        step=0.1,
        field=Field(None, density),
        threshold=0.02,
        update_every=2,
        cells_per_update=64,
        initial_passes=0,
    )
    cells = np.arange(0, 64, 2, dtype=np.int32)
    return experiment._replace(
        model=types.SimpleNamespace(init=plain.init, render=render, grid_schedule=schedule, input_layers={}),
        draw=lambda step, positions, data: toy_draw(step, positions, (rays, jnp.array([-1]))),
        survey=lambda views: (None, TrainData(np.uint32(0), views, None, cells)),
    )


def train(folder, views):
    """Runs the toy's training; fails where a save finds this process's devices with different states."""
    save = Checkpoints.save

    @functools.wraps(save)
    def checked(self, state):
        for leaf in jax.tree.leaves(state):
            first, *others = [np.asarray(shard.data) for shard in leaf.addressable_shards]
            assert all((first == other).all() for other in others)
        print("state", int(state.step), shards.digest(jax.tree.map(np.asarray, state)), file=sys.stderr)
        save(self, state)

    Checkpoints.save = checked
    try:
        folder.mkdir(exist_ok=True)
        return loop.train(toy_experiment()._replace(load_views=None), views, folder)
    finally:
        Checkpoints.save = save


if __name__ == "__main__":
    with processes.cluster():
        train(pathlib.Path(sys.argv[1]), toy_experiment().load_views("train"))
