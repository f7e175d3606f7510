"""Imports go downwards only: core -> fields -> data -> engine -> mains."""

import ast
import pathlib
import sys

import pytest

ROOT = pathlib.Path(__file__).resolve().parent.parent / "jaxnerf"
FLOORS = ["core", "fields", "data", "engine", "mains"]
# jaxnerf/__init__.py stands outside: it hands out the core, and the engine when it is asked for.
FILES = sorted(path for path in ROOT.rglob("*.py") if path != ROOT / "__init__.py")


def floor(parts):
    """Returns the number of a module's floor; parts is its dotted name after "jaxnerf", split."""
    return FLOORS.index(parts[0]) if parts[0] in FLOORS else FLOORS.index("mains")


def imports(source, package):
    """Returns every module that the source imports, at the top or inside a function, as dotted names."""
    found = []
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            found += [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            base = package[: len(package) - node.level + 1] if node.level else []
            module = ".".join([*base, *([node.module] if node.module else [])])
            # "from jaxnerf.core import structs" means the module structs, where there is one.
            found += [f"{module}.{alias.name}" if is_module(module, alias.name) else module for alias in node.names]
    return found


def is_module(package, name):
    path = ROOT.parent.joinpath(*package.split("."), name)
    return path.is_dir() or path.with_suffix(".py").is_file()


def upward(path, source):
    """Returns the imports of a file that the house does not allow."""
    package = ["jaxnerf", *path.relative_to(ROOT).parts[:-1]]
    own = [*package[1:], path.stem]
    wrong = []
    for name in imports(source, package):
        top, *rest = name.split(".")
        if top == "jaxnerf":
            higher = not rest or floor(rest) > floor(own)
            sibling = own[0] == "core" and rest[:1] == ["core"] and rest[1] not in ("structs", "numerics")
            if higher or (sibling and own[1] not in ("rendering", "occupancy", "lanes", "packing", "__init__")):
                wrong.append(name)
        elif own[0] == "core" and top != "jax" and top not in sys.stdlib_module_names:
            wrong.append(name)
    return wrong


@pytest.mark.parametrize("path", FILES, ids=lambda path: str(path.relative_to(ROOT)))
def test_imports_go_downwards(path):
    assert upward(path, path.read_text()) == []


@pytest.mark.parametrize(
    "path, line, allowed",
    [
        ("core/sampling.py", "from jaxnerf.core.types import Samples", True),
        ("core/sampling.py", "from jaxnerf.core import cameras", False),
        ("core/sampling.py", "from . import cameras", False),
        ("core/rendering.py", "from jaxnerf.core import cameras", True),
        ("core/sampling.py", "import numpy as np", False),
        ("core/sampling.py", "from jaxnerf.fields import mlp", False),
        ("core/sampling.py", "import jaxnerf", False),
        ("fields/mlp.py", "from jaxnerf.core.encoding import positional_encoding", True),
        ("fields/mlp.py", "def f():\n    from jaxnerf.data import blender", False),
        ("engine/loop.py", "from jaxnerf import train", False),
        ("train.py", "from jaxnerf.engine import loop", True),
    ],
)
def test_the_test_itself(path, line, allowed):
    assert (upward(ROOT / path, line) == []) == allowed
