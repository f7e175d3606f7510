"""The learning rate of a run of limited time."""

from types import SimpleNamespace

import jax
import numpy as np
import pytest

from jaxnerf.training.compiled_step import compile_training
from jaxnerf.training.optimizer import DecayData, learning_rate
from jaxnerf.training.options import TrainOptions
from jaxnerf.training.pace import Pace
from jaxnerf.training.step import TrainData
from runs import smoke_experiment


@pytest.mark.parametrize("power", [1.0, 4.0])
@pytest.mark.parametrize("seconds, step, fraction", [(0, 1, 0), (5, 1, 0.5), (5, 81, 0.8), (10, 1, 1), (20, 201, 1)])
def test_it_reaches_its_end_when_the_time_or_the_steps_do(seconds, step, fraction, power):
    options = TrainOptions(lr_init=1e-2, lr_final=1e-4, lr_steps=100, lr_decay_power=power, max_seconds=10.0)
    data = TrainData(None, None, None, None, decay=jax.device_put(DecayData(np.float32(100), np.float32(1))))
    pace = Pace(options, SimpleNamespace(seconds=lambda: seconds), data)
    decay = pace.data_of(step).decay
    assert float(learning_rate(options, decay)(step - 1)) == pytest.approx(1e-2 * 0.01 ** (fraction**power), rel=1e-5)


def test_without_a_limit_nothing_changes():
    data = TrainData(None, None, None, None)
    pace = Pace(TrainOptions(), None, data)
    assert pace.data_of(7) is data and pace.scale == 1.0


def test_runs_that_differ_in_their_length_have_the_same_compiled_step(monkeypatch):
    """A short try and a run of hours, or one that its time limits, then share an entry of the compilation cache."""
    programs = []

    def lowered(train_step, state, data, **_):
        state = jax.eval_shape(state)
        programs.append(jax.jit(train_step).lower(state, data, np.arange(64).reshape(1, 64)).as_text())
        return None, state, data

    monkeypatch.setattr("jaxnerf.runtime.devices.compile_step", lowered)
    lengths = [{"max_steps": 30, "lr_steps": 30}, {"max_steps": 70, "lr_steps": 50}, {"max_seconds": 9.0}]
    for length in [*lengths, {"lr_final": 1e-6}]:
        experiment = smoke_experiment(batch_size=64, **length)
        compile_training(experiment, experiment.load_split("train"))
    assert programs[0] == programs[1] == programs[2] != programs[3]
