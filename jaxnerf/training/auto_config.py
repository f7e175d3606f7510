"""Resolves a config against a dataset: every "auto" becomes a value, and a line gives the reason."""

from collections.abc import Iterable
from typing import NamedTuple

import jax

from jaxnerf.core.views import Views
from jaxnerf.data import dataset
from jaxnerf.data.facts import dataset_facts
from jaxnerf.data.readers.base import TIME_UNUSED
from jaxnerf.data.scene import bounded_by_alpha, outlined_by_alpha, resolve_background, resolve_scene
from jaxnerf.options import Changes, Device, Facts, changing, is_auto, replaced
from jaxnerf.registry import FIELDS, LOSSES, SAMPLERS
from jaxnerf.runtime.processes import Detail
from jaxnerf.training.build import build_model
from jaxnerf.training.camera_parameters import resolve_cameras
from jaxnerf.training.config import (
    Config,
    RunConfig,
    auto_fields,
    changed,
    declared,
    flatten,
    read_config,
    used_sections,
)

_WITHOUT_POINTS = "; no sparse points are known, which help most there: jaxnerf-cameras --cameras_of finds them"


class Resolved(NamedTuple):
    """A resolved config.

    Attributes:
        config: without "auto", except for options of Changes.SPEED.
        views: of the split "train", which it was resolved against.
        lines: one per inferred value that the run uses, with its reason; a Detail where it is not about the dataset.
    """

    config: RunConfig
    views: Views
    lines: list[str]


def resolve(config: Config, views: Views | None = None, *, platform: str | None = None) -> Resolved:
    """Resolves a config against its dataset; explicit values are never changed.

    The order is that in which parts depend on each other: the dataset, the scene's box, the field, training, the
    sampler, all others. Options of Changes.SPEED stay "auto"; see `resolve_for_device`. Sections that a run does not
    use are resolved, too: evaluation may use them later, as `eval.bake_occupancy` does.

    Args:
        config: of a run.
        views: of the split "train" where they have been read.
        platform: see `resolve_for_device`. It determines the number of rays and samples per step, and the sizes of
            the hash grid.

    Raises:
        ValueError: names the option or file, what was found and what is expected.
    """
    config = with_registered_parts(read_config(config))
    device = Device(platform or jax.default_backend(), jax.process_count())
    data, lines, capture = dataset.resolve(config.data)
    if views is None:
        views = dataset.load_split(data, "train", capture=capture, fingerprint=config.fingerprint)
    fingerprint = config.fingerprint or dataset.fingerprint(data, capture)
    sampler = config.declared_by(SAMPLERS)
    cameras, found = resolve_cameras(config.cameras, views)
    config, lines = replaced(config, cameras=cameras), lines + found
    has_alpha = bounded_by_alpha(config.scene, views, ndc=data.ndc, refined=config.cameras.refine)
    # A box only for rendering holds all that cameras see.
    has_alpha &= config.has_box
    outlined = config.has_box and outlined_by_alpha(config.scene, views, ndc=data.ndc)
    scene, found = resolve_scene(
        config.scene, views, ndc=data.ndc, world=data.world, outlined=outlined, has_alpha=has_alpha
    )
    if config.has_box or config.eval.bake_occupancy:
        lines += map(Detail, found)
    facts = dataset_facts(
        views,
        lower=scene.box[0],
        upper=scene.box[1],
        ndc=data.ndc,
        contracted=scene.contracted,
        has_alpha=has_alpha,
        factor=data.factor,
        skips_empty_cells=sampler.skips_empty_cells,
        trains_cameras=config.cameras.any,
        outlined=outlined,
    )
    if facts.travels and facts.fills_space:
        lines.append(
            "walk          the cameras look at no common point" + _WITHOUT_POINTS * (not facts.num_observations)
        )
    scene, more = resolve_background(scene, views, behind_alpha=data.background, fills_space=facts.fills_space)
    data, views, near = dataset.resolve_near(data, views, fills_space=facts.fills_space)
    config = replaced(config, data=data, scene=scene, fingerprint=fingerprint)
    samplers = [SAMPLERS.get(name).section or name for name in SAMPLERS.names()]
    fields = [name for name in config.parts if name not in samplers]
    others = [name for name in config.sections() if name not in (*fields, *samplers, "data", "scene", "train")]
    config = _resolve_sections(config, fields, facts, device, lines)
    rays, why = sampler.rays_per_step(
        config.train.cpu_batch_size, device, large_field=config.declared_by(FIELDS).is_large
    )
    batch = rays if is_auto(config.train.batch_size) else config.train.batch_size
    facts = facts._replace(rays_per_step=rays, rays_reason=why, batch_size=batch)
    config = _resolve_sections(config, ["train", *samplers, *others], facts, device, lines)
    config = replaced(config, losses=_resolve_losses(config.losses, facts, lines))
    left = [name for name in auto_fields(config) if name not in device_fields(config)]
    if left:
        raise ValueError(f"{left[0]} is 'auto', which is not inferred for this field; set a value")
    if views.time is not None and "time" not in build_model(resolve_for_device(config, training=False)[0]).needs:
        lines.append(f"time          {TIME_UNUSED}")
    return Resolved(config, views, lines + more + near)


def with_registered_parts(config: RunConfig) -> RunConfig:
    """Returns the config; raises a ValueError if its field, its sampler or a loss with a weight is not registered."""
    losses = [(LOSSES, name) for name, weight in config.losses.items() if weight != 0]
    for registry, name in ((FIELDS, config.field), (SAMPLERS, config.sampler), *losses):
        registry.get(name)
    return config


def resolve_for_device(
    config: Config, platform: str | None = None, *, training: bool = True
) -> tuple[RunConfig, list[str]]:
    """Resolves options of Changes.SPEED of an otherwise resolved config for the devices of this process.

    Args:
        config: of a run.
        platform: of the devices to resolve for in place of those of this process: "cpu", "gpu" or "tpu".
        training: whether the section `train` is resolved, too; without, the config renders and does not train.

    Returns:
        The config, and one line per inferred value.

    Raises:
        ValueError: on a value that no run can have; config.json may have been edited.
    """
    config, lines = read_config(config), []
    device = Device(platform or jax.default_backend(), jax.process_count())
    device = device._replace(chunk=config.declared_by(SAMPLERS).rays_per_chunk(device))
    others = [name for name in config.sections() if name != "train"]
    config = _resolve_sections(config, others, None, device, lines)
    if not training:
        return config, lines
    if is_auto(config.train.microbatch_size) and not is_auto(config.train.batch_size):
        device = device._replace(samples_per_ray=build_model(config).samples_per_ray)
    config = _resolve_sections(config, ["train"], None, device, lines)
    left = [name for name in auto_fields(config) if name in device_fields(config)]
    if left and not is_auto(config.train.batch_size):
        raise ValueError(f"{left[0]} is 'auto', which `resolve_for_device` of its options does not infer; set a value")
    return config, lines


def device_fields(config: RunConfig) -> list[str]:
    """Returns the dotted names of the options that are inferred at every start, so that they stay "auto"."""
    return [name for name, option, _, _ in declared(config) if option.auto and option.changes & Changes.SPEED]


def fill_from(config: Config, resolved: Config) -> RunConfig:
    """Returns a config whose "auto" values are those of a resolved one; options of Changes.SPEED stay "auto"."""
    config, resolved = read_config(config), read_config(resolved)
    values, device = flatten(resolved.to_dict()), device_fields(config)
    names = [name for name in auto_fields(config) if name not in device]
    missing = [name for name in names if name not in values]
    if missing:
        raise ValueError(f"{missing[0]} is 'auto', and the config of the workdir has no such field; set a value")
    return replaced(changed(config, {name: values[name] for name in names}), fingerprint=resolved.fingerprint)


def _resolve_sections(
    config: RunConfig, names: Iterable[str], facts: Facts | None, device: Device, lines: list[str]
) -> RunConfig:
    """Returns the config with some sections resolved by their parts; adds lines of the sections that the run uses.

    Without facts those options are resolved that are inferred at every start.
    """
    sections = config.sections()
    used = used_sections(config)
    for name in names:
        if name not in sections:
            continue
        part = sections[name]
        resolved, found = part.resolve_for_device(device) if facts is None else part.resolve(facts, device)
        if facts is not None:  # these stay "auto"
            kept = changing(part, Changes.SPEED)
            resolved = replaced(resolved, **{each: getattr(part, each) for each in kept})
        sections[name] = resolved
        lines += [Detail(line.replace("{section}", name)) for line in found if name in used]
    return config.with_sections(sections)


def _resolve_losses(losses, facts, lines):
    weights = {}
    for name, weight in losses.items():
        if is_auto(weight) and name in LOSSES.names() and LOSSES.get(name).infer:
            weight, line = LOSSES.get(name).infer(facts)
            lines += [Detail(line)] if line else []
        weights[name] = weight
    return weights
