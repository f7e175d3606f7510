"""Trains a toy in one of several processes, which test_processes.py starts: python tests/two_hosts.py FOLDER."""

import dataclasses
import functools
import pathlib
import sys

import jax
import jax.numpy as jnp
import numpy as np

from helpers import random_rays
from jaxnerf.fields.base import Field
from jaxnerf.models.grid_schedule import make_grid_schedule
from jaxnerf.runtime import processes
from jaxnerf.runtime.fingerprint import fingerprint
from jaxnerf.training import loop
from jaxnerf.training.checkpoint import Checkpoints
from jaxnerf.training.state import rendered_shapes
from jaxnerf.training.step import TrainData
from runs import smoke_experiment
from toys import toy_draw, toy_model, toy_rendering

STEPS, RAYS = 6, 64


def toy_experiment():
    """Returns an Experiment of colours that are linear in the direction, with a grid and dropped rays."""
    experiment = smoke_experiment(max_steps=STEPS, save_every=3, log_every=3, batch_size=RAYS)
    plain, rays = toy_model(), random_rays(0, (RAYS,))

    def render(keys, params, grid, rays, step):
        seen = plain.render(keys, params, grid, rays, step)
        full = (rays.origins[:, 0] > 1.0).astype(jnp.int32)
        return {name: toy_rendering(one.rgb, full) for name, one in seen.items()}

    def density(params, x, viewdirs):
        return jax.nn.relu(x @ params["w"])[..., 0], x

    schedule = make_grid_schedule(
        (-1.0, -1.0, -1.0),
        (1.0, 1.0, 1.0),
        resolution=4,
        step_size=0.1,
        field=Field(None, density),
        threshold=0.02,
        update_every=2,
        cells_per_update=64,
        initial_passes=0,
    )
    cells = np.arange(0, 64, 2, dtype=np.int32)
    return dataclasses.replace(
        experiment,
        model=plain._replace(render=render, grid_schedule=schedule),
        draw=lambda step, positions, data: toy_draw(step, positions, (rays, jnp.array([-1]))),
        prepare=lambda views: (None, TrainData(np.uint32(0), views, None, cells)),
    )


def train(folder, views):
    """Trains the toy; fails if a save finds different states on this process's devices."""
    save = Checkpoints.save

    @functools.wraps(save)
    def checked(self, state):
        for leaf in jax.tree.leaves(state):
            first, *others = [np.asarray(shard.data) for shard in leaf.addressable_shards]
            assert all((first == other).all() for other in others)
        print("state", int(state.step), fingerprint(jax.tree.map(np.asarray, state)), file=sys.stderr)
        save(self, state)

    Checkpoints.save = checked
    try:
        folder.mkdir(exist_ok=True)
        return loop.run_training(toy_experiment(), views, folder)
    finally:
        Checkpoints.save = save


def rendered(folder):
    """Returns what images of the last checkpoint are rendered with; each process that scores reads it by itself."""
    experiment = toy_experiment()
    averaged = experiment.config.train.averaging_power > 0
    return Checkpoints(folder).load_rendered(STEPS, rendered_shapes(experiment.model), averaged=averaged)


if __name__ == "__main__":
    with processes.cluster():
        target = pathlib.Path(sys.argv[1])
        train(target, toy_experiment().load_split("train"))
        print("rendered", fingerprint(jax.tree.map(np.asarray, rendered(target))), file=sys.stderr)
