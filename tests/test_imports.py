"""Tests that imports follow the order of the packages, without cycles.

core <- fields, models <- data <- training <- evaluation, interop, capture_check, structure_from_motion <-
programs. runtime imports core only, and data and everything above may import it. Everything but core may import
jaxnerf.registry and jaxnerf.options.
"""

import ast
import graphlib
import pathlib
import sys

import pytest

ROOT = pathlib.Path(__file__).resolve().parent.parent / "jaxnerf"
RANKS = {
    "core": 0,
    "fields": 1,
    "models": 1,
    "runtime": 1,
    "configs": 1,
    "data": 2,
    "training": 3,
    "evaluation": 4,
    "interop": 4,
    "capture_check": 4,
    "structure_from_motion": 4,
    "exporters": 4,
    "viewer": 4,
    "programs": 5,
}
# Packages of one rank do not import each other, apart from these.
ALLOWED = {("models", "fields"), ("exporters", "evaluation"), ("viewer", "evaluation"), ("viewer", "exporters")}
FORBIDDEN = {("fields", "runtime"), ("models", "runtime")}
SHARED = ("jaxnerf.registry", "jaxnerf.options")
CORE_LIBRARIES = {"jax", "jaxtyping", *sys.stdlib_module_names}
# jaxnerf/__init__.py is excluded: it exports names of core, and names of other packages on demand.
FILES = sorted(
    path for path in ROOT.rglob("*.py") if path != ROOT / "__init__.py" and ROOT / "configs" not in path.parents
)


def module_name(path):
    parts = path.relative_to(ROOT.parent).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def is_module(name):
    path = ROOT.parent.joinpath(*name.split("."))
    return path.is_dir() or path.with_suffix(".py").is_file()


def imported_modules(source, package):
    """Returns the dotted names of all modules that a source imports, also inside functions and for types."""
    found = []
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            found += [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            base = package[: len(package) - node.level + 1] if node.level else []
            module = ".".join([*base, *([node.module] if node.module else [])])
            names = [f"{module}.{alias.name}" for alias in node.names]
            found += [name if name.startswith("jaxnerf.") and is_module(name) else module for name in names]
    return found


def package_of(module):
    """Returns the part of the package that a module belongs to; a module at the top is a program."""
    parts = module.split(".")
    return parts[1] if len(parts) > 1 and parts[1] in RANKS else "programs"


def forbidden_imports(path, source):
    """Returns the imports of a file that the order of the packages does not allow."""
    module, wrong = module_name(path), []
    own = package_of(module)
    for name in imported_modules(source, ["jaxnerf", *path.relative_to(ROOT).parts[:-1]]):
        if name.partition(".")[0] == "jaxnerf":
            other = package_of(name)
            if (name in SHARED and own != "core") or own == other and name != "jaxnerf":
                continue
            lower = RANKS[other] < RANKS[own] or (own, other) in ALLOWED
            if module in SHARED or not lower or (own, other) in FORBIDDEN:
                wrong.append(name)
        elif own == "core" and name.partition(".")[0] not in CORE_LIBRARIES:
            wrong.append(name)
    return wrong


@pytest.mark.parametrize("path", FILES, ids=lambda path: str(path.relative_to(ROOT)))
def test_imports_follow_the_order(path):
    assert forbidden_imports(path, path.read_text()) == []


def test_no_cycles():
    graph = {
        module_name(path): {
            name
            for name in imported_modules(path.read_text(), ["jaxnerf", *path.relative_to(ROOT).parts[:-1]])
            if name.startswith("jaxnerf.")
        }
        for path in FILES
    }
    list(graphlib.TopologicalSorter(graph).static_order())  # raises CycleError with the modules of a cycle


def test_every_package_has_an_init():
    folders = {path.parent for path in ROOT.rglob("*.py")}
    assert [folder for folder in sorted(folders) if not (folder / "__init__.py").is_file()] == []


@pytest.mark.parametrize(
    "path, line, allowed",
    [
        ("core/sampling.py", "from jaxnerf.core.types import Samples", True),
        ("core/sampling.py", "from . import cameras", True),
        ("core/sampling.py", "import numpy as np", False),
        ("core/sampling.py", "import jaxtyping", True),
        ("core/sampling.py", "from jaxnerf.fields import mlp", False),
        ("core/sampling.py", "import jaxnerf", False),
        ("core/sampling.py", "from jaxnerf import registry", False),
        ("core/losses.py", "from jaxnerf.options import Facts", False),
        ("options.py", "from jaxnerf.core import types", False),
        ("fields/mlp.py", "from jaxnerf.core.encoding import positional_encoding", True),
        ("fields/mlp.py", "def f():\n    from jaxnerf.data.readers import blender", False),
        ("fields/mlp.py", "from jaxnerf.models import base", False),
        ("models/occupancy.py", "from jaxnerf.fields import base", True),
        ("models/occupancy.py", "from jaxnerf.runtime import memory", False),
        ("runtime/memory.py", "from jaxnerf.core.types import Rays", True),
        ("runtime/memory.py", "from jaxnerf.data import dataset", False),
        ("data/dataset.py", "from jaxnerf.runtime import user_cache", True),
        ("training/loop.py", "from jaxnerf.evaluation import evaluate", False),
        ("training/loop.py", "from jaxnerf import train", False),
        ("interop/convert.py", "from jaxnerf.evaluation import restore", False),
        ("registry.py", "from jaxnerf.core import types", False),
        ("train.py", "from jaxnerf.training import loop", True),
        ("train.py", "from jaxnerf import evaluation", True),
    ],
)
def test_this_test(path, line, allowed):
    assert (forbidden_imports(ROOT / path, line) == []) == allowed
