"""Tests that imports follow the order of the packages, without cycles.

core <- fields, models <- data <- training <- evaluation <- programs, tools. runtime imports core only, and data and
everything above may import it. Everything but core may import jaxnerf.registry and jaxnerf.options. Nothing outside
jaxnerf/tools imports a tool, except where a program hands over.
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
    "programs": 5,
    **{f"tools.{path.name}": 6 for path in (ROOT / "tools").iterdir() if path.is_dir()},
}
# Packages of one rank do not import each other, apart from these.
ALLOWED = {
    ("models", "fields"),
    ("tools.capture_check", "tools.curve"),
    ("tools.capture_check", "tools.next_images"),
    ("tools.needs", "tools.curve"),
    ("tools.viewer", "tools.exporters"),
    ("tools.viewer", "tools.next_images"),
    ("tools.viewer", "tools.uncertainty"),
    ("tools.exporters", "tools.uncertainty"),
}
# Where the method hands over to a tool, in a lazy import.
HANDS_OVER = {
    ("jaxnerf.train", "tools.options_page"),
    ("jaxnerf.train", "tools.viewer"),
    ("jaxnerf.eval", "tools.alignment"),
    ("jaxnerf.eval", "tools.predictions"),
    ("jaxnerf.eval", "tools.quality_search"),
    ("jaxnerf.eval", "tools.uncertainty"),
    ("jaxnerf.report", "tools.curve"),
    ("jaxnerf.data.synthetic", "tools.embedded_scene"),
    ("jaxnerf.evaluation.run_flags", "tools.uncertainty"),
    ("jaxnerf.training.metric_log", "tools.interop"),
    ("jaxnerf.extend", "tools.exporters"),
    ("jaxnerf.extend", "tools.uncertainty"),
}
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
    if parts[1:2] == ["tools"]:
        return ".".join(parts[1:3])
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
            lower = RANKS[other] < RANKS[own] or (own, other) in ALLOWED or (module, other) in HANDS_OVER
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
        ("tools/interop/convert.py", "from jaxnerf.evaluation import restore", True),
        ("tools/interop/convert.py", "from jaxnerf.tools.viewer import page", False),
        ("evaluation/evaluate.py", "from jaxnerf.tools.viewer import page", False),
        ("eval.py", "def f():\n    from jaxnerf.tools.exporters import base", False),
        ("registry.py", "from jaxnerf.core import types", False),
        ("train.py", "from jaxnerf.training import loop", True),
        ("train.py", "from jaxnerf import evaluation", True),
    ],
)
def test_this_test(path, line, allowed):
    assert (forbidden_imports(ROOT / path, line) == []) == allowed
