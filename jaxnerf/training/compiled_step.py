"""The training step of a run, compiled, with its data on the devices."""

import dataclasses
import functools
import math
import time
from collections.abc import Callable
from typing import Any

import jax
import numpy as np

from jaxnerf.core.views import Views
from jaxnerf.data.ray_batches import BatchPixels
from jaxnerf.runtime import devices, memory, processes, stages
from jaxnerf.training.build import Experiment
from jaxnerf.training.dead_networks import CHECK_EVERY
from jaxnerf.training.optimizer import DecayData
from jaxnerf.training.options import TrainOptions
from jaxnerf.training.state import TrainState, create_state
from jaxnerf.training.step import make_train_step, repeat_step

# On an accelerator a dispatch costs as much as a small step; a CPU gains nothing.
_MAX_STEPS_PER_DISPATCH = 16


def compile_training(experiment: Experiment, views: Views) -> tuple["CompiledStep", TrainState]:
    """Compiles the training step of an experiment; returns it, and the state at step 0 on the devices.

    Raises:
        ValueError: if the batch does not split evenly, or the step does not fit into memory.
    """
    started = time.perf_counter()
    cells, data = experiment.prepare(views)
    prepared = time.perf_counter()
    memory.release()
    step = CompiledStep(experiment, cells, data)
    with stages.stage("compiling the training step"):
        state = step.compile()
    step.prepare_seconds, step.compile_seconds = prepared - started, time.perf_counter() - prepared
    return step, state


class CompiledStep:
    """The compiled training step: for as many steps in one dispatch as suit the devices, and for single ones.

    Single steps are taken where a full dispatch would go past a step at which the host logs, saves or decides, so the
    result does not depend on the number of steps in a dispatch.

    Attributes:
        data: TrainData on the devices.
        num_threads: that compute the gradient of a part of the rays each; see `devices.threads_of_step`.
        prepare_seconds, compile_seconds: that it took to prepare the data, and to compile.
    """

    prepare_seconds = compile_seconds = 0.0

    def __init__(self, experiment: Experiment, cells: Any, data: Any):
        """Takes an experiment, and what its `prepare` returns."""
        options = experiment.config.train
        self.data = data._replace(decay=DecayData(np.float32(options.lr_steps), np.float32(1)))
        self._experiment, self._options, self._by_count = experiment, options, {}
        self.num_threads = devices.threads_of_step(options.batch_size // options.rays_per_side**2)
        create = functools.partial(create_state, experiment.model, experiment.optimizer, experiment.config.seed)
        self._initial_state = jax.tree_util.Partial(create, cells)
        pixels = data.views.pixels
        self._host_pixels = pixels if _stay_on_host(pixels) else None
        if self._host_pixels is None:
            self._per_dispatch = steps_per_dispatch(options, jax.default_backend())
        else:
            self._per_dispatch = 1  # such pixels are sent for one step at a time
            rows = np.zeros_like(pixels, shape=(options.batch_size, pixels.shape[1]))
            drawn = BatchPixels(rows=rows, shape=pixels.shape)
            self.data = self.data._replace(views=dataclasses.replace(data.views, pixels=drawn))

    def count_after(self, step: int) -> int:
        """Returns the number of steps of the dispatch that follows a step."""
        ends = [self._options.max_steps - step, *(every - step % every for every in _host_intervals(self._options))]
        return self._per_dispatch if min(ends) >= self._per_dispatch else 1

    def compile(self) -> TrainState:
        """Compiles full dispatches and places the data; returns the state at step 0."""
        self._by_count[self._per_dispatch], state, self.data = self._compile(self._per_dispatch)
        return state

    def of(self, count: int) -> Callable[..., tuple]:
        """Returns (state, data) -> (state, metrics) of a number of steps, compiled if it has not been."""
        if count not in self._by_count:
            self._by_count[count], _, _ = self._compile(count)
        return self._by_count[count]

    def _compile(self, count):
        experiment, size = self._experiment, self._options.batch_size
        num_threads = self.num_threads if count == 1 else 1
        train_step = make_train_step(
            experiment.model,
            experiment.optimizer,
            experiment.draw,
            experiment.losses,
            experiment.cameras,
            experiment.pixel_rays,
        )

        def compile_step(state, data, microbatch_size):
            options = {"batch_size": size, "microbatch_size": microbatch_size, "num_threads": num_threads}
            return devices.compile_step(repeat_step(train_step, count), state, data, **options)

        microbatch_size = min(self._options.microbatch_size, size // jax.device_count())
        step, state, data = memory.fit_step(compile_step, self._initial_state, self.data, microbatch_size)
        if self._host_pixels is not None:
            ids = functools.partial(experiment.pixel_ids, positions=np.arange(size))
            step = _gather_ahead(step, jax.jit(lambda step, data: ids(step, data=data)), self._host_pixels)
        return step, state, data


def steps_per_dispatch(options: TrainOptions, platform: str) -> int:
    """Returns the number of steps in a full dispatch: the host does nothing between them."""
    most = 1 if platform == "cpu" else _MAX_STEPS_PER_DISPATCH
    whole = math.gcd(*_host_intervals(options))
    return max(count for count in range(1, most + 1) if whole % count == 0)


def _host_intervals(options):
    """Returns the numbers of steps at whose multiples training logs, saves or decides on the host."""
    intervals = (options.log_every, options.save_every)
    if options.max_reinits:
        intervals += (CHECK_EVERY,)
    return intervals + ((processes.AGREE_EVERY,) if jax.process_count() > 1 else ())


def _stay_on_host(pixels):
    """Returns whether pixels stay on the host, as they would fill over half of a device's free memory."""
    if jax.local_devices()[0].platform == "cpu":  # it maps them
        return False
    free = memory.available()
    return free is not None and pixels.nbytes > free / 2


def _gather_ahead(step, ids, pixels):
    """Returns a step for data whose views' pixels are BatchPixels: it receives only the pixels that it draws.

    Args:
        step: (state, data) -> (state, metrics).
        ids: (step, data) -> [batch] int32, the pixels that a step draws; jitted.
        pixels: [P, C] of all views, on the host.
    """
    number, drawn, progress = None, None, None

    def step_with_pixels(state, data):
        nonlocal number, drawn, progress
        if number is None:
            number, progress = int(state.step), data.progress
            drawn = ids(number, data)
        drawn_with, progress = progress, data.progress
        template = data.views.pixels
        rows = devices.place(pixels[np.asarray(drawn)], template.rows.sharding)
        number += 1
        drawn = ids(number, data)  # before the step starts, as the device would compute this after it
        views = dataclasses.replace(data.views, pixels=dataclasses.replace(template, rows=rows))
        return step(state, data._replace(views=views, progress=drawn_with))  # on which the pixels depend

    return step_with_pixels
