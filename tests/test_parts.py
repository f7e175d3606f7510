"""Tests that no code compares with the name of a registered part: a part declares what others ask it."""

import ast

import pytest

from jaxnerf.registry import FIELDS, LOSSES, READERS, SAMPLERS
from jaxnerf.tools.exporters.registration import EXPORTERS
from jaxnerf.tools.uncertainty.registration import ESTIMATORS
from runs import ROOT

REGISTRIES = (FIELDS, SAMPLERS, LOSSES, READERS, EXPORTERS, ESTIMATORS)
NAMES = {name for registry in REGISTRIES for name in registry.builtin}
# Variables whose values have some of the same names: the quadrature rule "points", and the viewer's mode "depth".
OTHER = {"rule", "mode"}


def name_tests(source):
    """Returns the comparisons of a source with the name of a registered part, in a set or a match, too."""
    found = []
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Compare):
            sides = [node.left, *node.comparators]
            if not any(isinstance(side, ast.Name) and side.id in OTHER for side in sides):
                found += [ast.unparse(node) for side in sides if texts(side) & NAMES]
        elif isinstance(node, ast.MatchValue) and texts(node) & NAMES:
            found.append(ast.unparse(node))
    return found


def texts(node):
    return {part.value for part in ast.walk(node) if isinstance(part, ast.Constant) and isinstance(part.value, str)}


@pytest.mark.parametrize("path", sorted((ROOT / "jaxnerf").rglob("*.py")), ids=lambda path: str(path.relative_to(ROOT)))
def test_no_code_compares_with_the_name_of_a_part(path):
    assert name_tests(path.read_text()) == []


@pytest.mark.parametrize(
    "line",
    [
        'if config.sampler == "occupancy": pass',
        'x = "blender" != data.format',
        'x = kind in ("mesh", "points")',
        'match kind:\n    case "web": pass',
        'x = loss.name == "depth"',
    ],
)
def test_this_test(line):
    assert name_tests(line)
