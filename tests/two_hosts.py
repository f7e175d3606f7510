"""A training of a toy by several processes, as test_hosts starts each: python tests/two_hosts.py FOLDER."""

import functools
import pathlib
import sys
import types

import jax
import jax.numpy as jnp
import numpy as np

from helpers import random_rays
from jaxnerf.engine import hosts, loop, shards
from jaxnerf.engine.build import build
from jaxnerf.engine.checkpoint import Checkpoints
from jaxnerf.engine.space import make_space
from jaxnerf.engine.step import TrainData
from jaxnerf.fields.mlp import Field
from runs import smoke_config
from test_step import toy_draw, toy_model

STEPS, RAYS = 6, 64


def toy_experiment():
    """Returns an Experiment of colours linear in the direction, with cells to look at and a full pool."""
    experiment = build(smoke_config(max_steps=STEPS, save_every=3, log_every=3, batch_size=RAYS))
    plain, rays = toy_model(), random_rays(0, (RAYS,))

    def render(keys, params, grid, rays, step):
        seen = plain.render(keys, params, grid, rays, step)
        full = (rays.origins[:, 0] > 1.0).astype(jnp.int32)
        return tuple(types.SimpleNamespace(rgb=one.rgb, dropped=full) for one in seen)

    def density(params, x, viewdirs):
        return jax.nn.relu(x @ params["w"])[..., 0], x

    space = make_space(
        (-1.0, -1.0, -1.0),
        (1.0, 1.0, 1.0),
        resolution=4,
        step=0.1,
        field=Field(None, density),
        threshold=0.02,
        update_every=2,
        look_at_once=64,
        passes_from_start=0,
    )
    cells = np.arange(0, 64, 2, dtype=np.int32)
    return experiment._replace(
        model=types.SimpleNamespace(init=plain.init, render=render, space=space, entrances={}),
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
    with hosts.cluster():
        train(pathlib.Path(sys.argv[1]), toy_experiment().load_views("train"))
