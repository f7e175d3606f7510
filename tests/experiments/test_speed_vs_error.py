"""What the study of speed against error computes from its measurements."""

import math
import pathlib
import sys

import numpy as np
import pytest

sys.path.insert(0, str(pathlib.Path(__file__).resolve().parents[2] / "experiments"))

import speed_figures
import speed_machine
import speed_training

from jaxnerf.training import workdir


def test_the_front_holds_what_no_other_point_beats():
    points = [(3.0, 1.0), (1.0, 2.0), (2.0, 2.0), (4.0, 5.0), (1.0, 1.0), (5.0, 4.0)]
    assert speed_figures.pareto_front(points) == [(1.0, 2.0), (4.0, 5.0)]
    assert speed_figures.pareto_front([]) == []


def test_a_point_is_on_the_front_or_is_beaten_by_one_that_is():
    points = [tuple(pair) for pair in np.random.default_rng(0).uniform(size=(200, 2)).tolist()]
    front = speed_figures.pareto_front(points)
    assert front == sorted(front) and front == sorted(front, key=lambda point: point[1])
    for cost, value in points:
        assert any(a <= cost and b >= value for a, b in front)


def test_comparable_seconds_are_those_of_the_reference_machine():
    assert speed_machine.comparable(10.0, speed_machine.REFERENCE) == 10.0
    assert speed_machine.comparable(10.0, 2 * speed_machine.REFERENCE) == 20.0  # twice as fast, so twice the work


def test_a_bar_is_reached_at_the_first_score_above_it():
    points = [{"seconds": 2.0, "psnr": 30.0}, {"seconds": 1.0, "psnr": 28.0}, {"seconds": 3.0, "psnr": 29.9}]
    assert speed_figures.first_reached(points, 29.0) == 2.0
    assert math.isinf(speed_figures.first_reached(points, 31.0))


def test_a_curve_of_seeds_has_medians_where_all_were_scored():
    run = lambda *scores: [{"stop": stop, "psnr": psnr} for stop, psnr in scores]  # noqa: E731
    runs = {"0": run((1, 20.0), (2, 25.0)), "1": run((1, 22.0)), "2": run((1, 27.0), (2, 21.0))}
    (point,) = speed_figures.medians(runs)
    assert point["psnr"] == 22.0 and point["seeds"] == [20.0, 22.0, 27.0]


@pytest.mark.parametrize("power", [0.0, 1.0, 2.0])
def test_the_slope_is_the_power(power):
    values = [1.0, 2.0, 4.0]
    assert speed_figures.slope(values, [3 * value**power for value in values]) == pytest.approx(power, abs=1e-9)


@pytest.mark.parametrize("step, ended", [(5, False), (7, True)])
def test_a_curve_ends_where_its_run_does_even_if_the_images_say_where(monkeypatch, tmp_path, step, ended):
    config = speed_training.configuration("grid 200")
    assert config.train.max_steps == 0

    def train(config, where):
        config = config.copy_and_resolve_references()
        config.train.max_steps = 7
        workdir.claim(where, config)
        return True

    names = ("psnr", "ssim", "seconds_per_frame", "views", "parameters", "rays_seen", "compile_seconds")
    scores = {**dict.fromkeys(names, 1.0), "step": step, "training_seconds": 2.0}
    monkeypatch.setattr(speed_training, "train_and_evaluate", train)
    monkeypatch.setattr(speed_training, "evaluate", lambda where, overwrite: scores)
    monkeypatch.setattr(speed_machine, "matrix_gflops", lambda: 2 * speed_machine.REFERENCE)
    point = speed_training.run_to(3, config, tmp_path, None)
    assert (point["ended"], point["seconds"], point["comparable"]) == (ended, 2.0, 4.0)
