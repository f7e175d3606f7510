"""Restores a trained run as functions that read and render its checkpoints."""

import dataclasses
import functools
import os
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import jax

from jaxnerf.core.types import Rays, Rendering, SceneFn
from jaxnerf.core.views import Views
from jaxnerf.data import dataset
from jaxnerf.data.ray_batches import random_rays
from jaxnerf.evaluation.image_renderer import image_renderer
from jaxnerf.fields.base import at_time
from jaxnerf.models.base import Model
from jaxnerf.options import AUTO, Changes, changing, is_auto, replaced
from jaxnerf.registry import needs_folder
from jaxnerf.runtime import stages
from jaxnerf.training import auto_config, build
from jaxnerf.training.checkpoint import Checkpoints
from jaxnerf.training.config import Config, RunConfig, auto_fields, changed, identity, read_config
from jaxnerf.training.state import rendered_shapes
from jaxnerf.training.stored_cameras import is_of_run, training_views, without_images
from jaxnerf.training.workdir import load_config


class TrainedRun(NamedTuple):
    """A run's experiment and the functions that read and render its checkpoints.

    Attributes:
        experiment: what its config describes for rendering, see `build.RenderParts`.
        steps: () -> the steps of the finished checkpoints, ascending.
        variables: step -> (params, grid) of that checkpoint; the grid is None where the model has none.
        render: (variables, Rays [...]) -> Rendering [...] without weights, jitted.
        identity: text that is equal for configs that render alike, see `config.identity`.
        render_image: (variables, Rays [...], chunk=None, median_depth=False) -> Rendering [...] as `render`, in
            chunks that fit into memory.
        variables_of: (`image_params`, grid) of a state of training -> (params, grid) as `variables` returns them.
        model_with: (settings of the section `eval`, by name; wrap=None) -> the Model that renders with these in place
            of the run's own, and whose field is wrapped as `build_model` does. It takes the same variables.
        settings: what the images of the same variables depend on: the options of the section `eval` that change them,
            by name, and what a tool has changed about the run.
    """

    experiment: build.RenderParts
    steps: Callable[[], list[int]]
    variables: Callable[[int], tuple]
    render: Callable[[tuple, Rays], Rendering]
    identity: str
    render_image: Callable[..., Rendering]
    variables_of: Callable[[Any, Any], tuple]
    model_with: Callable[..., Model]
    settings: Mapping[str, Any] = {}


def restore_run(
    workdir: str | os.PathLike,
    config: Config | None = None,
    *,
    data_dir: str | None = None,
    settings: dict[str, Any] | None = None,
    time: float | None = None,
) -> TrainedRun:
    """Restores the run in a workdir. Checkpoints are read when `variables` is called.

    Args:
        workdir: the folder that training wrote.
        config: in place of the workdir's own; its "auto" fields have the values of the workdir's.
        data_dir: the dataset's folder in place of the config's.
        settings: fields of the config's section `eval` to replace, by name.
        time: in [0, 1], at which a scene that moves is shown, whatever the time of rays; None: at theirs.

    Returns:
        TrainedRun.

    Raises:
        ValueError: if there is no run, or no dataset in data_dir, names the folder; if there is a time and the scene
            does not move.
    """
    return _restore(workdir, config, data_dir, settings or {}, crop=True, time=time)


def restore_with_grid(
    workdir: str | os.PathLike, *, data_dir: str | None = None, settings: dict[str, Any] | None = None
) -> TrainedRun:
    """Restores the run in a workdir so that every model renders through an occupancy grid, and all have one shape.

    A model that was trained without a grid renders as with `eval.bake_occupancy`; see `restore_run`.
    """
    return _restore(workdir, None, data_dir, {**(settings or {}), "bake_occupancy": True}, crop=False)


def _restore(workdir, config, data_dir, settings, *, crop, time=None):
    """Returns what `restore_run` describes; crop: see `bake_occupancy`."""
    if config is None:
        config = load_config(workdir)
    elif auto_fields(config):
        config = auto_config.fill_from(config, load_config(workdir))
    config = dataset_at(read_config(config), data_dir)
    if data_dir or is_auto(config.data.ndc):
        config = replaced(config, data=dataset.resolve(config.data)[0])
    config = _with_settings(config, settings)
    config, _ = auto_config.resolve_for_device(config, training=False)
    at_rest = None
    if time is not None:
        check_moves(build.build_model(config), time)
        at_rest = functools.partial(at_time, time=time)
    experiment = build.render_parts(config, at_rest)
    read = functools.partial(_load_split, workdir, config, bool(data_dir), experiment.load_split)
    experiment = dataclasses.replace(experiment, load_split=read)
    checkpoints = Checkpoints(workdir)
    model, bake = experiment.model, None
    if config.eval.bake_occupancy and model.grid_schedule is None:
        views = experiment.load_split("train", images=bool(auto_fields(config)))
        if auto_fields(config):  # of a run that was converted without its dataset
            config = auto_config.resolve_for_device(auto_config.resolve(config, views).config, training=False)[0]
        options = {"view_rays": experiment.view_rays, "pixel_offset": config.data.pixel_offset}
        rays = functools.partial(random_rays, views, **options)
        model, bake = build.bake_model(config, model, rays, crop=crop)

    shapes = functools.cache(lambda: rendered_shapes(experiment.model))

    def render(variables, rays, **options):
        return model.view(*variables, rays, **options)

    def variables_of(params, grid):
        if bake:
            with stages.stage("extracting an occupancy grid"):
                grid = bake(params)
        return params, grid

    def variables(step):
        return variables_of(*checkpoints.load_rendered(step, shapes(), averaged=config.train.averaging_power > 0))

    def model_with(settings, wrap=None):
        other = _with_settings(config, settings)
        both = wrap and at_rest and (lambda field: wrap(at_rest(field)))
        model = build.build_model(other, both or wrap or at_rest)
        return build.bake_model(other, model, lambda count: None)[0] if bake else model

    def cull(variables, rays, **options):
        return model.cull(variables[1], rays, **options)

    @functools.cache
    def renderer(**options):
        part, mask = (jax.jit(functools.partial(each, **options)) for each in (render, cull))
        return image_renderer(part, config.eval.chunk, model.cull and mask)

    def render_image(variables, rays, chunk=None, median_depth=False):
        return renderer(**{"median_depth": True} if median_depth else {})(variables, rays, chunk)

    options = config.eval
    return TrainedRun(
        experiment,
        checkpoints.steps,
        variables,
        jax.jit(render),
        identity(config),
        render_image,
        variables_of,
        model_with,
        {name: getattr(options, name) for name in changing(options, Changes.IMAGES)}
        | ({} if time is None else {"time": time}),
    )


def check_moves(model: Model, time: Any) -> None:
    """Raises a ValueError if a time was given and a model's scene does not move."""
    if "time" not in model.needs:
        raise ValueError(f"time is {time}, and the scene of this run does not move, expected none; drop it")


def _load_split(workdir, config, is_elsewhere, read, split, *, images=True, **options):
    """Does what `RenderParts.load_split` describes; is_elsewhere: whether the dataset is another one than the run's."""
    there = dataset.is_there(config.data)
    stored = split == "train" and (images is False or not (images or there))
    if stored and not is_elsewhere and is_of_run(workdir, config):
        return training_views(workdir)
    if not there:
        raise ValueError(
            f"this needs the images of the split {split!r}, and data.dir is {config.data.dir!r}: no such folder; give "
            "--data_dir of the dataset"
        )
    views = read(split, **options)
    return without_images(views) if images is False else views


def dataset_at(config: RunConfig, folder: str | None) -> RunConfig:
    """Returns the config with another folder of the dataset; None: its own."""
    if not folder:
        return config
    format = config.data.format if needs_folder(config.data.format) else AUTO
    return changed(config, {"data.dir": folder, "data.format": format})


def _with_settings(config, settings):
    return changed(config, {f"eval.{name}": value for name, value in settings.items()}) if settings else config


def refined_views(run: TrainedRun, views: Views, split: str, params: Any) -> Views:
    """Returns Views of a split with the cameras that a run has refined; as they are where it has not."""
    cameras = run.experiment.cameras
    return views if cameras is None else cameras.refined_views(params, views, split)


def newest_step(run: TrainedRun, workdir: str | os.PathLike, step: int | None = None) -> int:
    """Returns the newest checkpoint's step, or the given one; ValueError, with the workdir, if there is none."""
    steps = run.steps()
    if not steps:
        raise ValueError(f"{workdir}: has no checkpoint yet; train first")
    if step is not None and step not in steps:
        raise ValueError(f"{workdir}: has no checkpoint of step {step}, only {steps}; give one of these")
    return steps[-1] if step is None else step


def load_scene(workdir: str | os.PathLike) -> tuple[SceneFn, Callable[[Rays], Rendering]]:
    """Loads the newest checkpoint of a run for other code.

    Args:
        workdir: the folder that training wrote.

    Returns:
        scene, the trained field as a function (x, viewdirs) -> (density, rgb), which asks for what the field asks for
        except the progress of training, which is the checkpoint's; and render, a function
        Rays [...] -> Rendering [...] with the samples and background of the run's evaluation. It renders in chunks
        that fit into memory, and skips rays that hit nothing; inside a jitted function it renders all rays at once.
        It has no gradient in reverse mode, as it ends rays early; for one, pass scene to `render_rays`, with the near,
        far and background of the run, see `TrainedRun`.

    Raises:
        ValueError: if the folder holds no finished checkpoint; names it.
    """
    run = restore_run(workdir)
    variables = run.variables(newest_step(run, workdir))

    def render(rays: Rays) -> Rendering:
        traced = any(isinstance(leaf, jax.core.Tracer) for leaf in jax.tree.leaves(rays))
        return (run.render if traced else run.render_image)(variables, rays)

    return run.experiment.model.scene(*variables), render
