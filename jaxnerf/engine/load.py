"""A trained run as functions for other code."""

import functools
from typing import Any, NamedTuple

import jax

from jaxnerf.core.structs import without_weights
from jaxnerf.engine import build, workdir
from jaxnerf.engine.checkpoint import Checkpoints
from jaxnerf.engine.state import create_state


class Trained(NamedTuple):
    """A run's experiment and the functions to read its checkpoints and render them."""

    experiment: build.Experiment
    steps: Any  # () -> steps of the finished checkpoints, ascending
    params: Any  # step -> params
    render: Any  # (params, Rays [...]) -> Rendering [...] without weights, jitted once for all steps


def open_run(folder, config=None, *, data_dir=None):
    """Returns the Trained run in a workdir, with its own configuration unless one is given.

    Raises:
        ValueError: if there is no run; names the folder.
    """
    config = workdir.read_config(folder) if config is None else config
    if data_dir:
        config.data.dir = data_dir
    experiment = build.build(config)
    checkpoints = Checkpoints(folder)
    model = experiment.model

    @functools.cache
    def template():
        return create_state(model, experiment.optimizer, experiment.seed)

    @jax.jit
    def render(params, rays):
        return without_weights(model.render(None, params, rays)[-1])

    return Trained(
        experiment, checkpoints.steps, lambda step: checkpoints.load(step, template()).params, render
    )


def newest_step(run, folder, step=None):
    """Returns the newest checkpoint's step, or the given one; ValueError if there is none."""
    steps = run.steps()
    if not steps:
        raise ValueError(f"{folder}: has no checkpoint yet; train first, or wait with --watch")
    if step is not None and step not in steps:
        raise ValueError(f"{folder}: has no checkpoint of step {step}, only {steps}; give one of these")
    return steps[-1] if step is None else step


def load_scene(folder):
    """See jaxnerf.load_scene."""
    run = open_run(folder)
    params = run.params(newest_step(run, folder))
    return run.experiment.model.scene(params), functools.partial(run.render, params)
