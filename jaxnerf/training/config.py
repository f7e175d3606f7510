"""The config of a run: the tree of the options of its parts; and as a ConfigDict, which flags and Python code set."""

import ast
import dataclasses
import json
from collections.abc import Iterator, Mapping
from typing import Any, TypeAlias

from absl import flags
from ml_collections import ConfigDict, FieldReference, config_flags

from jaxnerf.data.dataset import DataOptions
from jaxnerf.data.scene import SceneOptions
from jaxnerf.options import (
    AUTO,
    Changes,
    Option,
    Options,
    Schedule,
    as_tuples,
    declarations,
    is_auto,
    is_kind,
    is_schedule,
    is_tuple,
    option,
    read,
    read_value,
    replaced,
    short_repr,
    unknown_field,
    values_of,
)
from jaxnerf.registry import FIELDS, LOSSES, SAMPLERS, Part, Registry
from jaxnerf.runtime import memory
from jaxnerf.training.camera_parameters import CameraOptions
from jaxnerf.training.earlier_options import RENAMED, in_todays_names, refuse, today
from jaxnerf.training.options import EvalOptions, TrainOptions

_MAX_SEED = 2**63 - 1  # what jax.random.key takes


@dataclasses.dataclass(frozen=True)
class RunConfig(Options):
    """The config of a run.

    Attributes:
        fingerprint: no option but a record: that of the dataset that the run is trained on, see `dataset.fingerprint`.
        losses: the weight of each loss, by its registered name; 0: off.
        parts: the options of fields and samplers, by the name of their section; of a config that has been read, those
            of built-in parts and of others that it uses. A part without a class of options has a dict. Each is an
            attribute of the config, too.
    """

    seed: int = option(0, "seed of all random numbers", max_int=_MAX_SEED)
    field: str = option(
        "mlp", "the field of the final rendering: `mlp` (section `fine`), `hash_grid`, or a registered one"
    )
    sampler: str = option("hierarchical", "`hierarchical` (section `sampling`), `occupancy`, or a registered one")
    fingerprint: str = ""
    data: DataOptions = dataclasses.field(default_factory=DataOptions)
    scene: SceneOptions = dataclasses.field(default_factory=SceneOptions)
    losses: Mapping[str, Schedule] = dataclasses.field(
        default_factory=lambda: {name: LOSSES.get(name).weight for name in LOSSES.names()}
    )
    cameras: CameraOptions = dataclasses.field(default_factory=CameraOptions)
    train: TrainOptions = dataclasses.field(default_factory=TrainOptions)
    eval: EvalOptions = dataclasses.field(default_factory=EvalOptions)
    parts: Mapping[str, Any] = dataclasses.field(
        default_factory=lambda: {name: part.options() for name, part in part_sections().items() if part.options}
    )

    def __getattr__(self, name: str) -> Any:
        parts = self.__dict__.get("parts", {})
        if name not in parts:
            raise AttributeError(f"the config has no section {name!r}")
        return parts[name]

    def sections(self) -> dict[str, Options]:
        """Returns the options of all parts, by the name of their section; those without a class excepted."""
        own = {field.name: getattr(self, field.name) for field in dataclasses.fields(self)}
        return {name: part for name, part in {**own, **self.parts}.items() if isinstance(part, Options)}

    def with_sections(self, sections: Mapping[str, Any]) -> "RunConfig":
        """Returns a config with other sections, by name."""
        own = {name: part for name, part in sections.items() if name not in self.parts}
        parts = {name: sections.get(name, part) for name, part in self.parts.items()}
        return dataclasses.replace(self, parts=parts, **own)

    def options_of(self, registry: Registry) -> Any:
        """Returns the options of the run's part in a registry, the run's field or sampler."""
        name = self.field if registry is FIELDS else self.sampler
        part = registry.get(name)
        return self.parts.get(part.section or name, part.options() if part.options else {})

    def declared_by(self, registry: Registry) -> Options:
        """Returns the options of the run's field or sampler for what they declare; default ones if it has no class."""
        options = self.options_of(registry)
        return options if isinstance(options, Options) else Options()

    @property
    def has_box(self) -> bool:
        """Whether the run's field is defined in the scene's box."""
        return any(self.declared_by(registry).needs_box for registry in (FIELDS, SAMPLERS))

    def to_dict(self) -> dict[str, Any]:
        """Returns {section: {option: value}}, and the values of the options that are in no section."""
        sections = {name: values_of(part) for name, part in self.sections().items()}
        plain = {name: dict(part) for name, part in self.parts.items() if name not in sections}
        record = {"fingerprint": self.fingerprint} if self.fingerprint else {}
        return {**record, **values_of(self), **sections, **plain, "losses": dict(self.losses)}

    def to_json(self) -> str:
        """Returns `to_dict` as JSON."""
        return json.dumps(self.to_dict(), indent=2)


Config: TypeAlias = RunConfig | ConfigDict | Mapping[str, Any]


def part_sections() -> dict[str, Part]:
    """Returns the registered fields and samplers, and the fields of a sampler's further networks, by their section.

    Raises:
        ValueError: if one has the name of an option or section of every config.
    """
    found: dict[str, Part] = {}
    for registry in (SAMPLERS, FIELDS):
        for name in registry.names():
            part = registry.get(name)
            section = part.section or name
            if section in found or section in RunConfig.__dataclass_fields__:
                raise ValueError(
                    f"a field or sampler is registered as {section!r}, which every config has for something else; "
                    "register it under another name"
                )
            found |= {**part.networks, section: part}
    return found


def read_config(config: Config) -> RunConfig:
    """Reads a config of unknown origin, such as that of a config file or of a config.json, and checks it.

    Args:
        config: with the names and types of the options' declarations; returned as it is if it has been read.

    Raises:
        ValueError: names the flag, the value and what is expected.
    """
    if isinstance(config, RunConfig):
        return config
    if not isinstance(config, ConfigDict | Mapping):
        raise ValueError(f"config is {short_repr(config)}, expected one such as jaxnerf.configs.default.get_config()")
    content, left = in_todays_names(config.to_dict() if isinstance(config, ConfigDict) else config)
    refuse(left, "--config.")
    record = content.pop("fingerprint", "")
    types = {field.name: field.type for field in dataclasses.fields(RunConfig)}
    kinds = {name: kind for name, kind in types.items() if isinstance(kind, type) and issubclass(kind, Options)}
    top = read(RunConfig, {name: content.pop(name) for name in declarations(RunConfig) if name in content}, "config.")
    own = {name: read(kind, _section(content, name), f"config.{name}.") for name, kind in kinds.items()}
    losses = {name: _read_weight(name, weight) for name, weight in _section(content, "losses").items()}
    registered = part_sections()
    built_in = [name for name, part in registered.items() if part.section]
    parts = {name: read(registered[name].options, _section(content, name), f"config.{name}.") for name in built_in}
    parts |= {
        name: _read_part(name, registered.get(name), part)
        for name, part in {**top.parts, **content}.items()
        if name not in parts
    }
    fingerprint = "" if is_auto(record) else record  # a run that was converted without its dataset has "auto"
    config = dataclasses.replace(top, **own, losses=losses, parts=parts, fingerprint=fingerprint)
    used, known = used_sections(config), {*kinds, "losses", *registered}
    unknown = sorted(name for name in parts if name not in known | used)
    if unknown:
        message = unknown_field("config.", unknown[0], known | set(declarations(RunConfig)))
        raise ValueError(f"{message}; correct the name, or import the module that registers it with --plugins=MODULE")
    config = replaced(config, parts={name: part for name, part in parts.items() if name in {*built_in, *used}})
    _check(config)
    return config


def to_config_dict(config: RunConfig) -> ConfigDict:
    """Returns a config as a ConfigDict, whose fields have the types of the options, for flags and config files."""
    content = replaced(config, fingerprint="").to_dict()
    for name, declaration, kind, value in declared(config):
        section, dot, field = name.rpartition(".")
        (content[section] if dot else content)[field] = typed(value, kind, auto=declaration.auto)
    for old, (new, _) in RENAMED.items():
        (section, name), (new_section, _, new_name) = old.split("."), new.rpartition(".")
        if not new_section:  # a record, not an option
            continue
        # One reference under both names: whichever is set, the other follows.
        value = content[new_section][new_name]
        if not isinstance(value, FieldReference):
            value = content[new_section][new_name] = FieldReference(value)
        content[section][name] = value
    return ConfigDict(content)


def auto_fields(config: Config) -> list[str]:
    """Returns the dotted names of the options that are still "auto"; for some "auto" is a value like any other."""
    config = read_config(config)
    values = {name for name, option_, _, _ in declared(config) if not (option_.auto or name.startswith("losses."))}
    return [name for name, value in flatten(config.to_dict()).items() if is_auto(value) and name not in values]


def flatten(content: Mapping[str, Any]) -> dict[str, Any]:
    """Returns {"section.option": value} of {section: {option: value}}."""
    flat = {}
    for name, value in content.items():
        fields = value.items() if isinstance(value, Mapping) else [("", value)]
        flat.update({f"{name}.{field}" if field else name: each for field, each in fields})
    return flat


def changed(config: RunConfig, values: Mapping[str, Any]) -> RunConfig:
    """Returns a config with other values, {"section.option": value}, checked as `read_config` does."""
    content = config.to_dict()
    for name, value in values.items():
        section, dot, field = today(name).partition(".")
        if dot:
            content[section] = {**content.get(section, {}), field: value}
        else:
            content[section] = value
    return read_config(content)


def declared(config: RunConfig) -> Iterator[tuple[str, Option, Any, Any]]:
    """Yields the dotted name of each option, its declaration, its type and its value."""
    for section, part in {"": config, **config.sections()}.items():
        for name, (option_, kind) in declarations(type(part)).items():
            yield f"{section}.{name}" if section else name, option_, kind, getattr(part, name)
    for name, weight in config.losses.items():
        yield f"losses.{name}", weight_option(name), Schedule, weight


def option_names() -> list[str]:
    """Returns the dotted names of all options, those of registered parts, too."""
    return [name for name, _, _, _ in declared(RunConfig())]


def weight_option(name: str) -> Option:
    """Returns the declaration of the weight of a loss."""
    loss = LOSSES.get(name) if name in LOSSES.names() else None
    weight, help = (loss.weight, loss.help) if loss else (0.0, "")
    declaration = option(weight, help, auto=is_auto(weight), changes=Changes.TRAINING)
    return declaration.metadata["option"]


def identity(config: RunConfig) -> str:
    """Returns as text the options that renderings depend on; not training, nor the dataset's folder.

    Those of the section `eval`, which evaluation may change, are absent.
    """
    render = {
        name: value
        for name, option_, _, value in declared(config)
        if option_.changes & Changes.IMAGES and not name.startswith("eval.")
    }
    plain = {name: part for name, part in config.parts.items() if not isinstance(part, Options)}
    return json.dumps({**render, **plain}, sort_keys=True)


def _read_weight(name, weight):
    declaration = weight_option(name)._replace(auto=is_auto(weight))  # a loss that is not registered may have "auto"
    return read_value(declaration, Schedule, weight, f"--config.losses.{name}")


def _section(content, name):
    if name not in content:
        raise ValueError(f"--config.{name} is missing; restore the config")
    section = content.pop(name)
    if not isinstance(section, Mapping):
        raise ValueError(f"--config.{name} is {short_repr(section)}, expected a section; correct it")
    return section


def _read_part(name, part, section):
    """Returns the options of a registered part; of one that is not registered, or has no class, the section itself."""
    if isinstance(section, Options):
        return section
    section = _section({name: section}, name)
    if part is None or part.options is None:
        return {field: as_tuples(value) for field, value in section.items()}
    return read(part.options, {**values_of(part.options()), **section}, f"config.{name}.")


def _check(config):
    """Checks values that concern each other, and that what a run keeps fits into memory."""
    free, used, box = memory.available(), used_sections(config), config.scene.box
    samplers = {SAMPLERS.get(name).section or name for name in SAMPLERS.names()}
    for section, part in config.sections().items():
        try:
            if section in samplers - used:
                part.check_unused(config.sampler)
                continue
            part.check(box)
        except ValueError as error:
            raise ValueError(f"--config.{section}.{error}") from None
        needed = part.bytes_needed(box) if free is not None and section in used else {}
        for name, size in needed.items():
            if size > free:
                raise ValueError(
                    f"--config.{section}.{name} is {getattr(part, name)}, which needs {size / 1e9:,.1f} GB for "
                    f"parameters, gradients and the optimizer, the grid or rays, and {free / 1e9:,.1f} GB are free; "
                    "reduce it"
                )


def used_sections(config: RunConfig) -> set[str]:
    """Returns the names of the sections that training with a config uses."""
    used = {"data", "scene", "train", "eval", "cameras", "losses"}
    for name, registry in ((config.field, FIELDS), (config.sampler, SAMPLERS)):
        part = registry.get(name) if name in registry.names() else Part(None)
        used |= {part.section or name, *part.networks}
    return used


def typed(value: Any, kind: Any, *, auto: bool) -> Any:
    """Returns a value for a ConfigDict's field that accepts the values of one type, or "auto", too.

    Args:
        value: of the field.
        kind: an annotation of an option, see `option`.
        auto: whether "auto" is accepted.
    """
    if kind == Schedule:
        return FieldReference(value, field_type=_SCHEDULE)
    if auto and kind is not str:
        return FieldReference(value, field_type=_AUTO_TYPES[tuple if is_tuple(kind) else kind])
    return float(value) if kind is float else value  # the type of a flag is that of the value


class _Accepts(type):
    """A type whose instances are the values that a field accepts."""

    def __instancecheck__(cls, value):
        return cls.accepts(value)


class _Literal(flags.ArgumentParser):
    """Reads "auto" as text and all else as a Python literal of the field's type."""

    def __init__(self, field_type, syntactic_help):
        self._type, self.syntactic_help = field_type, syntactic_help

    def parse(self, argument):
        value = argument
        if isinstance(argument, str) and argument != AUTO:
            try:
                value = ast.literal_eval(argument[:1].upper() + argument[1:])
            except (SyntaxError, ValueError):
                value = None
        if not isinstance(value, self._type):
            raise ValueError(f"expected {self.syntactic_help}")
        return value

    def flag_type(self):
        return self.syntactic_help


def _auto_type(kind):
    accepts = staticmethod(lambda value: is_auto(value) or is_kind(value, kind))
    field_type = _Accepts(f"auto_{kind.__name__}", (), {"accepts": accepts})
    config_flags.register_flag_parser_for_type(field_type, _Literal(field_type, f"auto, or {kind.__name__}"))
    return field_type


_AUTO_TYPES = {kind: _auto_type(kind) for kind in (bool, int, float, tuple)}
_SCHEDULE = _Accepts("schedule", (), {"accepts": staticmethod(lambda value: is_auto(value) or is_schedule(value))})
config_flags.register_flag_parser_for_type(_SCHEDULE, _Literal(_SCHEDULE, "a number, ((step, value), ...), or auto"))
