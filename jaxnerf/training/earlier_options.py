"""Options of the previous release that have another name or are gone, so that its configs and workdirs still work."""

from collections.abc import Mapping
from typing import Any, NamedTuple

from jaxnerf.options import AUTO, Changes, as_tuples


class Gone(NamedTuple):
    """An option that no longer exists.

    Attributes:
        off: the values with which a run was as all runs are now.
        changes: what depended on other values, see `Changes`.
        instead: what to do in place of setting it, for the message.
    """

    off: tuple[Any, ...]
    changes: Changes
    instead: str


class Renamed(NamedTuple):
    """An option that has another name.

    Attributes:
        name: "section.option" today.
        default: its default value.
    """

    name: str
    default: Any


RENAMED: dict[str, Renamed] = {  # by "section.option"; flags and config files have both names
    "data.background_color": Renamed("scene.background", AUTO),
    "data.fingerprint": Renamed("fingerprint", ""),
    "occupancy.contracted": Renamed("scene.contracted", AUTO),
    "occupancy.lower": Renamed("scene.lower", AUTO),
    "occupancy.upper": Renamed("scene.upper", AUTO),
    "occupancy.use_alpha": Renamed("scene.use_alpha", True),
}
_DROP = "use the version that wrote it"
_REFLECTIONS = Gone((False,), Changes.TRAINING | Changes.IMAGES, _DROP)
_LOSS = Gone((0, "auto"), Changes.TRAINING, f"set it to 0, or {_DROP}")
_SCALES = "write the images at all sizes as experiments/multiscale does"
GONE: dict[str, Gone] = {  # by "section.option"
    "data.num_scales": Gone((1,), Changes.TRAINING, _SCALES),
    **{f"{name}.reflections": _REFLECTIONS for name in ("coarse", "fine", "hash_grid")},
    "hash_grid.geometry_features": Gone((15,), Changes.TRAINING | Changes.IMAGES, _DROP),
    "hash_grid.feature_scale": Gone((4.0,), Changes.TRAINING | Changes.IMAGES, _DROP),
    **{f"losses.{name}": _LOSS for name in ("near_opacity", "depth_smoothness", "normals", "hash_decay", "opaque")},
    "train.beta1": Gone((0.9,), Changes.TRAINING, "Adam's first moment always decays by 0.9; leave it out"),
    "train.max_nonfinite": Gone((20,), Changes.NOTHING, "a run fails after 20 such steps in a row; leave it out"),
    "train.parallel": Gone(("auto",), Changes.SPEED, "CUDA_VISIBLE_DEVICES limits the devices; leave it out"),
    "train.steps_per_dispatch": Gone(("auto",), Changes.SPEED, "the device determines it; leave it out"),
    "occupancy.cells_per_update": Gone((2**18,), Changes.TRAINING, _DROP),
    "occupancy.update_chunk": Gone((AUTO,), Changes.SPEED, "drop it"),
    "eval.max_uncertainty": Gone(
        (1.0,),
        Changes.IMAGES,
        "set it to 1 in config.json, and give --max_uncertainty to jaxnerf-eval, jaxnerf-render and jaxnerf-export",
    ),
}


def in_todays_names(content: Mapping[str, Any]) -> tuple[dict[str, Any], dict[str, Any]]:
    """Returns a config's content with today's names and without options that are gone.

    Args:
        content: {section: {option: value}}, with the values of options that are in no section beside the sections.

    Returns:
        The content; and by "section.option" the values of options that are gone and were not off.

    Raises:
        ValueError: if an option has different values under both names, and neither is the default.
    """
    content = {name: dict(part) if isinstance(part, Mapping) else part for name, part in content.items()}
    for old, new in RENAMED.items():
        if _has(content, old):
            section, _, option = new.name.rpartition(".")
            part, value = (content.setdefault(section, {}) if section else content), _pop(content, old)
            if part.setdefault(option, value) == new.default:  # a config as a dict has both names
                part[option] = value
            elif value not in (part[option], new.default):
                raise ValueError(f"--config.{old} is now {new.name}, and they have different values; drop the first")
    found = {name: _pop(content, name) for name in GONE if _has(content, name)}
    return content, {name: value for name, value in found.items() if as_tuples(value) not in GONE[name].off}


def refuse(left: Mapping[str, Any], prefix: str, changes: Changes | None = None) -> None:
    """Raises a ValueError that names an option that is gone and was not off; see `in_todays_names`.

    Args:
        left: the values of such options.
        prefix: of the message.
        changes: only an option on which any of these depended is an error; None: each.
    """
    for name, value in left.items():
        if changes is None or GONE[name].changes & changes:
            raise ValueError(f"{prefix}{name} is {value!r}, but the option no longer exists; {GONE[name].instead}")


def today(name: str) -> str:
    """Returns the name of today of "section.option"."""
    return RENAMED[name].name if name in RENAMED else name


def _part(content, name):
    """Returns the mapping that holds, or would hold, an option, and its name there."""
    section, _, option = name.rpartition(".")
    return (content.get(section) if section else content), option


def _has(content, name):
    part, option = _part(content, name)
    return isinstance(part, dict) and option in part


def _pop(content, name):
    part, option = _part(content, name)
    return part.pop(option)
