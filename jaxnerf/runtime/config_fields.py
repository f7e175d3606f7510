"""Types of configuration fields: values that may be inferred, and numbers that may change during training."""

import ast
from typing import Any

from absl import flags
from ml_collections import FieldReference, config_flags

AUTO = "auto"  # the only marker of a value that is inferred
UNLIMITED_STEPS = 10**7  # train.max_steps of a run that train.max_seconds ends


def auto(kind: type, value: Any = AUTO) -> FieldReference:
    """Declares a field that holds a value of one type, or "auto".

    Flags and Python code can set the field, also back to "auto". `auto_config.resolve` replaces "auto".

    Args:
        kind: bool, int, float or tuple. A field that holds text is declared as a plain string.
        value: the default.
    """
    return FieldReference(value, field_type=_AUTO_TYPES[kind])


def schedule(value: float | tuple | str) -> FieldReference:
    """Declares a field that holds a number, a schedule ((step, value), ...), linear between its points, or "auto"."""
    return FieldReference(value, field_type=Schedule)


def is_auto(value: Any) -> bool:
    """Returns whether a value still has to be inferred."""
    return isinstance(value, str) and value == AUTO


class _Accepts(type):
    """A type whose instances are the values that a field accepts."""

    def __instancecheck__(cls, value):
        return cls.accepts(value)


class _Literal(flags.ArgumentParser):
    """Reads "auto" as text and all else as a Python literal of the field's type."""

    def __init__(self, field_type, kind):
        self._type, self.syntactic_help = field_type, f"auto, or {kind.__name__}"

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
    def accepts(value):
        if is_auto(value):
            return True
        if kind is float:
            return isinstance(value, int | float) and not isinstance(value, bool)
        if kind is tuple:
            return isinstance(value, tuple | list)
        return isinstance(value, kind) and (kind is bool or not isinstance(value, bool))

    field_type = _Accepts(f"auto_{kind.__name__}", (), {"accepts": staticmethod(accepts)})
    config_flags.register_flag_parser_for_type(field_type, _Literal(field_type, kind))
    return field_type


def _is_schedule(value):
    def is_number(number):
        return isinstance(number, int | float) and not isinstance(number, bool)

    def is_point(point):
        return isinstance(point, tuple | list) and len(point) == 2 and all(map(is_number, point))

    return (
        is_auto(value) or is_number(value) or (isinstance(value, tuple | list) and value and all(map(is_point, value)))
    )


Schedule = _Accepts("schedule", (), {"accepts": staticmethod(lambda value: bool(_is_schedule(value)))})
_AUTO_TYPES = {kind: _auto_type(kind) for kind in (bool, int, float, tuple)}


class _ScheduleParser(_Literal):
    def __init__(self):
        super().__init__(Schedule, float)
        self.syntactic_help = "a number, ((step, value), ...), or auto"


config_flags.register_flag_parser_for_type(Schedule, _ScheduleParser())
