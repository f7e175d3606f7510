"""The time of a run: its clock, what depends on a limit of time, and when previews are due."""

import contextlib
import time
from collections.abc import Iterator
from typing import Any

import jax
import numpy as np

from jaxnerf.runtime import devices
from jaxnerf.training.options import TrainOptions


class Clock:
    """Measures the seconds of training, without compiling and saving, continued from an earlier start."""

    def __init__(self, seconds: float, rays: int):
        self._started = time.perf_counter() - seconds
        self._last = (seconds, rays)

    def seconds(self) -> float:
        """Returns the seconds of training so far."""
        return time.perf_counter() - self._started

    def rate(self, rays: int) -> float:
        """Returns the rays per second since the last call."""
        (seconds, before), self._last = self._last, (self.seconds(), rays)
        return (rays - before) / max(self._last[0] - seconds, 1e-9)

    @contextlib.contextmanager
    def paused(self) -> Iterator[None]:
        """Does not count the time inside."""
        entered = time.perf_counter()
        yield
        self._started += time.perf_counter() - entered


class Pace:
    """The learning rate and the progress of a run of limited time: they reach their end when the time does.

    They depend on the fraction of the steps that are done or on that of the time that has passed, whichever is larger.
    Such a run depends on the clock. Several processes have several clocks, so theirs depend on the steps alone.

    Attributes:
        scale: the learning rate of the newest step, over that which the steps alone determine.
    """

    def __init__(self, options: TrainOptions, clock: Clock, data: Any):
        self.scale, self._data, self._clock, self._options = 1.0, data, clock, options

    def data_of(self, step: int) -> Any:
        """Returns the TrainData of a step, counted from 1."""
        data, options = self._data, self._options
        if not options.max_seconds or jax.process_count() > 1:
            return data
        by_time = min(self._clock.seconds() / options.max_seconds, 1.0)
        if data.progress is not None:
            passed = devices.place(np.float32(by_time), data.progress.time_fraction.sharding)
            data = data._replace(progress=data.progress._replace(time_fraction=passed))
        if options.lr_final == options.lr_init:
            return data
        by_steps = min((step - 1) / options.lr_steps, 1.0)
        ratio, power = options.lr_final / options.lr_init, options.lr_decay_power
        self.scale = ratio ** (max(by_steps, by_time) ** power - by_steps**power)
        scale = devices.place(np.float32(self.scale), data.decay.scale.sharding)
        return data._replace(decay=data.decay._replace(scale=scale))


class PreviewTimes:
    """When previews are due: every so many seconds of training, and less often in long runs or where they are slow."""

    def __init__(self, every: float, seconds: float):
        """Plans the first preview of a run that has trained for some seconds; every: 0 for none."""
        self._every, self._next = every, 0.0
        self._plan(seconds, 0.0)

    def is_due(self, seconds: float) -> bool:
        """Returns whether a preview is due after so many seconds of training."""
        return bool(self._every) and seconds >= self._next

    @contextlib.contextmanager
    def timed(self, seconds: float) -> Iterator[None]:
        """Measures the preview inside, and plans the next one."""
        entered = time.perf_counter()
        yield
        self._plan(seconds, time.perf_counter() - entered)

    def _plan(self, seconds, spent):
        self._next = seconds + max(self._every, 0.1 * seconds, 10 * spent)
