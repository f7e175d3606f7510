"""Options of the previous release that have another name or are gone, so that its configs and workdirs still work."""

from collections.abc import Mapping
from typing import Any, NamedTuple

from jaxnerf.options import Changes, as_tuples


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


RENAMED: dict[str, str] = {"data.fingerprint": "fingerprint"}  # "section.option" -> its name now
_DROP = "use the version that wrote it"
_REFLECTIONS = Gone((False,), Changes.TRAINING | Changes.IMAGES, _DROP)
_LOSS = Gone((0, "auto"), Changes.TRAINING, f"set it to 0, or {_DROP}")
GONE: dict[str, Gone] = {  # by "section.option"
    **{f"{name}.reflections": _REFLECTIONS for name in ("coarse", "fine", "hash_grid")},
    "hash_grid.geometry_features": Gone((15,), Changes.TRAINING | Changes.IMAGES, _DROP),
    "hash_grid.feature_scale": Gone((4.0,), Changes.TRAINING | Changes.IMAGES, _DROP),
    **{f"losses.{name}": _LOSS for name in ("near_opacity", "depth_smoothness", "normals", "hash_decay")},
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
    """
    content = {name: dict(part) if isinstance(part, Mapping) else part for name, part in content.items()}
    for old, new in RENAMED.items():
        if _has(content, old):
            section, _, option = new.rpartition(".")
            (content.setdefault(section, {}) if section else content)[option] = _pop(content, old)
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
