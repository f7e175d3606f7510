"""Turns a resolved config into the functions of a run."""

import dataclasses
import functools
from collections.abc import Callable, Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax

from jaxnerf.core.views import Views
from jaxnerf.data import dataset, ray_batches
from jaxnerf.data.active_pixels import active_region, unmasked_pixels
from jaxnerf.data.facts import footprint_radii
from jaxnerf.data.geometry.free_space import interpolated_depths
from jaxnerf.data.images.pixel_rays import sees_sideways
from jaxnerf.data.observations import confident_observations
from jaxnerf.data.scene import bounded_by_alpha
from jaxnerf.fields.base import Field, contract_field
from jaxnerf.models.base import FINAL_NETWORK, Model, SamplerContext
from jaxnerf.models.occupancy import bake_occupancy, schedule_of
from jaxnerf.options import Changes, Options, changing, is_auto, values_of
from jaxnerf.registry import FIELDS, LOSSES, SAMPLERS
from jaxnerf.training.camera_parameters import CameraParameters
from jaxnerf.training.config import Config, RunConfig, part_sections, read_config
from jaxnerf.training.optimizer import make_optimizer
from jaxnerf.training.step import PixelRays, ProgressData, StepLoss, TrainData

# The optional fields that datasets provide.
_FILLED_BATCH_FIELDS = ("image_index", "pixel", "alpha", *ray_batches.DEPTH_FIELDS)


@dataclasses.dataclass(frozen=True)
class RenderParts:
    """A run's config, and the functions that it describes and that images are rendered with.

    Attributes:
        config: resolved.
        model: the config's field and sampler; its parameters have those of the training images, too.
        cameras: the parameters of the training images; None where the config has none.
        load_split: (split, images=True) -> Views. With images=False they have no pixels, and of a restored run those
            of the split "train" come from its workdir; None: they have pixels if the dataset is there.
        view_rays: (Views, index, pixels) -> Rays.
        world_depth: (Views, index, pixels, depth in t) -> distance in the file's units.
        background: [3] the colour behind the scene; None: black.
    """

    config: RunConfig
    model: Model
    cameras: CameraParameters | None
    load_split: Callable[..., Views]
    view_rays: Callable[..., Any]
    world_depth: Callable[..., Any]
    background: tuple[float, ...] | None


@dataclasses.dataclass(frozen=True)
class Experiment(RenderParts):
    """A run's config, and the functions that it describes: those that render, and those that train.

    Attributes:
        losses: those whose weight is not 0.
        optimizer: see `make_optimizer`.
        schedule: step -> learning rate.
        draw: (step, positions, TrainData) -> (keys, Batch).
        pixel_ids: (step, positions, TrainData) -> ids [B] int32 of the pixels that draw takes.
        prepare: Views -> (InitialCells, or None without a grid; TrainData).
        pixel_rays: the several rays of a pixel that draw takes; None: each ray is a pixel.
    """

    losses: tuple[StepLoss, ...]
    optimizer: optax.GradientTransformation
    schedule: Callable[[int], float]
    draw: Callable[..., tuple]
    pixel_ids: Callable[..., Any]
    prepare: Callable[..., tuple]
    pixel_rays: PixelRays | None


def build(config: Config) -> Experiment:
    """Builds the Experiment that a resolved config describes.

    Raises:
        ValueError: names the option that holds what cannot be built.
    """
    parts = render_parts(config)
    config, model, cameras = parts.config, parts.model, parts.cameras
    given, train = config.data, _filled(config.train, "train")
    losses = build_losses(config.losses, model)
    if train.deterministic and jax.default_backend() != "cpu":  # there all sums have a fixed order
        _check_fixed_order(losses, cameras)
        model = model._replace(render=build_model(config, fixed_order=True).render)
        parts = dataclasses.replace(parts, model=model)
    optimizer, schedule = make_optimizer(train, None if cameras is None else config.cameras)
    needs = [*losses, cameras] if cameras is not None else losses
    extras = tuple(sorted({need for part in needs for need in part.needs}))
    options = {"batching": train.batching, "extras": extras}
    pixel_rays = _pixel_rays(train, cameras, extras)

    def rays_per_side(step, data):
        return {} if pixel_rays is None else {"rays_per_side": pixel_rays.side_at(data.progress.at(step))}

    def draw(step, positions, data):
        return ray_batches.draw_batch(
            data.seed,
            step,
            positions,
            data.views,
            data.active_pixels,
            pixel_offset=given.pixel_offset,
            ndc=given.ndc,
            needs=model.needs,
            **options,
            **rays_per_side(step, data),
        )

    def pixel_ids(step, positions, data):
        common = {**options, **rays_per_side(step, data)}
        return ray_batches.draw_pixels(data.seed, step, positions, data.views, data.active_pixels, **common)[1]

    return Experiment(
        **vars(parts),
        losses=losses,
        optimizer=optimizer,
        schedule=schedule,
        draw=draw,
        pixel_ids=pixel_ids,
        prepare=functools.partial(_prepare, config, model, extras),
        pixel_rays=pixel_rays,
    )


def render_parts(config: Config, wrap: Callable[[Field], Field] | None = None) -> RenderParts:
    """Builds the RenderParts that a resolved config describes; wrap: see `build_model`.

    Raises:
        ValueError: names the option that holds what cannot be built.
    """
    config = read_config(config)
    given, model = config.data, build_model(config, wrap)
    cameras = build_cameras(config, model.needs)
    if cameras is not None:
        model = cameras.added_to(model)
    return RenderParts(
        config=config,
        model=model,
        cameras=cameras,
        load_split=functools.partial(_load_views, config, model.needs),
        view_rays=jax.jit(functools.partial(ray_batches.view_rays, ndc=given.ndc, needs=model.needs)),
        world_depth=jax.jit(functools.partial(ray_batches.world_depth, ndc=given.ndc)),
        background=config.scene.color_behind(given.background),
    )


def _pixel_rays(train, cameras, extras):
    """Returns the PixelRays that the options of training describe; None where each ray is a pixel."""
    if train.rays_per_side == 1:
        return None
    reasons = {
        "the section cameras has parameters of each training image, which are trained by rays through pixels": cameras,
        "losses.depth needs rays through sparse points": not set(ray_batches.DEPTH_FIELDS).isdisjoint(extras),
    }
    for reason, holds in reasons.items():
        if holds:
            raise ValueError(f"train.rays_per_side is {train.rays_per_side}, expected 1, as {reason}")
    return PixelRays(train.rays_per_side, train.one_ray_fraction)


def _check_fixed_order(losses, cameras):
    """Raises a ValueError if the gradient of what is trained has no fixed order on an accelerator."""
    others = {"cameras.exposure or cameras.refine": cameras is not None}
    others |= {f"losses.{loss.name}": not LOSSES.get(loss.name).fixed_order for loss in losses}
    found = [name for name, is_on in others.items() if is_on]
    if found:
        raise ValueError(
            f"train.deterministic is True, and {' and '.join(found)} is on, whose gradient has no fixed order on an "
            "accelerator; set it to False, or turn the other off"
        )


def build_model(config: Config, wrap: Callable[[Field], Field] | None = None, *, fixed_order: bool = False) -> Model:
    """Builds the Model: the config's field under the config's sampler.

    Args:
        config: resolved.
        wrap: changes the field that images show; None: it is as the config says.
        fixed_order: whether the sums of training have a fixed order on an accelerator, too.
    """
    config = read_config(config)
    part, scene = SAMPLERS.get(config.sampler), config.scene

    def make_field(network):
        field = _make_field(config, network, fixed_order)
        return wrap(field) if wrap is not None and network == FINAL_NETWORK else field

    context = SamplerContext(
        options=_filled(config.options_of(SAMPLERS), part.section or config.sampler),
        make_field=make_field,
        view=config.eval,
        background=scene.color_behind(config.data.background),
        box=scene.box,
        contracted=scene.contracted is True,
        fixed_order=fixed_order,
    )
    return _checked(config.sampler, part.make(context), Model)


def build_cameras(config: RunConfig, needs: tuple[str, ...] = ()) -> CameraParameters | None:
    """Builds the parameters of the training images; None where none are trained.

    Args:
        config: resolved.
        needs: see `Model`.

    Raises:
        ValueError: if the number of training images is unknown.
    """
    if not config.cameras.any:
        return None
    options = _filled(config.cameras, "cameras")
    return CameraParameters(
        num_images=options.num_images,
        exposure=options.exposure,
        refine=options.refine,
        view_rays=functools.partial(ray_batches.view_rays, ndc=config.data.ndc, needs=needs),
        background=dataset.background_of(config.data),
        refine_focal=options.refine_focal,
    )


def build_losses(weights: Mapping[str, Any], model: Model | None = None) -> tuple[StepLoss, ...]:
    """Builds losses; one whose weight is 0 is absent.

    Args:
        weights: of the losses, by name.
        model: whose fields may bring regularizers; None: no field does.

    Raises:
        ValueError: if no loss has a weight, a name is not registered, or a loss needs a field that no dataset provides.
    """
    losses = []
    for name, weight in weights.items():
        # "auto" is left in a config that was converted without its dataset.
        if is_auto(weight) or (isinstance(weight, int | float) and weight == 0):
            continue
        loss = LOSSES.get(name)
        missing = [need for need in loss.needs if need not in _FILLED_BATCH_FIELDS]
        if missing:
            raise ValueError(
                f"losses.{name} needs {missing[0]} in the batch, expected one of {_FILLED_BATCH_FIELDS}; set it to 0"
            )
        function = _of_fields(name, model) if loss.on == "field" else loss.function
        losses.append(StepLoss(name, function, loss.on, _weight_at(name, weight), loss.needs))
    if not any(loss.on == "renderings" for loss in losses):
        raise ValueError("losses: no loss of the renderings has a weight; set losses.mse to 1")
    return tuple(losses)


def check_views(config: RunConfig, views: Views) -> None:
    """Raises a ValueError if a loss of a resolved config needs what the views lack, before training starts."""
    losses = build_losses(config.losses, build_model(config))
    if any(not set(ray_batches.DEPTH_FIELDS).isdisjoint(loss.needs) for loss in losses):
        confident_observations(views)


def _of_fields(name, model):
    """Returns the regularizer (params) -> scalar of that name, the sum over the fields that bring it."""
    fields = {} if model is None else model.fields
    found = {network: field.regularizers[name] for network, field in fields.items() if name in field.regularizers}
    if not found:
        raise ValueError(f"losses.{name} needs a field that brings it, as a hash grid does; set it to 0")

    def regularizer(params):
        return functools.reduce(jnp.add, (function(params[network]) for network, function in found.items()))

    return regularizer


def bake_model(config: RunConfig, model: Model, visibility_rays, *, crop: bool = True):
    """Calls `bake_occupancy` for the box of a resolved config's section `occupancy`."""
    scene = config.scene
    schedule = schedule_of(_filled(config.occupancy, "occupancy"), scene.box, None, contracted=scene.contracted)
    background = scene.color_behind(config.data.background)
    return bake_occupancy(model, schedule, visibility_rays, config.eval, crop=crop, background=background)


def load_split(config: Config, split: str | None = None) -> tuple[Views, str, dict[str, Any]]:
    """Reads the Views of a split without building a model.

    Returns:
        Views; the split's name, which is eval.split where none is given; and the conventions.
    """
    config = read_config(config)
    (data, _, capture), split = dataset.resolve(config.data), split or config.eval.split
    views = dataset.load_split(data, split, capture=capture, fingerprint=config.fingerprint)
    return views, split, dataset.conventions(data, capture)


def _make_field(config, network, fixed_order) -> Field:
    """Makes the field of a network: the one that the config names, or that of a section of the network's name."""
    if network == FINAL_NETWORK:
        part, options = FIELDS.get(config.field), config.options_of(FIELDS)
        section = part.section or config.field
    elif network in config.parts:
        part, options, section = part_sections()[network], getattr(config, network), network
    else:
        raise ValueError(f"make_field: no network {network!r}, expected one of {FINAL_NETWORK!r} and {[*config.parts]}")
    name = config.field if network == FINAL_NETWORK else network
    field = _checked(name, part.make(_filled(options, section), config.scene.box), Field)
    if fixed_order and field.apply_in_fixed_order is not None:
        field = field._replace(apply=field.apply_in_fixed_order)
    # The paper's networks are not contracted; all other fields are defined in the box.
    declared = options if isinstance(options, Options) else Options()
    if (declared.needs_box or config.declared_by(SAMPLERS).needs_box) and config.scene.contracted is True:
        if config.scene.box is None:
            raise ValueError("scene.lower or scene.upper is 'auto'; resolve the config, or set both")
        return contract_field(field, *config.scene.box)
    return field


def _checked(name, made, kind):
    """Returns what a registered function has made; ValueError if it is of another kind."""
    if not isinstance(made, kind):
        raise ValueError(f"{name!r}: its function returned {type(made).__name__}, expected a {kind.__name__}")
    return made


def _filled(options, section):
    """Returns the options; ValueError if one is "auto" that the dataset determines."""
    values = values_of(options) if isinstance(options, Options) else options
    free = changing(options, Changes.SPEED) if isinstance(options, Options) else ()
    left = [name for name, value in values.items() if is_auto(value) and name not in free]
    if left:
        raise ValueError(f"{section}.{left[0]} is 'auto'; resolve the config against a dataset, or set a value")
    return options


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
            use_alpha=bounded_by_alpha(config.scene, views, ndc=config.data.ndc, refined=config.cameras.refine),
            # Nor does it where a lens sees beside it: its view is not that of a frustum.
            min_views=0 if views.time is not None or sees_sideways(views) else model.grid_schedule.min_views,
            ndc=config.data.ndc,
            pixel_offset=config.data.pixel_offset,
        )
    seed = np.uint32(config.seed % 2**32)
    sparse = None
    if not set(ray_batches.DEPTH_FIELDS).isdisjoint(extras):
        sparse = confident_observations(views)
        if not config.data.ndc:
            depths = interpolated_depths(dataclasses.replace(views, sparse=sparse))
            sparse = dataclasses.replace(sparse, interpolated=depths)
    progress = None
    if "progress" in model.needs or config.train.rays_per_side > 1:
        # Like the learning rate: a longer run that goes on with the same lr_steps does not go back.
        progress = ProgressData(np.float32(config.train.lr_steps), np.float32(0))
    radii = None
    if model.grid_schedule is not None and "radius" in model.needs:
        smallest, largest = footprint_radii(views)
        radii = np.float32([smallest / config.train.rays_per_side, largest])
    # The mask is part of the active pixels. Names, which no step reads, would be part of the compiled step.
    drawn = dataclasses.replace(views, mask=None, sparse=sparse, names=())
    return cells, TrainData(seed, drawn, active, indices, progress=progress, radii=radii)


def _load_views(config, needs, split, *, images=True, **options):
    """Returns the Views of a split; a scene that asks for the image_index gets 0 for views that are not trained on."""
    del images  # they are read
    views = dataset.load_split(config.data, split, fingerprint=config.fingerprint, **options)
    if split == "train" or "image_index" not in needs:
        return views
    return dataclasses.replace(views, image_index=np.zeros(len(views.size), np.int32))
