"""Tests of jaxnerf-needs on datasets: what is refused in one line, and a study that is killed and continues."""

import json
import signal
import time

import numpy as np
import pytest

import captures
from jaxnerf.configs import capture, smoke
from jaxnerf.tools.needs import run
from jaxnerf.tools.needs.run import Request, find_needs
from jaxnerf.tools.needs.study import Settings
from jaxnerf.tools.needs.trial import Result
from jaxnerf.training import auto_config
from jaxnerf.training.config import read_config
from runs import PACKED, as_flags, start

pytest_plugins = ["run_fixtures"]

SETTINGS = Settings(60.0, 0.1)


def config_of(folder):
    config = capture.get_config()
    config.data.dir = str(folder)
    return config


@pytest.mark.parametrize("count", [1, 3])
def test_too_few_views(tmp_path, count):
    shots = captures.noise(captures.orbit(count), captures.orbit(2, first=count))
    captures.write_transforms(tmp_path / "data", shots, splits={"train": range(count), "test": range(count, count + 2)})
    with pytest.raises(ValueError, match=rf"has {count} training views?, expected at least 6"):
        find_needs(Request(config_of(tmp_path / "data"), SETTINGS), tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_black_images(tmp_path):
    shots = [shot._replace(pixels=np.full_like(shot.pixels, 0)) for shot in captures.noise(captures.orbit(12))]
    captures.write_transforms(tmp_path / "data", shots)
    with pytest.raises(ValueError, match="all held-out images have one colour"):
        find_needs(Request(config_of(tmp_path / "data"), SETTINGS), tmp_path / "out")


def test_wrong_parts_and_folders(tmp_path):
    request = Request(smoke.get_config(), SETTINGS, ("levels", "views"))
    with pytest.raises(ValueError, match="--parts has 'levels', expected some of .*view dependence"):
        find_needs(request, tmp_path / "out")
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "notes.txt").write_text("mine")
    with pytest.raises(ValueError, match="holds other files"):
        find_needs(request._replace(parts=()), tmp_path / "out")
    assert (tmp_path / "out" / "notes.txt").read_text() == "mine"


def test_a_dataset_that_does_not_train():
    shots = captures.noise(captures.orbit(2))
    held_out = _Images([shot.pixels[..., :3] / 65535 for shot in shots])
    scores = [8.0, 8.0]
    result = Result(scores, scores, None, 10, 1.0, 1.0, 0.0, 0.1, 1, 1.0)
    with pytest.raises(ValueError, match="it does not train"):
        run._check_trained(held_out, result)
    run._check_trained(held_out, result._replace(psnr_colors=[30.0, 30.0]))


class _Images:
    def __init__(self, images):
        self.image, self.size = images.__getitem__, [image.shape[:2] for image in images]


def test_images_shrink_with_the_budget():
    views = captures.black_views(captures.orbit(4, height=200, width=300))
    assert run.shrink_factor(views, 600.0) == 1
    assert run.shrink_factor(views, 75.0) == 2
    assert run.shrink_factor(views, 1.0) == 4, "no side is shorter than 50 px"


def test_rendered_images_shrink_by_a_divisor_of_their_size(tmp_path):
    captures.write_blender(tmp_path, captures.noise(captures.orbit(6, height=24, width=40)))
    config = read_config(config_of(tmp_path))
    views = auto_config.resolve(config).views
    shrunk, smaller = run._shrunk(config, views, 3)
    assert shrunk.data.factor == 4, "3 does not divide 24 x 40"
    assert smaller.size.tolist() == [[6, 10]] * 6


@pytest.mark.slow
def test_a_study_that_is_killed_continues(unoptimized, tmp_path, monkeypatch):
    """Two sizes of images, killed in its middle: finished trials stay, and all files of the result are written."""
    monkeypatch.setenv("PJRT_NPROC", "1")  # on one core the budget is CPU time, which lasts on a busy machine
    shots = captures.shoot(captures.orbit(8), captures.orbit(6, height=30, width=20, first=8))
    captures.write_transforms(tmp_path / "data", shots)
    out = tmp_path / "out"
    flags = [
        "--config=configs/smoke.py",
        *as_flags(PACKED),
        "--config.train.lr_init=0.01",
        "--config.train.lr_final=0.001",
        f"--data_dir={tmp_path / 'data'}",
        f"--out={out}",
        "--seconds=1",
        "--parts=view dependence,averaged parameters",
        "--config.data.background=auto",
        "--config.data.world=auto",
    ]
    process = start("needs", *flags, "--budget=3600s")
    deadline = time.monotonic() + 3600
    while len([*out.glob("trials/*.json")]) < 2:
        assert process.poll() is None and time.monotonic() < deadline, process.communicate()
        time.sleep(0.2)
    process.send_signal(signal.SIGKILL)
    process.communicate()
    kept = {path: path.read_bytes() for path in out.glob("trials/*.json")}
    # What is left is as much as this machine needs, however slow it is: a longest run is compiled for two models.
    budget = 3 * json.loads((out / "plan.json").read_text())["spent"]
    process = start("needs", *flags, f"--budget={budget:.0f}s")
    printed, errors = process.communicate(timeout=3600)
    assert process.returncode == 0, errors
    assert all(path.read_bytes() == content for path, content in kept.items())
    results = json.loads((out / "results.json").read_text())
    assert [row["part"] for row in results["parts"]] == ["view dependence", "averaged parameters"]
    assert all(row["verdict"] in ("needed", "not needed", "cannot tell") for row in results["parts"])
    assert (out / "page.html").read_text().count("data:image/png") >= 2
    assert "knee" in (out / "curve.csv").read_text() and "view dependence" in printed
    process = start(
        "train", f"--config={out / 'lean.py'}", f"--workdir={tmp_path / 'lean'}", "--config.train.max_steps=5"
    )
    assert process.wait(3600) == 0, process.communicate()
