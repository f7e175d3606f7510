"""The parts that a config selects by name: fields, samplers, losses and dataset readers.

Built-in parts are imported when they are first used. Code outside the package adds parts with the `register_*`
functions; a program imports such code with `--plugins=module,...`.
"""

import importlib
from collections.abc import Callable, Iterable, Mapping
from typing import Any, NamedTuple

from jaxnerf.options import Facts, Options, Schedule, is_auto


class Part(NamedTuple):
    """A field or a sampler.

    Attributes:
        make: see `register_field` and `register_sampler`.
        options: the class of its options; None: its section of the config is a dict without checks.
        section: the config's section that holds them, if it is not that of its own name.
        networks: of a sampler: the fields of further networks that it makes, by the name of the network, which is that
            of the config's section with its options, too.
    """

    make: Callable[..., Any]
    options: type[Options] | None = None
    section: str | None = None
    networks: Mapping[str, "Part"] = {}


class Loss(NamedTuple):
    """A loss, or a regularizer of the parameters.

    Attributes:
        function: see `register_loss`.
        on: "renderings", "params" or "field", see `register_loss`.
        needs: the optional fields of Batch that it reads.
        weight: where the config sets none; "auto" needs `infer`.
        infer: (facts) -> the weight in place of "auto", and the line that reports it, or "".
        help: what it compares, for the reference page.
        fixed_order: whether its gradient has a fixed order of sums where the renderings' gradients have one.
    """

    function: Callable[..., Any] | None
    on: str = "renderings"
    needs: tuple[str, ...] = ()
    weight: Schedule | str = 0.0
    infer: Callable[[Facts], tuple[Schedule, str]] | None = None
    help: str = ""
    fixed_order: bool = True


class Reader(NamedTuple):
    """A reader of one dataset format.

    Attributes:
        read: folder -> Capture, see `register_reader`.
        detect: folder -> whether the folder holds this format.
        views: (DataOptions, split) -> Views, of a dataset without a folder; `read` is not called then.
    """

    read: Callable[..., Any]
    detect: Callable[..., bool]
    views: Callable[..., Any] | None = None


class Registry:
    """Parts of one kind by name."""

    def __init__(self, kind: str, register: str, builtin: dict[str, Any]):
        """Creates a registry of built-in parts.

        Args:
            kind: what the parts are, for messages.
            register: the public function that adds a part, for messages.
            builtin: the part, or its "module:attribute", by name.
        """
        self._kind, self._register, self._parts = kind, register, dict(builtin)
        self.builtin = tuple(builtin)

    def add(self, name: str, part: Any) -> None:
        """Adds a part; raises a ValueError if another part has that name."""
        if name in self._parts and self._parts[name] != part:
            raise ValueError(f"there is already a {self._kind} {name!r}; register yours under another name")
        self._parts[name] = part

    def get(self, name: str) -> Any:
        """Returns the part of that name; raises a ValueError with the known names if there is none."""
        if name not in self._parts:
            known = ", ".join(repr(known) for known in self._parts)
            raise ValueError(
                f"there is no {self._kind} {name!r}, expected one of {known}; correct the name, or import the "
                f"module that calls {self._register} with --plugins=MODULE"
            )
        part = self._parts[name]
        if isinstance(part, str):
            module, _, attribute = part.partition(":")
            part = self._parts[name] = getattr(importlib.import_module(module), attribute)
        return part

    def names(self) -> list[str]:
        """Returns the names of all parts, built-in ones first."""
        return list(self._parts)


FIELDS = Registry(
    "field",
    "jaxnerf.register_field",
    {
        "mlp": "jaxnerf.fields.mlp:FIELD",
        "hash_grid": "jaxnerf.fields.hash_grid:FIELD",
        "moving": "jaxnerf.fields.moving:FIELD",
    },
)
SAMPLERS = Registry(
    "sampler",
    "jaxnerf.register_sampler",
    {
        "hierarchical": "jaxnerf.models.hierarchical:SAMPLER",
        "occupancy": "jaxnerf.models.occupancy:SAMPLER",
    },
)
LOSSES = Registry(
    "loss",
    "jaxnerf.register_loss",
    {
        "mse": "jaxnerf.training.losses:MSE",
        "opacity": "jaxnerf.training.losses:OPACITY",
        "distortion": "jaxnerf.training.losses:DISTORTION",
        "depth": "jaxnerf.training.losses:DEPTH",
        "total_variation": "jaxnerf.fields.hash_grid:TOTAL_VARIATION",
    },
)
READERS = Registry(
    "dataset format",
    "jaxnerf.register_reader",
    {  # in the order in which a folder is searched for them
        "blender": "jaxnerf.data.readers.blender:READER",
        "transforms": "jaxnerf.data.readers.transforms:READER",
        "colmap": "jaxnerf.data.readers.colmap:READER",
        "llff": "jaxnerf.data.readers.llff:READER",
        "synthetic": "jaxnerf.data.synthetic:READER",
    },
)


def checked_options(function: str, options: type[Options] | None) -> type[Options] | None:
    """Returns the class of options of a part; ValueError, with the name of the register function, if it is none."""
    is_class = isinstance(options, type) and issubclass(options, Options) and "__dataclass_fields__" in vars(options)
    if options is not None and not is_class:
        raise ValueError(f"{function}: options is {options!r}, expected a frozen dataclass that inherits from Options")
    return options


def register_field(name: str, make: Callable[..., Any], *, options: type[Options] | None = None) -> None:
    """Registers a field under a name for the config's `field`.

    Args:
        name: of the field, and of the config's section that holds its options.
        make: (options, box) -> Field, see `jaxnerf.extend.Field`. `box` is the scene's box (lower [3],
            upper [3]) in world units, or None if the run has none.
        options: the class of the options, see `jaxnerf.extend.Options`: it gives them flags, checks and help. None:
            `make` gets the section as a dict, without checks.

    Raises:
        ValueError: if another field has that name, or if `options` is no such class.
    """
    FIELDS.add(name, Part(make, checked_options("register_field", options)))


def register_sampler(name: str, make: Callable[..., Any], *, options: type[Options] | None = None) -> None:
    """Registers a way to place samples under a name for the config's `sampler`.

    Args:
        name: of the sampler, and of the config's section that holds its options.
        make: (context) -> Model, see `jaxnerf.extend.SamplerContext` and `Model`.
        options: the class of `context.options`, as of `register_field`.

    Raises:
        ValueError: if another sampler has that name, or if `options` is no such class.
    """
    SAMPLERS.add(name, Part(make, checked_options("register_sampler", options)))


def register_loss(
    name: str,
    function: Callable[..., Any] | None,
    *,
    on: str = "renderings",
    needs: Iterable[str] = (),
    weight: Schedule = 0.0,
    help: str = "",
) -> None:
    """Registers a loss under a name for the config's `losses`, which gives it a weight.

    Args:
        name: of the loss.
        function: with on="renderings" (outputs, batch) -> [B], one value per ray: `outputs` are the Renderings
            of a step, with weights and samples: a tuple of those that show colours, the final one last, and
            `outputs["name"]` that of any network. `batch` is a Batch. With on="params" (params) -> scalar, where params
            has an entry for each network. With on="field" None: the run's fields bring the function, see
            `Field.regularizers`.
        on: "renderings", "params" or "field".
        needs: the optional fields of Batch that the function reads, of "image_index", "pixel", "alpha", "depth" and
            "depth_weight". Fields that no loss needs are None. Where one needs a depth, some rays of each batch go
            through observations of the dataset's sparse points, see `draw_batch`.
        weight: where the config sets none; 0: off.
        help: what it compares, for the reference page.

    Raises:
        ValueError: if another loss has that name, or on another value of `on`.
    """
    if on not in (kinds := ("renderings", "params", "field")):
        raise ValueError(f"register_loss: on is {on!r}, expected one of {', '.join(map(repr, kinds))}")
    LOSSES.add(name, Loss(function, on, tuple(needs), weight, help=help))


def register_reader(name: str, read: Callable[..., Any], *, detect: Callable[..., bool] | None = None) -> None:
    """Registers a dataset format under a name for `--format` and the config's `data.format`.

    Args:
        name: of the format.
        read: (folder: Path) -> Capture, see `jaxnerf.extend.Capture`. If each split has a file of its own, `read` may
            ask for `split` by name: the Capture then needs the frames of that split only; None: those of all.
        detect: (folder: Path) -> whether the folder holds this format, for `data.format` "auto"; None: never.

    Raises:
        ValueError: if another format has that name.
    """
    READERS.add(name, Reader(read, detect or (lambda folder: False)))


def needs_folder(format: str) -> bool:
    """Returns whether datasets of a format, or of "auto", lie in a folder, unlike the embedded scene."""
    return is_auto(format) or READERS.get(format).views is None
