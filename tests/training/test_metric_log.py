"""Rows of metrics, and the lines that a run prints."""

import io
import types

import numpy as np
import pytest

from jaxnerf.training import metric_log

STEP = {
    "loss": 0.5,
    "mse": 0.01,
    "mse_coarse": 0.1,
    "grad_norm": 1.0,
    "nonfinite": 0,
    "nonfinite_in_a_row": 0,
    "num_reinits": 0,
}
TRAIN = types.SimpleNamespace(batch_size=64, max_steps=100, max_seconds=0.0)
EXPERIMENT = types.SimpleNamespace(train=TRAIN, schedule=lambda step: 1e-3 * step)


def row(steps, step=20):
    return metric_log.row(
        EXPERIMENT, step, [STEP | each for each in steps], seconds=5.0, rate=lambda rays: 100.0, compile_seconds=1.0
    )


def test_row_averages_errors_and_keeps_the_last_counters():
    found = row([{"loss": 1.0, "dead_fine": 3}])
    assert (found["loss"], found["dead_fine"], found["rays"]) == (1.0, 3, 20 * 64)
    found = row([{"mse": 0.01, "nonfinite": 1}, {"mse": 0.03, "nonfinite": 2}])
    assert found["psnr_fine"] == pytest.approx(-10 * np.log10(0.02)) and found["nonfinite"] == 2
    assert found["lr"] == pytest.approx(19e-3) and not any(name.startswith("loss_") for name in found)


def test_row_holds_each_loss_where_there_are_several():
    found = row([{"loss_mse": 0.1, "loss_distortion": 1.0}, {"loss_mse": 0.3, "loss_distortion": 3.0}])
    assert found["loss_mse"] == pytest.approx(0.2) and found["loss_distortion"] == pytest.approx(2.0)


def test_line_reports_what_went_wrong():
    plain = metric_log.line(row([{}]), TRAIN, out_of_time=False)
    assert plain == "20.00 dB  100 rays/s  0:05 elapsed, 0:51 left"
    steps = [{"rays_dropped": 320, "nonfinite": 3, "dead_fine": 150, "dead_coarse": 0, "num_reinits": 2}]
    line = metric_log.line(row(steps), TRAIN, out_of_time=True)
    assert line.endswith(
        "0:00 left  3 nonfinite steps  25% of rays dropped  fine network dead  2 networks reinitialized"
    )


def dropped(*counts):
    """Returns rows of 10 steps of 64 rays each, with so many dropped in total."""
    return [{"step": 10 * index, "rays_dropped": count} for index, count in enumerate(counts, 1)]


def test_a_full_sample_buffer_is_reported_once_and_names_the_setting():
    experiment = types.SimpleNamespace(train=TRAIN, model=types.SimpleNamespace(samples_per_ray=10.0))
    rows = dropped(320, 640, 700, 828, 956, 1084, 1212)  # 50, 50, 9, 20, 20, 20, 20 %
    said = [metric_log.warnings(rows[:count], experiment) for count in range(1, len(rows) + 1)]
    assert [len(lines) for lines in said] == [0, 0, 0, 0, 0, 1, 0]
    assert said[5][0].startswith("warning       20% of rays are dropped, as their samples do not fit")
    assert "--config.occupancy.pool_samples_per_ray to 15 or more (now 10)" in said[5][0]
    assert metric_log.warnings([{"step": 10}, {"step": 20}, {"step": 30}], experiment) == []


def test_a_note_is_a_line_above_the_bar():
    class Terminal(io.StringIO):
        def isatty(self):
            return True

    for stream, expected in ((Terminal(), "\r\033[Ka\n\r\033[Kb\n"), (io.StringIO(), "a\nb\n")):
        metric_log.Progress(10, stream).note("a", "b")
        assert stream.getvalue() == expected
        metric_log.Progress(10, stream, show=False).note("c")
        assert stream.getvalue() == expected
