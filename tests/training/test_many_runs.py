"""Runs that train one after the other in one program."""

import jax
import numpy as np
import pytest

import captures
import jaxnerf
from jaxnerf.evaluation import evaluate
from jaxnerf.evaluation.restore import restore_run
from jaxnerf.training import metric_log
from jaxnerf.training.checkpoint import Checkpoints
from runs import PACKED, smoke_config

pytest_plugins = ["run_fixtures"]
pytestmark = pytest.mark.usefixtures("unoptimized")


@pytest.fixture
def compiled_steps(monkeypatch):
    """The programs of training steps that are compiled."""
    compile_lowered, programs = jax.stages.Lowered.compile, []

    def compile_and_count(lowered, *args, **options):
        programs.append(lowered.as_text())
        return compile_lowered(lowered, *args, **options)

    monkeypatch.setattr(jax.stages.Lowered, "compile", compile_and_count)
    return programs


def config_of(seed=0, **train):
    config = smoke_config(**{"max_steps": 5, **train})
    config.update_from_flattened_dict(PACKED)
    config.seed, config.eval.at_end = seed, False
    return config


def difference(folder, other, step=5):
    """Returns the largest difference of two runs' parameters and grids."""
    a, b = (jax.device_get(restore_run(each).variables(step)) for each in (folder, other))
    return max(jax.tree.leaves(jax.tree.map(lambda a, b: np.abs(np.float32(a) - np.float32(b)).max(), a, b)))


@pytest.mark.slow
def test_seeds_have_one_compiled_step_and_each_run_ends_as_it_does_alone(tmp_path, compiled_steps, monkeypatch):
    loaded, load_split = [], evaluate.load_split
    monkeypatch.setattr(evaluate, "load_split", lambda *args: loaded.append(args) or load_split(*args))
    folders = [tmp_path / "a", tmp_path / "b"]
    assert jaxnerf.train_many([config_of(seed) for seed in (3, 5)], folders)
    assert len(compiled_steps) == len(loaded) == 1
    assert jaxnerf.train_and_evaluate(config_of(5), tmp_path / "alone")
    assert difference(folders[1], tmp_path / "alone") == 0
    assert difference(folders[0], tmp_path / "alone") > 0.01
    assert [metric_log.read_rows(folder)[-1]["step"] for folder in folders] == [5, 5]


@pytest.mark.slow
def test_datasets_of_the_same_shapes_have_one_compiled_step_and_other_options_another(tmp_path, compiled_steps):
    def scene(name, **train):
        captures.write_transforms(tmp_path / name, captures.noise(captures.orbit(6, height=8, width=8), seed=len(name)))
        config = config_of(**train)
        fields = {"lower": (-1.0,) * 3, "upper": (1.0,) * 3, "use_alpha": False, "contracted": False}
        config.update_from_flattened_dict({f"scene.{name}": value for name, value in fields.items()})
        config.data.format, config.data.dir, config.data.world = "transforms", str(tmp_path / name), "file"
        return config

    configs = [scene("a"), scene("bb"), scene("bb", warmup_steps=2)]
    folders = [tmp_path / f"run{index}" for index in range(3)]
    assert jaxnerf.train_many(configs, folders)
    assert len(compiled_steps) == 2
    assert jaxnerf.train_and_evaluate(configs[1], tmp_path / "alone")
    assert difference(folders[1], tmp_path / "alone") == 0
    assert difference(folders[0], tmp_path / "alone") > 0
    assert difference(folders[2], tmp_path / "alone") > 0


@pytest.mark.slow
def test_a_stopped_run_is_the_last_and_the_same_call_continues(tmp_path, monkeypatch, capsys):
    configs, folders = [config_of(seed) for seed in range(2)], [tmp_path / "a", tmp_path / "b"]
    train = evaluate.train
    with monkeypatch.context() as patched:
        patched.setattr(evaluate, "train", lambda *args, **options: train(*args, **options) and False)
        assert not jaxnerf.train_many(configs, folders)
    assert Checkpoints(folders[0]).steps() == [5] and not folders[1].exists()
    capsys.readouterr()
    assert jaxnerf.train_many(configs, folders)
    assert "5 of 5 done" in capsys.readouterr().err
    assert Checkpoints(folders[1]).steps() == [5]


def test_each_run_needs_a_workdir_of_its_own(tmp_path):
    with pytest.raises(ValueError, match="3 configs and 2 workdirs"):
        jaxnerf.train_many([config_of()] * 3, [tmp_path / "a", tmp_path / "b"])
    with pytest.raises(ValueError, match="two are the same"):
        jaxnerf.train_many([config_of()] * 2, [tmp_path / "a", tmp_path / "a"])
    assert not list(tmp_path.iterdir())
