"""Checks the annotations of jaxnerf's functions at run time, shapes included, with jaxtyping and beartype.

conftest.py calls `install` before jaxnerf is imported. Only functions at the top of a module are checked: JAX
rebuilds pytrees with None, PartitionSpecs and ShapeDtypeStructs, so that constructors must accept anything.
"""

import functools
import importlib.abc
import importlib.machinery
import inspect
import sys

from beartype import BeartypeConf, beartype
from jaxtyping import TypeCheckError, jaxtyped

_check = beartype(conf=BeartypeConf(is_pep484_tower=True))  # an int is a float, as in every type checker


def checked(function):
    """Returns the function with checks of its arguments and result.

    A function that itself refuses a wrong argument raises its own error, which tests expect; the TypeCheckError
    is raised where the function accepts the argument. The checks are made at the first call.
    """
    typed = functools.cache(lambda: jaxtyped(function, typechecker=_check))

    @functools.wraps(function)
    def call(*args, **kwargs):
        __tracebackhide__ = True
        try:
            return typed()(*args, **kwargs)
        except TypeCheckError:
            function(*args, **kwargs)
            raise

    return call


class _Loader(importlib.abc.Loader):
    """Loads a module and replaces its annotated functions by checked ones."""

    def __init__(self, loader):
        self._loader = loader

    def create_module(self, spec):
        return self._loader.create_module(spec)

    def exec_module(self, module):
        self._loader.exec_module(module)
        for name, value in list(vars(module).items()):
            defined_here = inspect.isfunction(value) and value.__module__ == module.__name__
            plain = not hasattr(value, "__wrapped__")  # a context manager is annotated as the generator that it wraps
            if defined_here and plain and value.__annotations__ and not name.startswith("__"):
                setattr(module, name, checked(value))

    def __getattr__(self, name):
        return getattr(self._loader, name)


class _Finder(importlib.abc.MetaPathFinder):
    def __init__(self, packages):
        self._packages = packages

    def find_spec(self, fullname, path=None, target=None):
        if not any(fullname == name or fullname.startswith(f"{name}.") for name in self._packages):
            return None
        spec = importlib.machinery.PathFinder.find_spec(fullname, path, target)
        if spec is not None and spec.loader is not None:
            spec.loader = _Loader(spec.loader)
        return spec


def install(*packages):
    """Checks the functions of all modules of these packages that are imported from now on."""
    sys.meta_path.insert(0, _Finder(packages))
