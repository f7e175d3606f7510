"""Resolves a config against a dataset: every "auto" becomes a value, and a line gives the reason."""

from collections.abc import Iterable
from typing import NamedTuple

import jax

from jaxnerf.core.views import Views
from jaxnerf.data import dataset
from jaxnerf.data.facts import dataset_facts
from jaxnerf.options import Changes, Device, Facts, changing, is_auto, replaced
from jaxnerf.registry import FIELDS, LOSSES, SAMPLERS
from jaxnerf.runtime.processes import Detail
from jaxnerf.training.build import build_model
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

    Options of Changes.SPEED stay "auto"; see `resolve_for_device`. Sections that a run does not use are resolved, too:
    evaluation may use them later, as `eval.bake_occupancy` does.

    Args:
        config: of a run.
        views: of the split "train" where they have been read.
        platform: see `resolve_for_device`. It determines the number of rays and samples per step, and the sizes of
            the hash grid.

    Raises:
        ValueError: names the option or file, what was found and what is expected.
    """
    config = read_config(config)
    device = Device(platform or jax.default_backend(), jax.process_count())
    data, lines, capture = dataset.resolve(config.data)
    if views is None:
        views = dataset.load_split(data, "train", capture=capture, fingerprint=config.fingerprint)
    config = replaced(config, data=data, fingerprint=config.fingerprint or dataset.fingerprint(data, capture))
    facts = _facts(config, views)
    samplers = [SAMPLERS.get(name).section or name for name in SAMPLERS.names()]
    others = [name for name in config.sections() if name not in (*samplers, "data", "train")]
    config = _resolve_sections(config, [*samplers, *others], facts, device, lines)
    field, sampler = (
        config.options_of(registry.get(name), name)
        for registry, name in ((FIELDS, config.field), (SAMPLERS, config.sampler))
    )
    facts = facts._replace(
        large_field=getattr(field, "is_large", False),
        factor=config.data.factor,
        trains_cameras=config.cameras.any,
        busy_rays=sampler.busy_rays(device) if hasattr(sampler, "busy_rays") else None,
    )
    config = _resolve_sections(config, ["train"], facts, device, lines)
    facts = facts._replace(batch_size=config.train.batch_size)
    config = _resolve_sections(config, samplers, facts, device, lines)
    data, views, more = dataset.resolve_for_scene(config.data, views, fills_space=facts.fills_space)
    config = replaced(config, data=data, losses=_resolve_losses(config.losses, facts, lines))
    left = [name for name in auto_fields(config) if name not in device_fields(config)]
    if left:
        raise ValueError(f"{left[0]} is 'auto', which is not inferred for this field; set a value")
    return Resolved(config, views, lines + more)


def resolve_for_device(config: Config, platform: str | None = None) -> tuple[RunConfig, list[str]]:
    """Resolves options of Changes.SPEED of an otherwise resolved config for the devices of this process.

    Args:
        config: of a run.
        platform: of the devices to resolve for in place of those of this process: "cpu", "gpu" or "tpu".

    Returns:
        The config, and one line per inferred value.

    Raises:
        ValueError: on a value that no run can have; config.json may have been edited.
    """
    config, lines = read_config(config), []
    device = Device(platform or jax.default_backend(), jax.process_count())
    sampler = config.options_of(SAMPLERS.get(config.sampler), config.sampler)
    if hasattr(sampler, "rays_per_chunk"):
        device = device._replace(chunk=sampler.rays_per_chunk(device))
    others = [name for name in config.sections() if name != "train"]
    config = _resolve_sections(config, others, None, device, lines)
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


def _facts(config, views):
    paper = config.sampler == "hierarchical" and config.field == "mlp"  # has no box
    occupancy = config.occupancy
    return dataset_facts(
        views,
        ndc=config.data.ndc,
        world=config.data.world,
        # Alpha bounds the box of a field that is defined in it, unless the scene moves: no image then shows where all
        # of it ever is. A box only for rendering holds all that cameras see.
        use_alpha=occupancy.use_alpha and not paper and views.time is None,
        sampler=config.sampler,
        contracted=occupancy.contracted,
        lower=occupancy.lower,
        upper=occupancy.upper,
        num_scales=config.data.num_scales,
    )


def _resolve_sections(
    config: RunConfig, names: Iterable[str], facts: Facts | None, device: Device, lines: list[str]
) -> RunConfig:
    """Returns the config with some sections resolved by their parts; adds lines of the sections that the run uses.

    Without facts those options are resolved that are inferred at every start.
    """
    sections = config.sections()
    used = used_sections(config)
    if config.field != "mlp" or config.sampler != "hierarchical" or config.eval.bake_occupancy:
        used.add("occupancy")  # its box
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
