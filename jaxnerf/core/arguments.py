"""Refuses arguments of another kind than a public function takes, such as rays and a scene in the wrong order."""

import dataclasses
import functools
import inspect
import operator
import os
import types
import typing
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import AbstractArray

_NAMES = {
    **{int: "a whole number", float: "a number", str: "text", types.NoneType: "None", os.PathLike: "a path"},
    **{Callable: "a function", Iterable: "a list", Sequence: "a list", tuple: "a tuple", Mapping: "a dict"},
}


def checked(function: Callable[..., Any]) -> Callable[..., Any]:
    """Makes a function refuse arguments of other kinds than those that its annotations name.

    Lists in place of arrays in a pytree class, such as Rays, become arrays. The function itself checks shapes. The
    package exports functions with these checks; inside, they call each other without them.

    Raises:
        ValueError: names the argument, what it is, what is expected, and the order of the arguments.
    """
    parameters = inspect.signature(function).parameters
    several = (inspect.Parameter.VAR_POSITIONAL, inspect.Parameter.VAR_KEYWORD)
    kinds = {name: each.annotation for name, each in parameters.items() if each.kind not in several}
    order = [name for name, each in parameters.items() if each.kind is each.POSITIONAL_OR_KEYWORD]

    def check(name, value):
        kind = kinds.get(name, Any)
        where = f"{function.__name__}: {name}"
        if not _fits(value, kind):
            advice = f"; the order is {', '.join(order)}" if name in order[:-1] or name in order[1:] else ""
            raise ValueError(f"{where} is {_described(value)}, expected {_name(kind)}{advice}")
        return _with_arrays(where, value)

    @functools.wraps(function)
    def call(*args, **kwargs):
        first = [*map(check, parameters, args), *args[len(parameters) :]]
        return function(*first, **{name: check(name, value) for name, value in kwargs.items()})

    call.__module__ = "jaxnerf"  # where pickle finds it
    return call


def _with_arrays(where, value):
    """Returns a value, in the fields of a pytree class with arrays in place of lists; ValueError on other fields."""
    lists = {}
    for field in dataclasses.fields(value) if dataclasses.is_dataclass(type(value)) else ():
        part = getattr(value, field.name)
        if any(map(_is_array, _kinds(field.type))):
            if not _fits(part, field.type):
                raise ValueError(f"{where}.{field.name} is {_described(part)}, expected {_name(field.type)}")
            if isinstance(part, list | tuple):
                lists[field.name] = jnp.asarray(part)
    return dataclasses.replace(value, **lists) if lists else value


def _kinds(kind):
    return typing.get_args(kind) if typing.get_origin(kind) in (typing.Union, types.UnionType) else (kind,)


def _is_array(kind):
    return isinstance(kind, type) and issubclass(kind, AbstractArray)


def _fits(value, kind):
    return any(_fits_one(value, each) for each in _kinds(kind))


def _fits_one(value, kind):
    if _is_array(kind) or kind in (bool, float):
        if hasattr(value, "dtype") and jnp.issubdtype(value.dtype, jax.dtypes.prng_key):
            return "prng_key" in getattr(kind, "dtypes", ())
        return hasattr(value, "shape") or isinstance(value, int | float | complex | list | tuple)
    if kind is int:
        try:
            return operator.index(value) is not None
        except TypeError:  # of a traced number, too
            return False
    kind = typing.get_origin(kind) or kind
    if kind is Any or not isinstance(kind, type):
        return True
    return isinstance(value, list | tuple if kind is tuple else kind) and (kind is str or not isinstance(value, str))


def _name(kind):
    """Returns the name of what is expected; numbers and lists that may stand for an array are not named."""
    kinds = [typing.get_origin(each) or each for each in _kinds(kind)]
    arrays = [each for each in kinds if _is_array(each)]
    named = [each for each in kinds if each is types.NoneType] if arrays else kinds
    array = "a key such as jax.random.key(0)" if arrays and "prng_key" in arrays[0].dtypes else "an array"
    return " or ".join([array] * bool(arrays) + [_NAMES.get(each, each.__name__) for each in named])


def _described(value):
    if hasattr(value, "dtype"):
        return f"{'a traced' if isinstance(value, jax.core.Tracer) else 'an'} array {value.shape} of {value.dtype}"
    if isinstance(value, str | int | float | types.NoneType):
        return f"{value!r:.60}"
    return "a function" if inspect.isroutine(value) else f"of type {type(value).__name__}"
