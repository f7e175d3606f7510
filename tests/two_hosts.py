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

    def update(step, params, grid, cells):
        noise = jax.random.normal(jax.random.fold_in(jax.random.key(7), step), grid["peak"].shape)
        peak = grid["peak"].at[cells].add((params["fine"]["w"].sum() + noise)[cells])
        return {"peak": peak, "occupied": peak > 0}

    def create(possible):
        return {"peak": jnp.zeros(8), "occupied": possible}

    space = types.SimpleNamespace(shape=(8,), create=create, update=update)
    return experiment._replace(
        model=types.SimpleNamespace(init=plain.init, render=render, space=space),
        draw=lambda step, positions, data: toy_draw(step, positions, (rays, jnp.array([-1]))),
        survey=lambda views: (None, None, np.arange(0, 8, 2, dtype=np.int32)),
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
