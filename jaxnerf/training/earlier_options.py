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


# "section.option": its name of today, and its default there; flags and config files have both names.
RENAMED: dict[str, tuple[str, Any]] = {
    "data.background_color": ("scene.background", AUTO),
    "data.fingerprint": ("fingerprint", ""),
    "occupancy.contracted": ("scene.contracted", AUTO),
    "occupancy.lower": ("scene.lower", AUTO),
    "occupancy.upper": ("scene.upper", AUTO),
    "occupancy.use_alpha": ("scene.use_alpha", True),
}
_ABSENT = object()
_DROP = "use the version that wrote it"
_REFLECTIONS = Gone((False,), Changes.TRAINING | Changes.IMAGES, _DROP)
_LOSS = Gone((0, "auto"), Changes.TRAINING, f"set it to 0, or {_DROP}")
_SCALES = "write the images at all sizes as experiments/multiscale does"
GONE: dict[str, Gone] = {  # by "section.option"
    "data.num_scales": Gone((1,), Changes.TRAINING, _SCALES),
    **{f"{name}.reflections": _REFLECTIONS for name in ("coarse", "fine", "hash_grid")},
    "hash_grid.geometry_features": Gone((15,), Changes.TRAINING | Changes.IMAGES, _DROP),
    "hash_grid.feature_scale": Gone((4.0,), Changes.TRAINING | Changes.IMAGES, _DROP),
    **{f"{name}.initial_density": Gone((1.0,), Changes.TRAINING, _DROP) for name in ("hash_grid", "moving")},
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
    """Returns a config's content in today's names; and by "section.option" the values that are gone and were not off.

    Raises:
        ValueError: if an option has different values under both names, and neither is the default; or if poses were
            refined as they no longer are.
    """
    content = {name: dict(part) if isinstance(part, Mapping) else part for name, part in content.items()}
    for old, (new, default) in RENAMED.items():
        if (value := _pop(content, old)) is _ABSENT:
            continue
        section, _, option = new.rpartition(".")
        part = content.setdefault(section, {}) if section else content
        if part.setdefault(option, value) == default:  # a config as a dict has both names
            part[option] = value
        elif value not in (part[option], default):
            raise ValueError(f"--config.{old} is now {new}, and they have different values; drop the first")
    cameras = content.get("cameras")
    if isinstance(cameras, dict) and "refine_focal" not in cameras:
        if cameras.get("refine"):
            raise ValueError(
                "--config.cameras.refine_focal is missing, so the run turned each camera about itself, and today's "
                f"turn about what they look at; {_DROP}, or train again"
            )
        cameras["refine_focal"] = False
    found = {name: value for name in GONE if (value := _pop(content, name)) is not _ABSENT}
    return content, {name: value for name, value in found.items() if as_tuples(value) not in GONE[name].off}


def refuse(left: Mapping[str, Any], prefix: str, changes: Changes | None = None) -> None:
    """Raises a ValueError that names an option that is gone and was not off, of those that `in_todays_names` left.

    With `changes` only an option on which any of these depended is an error.
    """
    for name, value in left.items():
        if changes is None or GONE[name].changes & changes:
            raise ValueError(f"{prefix}{name} is {value!r}, but the option no longer exists; {GONE[name].instead}")


def today(name: str) -> str:
    """Returns the name of today of "section.option"."""
    return RENAMED.get(name, (name,))[0]


def _pop(content, name):
    """Removes "section.option" from a config's content and returns its value; _ABSENT where there is none."""
    section, _, option = name.partition(".")
    part = content.get(section)
    return part.pop(option, _ABSENT) if isinstance(part, dict) else _ABSENT
