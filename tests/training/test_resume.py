"""Stopped runs resume, and checkpoints restore the model for other code. test_faults.py kills runs."""

import functools
import json
import shutil
import signal
import time

import jax
import numpy as np
import pytest

from jaxnerf import load_scene, pixel_grid, render_image
from jaxnerf.evaluation.evaluate import train_and_evaluate
from jaxnerf.evaluation.restore import restore_run
from jaxnerf.options import AUTO, Changes, values_of
from jaxnerf.training import earlier_options, loop, metric_log, workdir
from jaxnerf.training.checkpoint import Checkpoints
from jaxnerf.training.config import read_config, to_config_dict
from jaxnerf.training.earlier_options import Gone
from jaxnerf.training.options import UNLIMITED_STEPS
from runs import SMOKE_FLAGS, run_forked, smoke_config, start

pytest_plugins = ["run_fixtures"]
pytestmark = pytest.mark.usefixtures("unoptimized")


def variables(folder, step):
    return jax.device_get(restore_run(folder).variables(step))


def logged_steps(folder):
    return [json.loads(line)["step"] for line in (folder / "metrics.jsonl").read_text().splitlines()]


def assert_equal(a, b):
    jax.tree.map(np.testing.assert_array_equal, a, b)


def wait_for_step(folder, process, step):
    """Waits until metrics.jsonl holds the step."""
    deadline = time.time() + 100
    while not any(row["step"] >= step for row in metric_log.read_rows(folder)):
        assert process.poll() is None, process.communicate()[1]
        assert time.time() < deadline
        time.sleep(0.01)


def long_run(folder):
    """Starts a run that only a signal ends."""
    flags = [*SMOKE_FLAGS, "--config.train.max_steps=1000000", "--config.train.log_every=1"]
    return start("train", f"--workdir={folder}", *flags)


@pytest.mark.parametrize("number", [signal.SIGTERM, pytest.param(signal.SIGINT, marks=pytest.mark.extra)])
def test_signal_saves_and_exits_with_0(compiled_once, tmp_path, number):
    folder = tmp_path / "run"
    process = long_run(folder)
    wait_for_step(folder, process, 7)
    process.send_signal(number)
    _, err = process.communicate(timeout=60)
    assert process.returncode == 0
    assert "Traceback" not in err
    last = max(Checkpoints(folder).steps())
    assert logged_steps(folder) == list(range(1, last + 1))
    assert err.splitlines()[-1] == f"stopped at step {last} and saved; the same command continues from there"


def test_last_checkpoints_are_kept(trained):
    assert Checkpoints(trained).steps() == [10, 15, 20]
    assert logged_steps(trained) == [5, 10, 15, 20]


def test_finished_run_does_not_change_and_is_not_compiled(trained, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(loop, "compile_training", None)
    folder = shutil.copytree(trained, tmp_path / "run")
    before = variables(folder, 20)
    assert train_and_evaluate(smoke_config(), folder)
    assert "20 of 20 done, so training is complete\n" in capsys.readouterr().err
    assert Checkpoints(folder).steps() == [10, 15, 20]
    assert logged_steps(folder) == [5, 10, 15, 20]
    assert_equal(variables(folder, 20), before)


def test_a_run_resumes_from_its_workdir_alone(trained, tmp_path):
    folder = shutil.copytree(trained, tmp_path / "run")
    for step in (15, 20):
        shutil.rmtree(folder / "checkpoints" / str(step))
    assert train_and_evaluate(workdir.load_config(folder), folder)
    assert Checkpoints(folder).steps() == [10, 15, 20]
    assert_equal(variables(folder, 20), variables(trained, 20))


@pytest.mark.slow
def test_the_program_resumes_with_flags_and_rejects_an_empty_workdir(trained, tmp_path):
    folder = shutil.copytree(trained, tmp_path / "run")
    code, _, err = run_forked("train", f"--workdir={folder}", "--config.train.max_steps=25")
    assert code == 0 and "20 of 25 done" in err and Checkpoints(folder).steps()[-1] == 25, err
    code, _, err = run_forked("train", f"--workdir={tmp_path / 'none'}")
    assert code == 1 and err.count("\n") == 1 and "holds no config.json, so there is no run to resume" in err
    code, _, err = run_forked("train", f"--workdir={tmp_path / 'none'}", "--config.train.max_steps=25")
    assert code == 2 and err.count("\n") == 1 and "give --config=NAME" in err


def test_a_config_to_resume_has_the_types_of_its_fields(trained, tmp_path):
    saved = json.loads((trained / "config.json").read_text())
    del saved["train"]["max_reinits"]  # as a version without this option would have saved it
    (tmp_path / "config.json").write_text(json.dumps(saved))
    config = to_config_dict(workdir.load_config(tmp_path))
    assert config.train.max_reinits == 10 and config.train.max_steps == 20
    workdir.save_config(tmp_path, workdir.load_config(tmp_path))  # finished steps do not depend on this field
    config.hash_grid.resolutions = "auto"
    config.train.lr_init = 1
    with pytest.raises(TypeError):
        config.train.max_steps = 1.5


@pytest.fixture
def earlier(trained, tmp_path, monkeypatch):
    """A function that writes the config.json of the previous release, with two options that it had, and reads it."""
    gone = {
        "occupancy.margin": Gone((0.0,), Changes.TRAINING, "use that version"),
        "eval.fog": Gone((1.0,), Changes.IMAGES, "give --fog"),
    }
    monkeypatch.setattr(earlier_options, "GONE", gone)
    monkeypatch.setattr(earlier_options, "RENAMED", {"train.rate": ("train.lr_init", 5e-4)})

    def load(margin=0.0, fog=1.0):
        saved = json.loads((trained / "config.json").read_text())
        saved["train"]["rate"] = saved["train"].pop("lr_init")
        saved["occupancy"]["margin"], saved["eval"]["fog"] = margin, fog
        (tmp_path / "config.json").write_text(json.dumps(saved))
        return workdir.load_config(tmp_path)

    return load


def test_a_run_of_the_previous_release_is_resumed(earlier, trained, tmp_path):
    config = earlier()
    assert config == workdir.load_config(trained)
    workdir.save_config(tmp_path, config)
    assert (tmp_path / "config.json").read_text() == (trained / "config.json").read_text()


def test_a_run_that_used_an_option_that_is_gone_is_reported(earlier, tmp_path):
    config = earlier(margin=0.2)  # on which training depended, but no image does
    with pytest.raises(ValueError, match="another version, whose occupancy.margin is 0.2, but .*; use that version"):
        workdir.save_config(tmp_path, config)
    with pytest.raises(ValueError, match="eval.fog is 0.5, but the option no longer exists; give --fog"):
        earlier(fog=0.5)
    content = {**config.to_dict(), "occupancy": {**values_of(config.occupancy), "margin": 0.2}}
    with pytest.raises(ValueError, match="--config.occupancy.margin is 0.2, but the option no longer exists"):
        read_config(content)


@pytest.mark.parametrize("refine", [False, True])
def test_a_run_from_before_refined_cameras_turned_about_what_they_look_at(trained, tmp_path, refine):
    saved = json.loads((trained / "config.json").read_text())
    saved["cameras"]["refine"] = refine
    del saved["cameras"]["refine_focal"]
    (tmp_path / "config.json").write_text(json.dumps(saved))
    if refine:
        with pytest.raises(ValueError, match="refine_focal is missing, so the run turned each camera about itself"):
            workdir.load_config(tmp_path)
    else:
        assert workdir.load_config(tmp_path) == workdir.load_config(trained)


@pytest.mark.slow
def test_resumed_run_does_not_exceed_its_limit_of_seconds(trained, tmp_path):
    folder = shutil.copytree(trained, tmp_path / "run")
    assert train_and_evaluate(smoke_config(max_steps=100, max_seconds=1e-3), folder)
    assert Checkpoints(folder).steps()[-1] == 20


@pytest.mark.slow
def test_a_run_that_only_its_time_ends_can_be_trained_longer(tmp_path):
    ends = []
    for seconds in (0.05, 0.3):
        config = smoke_config(max_seconds=seconds, save_every=10**6)
        config.train.max_steps = config.train.lr_steps = AUTO
        assert train_and_evaluate(config, tmp_path)
        ends.append(Checkpoints(tmp_path).steps()[-1])
    assert 0 < ends[0] < ends[1] < UNLIMITED_STEPS
    saved = json.loads((tmp_path / "config.json").read_text())["train"]
    assert saved["max_steps"] == saved["lr_steps"] == UNLIMITED_STEPS
    with pytest.raises(ValueError, match="--config.train.max_steps is 10,000,000, .* set a time"):
        train_and_evaluate(smoke_config(max_steps=UNLIMITED_STEPS, lr_steps=UNLIMITED_STEPS, max_seconds=0.0), tmp_path)


def test_load_scene_restores_the_model(trained):
    scene, render = load_scene(trained)
    run = restore_run(trained)
    views, variables = run.experiment.load_split("test"), run.variables(20)
    rays = run.experiment.view_rays(views, 1, pixel_grid(24, 24))
    expected = render_image(functools.partial(run.render, variables), rays, chunk=250)
    assert_equal(render_image(render, rays, chunk=250), expected)
    points = np.random.default_rng(0).normal(size=(5, 4, 3)).astype(np.float32)
    output = jax.jit(scene)(points, points[:, :1])
    assert [value.shape for value in output] == [(5, 4), (5, 4, 3)]
    assert_equal(output, jax.jit(run.experiment.model.scene(*variables))(points, points[:, :1]))


def test_second_checkpoint_compiles_nothing(trained):
    run = restore_run(trained)
    rays = run.experiment.view_rays(run.experiment.load_split("test"), 0, pixel_grid(24, 24))
    images = [
        render_image(lambda rays, step=step: run.render(run.variables(step), rays), rays, chunk=250)
        for step in (10, 20)
    ]
    assert run.render._cache_size() == 1
    assert np.abs(images[0].rgb - images[1].rgb).max() > 1e-4
