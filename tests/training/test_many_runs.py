"""Runs that train together end as each of them alone does."""

import jax
import numpy as np
import pytest

import captures
import jaxnerf
from jaxnerf.evaluation.restore import restore_run
from jaxnerf.training import many_runs, metric_log
from runs import PACKED, smoke_config

pytest_plugins = ["run_fixtures"]
pytestmark = pytest.mark.usefixtures("unoptimized")


def config_of(kind, seed, **train):
    config = smoke_config(**train)
    config.seed = seed
    config.eval.at_end = False
    if kind == "packed":
        config.update_from_flattened_dict(PACKED)
    return config


def variables(folder, step):
    return jax.device_get(restore_run(folder).variables(step))


def difference(a, b):
    """Returns the largest difference of two trees' leaves."""
    apart = jax.tree.map(lambda a, b: np.abs(np.float32(a) - np.float32(b)).max(), a, b)
    return max(jax.tree.leaves(apart))


@pytest.mark.parametrize(
    ("kind", "vmapped"),
    [
        pytest.param("packed", False, marks=pytest.mark.slow),
        pytest.param("packed", True, marks=pytest.mark.slow),
        pytest.param("paper", True, marks=pytest.mark.extra),
    ],
)
def test_each_run_ends_as_it_does_alone(kind, vmapped, tmp_path, monkeypatch):
    monkeypatch.setattr(many_runs, "runs_in_turn", lambda: not vmapped)
    train = {"max_steps": 10, "log_every": 5}
    folders = [tmp_path / "a", tmp_path / "b"]
    assert jaxnerf.train_many([config_of(kind, seed, **train) for seed in (3, 5)], folders)
    assert jaxnerf.train_and_evaluate(config_of(kind, 5, **train), tmp_path / "alone")
    alone = variables(tmp_path / "alone", 10)
    assert difference(variables(folders[1], 10), alone) <= (2e-4 if vmapped else 0)
    assert difference(variables(folders[0], 10), alone) > 0.01
    rows, expected = (metric_log.read_rows(folder) for folder in (folders[1], tmp_path / "alone"))
    assert [row["step"] for row in rows] == [5, 10]
    for row, same in zip(rows, expected, strict=True):
        np.testing.assert_allclose(row["loss"], same["loss"], rtol=1e-5 if vmapped else 0)
        assert row["rays"] == same["rays"] and row.keys() == same.keys()


@pytest.mark.extra
def test_runs_resume_from_the_newest_step_of_all(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(many_runs, "runs_in_turn", lambda: True)
    folders = [tmp_path / "a", tmp_path / "b"]

    def train(max_steps):
        return jaxnerf.train_many([config_of("paper", seed, max_steps=max_steps) for seed in (3, 5)], folders)

    assert train(10)
    assert jaxnerf.train_and_evaluate(config_of("paper", 3, max_steps=15), folders[0])  # one is ahead
    ahead = variables(folders[0], 15)
    assert train(15)
    assert "10 of 15 done" in capsys.readouterr().err
    assert difference(variables(folders[0], 15), ahead) == 0
    assert jaxnerf.train_and_evaluate(config_of("paper", 5, max_steps=15), tmp_path / "alone")
    assert difference(variables(folders[1], 15), variables(tmp_path / "alone", 15)) == 0
    assert [row["step"] for row in metric_log.read_rows(folders[0])] == [5, 10, 15]


def scene_config(folder, seed):
    """Returns the config of a dataset of noise, whose box is given as it would differ otherwise."""
    captures.write_transforms(folder, captures.noise(captures.orbit(6, height=8, width=8), seed=seed))
    config = config_of("packed", 0, max_steps=5)
    fields = {"lower": (-1.0,) * 3, "upper": (1.0,) * 3, "use_alpha": False, "contracted": False}
    config.update_from_flattened_dict({f"occupancy.{name}": value for name, value in fields.items()})
    config.data.format, config.data.dir, config.data.world = "transforms", str(folder), "file"
    return config


@pytest.mark.extra
def test_runs_of_several_scenes_end_as_each_does_alone(tmp_path):
    configs = [scene_config(tmp_path / f"scene{index}", index) for index in range(2)]
    assert jaxnerf.train_many(configs, [tmp_path / "a", tmp_path / "b"])
    assert jaxnerf.train_and_evaluate(configs[1], tmp_path / "alone")
    alone = variables(tmp_path / "alone", 5)
    assert difference(variables(tmp_path / "b", 5), alone) == 0
    assert difference(variables(tmp_path / "a", 5), alone) > 0


def test_what_does_not_fit_into_one_program_is_named(tmp_path):
    def train(changed, folders=("a", "b"), count=2):
        configs = [config_of("paper", seed) for seed in range(count)]
        configs[-1].update_from_flattened_dict(changed)
        jaxnerf.train_many(configs, [tmp_path / name for name in folders])

    with pytest.raises(ValueError, match=r"b: train.lr_init is 0.5, expected .* as in the first run"):
        train({"train.lr_init": 0.5})
    with pytest.raises(ValueError, match="two are the same"):
        train({}, ("a", "a"))
    with pytest.raises(ValueError, match="3 configs and 2 workdirs"):
        train({}, count=3)
    assert not list(tmp_path.iterdir())


def test_data_of_other_shapes_is_named():
    views = {"views": np.zeros(3)}
    with pytest.raises(
        ValueError, match=r"second: \['views'\] of its data has the shape \(4,\), expected \(3,\) as in"
    ):
        many_runs.stack_data([views, {"views": np.zeros(4)}], ["first", "second"])
    with pytest.raises(ValueError, match="has the shape None"):
        many_runs.stack_data([views, {"views": None}], ["first", "second"])


def test_only_what_differs_is_stacked():
    shared = np.arange(3)
    data = [{"pixels": shared, "seed": np.uint32(seed), "steps": np.float32(9)} for seed in (1, 2)]
    stacked, own = many_runs.stack_data(data, ["first", "second"])
    assert own == [False, True, False]
    assert stacked["pixels"] is shared and stacked["seed"].tolist() == [1, 2] and stacked["steps"] == 9
