"""The flag --set of the benchmark: options in place of the jobs' own."""

import ast
from collections.abc import Sequence
from typing import Any

from absl import flags

from jaxnerf.training.config import option_names


def define_set() -> flags.FlagHolder:
    """Defines --set, which takes "section.option=value" any number of times."""
    return flags.DEFINE_multi_string(
        "set", [], "An option in place of the jobs' own, such as data.factor=16, for a try. It can be repeated."
    )


def parse(values: Sequence[str]) -> dict[str, Any]:
    """Returns {"section.option": value} of texts "section.option=value".

    Raises:
        ValueError: if there is no such option.
    """
    found = {}
    for text in values:
        name, equals, value = text.partition("=")
        if not equals or name not in option_names():
            raise ValueError(f"--set is {text!r}, expected section.option=value such as data.factor=16")
        try:
            found[name] = ast.literal_eval(value)
        except (SyntaxError, ValueError):
            found[name] = value
    return found
