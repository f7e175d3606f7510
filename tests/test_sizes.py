"""Tests that functions and modules stay short; what is longer stands below with its reason."""

import ast

import pytest

from runs import ROOT

MAX_LINES, MAX_PARAMETERS, MAX_MODULE = 80, 8, 500  # lines of code without docstrings and comments; lines of a file
CONTRACT = "its keywords are public names, see test_api.py"
MANY_PARAMETERS = {
    "core/pose_estimation.py:estimate_pose": CONTRACT,
    "core/rendering.py:render_rays": CONTRACT,
    "core/rendering.py:render_hierarchical": CONTRACT,
    "core/occupancy/grid.py:update_grid": CONTRACT,
    "core/occupancy/grid.py:grid_from_scene": CONTRACT,
    "data/ray_batches.py:draw_batch": CONTRACT,
    "evaluation/evaluate.py:score_run": "each is a flag of jaxnerf-eval",
    "tools/exporters/base.py:export_run": "each is a flag of jaxnerf-export",
    "options.py:option": "each names a property of a declaration, and most declarations have two or three",
    "models/grid_schedule.py:make_grid_schedule": "its keywords are options of samplers, those of plug-ins, too",
    "models/occupancy.py:render_with_grid": "it adds the grid's steps to what render_packed takes",
    "core/occupancy/from_scene.py:visible_grid": "it adds the box of a GridSchedule to what grid_from_scene takes",
}
LONG_MODULES: dict[str, str] = {}
FILES = sorted((ROOT / "jaxnerf").rglob("*.py"))


def code_lines(node, lines):
    """Returns the lines of code of a function, without its docstring, comments and blank lines."""
    first, *_ = node.body
    is_docstring = isinstance(first, ast.Expr) and isinstance(first.value, ast.Constant)
    docstring = range(first.lineno, first.end_lineno + 1) if is_docstring else ()
    numbers = set(range(node.lineno, node.end_lineno + 1)).difference(docstring)
    return sum(not lines[number - 1].strip().startswith("#") for number in numbers if lines[number - 1].strip())


def num_parameters(node):
    """Returns the number of parameters of a function, without self."""
    parameters = {each.arg for each in (*node.args.posonlyargs, *node.args.args, *node.args.kwonlyargs)}
    return len(parameters - {"self", "cls"})


@pytest.mark.parametrize("path", FILES, ids=lambda path: str(path.relative_to(ROOT)))
def test_functions_and_modules_are_short(path):
    source, name = path.read_text(), path.relative_to(ROOT / "jaxnerf").as_posix()
    lines = source.splitlines()
    assert len(lines) <= MAX_MODULE or name in LONG_MODULES
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.FunctionDef):
            place = f"{name}:{node.name}"
            assert code_lines(node, lines) <= MAX_LINES, place
            assert num_parameters(node) <= MAX_PARAMETERS or place in MANY_PARAMETERS, place


def test_the_exceptions_are_needed():
    for place in MANY_PARAMETERS:
        name, _, function = place.partition(":")
        tree = ast.parse((ROOT / "jaxnerf" / name).read_text())
        (found,) = (node for node in ast.walk(tree) if isinstance(node, ast.FunctionDef) and node.name == function)
        assert num_parameters(found) > MAX_PARAMETERS, place
    for name in LONG_MODULES:
        assert len((ROOT / "jaxnerf" / name).read_text().splitlines()) > MAX_MODULE, name
