"""The table of what six scenes need, and that of their lean models."""

from studies import study

six_scenes = study("scene_needs/six_scenes")


def results(verdict, mean, part="levels"):
    """Returns results of jaxnerf-needs with one part."""
    effect = None if mean is None else {"mean": mean, "lower": mean - 0.1, "upper": mean + 0.1}
    row = {"part": part, "change": "less", "verdict": verdict, "effect": effect}
    return {
        "parts": [row],
        "plan": {"length": 4.2},
        "spent": 290.0,
        "complete": {"psnr": 25.0},
        "lean": {"parts": ["levels, less"] if verdict == "not needed" else []},
    }


def test_a_row_is_a_part_and_a_column_a_scene():
    needs = {
        "lego": results("needed", 1.25),
        "fern": results("not needed", -0.5),
        "fox": results("cannot tell", 0.125),
        "can": results("cannot tell", None),
        "mic": results("needed", 0.5, part="visual hull"),
    }
    lines = six_scenes.parts_table(needs, "5min")
    assert "| levels, less | **+1.25** | -0.50 | +0.12 ? | not tried |  |" in lines
    assert "| visual hull, less |  |  |  |  | **+0.50** |" in lines
    assert "5min" in lines[0] and "fern 4 s" in lines[0]
    assert any(line.startswith("| the program took | 290 s | 290 s |") for line in lines)


def test_the_lean_model_is_beside_the_complete_one():
    numbers = {"parameters": 2_000_000, "memory": 3e8, "frame_seconds": 0.25}
    scores = {
        "lego": {"complete": {**numbers, "psnr": 30.0}, "lean": {**numbers, "psnr": 30.5, "parameters": 1_000_000}},
        "fern": {"complete": {**numbers, "psnr": 25.0}, "lean": {**numbers, "psnr": 24.9}},
    }
    needs = {"lego": results("not needed", 0.0), "fern": results("needed", 1.0)}
    lines = six_scenes.lean_table(needs, scores, 60.0)
    assert "after 60 s" in lines[0] and "+0.20 dB" in lines[0]
    assert "| lego | 30.00 | 30.50 | +0.50 | 2.00, 1.00 | 300, 300 | 0.25, 0.25 | levels, less |" in lines
    assert any(line.startswith("| fern | 25.00 | 24.90 | -0.10 |") and line.endswith("| nothing |") for line in lines)
