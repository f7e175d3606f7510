"""The search for what a scene needs, on trials whose scores are made up."""

import ast
import importlib
import json
import pathlib

import pytest

from configs import capture, lego_small, quickstart
from studies import study

needs_report, scene_needs = study("needs_report"), study("scene_needs")
scene_parts = study("scene_parts")
PRICE = {"use_viewdirs": 0.01, "width": 0.06, "num_freqs": 0.9, "depth": 0.05}  # dB of each field's change


def made_up(complete, overrides, folder, seed):
    """Returns results as if each changed field cost its price, and half the width half the time."""
    del folder
    price, seconds = 0.0, 8.0
    for key, value in overrides.items():
        section, field = key.split(".")
        if section == "fine":
            ratio = complete.fine[field] / value if field == "width" else 2
            price += PRICE.get(field, 0.0) * (ratio - 1)
            seconds /= ratio if field == "width" else 1.1
    noise = 0.001 * ((seed * 7 + len(overrides)) % 3)
    return {"psnr": 30 - price + noise, "training_seconds": seconds, "step": 1000, "parameters": 1000}


@pytest.fixture
def found(monkeypatch, tmp_path):
    monkeypatch.setattr(scene_needs, "_run", made_up)
    names = ["view_dependence", "frequencies", "width", "depth", "precision"]
    return scene_needs.search(quickstart.get_config(), True, tmp_path, seeds=[0, 1, 2], loss=0.2, names=names)


def test_what_costs_less_than_the_loss_is_left_off_together(found):
    kept = [(names, kept) for names, _, kept in found.tried]
    # The width saves most; halved once more it would cost 0.18 with the rest.
    assert kept[0] == (["width"], True) and "fine.num_freqs" not in found.overrides
    assert found.overrides["fine.use_viewdirs"] is False and found.overrides["fine.width"] == 40
    names, cost, passed = found.tried[-1]
    assert all(cost.mean + cost.margin <= 0.2 for _, cost, kept in found.tried if kept)
    assert not all(kept for _, _, kept in found.tried), "the search ended before anything was too much"
    assert needs_report.verdict(found.parts["frequencies"][1], 0.2) == "needed"
    assert needs_report.verdict(found.parts["view_dependence"][1], 0.2) == "not needed"


def test_the_interval_is_student_s_over_the_seeds():
    base = scene_needs.Trial({}, {0: 30.0, 1: 31.0, 2: 32.0}, {0: 4.0, 1: 4.0, 2: 4.0}, 10)
    less = scene_needs.Trial({}, {0: 29.9, 1: 30.8, 2: 31.7}, {0: 3.0, 1: 2.0, 2: 2.0}, 7)
    cost = scene_needs.compare(base, less)
    assert cost.mean == pytest.approx(0.2) and cost.saved == 0.5 and cost.parameters == 3
    assert cost.margin == pytest.approx(2.920 * 0.1 / 3**0.5, rel=1e-3)  # a table's t at 95 %, 2 degrees
    assert not scene_needs.not_needed(cost, 0.3) and scene_needs.not_needed(cost, 0.4)


def test_what_is_written_can_be_trained_and_read(found, tmp_path, monkeypatch):
    out = tmp_path / "out"
    out.mkdir()
    readme = tmp_path / "README.md"
    readme.write_text("a\n<!-- needs -->\n<!-- end of needs -->\nb\n")
    needs_report.write(
        out,
        quickstart.get_config(),
        found,
        {"loss": 0.2, "steps": 800, "seeds": [0, 1, 2]},
        readme=str(readme),
    )
    monkeypatch.syspath_prepend(str(out))
    config = importlib.import_module("needed").get_config()
    expected = scene_parts.changed(quickstart.get_config(), found.overrides)
    assert config.to_dict() == expected.to_dict()
    assert "| frequencies:" in readme.read_text() and readme.read_text().endswith("b\n")
    assert json.loads((out / "needs.json").read_text())["overrides"] == found.overrides


@pytest.mark.parametrize("base", [lego_small, capture])
def test_each_part_changes_what_it_says_until_nothing_is_left(base):
    config = base.get_config()
    config.hash_grid.resolutions, config.occupancy.step_size, config.occupancy.outside = (
        (16, 32, 64),
        0.1,
        "contracted",
    )
    config.fine.num_freqs = config.fine.num_freqs or 8
    for name in scene_parts.PARTS:
        current = config
        for _ in range(8):
            change = scene_parts.without(name, current, alpha=False)
            if name != "samples" or not current.occupancy.skip_empty:
                if not change:
                    break
            for key, value in change.items():
                section, field = key.split(".")
                assert current[section][field] != value and (
                    value is False or value not in (0, ()) or field == "num_fine"
                )
            current = scene_parts.changed(current, change)
        else:
            assert name == "samples", f"{name} never ends"
    assert scene_parts.without("background", lego_small.get_config(), alpha=True) == {}


def test_every_part_says_what_it_leaves_off():
    tree = ast.parse(pathlib.Path(scene_parts.__file__).read_text())
    public = {node.name for node in tree.body if isinstance(node, ast.FunctionDef) and node.name[0] != "_"}
    assert public - {"without", "changed"} == set(scene_parts.PARTS)
    assert all(part.__doc__ for part in scene_parts.PARTS.values())
