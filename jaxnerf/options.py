"""Options of the parts of a run, declared beside their use.

The options of a part are a frozen dataclass that inherits from `Options`; each of its fields is made by `option`, with
its default, meaning, range, and what depends on it. The config of a run, its flags, checks and reference page are
derived from these declarations.
"""

import dataclasses
import difflib
import enum
import functools
import types
import typing
from collections.abc import Callable, Iterable, Mapping
from typing import Any, NamedTuple, Self, TypeAlias, TypeVar, dataclass_transform

AUTO = "auto"  # the only marker of a value that is inferred
MAX_INT, MAX_FLOAT = 2**31 - 1, 3.4e38  # int32, in which JAX counts, and float32
Box: TypeAlias = tuple[tuple[float, ...], tuple[float, ...]]  # lower and upper corner [3], world units
Schedule: TypeAlias = float | tuple[tuple[float, float], ...]  # a number, or points (step, value), linear between them
_Part = TypeVar("_Part", bound="Options")


class Changes(enum.Flag):
    """What depends on an option.

    Attributes:
        NOTHING: finished steps and given images do not, so a run may be resumed with another value; other options may
            be inferred from it.
        TRAINING: the parameters that training finds. A run is resumed with the same value only.
        IMAGES: the images that given parameters render.
        SPEED: the speed on a device. An "auto" value is inferred at every start, and stays "auto" in the workdir.
    """

    NOTHING = 0
    TRAINING = enum.auto()
    IMAGES = enum.auto()
    SPEED = enum.auto()
    MODEL = TRAINING | IMAGES


class Range(NamedTuple):
    """A range of numbers.

    Attributes:
        text: completes "expected".
        holds: whether a number is in it.
    """

    text: str
    holds: Callable[[float], bool]


def at_least(low: float) -> Range:
    """Returns the range of numbers that are not below one."""
    return Range(f"at least {_shown(low)}", lambda value: value >= low)


def between(low: float, high: float) -> Range:
    """Returns the range from one number to another, both included."""
    return Range(f"from {_shown(low)} to {_shown(high)}", lambda value: low <= value <= high)


def _shown(number):
    return f"{number:,}" if isinstance(number, int) else f"{number:,g}"


POSITIVE = Range("more than 0", lambda value: value > 0)
FRACTION = Range("more than 0 and at most 1", lambda value: 0 < value <= 1)
BELOW_ONE = Range("at least 0 and below 1", lambda value: 0 <= value < 1)
DTYPES = ("float32", "bfloat16", "float16", "float64")


class Ablation(NamedTuple):
    """What removing, reducing or adding a part of the method means for an option, for `jaxnerf-needs`.

    Each change is the option's new value, or a function (value, Options, Facts) of the resolved value, the options
    that it belongs to and the dataset, which returns the new value. None: there is no such change. Options of a run
    that name the same part change together.

    Attributes:
        part: in words, such as "view dependence".
        without: removes it.
        less: about halves it.
        more: adds it, or about doubles it.
        aligned: what of the scored views is fitted to the scene first, as they have no trained parameters: "colors",
            "pose", or nothing.
    """

    part: str
    without: Any = None
    less: Any = None
    more: Any = None
    aligned: str = ""


def half(value: int, *_: Any) -> int | None:
    """Returns half of a number of an `Ablation`; None where that is less than 8."""
    return value // 2 if value >= 16 else None


def double(value: float, *_: Any) -> float:
    """Returns twice the value of an option, for `Ablation`."""
    return 2 * value


class Option(NamedTuple):
    """What an option declares beside its name, type and default; see `option`."""

    help: str
    unit: str
    range: Range | None
    choices: tuple[str, ...]
    auto: bool
    changes: Changes | None
    check: Callable[[Any], str | None] | None
    protocol: bool
    max_int: int
    ablations: tuple[Ablation, ...]


def option(
    default: Any,
    help: str,
    *,
    unit: str = "",
    range: Range | None = None,
    choices: tuple[str, ...] = (),
    auto: bool = False,
    changes: Changes | None = None,
    check: Callable[[Any], str | None] | None = None,
    protocol: bool = False,
    max_int: int = MAX_INT,
    ablations: tuple[Ablation, ...] = (),
) -> Any:
    """Declares a field of a class of options.

    Its annotation is the type of the value: bool, int, float, str, a tuple of these, or Schedule.

    Args:
        default: the value where none is set.
        help: what it means, for the reference page; Markdown.
        unit: of the value.
        range: of a number.
        choices: all values of a text; empty: any.
        auto: whether the value may be "auto", which `Options.resolve` or `Options.resolve_for_device` replaces.
        changes: what depends on the value; None: as the class says in `Options.changes`.
        check: value -> what is expected in place of it, or None where the value is right. For tuples.
        protocol: whether an evaluation records the value, as it determines which images are compared.
        max_int: the largest whole number.
        ablations: of the parts of the method that the option belongs to.
    """
    declared = Option(help, unit, range, tuple(choices), auto, changes, check, protocol, max_int, ablations)
    return dataclasses.field(default=default, metadata={"option": declared})


_CELL_PER_PIXEL = 0.7  # cells a little finer than a pixel's footprint, the finest detail that images resolve
_FINE_DETAIL, _MAX_ALPHA = 256, 0.5


class Facts(NamedTuple):
    """Plain numbers about a dataset, and about parts of the run that are resolved first.

    Attributes:
        num_views: training images.
        side: px, that of a square image with as many pixels as an image has, the mean over the images.
        footprint: world units that a pixel covers at the point that the cameras look at.
        footprint_spread: side of the largest pixels' footprint over that of the smallest, at what each view shows, for
            all but the outermost twentieths of the views.
        num_observations: of sparse points that at least two views show; 0 unless the run can use them.
        has_alpha: whether alpha bounds the scene.
        mean_alpha: of the pixels; 1 without alpha.
        ndc: whether rays are in normalised device coordinates.
        lower, upper: world units, the corners of the box that holds what the run renders.
        contracted: whether the box holds all of space.
        factor: by which the images were downscaled.
        skips_empty_cells: whether the run's sampler does, see `Options.skips_empty_cells`.
        trains_cameras: whether the run trains parameters of the training images.
        travels: whether the cameras look at no common point, as on a walk.
        has_times: whether the images have times.
        outlined: whether alpha shows that nothing surrounds the scene, also where it does not bound it.
        rays_per_step: that suit the sampler and the device, see `Options.rays_per_step`; 0 for the options of a field,
            which are resolved before.
        rays_reason: why.
        batch_size: rays per step of the run; 0 for the options of a field.
    """

    num_views: int
    side: float
    footprint: float
    footprint_spread: float = 1.0
    num_observations: int = 0
    has_alpha: bool = False
    mean_alpha: float = 1.0
    ndc: bool = False
    lower: tuple[float, float, float] = (-1.0, -1.0, -1.0)
    upper: tuple[float, float, float] = (1.0, 1.0, 1.0)
    contracted: bool = False
    factor: int = 1
    skips_empty_cells: bool = False
    trains_cameras: bool = False
    travels: bool = False
    has_times: bool = False
    outlined: bool = False
    rays_per_step: int = 0
    rays_reason: str = ""
    batch_size: int = 0

    @property
    def longest(self) -> float:
        """World units, the longest side of the box."""
        return max(high - low for low, high in zip(self.lower, self.upper, strict=True))

    @property
    def detail(self) -> int:
        """Cells along the longest side of the box, each a little smaller than a pixel."""
        return round(self.longest / (_CELL_PER_PIXEL * self.footprint))

    @property
    def has_fine_cells(self) -> bool:
        """Whether fine cells of the box pay: images resolve more than 256 of them a side, and alpha empties most."""
        fine = self.skips_empty_cells and not self.contracted and self.detail > _FINE_DETAIL
        return fine and self.has_alpha and self.mean_alpha < _MAX_ALPHA

    @property
    def fills_space(self) -> bool:
        """Whether the run evaluates the field in all of space, near the cameras and far behind what they look at."""
        return self.contracted and self.skips_empty_cells


class Device(NamedTuple):
    """The devices of a run, and what the run's sampler asks of them.

    Attributes:
        platform: "cpu", "gpu" or "tpu".
        num_processes: that train together.
        chunk: rays that suit the device when images are rendered, see `Options.rays_per_chunk`.
        samples_per_ray: of the largest network in training.
    """

    platform: str
    num_processes: int = 1
    chunk: int = 2**12
    samples_per_ray: float = 1.0

    @property
    def is_cpu(self) -> bool:
        """Whether it is a CPU, whose caches are small; otherwise it is an accelerator, which needs much work."""
        return self.platform == "cpu"


@dataclass_transform(frozen_default=True)
class Options:
    """The base of a part's options; subclasses are frozen dataclasses whose fields are made by `option`.

    What other parts ask a field or a sampler is declared here, too: a subclass replaces what differs.

    Attributes:
        changes: what depends on the options that do not say it themselves.
        needs_box: of a field or a sampler: whether it is defined in the scene's box, and in its contraction of space if
            there is one. A run has a box if its field or its sampler needs one.
        skips_empty_cells: of a sampler: whether it evaluates the field in the occupied cells of a grid only. A cell may
            then be smaller, and where space is contracted rays start close to the cameras.
    """

    changes: typing.ClassVar[Changes] = Changes.MODEL
    needs_box: typing.ClassVar[bool] = True
    skips_empty_cells: typing.ClassVar[bool] = False

    def resolve(self, facts: Facts, device: Device) -> tuple[Self, list[str]]:
        """Replaces the "auto" values that are inferred once, when a run starts; see `infer`."""
        return self, []

    def resolve_for_device(self, device: Device) -> tuple[Self, list[str]]:
        """Replaces the "auto" values that are inferred at every start, those of Changes.SPEED; see `infer`."""
        return self, []

    def check(self, box: Box | None = None) -> None:
        """Raises a ValueError if values that are right one by one do not fit together, or not to the scene's box."""

    def check_unused(self, sampler: str) -> None:
        """Of a sampler: raises a ValueError if a value asks for what the run's sampler, another one, does not do."""

    def bytes_needed(self, box: Box | None) -> dict[str, float]:
        """Returns, by the name of an option that determines it, bytes of memory that a run with these options needs."""
        return {}

    @property
    def is_large(self) -> bool:
        """Of a field: whether an update of its parameters takes as long as half of the rays of a step."""
        return False

    def rays_per_step(self, cpu_rays: int, device: Device, *, large_field: bool) -> tuple[int, str]:
        """Of a sampler: returns the rays of a training step that suit a device, and why.

        Args:
            cpu_rays: `train.cpu_batch_size`.
            device: that trains.
            large_field: whether the run's field `is_large`.
        """
        return cpu_rays, "train.cpu_batch_size"

    def rays_per_chunk(self, device: Device) -> int:
        """Of a sampler: the rays that suit a device when images are rendered.

        Without an occupancy grid 192 samples per ray of the paper's network take 1.6 GB a layer for 2^13 rays.
        """
        return 2**12 if device.is_cpu else 2**13


def infer(options: _Part, **values: tuple[Any, str]) -> tuple[_Part, list[str]]:
    """Fills in options that are "auto".

    Args:
        options: of a part; values that are not "auto" stay.
        **values: by name, the value and the line that reports it. "{section}" in a line stands for the name of the
            part's section in the config. An empty line is not reported.

    Returns:
        The options, and the lines of the values that were filled in.
    """
    filled = {name: value for name, (value, _) in values.items() if is_auto(getattr(options, name))}
    return replaced(options, **filled), [values[name][1] for name in filled if values[name][1]]


def is_auto(value: Any) -> bool:
    """Returns whether a value still has to be inferred."""
    return isinstance(value, str) and value == AUTO


def is_schedule(value: Any) -> bool:
    """Returns whether a value is a number, or points ((step, value), ...)."""
    points = isinstance(value, tuple | list) and len(value) > 0
    return _is_number(value) or (
        points
        and all(isinstance(point, tuple | list) and len(point) == 2 and all(map(_is_number, point)) for point in value)
    )


def replaced(options: _Part, **values: Any) -> _Part:
    """Returns options with other values, without checks."""
    return dataclasses.replace(options, **values)  # type: ignore[type-var]


@functools.cache
def declarations(kind: type[Options]) -> dict[str, tuple[Option, Any]]:
    """Returns what the options of a class declare, and their types, by name; inherited ones first."""
    types_of, found = typing.get_type_hints(kind), {}
    for field in dataclasses.fields(kind):
        if "option" in field.metadata:
            declared = field.metadata["option"]
            changes = kind.changes if declared.changes is None else declared.changes
            found[field.name] = declared._replace(changes=changes), types_of[field.name]
    return found


def changing(options: Options | type[Options], changes: Changes) -> list[str]:
    """Returns the names of the options on which any of these depends."""
    kind = options if isinstance(options, type) else type(options)
    return [name for name, (declared, _) in declarations(kind).items() if declared.changes & changes]


def values_of(options: Options) -> dict[str, Any]:
    """Returns the values of a part's options by name."""
    return {name: getattr(options, name) for name in declarations(type(options))}


def read(kind: type[_Part], values: Mapping[str, Any], prefix: str) -> _Part:
    """Makes the options of a part from values of unknown origin.

    Args:
        kind: the part's class of options.
        values: of all options, by name; lists become tuples.
        prefix: of the flags in messages, such as "config.train.".

    Raises:
        ValueError: names the option, its value and what is expected, or the option that is missing or unknown.
    """
    known = declarations(kind)
    missing, unknown = [name for name in known if name not in values], sorted(set(values) - set(known))
    if missing:
        raise ValueError(f"--{prefix}{missing[0]} is missing; restore the config, or set it")
    if unknown:
        raise ValueError(unknown_field(prefix, unknown[0], known))
    return kind(**{name: read_value(*known[name], values[name], f"--{prefix}{name}") for name in known})


def unknown_field(prefix: str, name: str, known: Iterable[str]) -> str:
    """Returns the message about a field of a config that does not exist, with the name of one that it resembles."""
    meant = "".join(f"did you mean {each}? " for each in difflib.get_close_matches(name, sorted(known), n=1))
    return f"--{prefix}{name} is no field, {meant}expected one of {sorted(known)}"


def read_value(declared: Option, kind: Any, value: Any, name: str) -> Any:
    """Returns the value of one option, with tuples in place of lists; ValueError, with its name, where it is none."""
    value = as_tuples(value)

    def refuse(expected):
        raise ValueError(f"{name} is {short_repr(value)}, expected {expected}; correct it")

    if is_auto(value) and (declared.auto or AUTO in declared.choices):
        return value
    if not is_kind(value, kind):
        refuse(f"{'auto or ' * declared.auto}{kind_name(kind)}")
    limit = declared.max_int if kind is int else MAX_FLOAT
    if not all(abs(number) <= limit for number in _numbers(value)):  # not NaN either
        refuse(f"a finite number of at most {limit:g}")
    if declared.range and not declared.range.holds(value):
        refuse(declared.range.text)
    if declared.choices and value not in declared.choices:
        refuse(f"one of {declared.choices + (AUTO,) * declared.auto}")
    wrong = declared.check(value) if declared.check else None
    if wrong:
        refuse(wrong)
    return value


def is_kind(value: Any, kind: Any) -> bool:
    """Returns whether a value has the type that an annotation of an option names."""
    if kind == Schedule:
        return is_schedule(value)
    if kind is float:
        return _is_number(value)
    if kind is int:
        return isinstance(value, int) and not isinstance(value, bool)
    return isinstance(value, (typing.get_origin(kind) or kind, list) if is_tuple(kind) else kind)


def is_tuple(kind: Any) -> bool:
    """Returns whether an annotation is that of a tuple."""
    return kind is tuple or typing.get_origin(kind) is tuple


def kind_name(kind: Any) -> str:
    """Returns the name of an option's type, for messages."""
    return "schedule" if isinstance(kind, types.UnionType) else "tuple" if is_tuple(kind) else kind.__name__


def short_repr(value: Any) -> str:
    """Returns a value's repr for a message: one line of at most 80 characters."""
    text = repr(value)
    return text if len(text) <= 80 else text[:77] + "..."


def numbers(count: int) -> Callable[[Any], str | None]:
    """Returns the check of an option that is a tuple of so many numbers."""
    return lambda value: None if len(value) == count and all(map(_is_number, value)) else f"{count} finite numbers"


def _is_number(value):
    return isinstance(value, int | float) and not isinstance(value, bool)


def _numbers(value):
    """Yields the numbers of a value, which may be a tuple of tuples, as a schedule is."""
    for each in value if isinstance(value, tuple) else [value]:
        if isinstance(each, tuple):
            yield from _numbers(each)
        elif _is_number(each):
            yield each


def as_tuples(value: Any) -> Any:
    """Returns a value with tuples in place of lists, which JSON and flags have, and of ranges."""
    return tuple(map(as_tuples, value)) if isinstance(value, tuple | list | range) else value
