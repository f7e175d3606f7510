"""The learning rate of a run of limited time."""

from types import SimpleNamespace

import jax
import numpy as np
import pytest

from jaxnerf.training.loop import _Pace
from jaxnerf.training.optimizer import learning_rate
from jaxnerf.training.options import TrainOptions
from jaxnerf.training.step import TrainData


def experiment_of(train):
    return SimpleNamespace(config=SimpleNamespace(train=train))


@pytest.mark.parametrize("power", [1.0, 4.0])
@pytest.mark.parametrize("seconds, step, fraction", [(0, 1, 0), (5, 1, 0.5), (5, 81, 0.8), (10, 1, 1), (20, 201, 1)])
def test_it_reaches_its_end_when_the_time_or_the_steps_do(seconds, step, fraction, power):
    options = TrainOptions(lr_init=1e-2, lr_final=1e-4, lr_steps=100, lr_decay_power=power, max_seconds=10.0)
    data = TrainData(None, None, None, None, lr_scale=jax.device_put(np.float32(1)))
    pace = _Pace(experiment_of(options), SimpleNamespace(seconds=lambda: seconds), data)
    rate = float(pace.data_of(step).lr_scale) * float(learning_rate(options)(step - 1))
    assert rate == pytest.approx(1e-2 * 0.01 ** (fraction**power), rel=1e-5)


def test_without_a_limit_nothing_changes():
    data = TrainData(None, None, None, None)
    pace = _Pace(experiment_of(None), None, data)
    assert pace.data_of(7) is data and pace.scale == 1.0
