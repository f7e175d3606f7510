"""The studies of accelerators: what the runbook does without one, its page, and the packing."""

import json

import pytest

from studies import study

pack, runbook = study("gpu/pack"), study("gpu/run")


def test_page_has_a_section_for_each_finished_piece():
    origin = {"seconds": 3.2, "commit": "abc", "date": "2026-11-26", "command": "run.py"}
    kept = {
        "about": {"device": "a device", "jax": "1.0"},
        "pieces": {"frame": {**origin, "workdir": "lego-30", "rows": [{"chunk": 256, "ms per frame": 12.345}]}},
    }
    text = "\n".join(runbook.page(kept))
    assert "| 256 | 12.35 |" in text or "| 256 | 12.34 |" in text
    assert text.count("## ") == 1 and "| `run.py`, 3 s | abc, 2026-11-26 | a device |" in text


@pytest.fixture
def scene(tmp_path):
    """A scene of 10 training images of 100 bytes and a test image."""
    folder = tmp_path / "scenes" / "toy"
    (folder / "train").mkdir(parents=True)
    frames = [{"file_path": f"./train/r_{index}"} for index in range(10)]
    for index in range(10):
        (folder / "train" / f"r_{index}.png").write_bytes(bytes(100))
    (folder / "test.png").write_bytes(bytes(50))
    (folder / "transforms_train.json").write_text(json.dumps({"camera_angle_x": 1.0, "frames": frames}))
    return folder


def test_a_scene_that_does_not_fit_keeps_evenly_spread_views(scene, tmp_path, capsys):
    rest = 50 + (scene / "transforms_train.json").stat().st_size
    pack.pack(scene, tmp_path / "whole", rest + 1000)
    assert len(list((tmp_path / "whole").rglob("*"))) == 13
    pack.pack(scene, tmp_path / "part", rest + 450)
    frames = json.loads((tmp_path / "part" / "transforms_train.json").read_text())["frames"]
    assert [frame["file_path"] for frame in frames] == [f"./train/r_{index}" for index in (0, 3, 6, 9)]
    assert sorted(path.stem for path in (tmp_path / "part" / "train").iterdir()) == ["r_0", "r_3", "r_6", "r_9"]
    assert capsys.readouterr().out.splitlines()[-1].endswith("4 of 10 training views")
    with pytest.raises(ValueError, match="toy: has .* MiB, and .* name fewer --scenes"):
        pack.pack(scene, tmp_path / "none", 60)
