"""Evaluation: the files that it writes, their content, and that nothing is overwritten."""

import functools
import json
import os
import shutil
import threading
import time

import imageio.v3 as iio
import numpy as np
import pytest

import oracle
from jaxnerf import load_scene, pixel_grid, render_image
from jaxnerf.evaluation.evaluate import score_run, watch
from jaxnerf.evaluation.image_renderer import image_renderer
from jaxnerf.evaluation.restore import restore_run
from jaxnerf.training import build
from jaxnerf.training.checkpoint import Checkpoints
from runs import evaluate, run_forked, smoke_config, start

pytest_plugins = ["run_fixtures"]
pytestmark = pytest.mark.usefixtures("unoptimized")


@pytest.fixture(scope="module")
def run(trained, tmp_path_factory):
    """A copy of the trained workdir with room for its evaluations."""
    return shutil.copytree(trained, tmp_path_factory.mktemp("eval") / "run")


@pytest.fixture(scope="module")
def scored(run):
    """(results, folder) of an evaluation as the program makes it."""
    results = evaluate(run)
    return results, run / "eval" / "20"


def images(folder):
    return [np.asarray(iio.imread(path)) for path in sorted(folder.glob("*"))]


def test_results_hold_the_metrics_and_the_protocol(scored):
    results, folder = scored
    assert json.loads((folder / "results.json").read_text()) == results
    assert results["views"] == len(results["images"]) == 8
    assert (results["step"], results["rays_seen"], results["parameters"]) == (20, 20 * 64, 3448)
    for key in ("rays_per_second", "seconds_per_frame", "training_seconds"):
        assert results[key] > 0, key
    conventions = results["conventions"]
    assert {key: conventions[key] for key in ("background", "pixel_offset", "split")} == {
        "background": "white",
        "pixel_offset": 0.5,
        "split": "test",
    }
    assert [row["comparable"] for row in results["comparable_with"]] == [False] * 5
    assert results["exposure"] is False
    for key in ("psnr", "ssim", "psnr_float", "psnr_truncated", "psnr_aligned", "ssim_aligned"):
        assert results[key] == pytest.approx(np.mean([row[key] for row in results["images"]]))
    assert [row["name"] for row in results["images"]] == [f"test_{index:03d}" for index in range(8)]


def test_metrics_are_those_of_the_images_on_disk(scored):
    results, folder = scored
    for row, color, truth in zip(results["images"], images(folder / "color"), images(folder / "gt-color"), strict=True):
        assert color.dtype == truth.dtype == np.uint8 and color.shape == truth.shape == (24, 24, 3)
        assert row["psnr"] == pytest.approx(oracle.psnr(color / 255, truth / 255), abs=1e-4)
        assert row["ssim"] == pytest.approx(oracle.ssim(color / 255, truth / 255), abs=1e-5)
        assert 0 < abs(row["psnr"] - row["psnr_float"]) < 0.1
        assert 0 < abs(row["psnr_truncated"] - row["psnr_float"]) < 0.3


def test_images_show_the_model_and_its_depth(scored, run):
    _, folder = scored
    opened = restore_run(run)
    views = opened.experiment.load_split("test")
    rays = opened.experiment.view_rays(views, 0, pixel_grid(24, 24))
    image = render_image(load_scene(run)[1], rays, chunk=250)
    assert np.abs(images(folder / "color")[0] - 255 * np.asarray(image.rgb)).max() <= 0.5 + 1e-3
    depths = images(folder / "depth")
    assert len(depths) == 8 and {depth.dtype for depth in depths} == {np.dtype("float32")}
    assert all(path.suffix == ".tiff" for path in (folder / "depth").iterdir())
    distance = np.asarray(image.depth) * np.linalg.norm(rays.directions, axis=-1)
    np.testing.assert_allclose(depths[0], distance, rtol=1e-5)
    sheet = iio.imread(folder / "contact_sheet.png")
    assert sheet.shape == (4 * 24, 5 * 24, 3)
    np.testing.assert_array_equal(sheet[:24, :24], images(folder / "gt-color")[0])


def test_nothing_is_overwritten_without_the_flag(scored, run):
    results, folder = scored
    before = (folder / "results.json").stat().st_mtime_ns
    with pytest.raises(ValueError, match="eval/20: exists already; give --overwrite"):
        evaluate(run)
    with pytest.raises(ValueError, match=r"no checkpoint of step 7, only \[10, 15, 20\]"):
        evaluate(run, step=7)
    assert (folder / "results.json").stat().st_mtime_ns == before


@pytest.mark.slow
def test_other_splits_and_steps_have_folders_of_their_own_and_the_chunk_changes_no_metric(scored, run):
    results, _ = scored
    val = evaluate(run, split="val")
    assert val["conventions"]["split"] == "val" and val["images"][0]["name"] == "val_000"
    assert abs(val["psnr"] - results["psnr"]) > 1e-6
    evaluate(run, step=15)
    assert {path.name for path in (run / "eval").iterdir()} == {"15", "20", "20-val"}
    again = evaluate(run, settings={"chunk": 577}, overwrite=True)  # more than an image
    for row, other in zip(again["images"], results["images"], strict=True):
        assert row["psnr_float"] == pytest.approx(other["psnr_float"], abs=1e-5)


def test_a_last_smaller_chunk_and_other_views_compile_nothing(run):
    opened, sizes = restore_run(run), []
    render = opened.render
    counted = lambda variables, rays: sizes.append(rays.near.shape) or render(variables, rays)  # noqa: E731
    counted.lower = render.lower
    score_run(opened._replace(render_image=image_renderer(counted, 250)), run, step=10)
    assert sizes == [(250,)] * (3 * 8)  # 576 rays a view
    assert render._cache_size() == 1


@pytest.mark.slow
def test_watching_waits_scores_each_checkpoint_and_ends(trained, tmp_path):
    """Watches an empty folder, then one checkpoint, then the last two."""
    folder = tmp_path / "run"
    process = start("eval", f"--workdir={folder}", "--watch", "--poll_seconds=0.1")
    killer = threading.Timer(100, process.kill)
    killer.start()
    assert "checking again every 0.1 s" in process.stderr.readline()
    shutil.copytree(trained, folder, ignore=lambda path, names: {"15", "20"} & set(names))
    assert process.stdout.readline().startswith("step 10: PSNR ")
    time.sleep(0.5)
    assert process.poll() is None, "it ended before the training did"
    for step in ("15", "20"):
        shutil.copytree(trained / "checkpoints" / step, tmp_path / step)
        os.replace(tmp_path / step, folder / "checkpoints" / step)  # whole at once, as orbax does
    out, err = process.communicate()
    killer.cancel()
    assert process.returncode == 0, err
    assert [line.split(":")[0] for line in out.splitlines()] == ["step 15", "step 20"]
    assert 1 <= err.count("no new checkpoint") <= 2  # once for each wait, not for each search
    assert json.loads((folder / "eval" / "20" / "results.json").read_text())["step"] == 20


def test_watching_scores_a_last_checkpoint_that_comes_during_its_search(trained, tmp_path, monkeypatch):
    folder, scored = shutil.copytree(trained, tmp_path / "run"), []
    for step in (10, 15):
        (folder / "eval" / str(step)).mkdir(parents=True, exist_ok=True)
    os.replace(folder / "checkpoints" / "20", tmp_path / "20")
    steps = Checkpoints.steps

    def steps_and_then_the_last(run):
        found = steps(run)
        if (tmp_path / "20").exists():
            os.replace(tmp_path / "20", folder / "checkpoints" / "20")
        return found

    def score(run, workdir, *, step, **_):
        scored.append(step)
        (folder / "eval" / str(step)).mkdir()

    monkeypatch.setattr(Checkpoints, "steps", steps_and_then_the_last)
    monkeypatch.setattr("jaxnerf.evaluation.evaluate.score_run", score)
    monkeypatch.setattr("jaxnerf.evaluation.evaluate.summary", str)
    watch(folder, lambda: restore_run(folder), poll_seconds=0.01)
    assert scored == [20]


def test_watching_ends_where_training_ended_by_max_seconds(trained, tmp_path):
    folder = shutil.copytree(trained, tmp_path / "run")
    text = (folder / "config.json").read_text()
    (folder / "config.json").write_text(
        text.replace('"max_steps": 20', '"max_steps": 1000').replace('"max_seconds": 0.0', '"max_seconds": 1e-3')
    )
    for step in (10, 15, 20):
        (folder / "eval" / str(step)).mkdir(parents=True)
    restore = functools.partial(restore_run, folder)
    thread = threading.Thread(target=watch, args=[folder, restore], kwargs={"poll_seconds": 0.05}, daemon=True)
    thread.start()
    thread.join(timeout=5)
    assert not thread.is_alive()


def test_the_reference_is_the_datasets_image_over_its_background():
    views = build.load_split(smoke_config(), "test")[0]
    pixels = views.pixels[576 : 2 * 576].reshape(24, 24, 4) / 65535
    expected = pixels[..., :3] * pixels[..., 3:] + 1 - pixels[..., 3:]
    np.testing.assert_allclose(views.image(1), expected, atol=1e-6)


@pytest.mark.parametrize(
    ("flags", "named"),
    [
        (("--watch", "--step=20"), "--watch does not use --step"),
        (("--watch", "--error_budget=0.1"), "--watch does not use --error_budget"),
        (("--predictions=images", "--chunk=100"), "--predictions does not use --chunk"),
        (("--predictions=images", "--nobake_occupancy"), "--predictions does not use --bake_occupancy"),
    ],
)
def test_flags_that_would_be_ignored_are_errors(flags, named):
    code, _, err = run_forked("eval", "--workdir=nowhere", *flags)
    assert named in err and code == 1
