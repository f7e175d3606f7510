"""The results page has every run, and reports every workdir that cannot be read."""

import json
import os
import subprocess
import sys

import imageio.v3 as iio
import numpy as np
import pytest

from jaxnerf.evaluation import protocol
from runs import ROOT


def fake(folder, seconds, psnr, side):
    """Writes the workdir of a run that was scored twice, on four views of one grey each."""
    for fraction in (0.5, 1.0):
        scored = folder / "eval" / str(int(100 * fraction))
        results = {"step": int(100 * fraction), "training_seconds": fraction * seconds, "compile_seconds": 3.0}
        results |= {"psnr": fraction * psnr, "ssim": 0.9, "views": 4, "parameters": 1234}
        results |= protocol.of_images({"format": "blender", "split": "test"}, [(side, 2 * side)] * 4)
        for kind, level in (("gt-color", 0), ("color", 1)):
            (scored / kind).mkdir(parents=True)
            for view in range(4):
                pixels = np.full((side, 2 * side, 3), 50 * view + level, np.uint8)
                iio.imwrite(scored / kind / f"{view:03d}.png", pixels)
        (scored / "results.json").write_text(json.dumps(results))
    (folder / "eval" / "7.tmp").mkdir()  # of a score that was killed
    rows = [{"step": step, "seconds": step * seconds / 100, "psnr_fine": 20.0} for step in (10, 100)]
    (folder / "metrics.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows))
    return folder


def report(*arguments, **environment):
    """Returns (exit code, stderr) of the program."""
    command = [sys.executable, ROOT / "experiments" / "results" / "report.py", *arguments]
    path = os.pathsep.join([*environment.pop("first", []), str(ROOT)])
    ended = subprocess.run(command, capture_output=True, text=True, env={**os.environ, "PYTHONPATH": path})
    return ended.returncode, ended.stderr


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    folder = tmp_path_factory.mktemp("runs")
    broken = fake(folder / "broken", 60.0, 30.0, 8)
    (broken / "eval" / "100" / "results.json").write_text('{"step": 100}')
    return [
        fake(folder / "one", 60.0, 30.0, 8),
        broken,
        fake(folder / "two", 90.0, 33.0, 12),
        folder / "none",
    ]


def test_the_page_has_every_run_and_names_unreadable_workdirs(runs, tmp_path):
    code, errors = report(*runs, f"--out={tmp_path / 'page'}")
    assert code == 0, errors
    assert f"skipped {runs[1]}: lacks 'training_seconds'" in errors
    page = (tmp_path / "page" / "report.md").read_text()
    assert "| two | 100 | 1.5 min | 3 s | 33.00 dB | 0.900 | 4 | 1,234 |" in page
    assert [line.split()[1] for line in page.splitlines() if " dB |" in line] == ["one"] * 2 + ["two"] * 2
    assert "- one: format blender, split test, views 4, size [8, 16]" in page
    assert "Comparable with published tables: none" in page
    skipped = page.split("## Skipped")[1]
    assert f"{runs[1]}: lacks" in skipped and f"{runs[3]}: has no eval/*/results.json" in skipped
    sheet = iio.imread(tmp_path / "page" / "pictures.png")
    assert sheet.shape == (2 * 128, 6 * 256, 3)
    assert sheet[64, 128::256, 0].tolist() == [0, 1, 50, 51, 150, 151]  # views 0, 1 and 3 of four
    names = {path.name for path in (tmp_path / "page").iterdir()}
    assert names - {"psnr.png"} == {"report.md", "pictures.png"}
    assert ("psnr.png" in names) == ("![PSNR over time](psnr.png)" in page)


@pytest.mark.slow
def test_missing_matplotlib_is_reported_and_a_page_is_replaced_only_with_overwrite(runs, tmp_path):
    (tmp_path / "matplotlib.py").write_text("raise ImportError")
    code, errors = report(runs[0], f"--out={tmp_path}", first=[str(tmp_path)])
    assert code == 0 and "No plot, which needs matplotlib: pip install matplotlib" in errors
    page = (tmp_path / "report.md").read_text()
    assert "No plot, which needs matplotlib." in page and "psnr.png" not in page
    code, errors = report(runs[2], f"--out={tmp_path}")
    assert code == 1 and "report.md: exists already; give --overwrite" in errors
    assert (tmp_path / "report.md").read_text() == page
    code, errors = report(runs[2], f"--out={tmp_path}", "--overwrite")
    assert code == 0 and "| two |" in (tmp_path / "report.md").read_text()
    code, errors = report(runs[3], f"--out={tmp_path / 'other'}")
    assert code == 1 and "nothing to report" in errors and not (tmp_path / "other").exists()
