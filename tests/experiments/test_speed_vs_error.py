"""The study of speed against error: what it computes from its measurements."""

import jax
import jax.numpy as jnp
import pytest

from captures import orbit, shoot, write_transforms
from jaxnerf.core.sampling import inverse_cdf
from jaxnerf.fields.hash_grid import harmonics
from jaxnerf.tools.curve import measure
from jaxnerf.training import workdir
from jaxnerf.training.config import read_config
from studies import common, study

speed = study("speed/speed_vs_error")
training = study("speed/training")
step_parts = study("speed/step_parts")


def test_comparable_seconds_are_those_of_the_reference_machine():
    assert common.comparable(10.0, common.REFERENCE_GFLOPS) == 10.0
    assert common.comparable(10.0, 2 * common.REFERENCE_GFLOPS) == 20.0  # twice as fast, so twice the work


def test_a_curve_has_medians_where_all_seeds_were_scored():
    run = lambda *scores: [{"time_limit": time_limit, "psnr": psnr} for time_limit, psnr in scores]  # noqa: E731
    runs = {"0": run((1, 20.0), (2, 25.0)), "1": run((1, 22.0)), "2": run((1, 27.0), (2, 21.0))}
    (point,) = training.medians(runs)
    assert point["psnr"] == 22.0 and point["seeds"] == [20.0, 22.0, 27.0]


@pytest.mark.parametrize("step, ended", [(5, False), (7, True)])
def test_a_curve_ends_where_its_run_does_if_max_steps_is_inferred(monkeypatch, tmp_path, step, ended):
    config = training.configuration("fox")
    assert config.train.max_steps == "auto"

    def train(config, where):
        workdir.save_config(where, read_config(common.changed(config, {"train.max_steps": 7})))
        return True

    names = ("psnr", "ssim", "seconds_per_frame", "views", "parameters", "rays_seen", "compile_seconds")
    scores = {**dict.fromkeys(names, 1.0), "step": step, "training_seconds": 2.0}
    monkeypatch.setattr(measure, "train_and_evaluate", train)
    monkeypatch.setattr(measure, "restore_run", lambda where: None)
    monkeypatch.setattr(measure, "score_run", lambda run, where, overwrite: scores)
    monkeypatch.setattr(measure.machine, "matrix_gflops", lambda: 2 * common.REFERENCE_GFLOPS)
    point = measure.run_to(3, config, tmp_path)
    assert (point["ended"], point["seconds"], point["comparable"]) == (ended, 2.0, 4.0)


def test_views_of_a_config_with_fields_to_infer_are_read_once(tmp_path):
    write_transforms(tmp_path, shoot(orbit(4)))
    config = common.configuration("capture", {"data.dir": str(tmp_path)})
    views = common.load_split(config, "train")
    assert config.data.factor == "auto" and len(views.names) == 3  # the fourth is a test view
    assert common.load_split(config, "train") is views
    assert common.load_split(config, "test").names != views.names
    for width in range(common._MOST_SPLITS):
        common.load_split(common.changed(config, {"data.width": 100 + width}), "test")
    assert common.load_split(config, "train") is not views


def test_an_operation_is_charged_until_the_next_one_starts():
    events = [
        {"name": "loop", "ph": "X", "tid": 1, "ts": 0, "dur": 10},
        {"name": "add", "ph": "X", "tid": 1, "ts": 1, "dur": 3},
        {"name": "inside", "ph": "X", "tid": 1, "ts": 2, "dur": 1},
        {"name": "add", "ph": "X", "tid": 2, "ts": 5, "dur": 4},
        {"name": "not an operation", "ph": "X", "tid": 1, "ts": 5, "dur": 1},
        {"name": "loop", "ph": "M", "tid": 1},
    ]
    found = step_parts.wall_times(events, {"loop", "add", "inside"})
    assert found == [("loop", 1), ("add", 1), ("inside", 3), ("add", 5)]
    assert step_parts.wall_times([], {"loop"}) == []


def test_the_compiler_says_which_function_an_operation_comes_from():
    text = jax.jit(harmonics).lower(jnp.ones((4, 3))).compile().as_text()
    assert set(step_parts.parts_of_operations(text).values()) >= {"networks"}
    text = jax.jit(inverse_cdf).lower(jnp.linspace(0, 1, 5), jnp.ones(4), jnp.linspace(0, 1, 3)).compile().as_text()
    assert set(step_parts.parts_of_operations(text).values()) >= {"compositing and losses"}


def test_the_serial_part_follows_from_the_gain_of_more_cores():
    cores = study("speed/cores")
    assert cores.serial_fraction(2.0, 2) == 0.0 and cores.serial_fraction(0.9, 2) == 1.0
    assert cores.serial_fraction(1 / (0.4 + 0.6 / 8), 8) == pytest.approx(0.4)
    results = lambda ms, part: [{"ms": ms, "parts": {"networks": part}}]  # noqa: E731
    lines = cores.parts_table({"lego": {1: results(10.0, 8.0), 2: results(6.0, 4.0)}})
    assert lines[2:] == ["| whole step | 10.0, 6.0 (20%) |", "| networks | 8.0, 4.0 (0%) |"]
    run = {"ms_per_step": 10.0, "rays_per_second": 1e5, "frame": 0.5, "setup": 4.0, "psnr": 30.0}
    faster = {"ms_per_step": 5.0, "rays_per_second": 2e5, "frame": 0.25, "setup": 2.0, "psnr": 29.5}
    row = "| lego | 10.0, 5.0 (2.00) | 100,000, 200,000 (2.00) | 0.50, 0.25 (2.00) | 4.00, 2.00 (2.00) | 30.00, 29.50 |"
    assert cores.runs_table({"lego": {1: [run], 2: [faster]}})[2:] == [row]
    short = cores.short_table({"lego_100": {1: [run], 2: [faster]}})
    assert short[2:] == ["| lego, 100 px | 100, 200 (2.00) | 2.0, 4.0 (2.00) |"]
    half = {"ms_per_step": 7.5, "frame": 0.5, "setup": 2.0}  # of a step half is serial
    parts = {"lego": {1: results(10.0, 8.0), 2: results(6.0, 4.0)}}
    lines = cores.predictions_table({"lego": {1: [run], 2: [half]}}, parts)
    cells = ["50%: 1.6, 1.8, 1.9", "0%: 4.0, 8.0, 16.0", "100%: 1.0, 1.0, 1.0", "0%: 4.0, 8.0, 16.0"]
    assert lines[2:] == [f"| lego | {' | '.join(cells)} |"]
    beside = cores.beside_table({"lego": [{"alone": 1e5, "all": 9e4, "halves": 1.1e5}]})
    assert beside[2:] == ["| lego | 100,000 | 90,000 | 110,000 |"]
