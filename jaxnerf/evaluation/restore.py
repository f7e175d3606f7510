"""A trained run as functions for other code."""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import numpy as np
from ml_collections import ConfigDict

from jaxnerf.core.types import SceneFn
from jaxnerf.data.ray_batches import random_rays
from jaxnerf.runtime.chunking import image_renderer
from jaxnerf.training import auto_config, build, workdir
from jaxnerf.training.averaging import averaged_params
from jaxnerf.training.checkpoint import Checkpoints
from jaxnerf.training.state import create_state


class TrainedRun(NamedTuple):
    """A run's experiment and the functions that read and render its checkpoints.

    The variables of a checkpoint are (params, grid); the grid is None where the model has none.
    """

    experiment: build.Experiment
    steps: Callable[[], list[int]]  # the steps of the finished checkpoints, ascending
    variables: Callable[[int], tuple]  # step -> (params, grid)
    render: Callable[..., Any]  # (variables, Rays [...]) -> Rendering [...] without weights, jitted
    identity: str  # of its config, see build.identity
    render_image: Callable[..., Any]  # (variables, Rays [...], chunk=None) -> the same in chunks


def restore_run(
    workdir_path,
    config: ConfigDict | None = None,
    *,
    data_dir: str | None = None,
    settings: dict | None = None,
) -> TrainedRun:
    """Restores the run in a workdir.

    Args:
        workdir_path: the folder that training wrote.
        config: in place of the workdir's own; its "auto" fields have the values of the workdir's.
        data_dir: the dataset's folder in place of the config's.
        settings: fields of the config's section `eval` to replace, by name.

    Raises:
        ValueError: if there is no run; names the folder.
    """
    if config is None:
        config = workdir.read_config(workdir_path)
    elif auto_config.auto_fields(config):
        config = auto_config.fill_from(config, workdir.read_config(workdir_path))
    if data_dir:
        config.data.dir = data_dir
    config.eval.update(settings or {})
    config, _ = auto_config.resolve_for_device(config)
    experiment = build.build(config)
    checkpoints = Checkpoints(workdir_path)
    model, trained = experiment.model, experiment.model
    bake = None
    if config.eval.bake_occupancy and model.grid_schedule is None:
        views = experiment.load_split("train")
        options = {"view_rays": experiment.view_rays, "pixel_offset": experiment.pixel_offset}
        model, bake = build.bake_model(config, model, functools.partial(random_rays, views, **options))

    @functools.cache
    def template():
        # Only shapes count, and zeros need no compiling.
        shapes = jax.eval_shape(lambda: create_state(trained, experiment.optimizer, experiment.seed))
        return jax.tree.map(lambda leaf: jax.device_put(np.zeros(leaf.shape, leaf.dtype)), shapes)

    @jax.jit
    def render(variables, rays):
        return model.view(*variables, rays)

    def variables(step):
        state = checkpoints.load(step, template())
        params = averaged_params(state)
        return params, bake(params) if bake else state.grid

    cull = model.cull and jax.jit(lambda variables, rays: model.cull(variables[1], rays))
    render_image = image_renderer(render, experiment.eval.chunk, cull)
    identity = build.identity(config)
    return TrainedRun(experiment, checkpoints.steps, variables, render, identity, render_image)


def newest_step(run: TrainedRun, workdir_path, step: int | None = None) -> int:
    """Returns the newest checkpoint's step, or the given one; raises ValueError if there is none."""
    steps = run.steps()
    if not steps:
        raise ValueError(f"{workdir_path}: has no checkpoint yet; train first, or wait with --watch")
    if step is not None and step not in steps:
        raise ValueError(f"{workdir_path}: has no checkpoint of step {step}, only {steps}; give one of these")
    return steps[-1] if step is None else step


def load_scene(workdir_path) -> tuple[SceneFn, Callable[..., Any]]:
    """Loads a trained model for other code.

    Args:
        workdir_path: the folder that training wrote.

    Returns:
        scene, the trained field as a function (x, viewdirs) -> (density, rgb); and render, a jitted function
        Rays [...] -> Rendering [...] with the sampling and background that it was trained for.

    Raises:
        ValueError: if the folder holds no finished checkpoint; names it.
    """
    run = restore_run(workdir_path)
    variables = run.variables(newest_step(run, workdir_path))
    return run.experiment.model.scene(*variables), functools.partial(run.render, variables)
