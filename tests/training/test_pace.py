"""The learning rate of a run of limited time."""

from types import SimpleNamespace

import jax
import numpy as np
import pytest

from jaxnerf.training.loop import _Pace
from jaxnerf.training.step import TrainData


@pytest.mark.parametrize("seconds, step, exponent", [(0, 1, 0), (5, 1, 0.0625), (5, 51, 0.5), (10, 1, 1), (20, 201, 1)])
def test_it_reaches_its_end_when_the_time_or_the_steps_do(seconds, step, exponent):
    options = SimpleNamespace(lr_init=1e-2, lr_final=1e-4, lr_steps=100, max_seconds=10.0)
    data = TrainData(None, None, None, None, lr_scale=jax.device_put(np.float32(1)))
    pace = _Pace(SimpleNamespace(train=options), SimpleNamespace(seconds=lambda: seconds), data)
    scale = float(pace.data_of(step).lr_scale)
    by_steps = 0.01 ** min((step - 1) / 100, 1)  # what the schedule of the optimizer does itself
    assert scale * by_steps == pytest.approx(0.01**exponent, rel=1e-5)


def test_without_a_limit_nothing_changes():
    data = TrainData(None, None, None, None)
    pace = _Pace(SimpleNamespace(train=None), None, data)
    assert pace.data_of(7) is data and pace.scale == 1.0
