"""A run that was stopped is whole, and its checkpoints give the model to others. Kills: test_faults.py."""

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
from jaxnerf.training import metric_log
from jaxnerf.training.checkpoint import Checkpoints
from runs import SMOKE_FLAGS, smoke_config, start

pytest_plugins = ["run_fixtures"]
pytestmark = pytest.mark.usefixtures("unoptimized")


def weights(folder, step):
    return jax.device_get(restore_run(folder).weights(step))


def logged_steps(folder):
    return [json.loads(line)["step"] for line in (folder / "metrics.jsonl").read_text().splitlines()]


def assert_equal(a, b):
    jax.tree.map(np.testing.assert_array_equal, a, b)


def wait_for_step(folder, process, step):
    """Returns when metrics.jsonl shows the step."""
    deadline = time.time() + 100
    while not any(row["step"] >= step for row in metric_log.read_rows(folder)):
        assert process.poll() is None, process.communicate()[1]
        assert time.time() < deadline
        time.sleep(0.01)


def long_run(folder):
    """Starts a run that does not end by itself."""
    flags = [*SMOKE_FLAGS, "--config.train.max_steps=1000000", "--config.train.log_every=1"]
    return start("train", f"--workdir={folder}", *flags)


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_a_signal_saves_and_leaves_in_peace(compiled_once, tmp_path, number):
    folder = tmp_path / "run"
    process = long_run(folder)
    wait_for_step(folder, process, 7)
    process.send_signal(number)
    _, err = process.communicate(timeout=60)
    assert process.returncode == 0
    assert "Traceback" not in err
    last = max(Checkpoints(folder).steps())
    assert logged_steps(folder) == list(range(1, last + 1))
    assert err.splitlines()[-1] == f"stopped at step {last} and saved; the same command goes on from there"


def test_the_last_few_checkpoints_are_kept(trained):
    assert Checkpoints(trained).steps() == [10, 15, 20]
    assert logged_steps(trained) == [5, 10, 15, 20]


def test_a_finished_run_is_left_as_it_is(trained, tmp_path, capsys):
    folder = shutil.copytree(trained, tmp_path / "run")
    before = weights(folder, 20)
    assert train_and_evaluate(smoke_config(), folder)
    assert "20 of 20 taken" in capsys.readouterr().err
    assert Checkpoints(folder).steps() == [10, 15, 20]
    assert logged_steps(folder) == [5, 10, 15, 20]
    assert_equal(weights(folder, 20), before)


def test_a_limit_of_seconds_is_not_passed_again_and_again(trained, tmp_path):
    folder = shutil.copytree(trained, tmp_path / "run")
    for _ in range(2):
        assert train_and_evaluate(smoke_config(max_steps=100, max_seconds=1e-3), folder)
    assert Checkpoints(folder).steps()[-1] == 20


def test_load_scene_gives_the_model_to_other_code(trained):
    scene, render = load_scene(trained)
    opened = restore_run(trained)
    views, weights = opened.experiment.load_views("test"), opened.weights(20)
    rays = opened.experiment.view_rays(views, 1, pixel_grid(24, 24))
    wanted = render_image(functools.partial(opened.render, weights), rays, chunk=250)
    assert_equal(render_image(render, rays, chunk=250), wanted)
    points = np.random.default_rng(0).normal(size=(5, 4, 3)).astype(np.float32)
    answer = jax.jit(scene)(points, points[:, :1])
    assert [value.shape for value in answer] == [(5, 4), (5, 4, 3)]
    assert_equal(answer, jax.jit(opened.experiment.model.scene(*weights))(points, points[:, :1]))


def test_another_checkpoint_compiles_nothing(trained):
    opened = restore_run(trained)
    rays = opened.experiment.view_rays(opened.experiment.load_views("test"), 0, pixel_grid(24, 24))
    images = [
        render_image(lambda rays, step=step: opened.render(opened.weights(step), rays), rays, chunk=250)
        for step in (10, 20)
    ]
    assert opened.render._cache_size() == 1
    assert np.abs(images[0].rgb - images[1].rgb).max() > 1e-4
