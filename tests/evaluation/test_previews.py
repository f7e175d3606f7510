"""Previews and the summary of a run: their metrics, their files, and that they leave training as it is."""

import shutil
import time

import imageio.v3 as iio
import jax
import numpy as np
import pytest

from jaxnerf.evaluation import output_images, previews
from jaxnerf.evaluation.evaluate import train_and_evaluate
from jaxnerf.evaluation.previews import Previews
from jaxnerf.evaluation.restore import restore_run
from jaxnerf.training import build, loop, metric_log
from jaxnerf.training.state import TrainState
from runs import evaluate, smoke_config

pytest_plugins = ["run_fixtures"]
pytestmark = pytest.mark.usefixtures("unoptimized")


NAMES = ["done", "training", "held-out", "preview", "workdir", "next"]


@pytest.fixture
def folder(trained, tmp_path):
    """A copy of the trained workdir."""
    return shutil.copytree(trained, tmp_path / "run")


@pytest.fixture(scope="module")
def views():
    """The training views of the run."""
    return build.load_split(smoke_config(), "train")[0]


def with_summary(folder):
    """Returns Previews of a workdir whose config asks for scores."""
    text = (folder / "config.json").read_text()
    assert '"summary_seconds": 0.0' in text
    (folder / "config.json").write_text(text.replace('"summary_seconds": 0.0', '"summary_seconds": 60.0'))
    return Previews(folder)


def test_the_summary_has_the_psnr_of_the_evaluation_and_the_next_commands(folder, views, monkeypatch):
    monkeypatch.setattr(previews, "_num_pixels", lambda _: 1280)
    lines = with_summary(folder).summary(views)
    psnr = evaluate(folder)["psnr"]
    assert [line[:14].strip() for line in lines] == [*NAMES, "", ""]
    assert lines[0].startswith("done          it reached train.max_steps = 20: 1,280 rays in ")
    assert lines[1].endswith(" dB over 8 of 60 images")
    assert lines[2] == f"held-out      PSNR {psnr:.2f} dB over 8 images of the split 'test'"
    assert lines[3].endswith(f"held-out image test_004: {folder}/previews/20.png")
    assert f"{folder}: checkpoints (10, 15, 20), metrics.jsonl, config.json, previews" in lines[4]
    commands = [line[14:].split("  ")[0] for line in lines[5:]]
    workdir = f"--workdir={folder}"
    assert commands == [
        f"jaxnerf-eval {workdir}",
        f"jaxnerf-render {workdir}",
        f"jaxnerf-train {workdir} --config.train.max_steps=40",
    ]
    image = iio.imread(folder / "previews" / "20.png")
    np.testing.assert_array_equal(image[:, :24], iio.imread(folder / "eval" / "20" / "color" / "004.png"))
    np.testing.assert_array_equal(image[:, 24:], iio.imread(folder / "eval" / "20" / "gt-color" / "004.png"))
    again = Previews(folder).summary(views)
    assert again[3] == f"evaluation    PSNR {psnr:.2f} dB over 8 views, in {folder / 'eval' / '20'}"
    assert not any(line.startswith("held-out") for line in again)


def test_a_run_that_saw_few_of_its_pixels_says_so_and_advises_to_train_longer_first(folder, views):
    lines = Previews(folder).summary(views)
    seen = 1280 / (np.asarray(views.pixels)[:, 3] > 0).sum()
    assert lines[1].startswith(f"note          training saw at most {seen:.0%} of the pixels of its images")
    (first,) = (line for line in lines if line.startswith("next"))
    assert f"jaxnerf-train --workdir={folder}" in first and first.endswith("trains longer")


def test_the_summary_states_that_the_time_has_passed(folder, views, monkeypatch):
    monkeypatch.setattr(previews, "_num_pixels", lambda _: 1280)
    text = (folder / "config.json").read_text().replace('"max_steps": 20', '"max_steps": 1000')
    (folder / "config.json").write_text(text.replace('"max_seconds": 0.0', '"max_seconds": 0.5'))
    lines = Previews(folder).summary(views)
    assert lines[0].startswith("done          train.max_seconds = 0.5 have passed at step 20 of 1,000: 1,280 rays in ")
    assert lines[-1].startswith(f"              jaxnerf-train --workdir={folder} --config.train.max_seconds=1 ")
    assert len(lines) == 5, "without summary_seconds nothing is scored"


def test_without_held_out_views_training_views_are_shown(folder, views, monkeypatch):
    def missing(data, split, **options):
        raise ValueError(f"no split {split!r}")

    monkeypatch.setattr("jaxnerf.data.dataset.load_split", missing)
    monkeypatch.setattr(previews, "_num_pixels", lambda _: 1280)
    lines = with_summary(folder).summary(views)
    assert "dB on the training image train_030" in lines[2]
    assert lines[3].startswith("held-out      no images (no split 'test'); --config.data.hold_out=8 with a new")
    assert not any("jaxnerf-eval" in line for line in lines)
    image = iio.imread(folder / "previews" / "20.png")
    np.testing.assert_array_equal(image[:, 24:], output_images.to_8_bits(views.image(30)))


@pytest.mark.slow
def test_previews_change_no_bit_of_training(trained, tmp_path, capsys):
    assert train_and_evaluate(smoke_config(preview_every=1e-9), tmp_path)
    said = [line for line in capsys.readouterr().err.splitlines() if line.startswith("preview ")]
    assert said and f"dB on the held-out image test_004: {tmp_path}/previews/1.png" in said[0]
    assert len(list((tmp_path / "previews").iterdir())) == len(said)
    found, expected = (jax.device_get(restore_run(run).variables(20)) for run in (tmp_path, trained))
    jax.tree.map(np.testing.assert_array_equal, found, expected)


@pytest.mark.slow
def test_the_time_of_previews_does_not_count(tmp_path):
    steps = []

    def preview(state, views):
        steps.append(int(state.step))
        time.sleep(1.5)
        return "preview       slow"

    assert loop.train(smoke_config(preview_every=1e-9), tmp_path, preview=preview)
    assert steps == [1], "the next one is due after ten times that time"
    assert metric_log.read_rows(tmp_path)[-1]["seconds"] < 1.5


def test_a_preview_that_fails_is_reported(folder, views, monkeypatch):
    def full(path, pixels):
        raise OSError(28, "No space left on device", str(path))

    monkeypatch.setattr(output_images, "write_image", full)
    params, grid = restore_run(folder).variables(20)
    state = TrainState(step=20, params=params, opt_state=None, grid=grid, counters={})
    assert Previews(folder).write(state, views).startswith("preview       none: [Errno 28] No space left on device")
    assert "scores        none: [Errno 28] No space left on device" in "\n".join(with_summary(folder).summary(views))


def test_large_images_are_subsampled(folder, views, monkeypatch):
    monkeypatch.setattr("jaxnerf.evaluation.previews._MAX_RAYS", 12 * 12)
    previews = with_summary(folder)
    previews.summary(views)
    image, shown = iio.imread(folder / "previews" / "20.png"), build.load_split(smoke_config(), "test")[0]
    assert image.shape == (12, 24, 3)
    np.testing.assert_array_equal(image[:, 12:], output_images.to_8_bits(shown.image(4))[::2, ::2])
