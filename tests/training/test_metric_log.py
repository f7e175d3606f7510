"""Rows of metrics, and the lines that a run prints."""

import types

import numpy as np
import pytest

from jaxnerf.runtime import stages
from jaxnerf.training import metric_log
from jaxnerf.training.options import UNLIMITED_STEPS, TrainOptions
from jaxnerf.training.pace import Clock, Pace

STEP = {
    "loss": 0.5,
    "mse_fine": 0.01,
    "mse_coarse": 0.1,
    "grad_norm": 1.0,
    "nonfinite": 0,
    "nonfinite_in_a_row": 0,
    "num_reinits": 0,
}
TRAIN = types.SimpleNamespace(batch_size=64, max_steps=100, max_seconds=0.0)
EXPERIMENT = types.SimpleNamespace(
    config=types.SimpleNamespace(train=TRAIN),
    model=types.SimpleNamespace(image_networks=("coarse", "fine")),
    schedule=lambda step: 1e-3 * step,
)


class StoppedClock(Clock):
    def seconds(self):
        return 5.0

    def rate(self, rays):
        return 100.0


def row(steps, step=20):
    clock = StoppedClock(5.0, 0)
    pace = Pace(TrainOptions(), clock, None)
    return metric_log.row(EXPERIMENT, step, [STEP | each for each in steps], clock, pace, 1.0)


def test_row_averages_errors_and_keeps_the_last_counters():
    found = row([{"loss": 1.0, "dead_fine": 3}])
    assert (found["loss"], found["dead_fine"], found["rays"]) == (1.0, 3, 20 * 64)
    found = row([{"mse_fine": 0.01, "nonfinite": 1}, {"mse_fine": 0.03, "nonfinite": 2}])
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


@pytest.mark.parametrize("max_steps, shown, done", [(100, "20/100  text\n", 0.5), (UNLIMITED_STEPS, "20  text\n", 0.5)])
def test_progress_of_a_run_of_limited_time(max_steps, shown, done, capsys):
    """Its part is that of the time, and the number of steps is shown only if it may end the run."""
    train = types.SimpleNamespace(batch_size=64, max_steps=max_steps, max_seconds=10.0)
    with stages.Progress("training", metric_log.all_steps(train)) as progress:
        progress.show(20, "text", 0.5)
    assert capsys.readouterr().err == shown
    assert metric_log.fraction_done(row([{}]), train) == done
    assert metric_log.of_all(20, train) == ("20 of 100" if max_steps == 100 else "20")


@pytest.mark.parametrize(
    ("seconds", "shown"),
    [
        (110.0, "0.6 over 50,000 pixels at this pace; images 109 px wide would be read twice"),
        (210.0, "1.1 over 50,000"),
    ],
)
def test_passes_follow_from_the_pace_and_the_time_that_is_left(seconds, shown):
    size = np.array([[100, 200], [150, 200]])
    at = {"step": 50, "rays": 5_000, "seconds": 10.0, "rays_per_second": 250.0}
    options = TrainOptions(max_steps=UNLIMITED_STEPS, max_seconds=seconds, batch_size=100)
    assert shown in metric_log.passes(at, options, size)
