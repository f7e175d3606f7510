"""Types of the fields of an ml_collections.ConfigDict, by which flags and Python code set the options of a run."""

import ast
from typing import Any

from absl import flags
from ml_collections import FieldReference, config_flags

from jaxnerf.options import AUTO, Schedule, is_auto, is_kind, is_schedule, is_tuple


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
