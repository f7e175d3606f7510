"""A trained run as functions for other code."""

import functools
from typing import Any, NamedTuple

import jax
import numpy as np

from jaxnerf.data.batches import random_rays
from jaxnerf.engine import build, fit, workdir
from jaxnerf.engine.averaging import rendered_params
from jaxnerf.engine.checkpoint import Checkpoints
from jaxnerf.engine.fitting import image_renderer
from jaxnerf.engine.state import create_state


class Trained(NamedTuple):
    """A run's experiment and the functions to read its checkpoints and render them."""

    experiment: build.Experiment
    steps: Any  # () -> steps of the finished checkpoints, ascending
    weights: Any  # step -> (params, grid or None)
    render: Any  # (weights, Rays [...]) -> Rendering [...] without weights, jitted once for a grid's shape
    identity: str  # of its configuration, see build.identity
    image: Any  # (weights, Rays [...], chunk=None) -> the same in chunks, see image_renderer


def open_run(folder, config=None, *, data_dir=None, settings=None):
    """Returns the Trained run in a workdir, with its own configuration unless one is given.

    Args:
        folder: the workdir.
        config: ConfigDict; sizes that it leaves open are those of the workdir's.
        data_dir: the scene's folder in place of the configuration's.
        settings: fields of the configuration's eval section to replace, by name.

    Raises:
        ValueError: if there is no run; names the folder.
    """
    own = workdir.read_config(folder) if config is None or fit.is_open(config) else None
    config = own if config is None else fit.fill_from(config, own)
    if data_dir:
        config.data.dir = data_dir
    config.eval.update(settings or {})
    experiment = build.build(config)
    checkpoints = Checkpoints(folder)
    model, trained = experiment.model, experiment.model
    extract = None
    if config.eval.get("skip_empty") and model.space is None:
        views = experiment.load_views("train")
        config, _ = fit.fit_config(fit.skipping(config), views)
        options = {"view_rays": experiment.view_rays, "pixel_offset": experiment.pixel_offset}
        look = functools.partial(random_rays, views, **options)
        model, extract = build.skipping_model(config, model, look)

    @functools.cache
    def template():
        # Only shapes count, and zeros need no compiling.
        shapes = jax.eval_shape(lambda: create_state(trained, experiment.optimizer, experiment.seed))
        return jax.tree.map(lambda leaf: jax.device_put(np.zeros(leaf.shape, leaf.dtype)), shapes)

    @jax.jit
    def render(weights, rays):
        return model.view(*weights, rays)

    def weights(step):
        state = checkpoints.load(step, template())
        params = rendered_params(state)
        return params, extract(params) if extract else state.grid

    unseen = model.unseen and jax.jit(lambda weights, rays: model.unseen(weights[1], rays))
    image = image_renderer(render, experiment.eval.chunk, unseen)
    return Trained(experiment, checkpoints.steps, weights, render, build.identity(config), image)


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
    weights = run.weights(newest_step(run, folder))
    return run.experiment.model.scene(*weights), functools.partial(run.render, weights)
