"""Turns a resolved config into the functions of a run.

Beside it, only `auto_config` and `restore_run`, which fill in and replace fields, read a resolved config.
"""

import dataclasses
import functools
import json
from collections.abc import Callable, Mapping, Sequence
from types import SimpleNamespace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
from ml_collections import ConfigDict

from jaxnerf.core.types import TableLevel, Views
from jaxnerf.data import dataset, ray_batches
from jaxnerf.data.active_pixels import active_region, unmasked_pixels
from jaxnerf.data.geometry.free_space import interpolated_depths
from jaxnerf.data.observations import confident_observations
from jaxnerf.fields.base import Field, contract_field, make_field
from jaxnerf.models.base import Model, SamplerContext, make_model
from jaxnerf.models.occupancy import bake_occupancy, schedule_from_section, view_options
from jaxnerf.registry import LOSSES, Loss
from jaxnerf.runtime.config_fields import is_auto
from jaxnerf.training.camera_parameters import CameraParameters
from jaxnerf.training.optimizer import make_optimizer
from jaxnerf.training.step import ProgressData, StepLoss, TrainData

# The optional fields that datasets provide.
_FILLED_BATCH_FIELDS = ("image_index", "pixel", "alpha", *ray_batches.DEPTH_FIELDS)


class Experiment(NamedTuple):
    """Everything that the training and evaluation loops need of a config.

    Attributes:
        model: the config's field and sampler.
        cameras: the parameters of the training images; None where the config has none.
        losses: those whose weight is not 0.
        optimizer: see `make_optimizer`.
        schedule: step -> learning rate.
        load_split: split -> Views.
        draw: (step, positions, TrainData) -> (keys, Batch).
        pixel_ids: (step, positions, TrainData) -> ids [B] int32 of the pixels that draw takes.
        view_rays: (Views, index, pixels) -> Rays.
        world_depth: (Views, index, pixels, depth in t) -> distance in the file's units.
        prepare: Views -> (InitialCells, or None without a grid; TrainData).
        seed: of everything random.
        pixel_offset: px, from a pixel's index to the point that its ray goes through.
        ndc: whether view_rays returns rays in normalised device coordinates.
        background: [3] the colour behind the scene; None: black.
        train, eval: the config's sections.
        conventions: see `conventions`.
    """

    model: Model
    cameras: CameraParameters | None
    losses: tuple[StepLoss, ...]
    optimizer: optax.GradientTransformation
    schedule: Callable[[int], float]
    load_split: Callable[[str], Views]
    draw: Callable[..., tuple]
    pixel_ids: Callable[..., Any]
    view_rays: Callable[..., Any]
    world_depth: Callable[..., Any]
    prepare: Callable[..., tuple]
    seed: int
    pixel_offset: float
    ndc: bool
    background: tuple[float, float, float] | None
    train: SimpleNamespace
    eval: SimpleNamespace
    conventions: dict[str, Any]


def build(config: ConfigDict) -> Experiment:
    """Builds the Experiment that a resolved config describes.

    Raises:
        ValueError: names the field that holds what cannot be built.
    """
    model, losses = build_model(config), build_losses(dict(config.losses), functools.partial(_levels, config))
    cameras = build_cameras(config, model.needs)
    optimizer, schedule = make_optimizer(config.train, None if cameras is None else config.cameras)
    if cameras is not None:
        model = cameras.added_to(model)
    options = {"pixel_offset": config.data.pixel_offset, "ndc": config.data.ndc, "needs": model.needs}
    batching = {"batching": config.train.batching}
    needs = [*losses, cameras] if cameras is not None else losses
    extras = tuple(sorted({need for part in needs for need in part.needs}))
    if config.train.batching not in ray_batches.BATCHINGS:
        raise ValueError(f"train.batching is {config.train.batching!r}, expected one of {ray_batches.BATCHINGS}")

    def draw(step, positions, data):
        return ray_batches.draw_batch(
            data.seed, step, positions, data.views, data.active_pixels, extras=extras, **batching, **options
        )

    def pixel_ids(step, positions, data):
        return ray_batches.draw_pixels(
            data.seed, step, positions, data.views, data.active_pixels, extras=extras, **batching
        )[1]

    return Experiment(
        model=model,
        cameras=cameras,
        losses=losses,
        optimizer=optimizer,
        schedule=schedule,
        load_split=functools.partial(_load_views, config.data, model.needs),
        draw=draw,
        pixel_ids=pixel_ids,
        view_rays=jax.jit(functools.partial(ray_batches.view_rays, ndc=config.data.ndc, needs=model.needs)),
        world_depth=jax.jit(functools.partial(ray_batches.world_depth, ndc=config.data.ndc)),
        prepare=functools.partial(_prepare, config, model, extras),
        seed=config.seed,
        pixel_offset=config.data.pixel_offset,
        ndc=config.data.ndc,
        background=dataset.color_behind(config.data),
        train=SimpleNamespace(**config.train),
        eval=SimpleNamespace(**config.eval),
        conventions=conventions(config.data),
    )


def build_model(config: ConfigDict) -> Model:
    """Builds the Model: the config's field under the config's sampler."""
    return make_model(config.sampler, _context(config))


def build_cameras(config: ConfigDict, needs: tuple[str, ...] = ()) -> CameraParameters | None:
    """Builds the parameters of the training images; None where none are trained, as in configs of older versions.

    Args:
        config: resolved.
        needs: see `Model`.

    Raises:
        ValueError: if the number of training images is unknown.
    """
    section = config.get("cameras", {})
    if not (section.get("exposure") or section.get("refine")):
        return None
    if is_auto(section.num_images):
        raise ValueError("cameras.num_images is 'auto'; resolve the config against a dataset, or set a number")
    return CameraParameters(
        num_images=section.num_images,
        exposure=section.exposure,
        refine=section.refine,
        view_rays=functools.partial(ray_batches.view_rays, ndc=config.data.ndc, needs=needs),
        background=dataset.background_of(config.data),
    )


def build_losses(
    weights: Mapping[str, Any], levels: Callable[[], Sequence[TableLevel]] = tuple
) -> tuple[StepLoss, ...]:
    """Builds the losses of the config's section; one whose weight is 0 is absent.

    Args:
        weights: of the losses, by name.
        levels: called where a regularizer needs them; returns those of the field's table, see `Field`.

    Raises:
        ValueError: if no loss has a weight, a name is not registered, or a loss needs a field that no dataset provides.
    """
    losses = []
    for name, weight in weights.items():
        # "auto" is left in a config that was converted without its dataset.
        if is_auto(weight) or (isinstance(weight, int | float) and weight == 0):
            continue
        loss = LOSSES.get(name)
        if loss.on == "params" and "levels" in loss.needs:
            loss = _of_levels(name, loss, levels())
        missing = [need for need in loss.needs if need not in _FILLED_BATCH_FIELDS]
        if missing:
            raise ValueError(
                f"losses.{name} needs {missing[0]} in the batch, expected one of {_FILLED_BATCH_FIELDS}; set it to 0"
            )
        losses.append(StepLoss(name, loss.function, loss.on, _weight_at(name, weight), loss.needs))
    if not any(loss.on == "renderings" for loss in losses):
        raise ValueError("losses: no loss of the renderings has a weight; set losses.mse to 1")
    return tuple(losses)


def check_views(config: ConfigDict, views: Views) -> None:
    """Raises a ValueError if a loss of a resolved config needs what the views lack, before training starts."""
    losses = build_losses(dict(config.losses), functools.partial(_levels, config))
    if any(not set(ray_batches.DEPTH_FIELDS).isdisjoint(loss.needs) for loss in losses):
        confident_observations(views)


def _of_levels(name, regularizer, levels):
    """Returns the Loss of a regularizer (params, levels) -> scalar for the given levels."""
    if not levels:
        raise ValueError(f"losses.{name} needs a hash grid, which the field does not have; set it to 0")
    return Loss(functools.partial(regularizer.function, levels=levels), on="params")


def _levels(config):
    """Returns the levels of the table of the final rendering's field; empty without a table."""
    return _context(config).make_field("fine").levels


def bake_model(config: ConfigDict, model: Model, visibility_rays, *, crop: bool = True):
    """Calls `bake_occupancy` for the box of a resolved config's section `occupancy`."""
    schedule = schedule_from_section(_section(config, "occupancy"), None)
    return bake_occupancy(model, schedule, visibility_rays, crop=crop, **view_options(_context(config)))


def load_split(config: ConfigDict, split: str | None = None) -> tuple[Views, str, dict[str, Any]]:
    """Reads the Views of a split without building a model.

    Returns:
        Views; the split's name, which is eval.split where none is given; and the conventions.
    """
    data, split = dataset.resolve(config.data)[0], split or config.eval.split
    return dataset.load_split(data, split), split, conventions(data)


def conventions(data: ConfigDict) -> dict[str, Any]:
    """Returns the fields of a data section that an evaluation protocol records."""
    return {name: data[name] for name in ("format", "background", "pixel_offset", "factor", "hold_out", "num_views")}


def identity(config: ConfigDict) -> str:
    """Returns as text the parts of a config that renderings depend on; not training, nor the dataset's folder."""
    plain = json.loads(config.to_json_best_effort())
    data = {name: value for name, value in plain["data"].items() if name != "dir"}
    rest = {name: value for name, value in plain.items() if name not in ("train", "eval", "data", "losses", "cameras")}
    rest["occupancy"].pop("update_chunk", None)  # as "auto" it depends on the device, and it changes no image
    return json.dumps({**rest, "data": data}, sort_keys=True)


def check_released(config: ConfigDict, origin: str) -> None:
    """Raises a ValueError if a config's networks differ from those of a released code."""
    if config.sampler != "hierarchical" or config.field != "mlp":
        raise ValueError(
            f"sampler is {config.sampler!r} and field {config.field!r}, expected 'hierarchical' and 'mlp' as in "
            f"{origin}"
        )
    activations = ("relu", "softplus") if origin == "JaxNeRF" else ("relu",)
    for name in ("coarse", "fine"):
        if not config[name].encode:
            raise ValueError(f"{name}.encode is False, expected True as in {origin}")
        if config[name].density_bias:
            raise ValueError(f"{name}.density_bias is {config[name].density_bias}, expected 0 as in {origin}")
        if config[name].density_activation not in activations:
            raise ValueError(
                f"{name}.density_activation is {config[name].density_activation!r}, expected "
                f"{' or '.join(map(repr, activations))} as in {origin}"
            )


def _context(config):
    names = [name for name, value in config.items() if isinstance(value, ConfigDict)]
    sections = {name: _section(config, name) for name in names}
    section = sections["occupancy"]
    box = None
    if not (is_auto(section["lower"]) or is_auto(section["upper"])):
        box = section["lower"], section["upper"]
    return SamplerContext(
        make_field=functools.partial(_make_field, config, sections, box),
        sections=sections,
        background=dataset.color_behind(config.data),
    )


def _make_field(config, sections, box, network) -> Field:
    """Makes the field of a network; that of "coarse" is always an MLP."""
    name = config.field if network == "fine" else "mlp"
    options = sections[network] if name == "mlp" else sections.get(name, {})
    if name == "mlp" and is_auto(options["num_freqs"]):
        raise ValueError(f"{network}.num_freqs is 'auto'; resolve the config against a dataset, or set a number")
    field = make_field(name, options, box)
    # The paper's networks are not contracted; all other fields are defined in the box.
    in_box = config.sampler != "hierarchical" or name != "mlp"
    if in_box and sections["occupancy"]["contracted"] is True:
        if box is None:
            raise ValueError("occupancy.lower or occupancy.upper is 'auto'; resolve the config, or set both")
        return contract_field(field, *box)
    return field


def _section(config, name):
    """Returns a section as a plain dict, with tuples for the lists of a config.json."""
    section = {field: tuple(value) if isinstance(value, list) else value for field, value in config[name].items()}
    for field, value in section.items():
        if name == "occupancy" and config.sampler == "occupancy" and is_auto(value):
            raise ValueError(f"occupancy.{field} is 'auto'; resolve the config against a dataset, or set a value")
    return section


def _weight_at(name, weight):
    """Returns the function step -> weight of a number or of points (step, weight), linear between them."""
    if isinstance(weight, int | float):
        return lambda step: weight
    steps, values = zip(*weight, strict=True)
    if list(steps) != sorted(steps):
        raise ValueError(f"losses.{name} is {weight}, expected points (step, weight) with ascending steps")
    steps, values = np.float32(steps), np.float32(values)
    return lambda step: jnp.interp(jnp.asarray(step, jnp.float32), steps, values)


def _prepare(config, model, extras, views):
    cameras = build_cameras(config)
    if cameras is not None and cameras.num_images != len(views.size):
        raise ValueError(
            f"cameras.num_images is {cameras.num_images}, expected {len(views.size)}, the training images of the "
            "dataset; do not set it"
        )
    cells = indices = None
    if model.grid_schedule is None:
        active = unmasked_pixels(views)
    else:
        cells, active, indices = active_region(
            views,
            model.grid_schedule,
            # What is empty in one image of a scene that moves may hold matter in others.
            use_alpha=config.occupancy.use_alpha and not config.data.ndc and views.time is None,
            min_views=config.occupancy.get("min_views", 0) if views.time is None else 0,
            ndc=config.data.ndc,
            pixel_offset=config.data.pixel_offset,
        )
    seed = np.uint32(config.seed % 2**32)
    sparse = None
    if not set(ray_batches.DEPTH_FIELDS).isdisjoint(extras):
        sparse = confident_observations(views)
        if not config.data.ndc:
            between = interpolated_depths(dataclasses.replace(views, sparse=sparse))
            sparse = dataclasses.replace(sparse, between=between)
    progress = None
    if "progress" in model.needs:
        progress = ProgressData(np.float32(config.train.max_steps), np.float32(0))
    # The mask is part of the active pixels.
    views = dataclasses.replace(views, mask=None, sparse=sparse)
    return cells, TrainData(seed, views, active, indices, progress=progress)


def _load_views(data, needs, split, **options):
    """Returns the Views of a split; a scene that asks for the image_index gets 0 for views that are not trained on."""
    views = dataset.load_split(data, split, **options)
    if split == "train" or "image_index" not in needs:
        return views
    return dataclasses.replace(views, image_index=np.zeros(len(views.size), np.int32))
