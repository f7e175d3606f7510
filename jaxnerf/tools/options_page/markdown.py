"""The reference page of all options, written from their declarations."""

import inspect

from jaxnerf.options import AUTO, Changes, Option, kind_name
from jaxnerf.training.config import RunConfig, declared

_BADGES = {  # what depends on an option: a word beside each, explained once
    Changes.MODEL: ("model", "the parameters that training finds, and the images; resumed with the same value"),
    Changes.TRAINING: ("training", "the parameters that training finds; resumed with the same value"),
    Changes.IMAGES: ("images", "only the images that given parameters render"),
    Changes.SPEED: ("speed", "only the speed"),
    Changes.SPEED | Changes.IMAGES: ("speed, images", "the speed and, by rounding, the images"),
    Changes.NOTHING: ("free", "nothing that is done: a run may be resumed with another value"),
}


def options_page() -> str:
    """Returns Markdown that lists the options of all parts, registered ones too, with a heading for each."""
    config, shown = RunConfig(), ""
    lines = ["The last word of an option's first line says what depends on it:", ""]
    lines += [*(f"- *{badge}*: {meaning}" for badge, meaning in _BADGES.values()), ""]
    for name, option, kind, default in declared(config):
        section, dot, _ = name.partition(".")
        if dot and section != shown:
            shown = section
            lines += [f"## {section}", "", _about(config, section), ""]
        lines += [f"### {name}", "", _facts(option, kind, default), "", _sentence(option.help), ""]
    return "\n".join(lines)


def _about(config, section):
    if section == "losses":
        return "The weight of each loss; 0: off. It may change: `((step, weight), ...)` is linear between its points."
    return inspect.cleandoc(type(config.sections()[section]).__doc__ or "").splitlines()[0]


def _facts(option: Option, kind, default):
    """Returns the line with type, default, unit, range and consequences of an option."""
    values = f"`{kind_name(kind)}`"
    if option.choices:
        values = f"one of {', '.join(f'`{choice}`' for choice in option.choices)}"
    values += f" or `{AUTO}`" if option.auto and AUTO not in option.choices else ""
    parts = [values, f"default `{default!r}`" if isinstance(default, str) else f"default `{default}`"]
    parts += [option.unit] if option.unit else []
    parts += [option.range.text] if option.range else []
    return "; ".join([*parts, f"*{_BADGES[option.changes][0]}*"])


def _sentence(text):
    text = text[0].upper() + text[1:]
    return text if text.endswith(".") else text + "."
