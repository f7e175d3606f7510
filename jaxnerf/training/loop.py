"""The training loop: resume, step, log, save, stop cleanly."""

import contextlib
import dataclasses
import functools
import os
import pathlib
import time
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import jax
import numpy as np

from jaxnerf.core.views import Views
from jaxnerf.data.ray_batches import BatchPixels
from jaxnerf.options import Changes
from jaxnerf.runtime import devices, memory, processes, signals, stages, user_cache
from jaxnerf.runtime.fingerprint import fingerprint
from jaxnerf.training import build, many_runs, metric_log, workdir
from jaxnerf.training.auto_config import resolve, resolve_for_device
from jaxnerf.training.checkpoint import Checkpoints
from jaxnerf.training.config import Config, changed, declared, read_config
from jaxnerf.training.dead_networks import CHECK_EVERY, dead_networks, make_reinitializer
from jaxnerf.training.optimizer import DecayData
from jaxnerf.training.options import host_intervals
from jaxnerf.training.state import TrainState, create_state
from jaxnerf.training.step import make_train_step, repeat_step


def train(
    config: Config,
    folder: str | os.PathLike,
    *,
    views: Views | None = None,
    preview: Callable[[TrainState, Views], str] | None = None,
    at_end: Callable[[Views], bool] | None = None,
    observe: Callable[[TrainState, Views], None] | None = None,
) -> bool:
    """Trains as a config says, from the last checkpoint in a workdir if there is one.

    Args:
        config: of the run.
        folder: the workdir; made if missing.
        views: of the split "train" where they have been read.
        preview: called with the state and the Views of the split "train" about every `train.preview_every` seconds;
            returns a line to print. Its time does not count.
        at_end: called with these Views when training is complete; returns whether it has completed.
        observe: called with the state and these Views after each step, as a viewer needs. The next step destroys the
            state, so what is kept must be copied.

    Returns:
        Whether training, and at_end, have completed. False: stopped by a signal and saved.

    Raises:
        ValueError: on bad input, when another process trains in the workdir, or when too many steps in a row
            were not finite.
    """
    return _train_all([config], [folder], views, preview=preview, at_end=at_end, observe=observe)


def train_runs(
    configs: Sequence[Config], folders: Sequence[str | os.PathLike], *, at_end: Callable[[Views], bool] | None = None
) -> bool:
    """Trains several runs at once, in one program, each from its config into its workdir; see `train`.

    Args:
        configs: of the runs. They may differ in the seed and in the dataset, whose images must have the same shapes.
        folders: their workdirs.
        at_end: see `train`; it receives the Views of the first run.

    Raises:
        ValueError: as `train` does; and if the runs differ in anything else; names it.
    """
    if len(configs) != len(folders) or not folders:
        raise ValueError(f"{len(configs)} configs and {len(folders)} workdirs, expected a workdir for each run")
    if len({pathlib.Path(folder).resolve() for folder in folders}) < len(folders):
        raise ValueError(f"workdirs {', '.join(map(str, folders))}: two are the same, expected one for each run")
    return _train_all(configs, folders, at_end=at_end)


def _train_all(configs, folders, views=None, *, preview=None, at_end=None, observe=None):
    started = time.perf_counter()
    with stages.stage("reading the dataset"):
        # Before a workdir is made: bad input leaves no trace.
        resolved = _resolve_all(configs, views)
    configs, all_views = [each.config for each in resolved], [each.views for each in resolved]
    (on_device, device_lines), views, lines = resolve_for_device(configs[0]), all_views[0], resolved[0].lines
    experiments = []
    for folder, config, own_views in zip(folders, configs, all_views, strict=True):
        if config is not configs[0]:
            _check_alike(configs[0], config, folder)
        own_config = on_device if config is configs[0] else resolve_for_device(config)[0]
        build.check_views(own_config, own_views)
        experiments.append(build.build(own_config))
    options = on_device.train
    num_devices = len(devices.devices_of(options.parallel))
    devices.split_positions(options.batch_size, num_devices, options.microbatch_size)
    for config in configs:
        anywhere = changed(config, {"data.dir": ""})  # its place may differ; its content is compared later
        processes.check_same("config", anywhere.to_json())
    with contextlib.ExitStack() as stack:
        for folder, config in zip(folders, configs, strict=True):

            def claim_workdir(folder=folder, config=config):
                stack.enter_context(workdir.workdir_lock(folder))
                workdir.save_config(folder, config)

            processes.run_on_first(claim_workdir, pathlib.Path(folder) / "config.json")
        lines += [processes.Detail(line) for line in device_lines]
        hidden = sum(isinstance(line, processes.Detail) for line in lines)
        if hidden and not processes.prints_details():
            lines.append(
                f"settings      {hidden} more values are inferred; --verbosity=1 prints them with their reasons"
            )
        processes.print_once(*lines, f"dataset       read in {time.perf_counter() - started:.1f} s")
        finished = _run_all(experiments, all_views, folders, preview=preview, observe=observe)
        memory.release()
        return finished and (at_end is None or at_end(views))


def run_training(
    experiment: build.Experiment,
    views: Views,
    folder: str | os.PathLike,
    *,
    preview: Callable[[TrainState, Views], str] | None = None,
    observe: Callable[[TrainState, Views], None] | None = None,
) -> bool:
    """Runs the loop of `train` on the Views of the split "train"; returns whether it has completed."""
    return _run_all([experiment], [views], [folder], preview=preview, observe=observe)


def _resolve_all(configs, views):
    """Returns the Resolved of each config; runs that differ in the seed alone share what is inferred, and the Views."""
    configs = list(map(read_config, configs))
    resolved = [resolve(configs[0], views)]
    for config in configs[1:]:
        if changed(config, {"seed": configs[0].seed}) == configs[0]:
            resolved.append(resolved[0]._replace(config=changed(resolved[0].config, {"seed": config.seed})))
        else:
            resolved.append(resolve(config))
    return resolved


def _check_alike(first, config, folder):
    """Raises a ValueError if a run has another program than the first one."""
    mine = {name: value for name, _, _, value in declared(config)}
    for name, option, _, value in declared(first):
        free = option.changes == Changes.NOTHING or name in ("seed", "data.dir")
        if not free and mine.get(name) != value:
            raise ValueError(
                f"{folder}: {name} is {mine.get(name)!r}, expected {value!r} as in the first run: runs of one program "
                "may differ in seed and data.dir only; set it to the same value in all configs, or train the run alone"
            )


class _Runs:
    """The files of runs that train together: a workdir for each.

    Attributes:
        first: the step from which they continue.
        seconds: of training until then.
    """

    def __init__(self, experiments: Sequence[build.Experiment], folders: Sequence[str | os.PathLike]):
        self._experiments, self._folders, self._many = experiments, folders, len(folders) > 1
        keep = experiments[0].config.train.max_to_keep
        self._checkpoints = [Checkpoints(folder, max_to_keep=keep) for folder in folders]
        self._reinitialize = [make_reinitializer(*run) for run in zip(experiments, folders, strict=True)]
        self._logs, self.first, self.seconds = [], 0, 0.0

    def load(self, state: TrainState) -> tuple[TrainState, list[str]]:
        """Returns the state of the newest step that all runs have, `state` if there is none; and lines about files."""
        loaded, lines = [], []
        for index, checkpoints in enumerate(self._checkpoints):
            own, unreadable = checkpoints.load_newest(self._of(state, index))
            loaded.append(own)
            lines += unreadable
        self.first = min(int(own.step) for own in loaded)
        for index, own in enumerate(loaded):
            if int(own.step) != self.first:  # a run was killed while it saved, or has been continued alone
                loaded[index] = self._load_first(state, index)
        for folder in self._folders:
            log = metric_log.MetricLog(folder, first_step=self.first, write=processes.is_first())
            self._logs.append(log)
        rows = self._logs[0].rows
        self.seconds = rows[-1]["seconds"] if rows else 0.0
        return self._join(state, loaded), lines

    def _load_first(self, state, index):
        if self.first == 0:
            return self._of(state, index)
        checkpoints = self._checkpoints[index]
        if self.first not in checkpoints.steps():
            raise ValueError(
                f"{self._folders[index]}: has no checkpoint at step {self.first}, the last one of another run, "
                "expected runs at the same step; continue the other runs alone with jaxnerf-train --workdir"
            )
        return checkpoints.load(self.first, self._of(state, index))

    def first_state(self, state: TrainState) -> TrainState:
        return self._of(state, 0)

    def save(self, state: TrainState) -> None:
        for index, checkpoints in enumerate(self._checkpoints):
            checkpoints.save(self._of(state, index))

    def log(self, step: int, recent: list, *, rate: Callable[[int], float], scale: float, **seconds: float) -> list:
        """Appends the row of each run; returns them."""
        rows, recent = [], jax.device_get(recent)
        for index, (experiment, log) in enumerate(zip(self._experiments, self._logs, strict=True)):
            own = [many_runs.metrics_of(part, index) for part in recent] if self._many else recent
            if rows:  # the clock's rate is since its last call
                rate = functools.partial(lambda known, rays: known, rows[0]["rays_per_second"])
            row = metric_log.row(experiment, step, own, rate=rate, **seconds)
            row["lr"] *= scale
            log.append(row)
            rows.append(row)
        return rows

    def check_finite(self, rows: list[dict[str, Any]]) -> None:
        for row, folder in zip(rows, self._folders, strict=True):
            _check_finite(row, self._experiments[0].config.train, folder)

    def reinitialize_dead(self, step: int, state: TrainState, metrics: Any) -> tuple[TrainState, Any]:
        """Reinitializes the dead networks of each run, see `make_reinitializer`."""
        if not self._many:
            return self._reinitialize[0](step, state, metrics)
        each = range(len(self._folders))
        if step % CHECK_EVERY or not any(dead_networks(self._of(state, index).counters) for index in each):
            return state, metrics
        pairs = [
            self._reinitialize[index](step, self._of(state, index), many_runs.metrics_of(metrics, index))
            for index in each
        ]
        states, new = zip(*pairs, strict=True)
        state = self._join(state, states)
        return state, new if isinstance(metrics, tuple) else {**metrics, **jax.device_get(state.counters)}

    def close(self) -> None:
        for part in (*self._checkpoints, *self._logs):
            part.close()

    def _of(self, state, index):
        return many_runs.state_of(state, index) if self._many else state

    def _join(self, like, states):
        if not self._many:
            return states[0]
        if isinstance(like, tuple):
            return tuple(states)
        shardings = jax.tree.map(lambda leaf: leaf.sharding, like)
        return jax.device_put(many_runs.stack_states(states), shardings)


def _run_all(experiments, all_views, folders, *, preview=None, observe=None):
    """Does what `run_training` does for runs that train together."""
    experiment, views = experiments[0], all_views[0]
    options = experiment.config.train
    dispatch, state, data, seconds = _compile(
        experiment, views, list(zip(experiments, all_views, folders, strict=True))
    )
    runs = _Runs(experiments, folders)
    with stages.stage("reading the checkpoint"):
        state, unreadable = runs.load(state)
    first, before = runs.first, runs.seconds
    processes.print_once(*unreadable, *metric_log.header(experiment, views, runs.first_state(state), **seconds))
    if len(folders) > 1:
        processes.print_once(f"runs          {len(folders)} in one program; the line below is of {folders[0]}")
    progress = metric_log.Progress(metric_log.all_steps(options), show=processes.is_first())
    previews = _PreviewTimes(options.preview_every if preview else 0.0, before)
    dropped = runs.first_state(state).counters.get("rays_dropped", 0)
    clock = _Clock(before, first * options.batch_size - int(dropped))
    pace = _Pace(experiment, clock, data)
    recent = []
    done = processes.any_of(first >= options.max_steps or 0 < options.max_seconds <= before)
    with signals.Interrupt() as interrupt:
        step = options.max_steps if done else first
        while step < options.max_steps:
            count = dispatch.count_after(step)
            with clock.paused():
                dispatch.compile(count)
            run, step = dispatch.runs[count], step + count
            state, metrics = runs.reinitialize_dead(step, *run(state, pace.data_of(step - count + 1)))
            if observe is not None:
                observe(state, views)
            recent.append(metrics)
            jax.block_until_ready(recent[-2:][0])  # at most one dispatch in flight, so that stopping is prompt
            out_of_time = 0 < options.max_seconds <= clock.seconds()
            stopped = processes.any_of(out_of_time or interrupt.caught, step)
            last = step == options.max_steps or stopped
            save = step % options.save_every == 0 or last
            if step % options.log_every == 0 or save:  # a resumed run reads the clock from the checkpoint's row
                rows = runs.log(
                    step,
                    recent,
                    rate=clock.rate,
                    scale=pace.scale,
                    seconds=clock.seconds(),
                    compile_seconds=seconds["compile_seconds"],
                )
                text = metric_log.line(rows[0], options, out_of_time=out_of_time)
                progress.show(step, text, metric_log.fraction_done(rows[0], options))
                recent = []
                runs.check_finite(rows)
            if save:
                with clock.paused(), stages.stage("saving the checkpoint"):
                    memory.release()
                    runs.save(state)
                    memory.release()
            if last:
                break
            if processes.any_of(previews.is_due(clock.seconds()), step):
                jax.block_until_ready(state)  # its step counts
                with clock.paused(), previews.timed(clock.seconds()):
                    progress.note(preview(state, views))
    progress.close()
    runs.close()
    interrupted = processes.any_of(interrupt.caught)
    if interrupted:
        processes.print_once(
            f"stopped at step {int(runs.first_state(state).step)} and saved; the same command continues from there"
        )
    return not interrupted


class _Dispatch:
    """The compiled training step: for as many steps in one dispatch as are configured, and for single ones.

    Single steps are taken where a full dispatch would go past a step at which the host logs, saves or decides, so the
    result does not depend on the number of steps in a dispatch.

    Attributes:
        runs: by number of steps, (state, data) -> (state, metrics), see `devices.compile_step` and `repeat_step`.
    """

    def __init__(self, options: Any, num_steps: int, compile_steps: Callable[[int], tuple]):
        self._options, self._num_steps, self._compile_steps = options, num_steps, compile_steps
        self.runs: dict[int, Callable[..., tuple]] = {}

    def compile(self, count: int) -> tuple:
        """Compiles the step for a number of steps in a dispatch, unless it has been; returns the initial state, data"""
        placed = ()
        if count not in self.runs:
            self.runs[count], *placed = self._compile_steps(count)
        return placed

    def count_after(self, step: int) -> int:
        """Returns the number of steps of the dispatch that follows a step."""
        ends = [self._options.max_steps - step, *(every - step % every for every in host_intervals(self._options))]
        return self._num_steps if min(ends) >= self._num_steps else 1


def _compile(experiment, views, together=()):
    """Compiles the step of an experiment, or of several (Experiment, Views, folder) in one program.

    Returns _Dispatch, state, data, see `devices.compile_step`; and the seconds that it took, by name.
    """
    options = experiment.config.train
    started = time.perf_counter()
    decay = DecayData(np.float32(options.lr_steps), np.float32(1))
    cells, data = zip(*_prepare_all(experiment, views, together), strict=True)
    each_data = [each._replace(decay=decay) for each in data]
    seeds = [run.config.seed for run, *_ in together] or [experiment.config.seed]
    many = len(seeds) > 1
    data, own = each_data[0], []
    if many:
        data, own = many_runs.stack_data(each_data, [str(folder) for *_, folder in together])
    prepared = time.perf_counter()
    memory.release()
    pixels = each_data[0].views.pixels
    gather = not many and _stay_on_host(pixels)
    if gather:
        rows = np.zeros_like(pixels, shape=(options.batch_size, pixels.shape[1]))
        batch_pixels = BatchPixels(rows=rows, shape=pixels.shape)
        data = data._replace(views=dataclasses.replace(data.views, pixels=batch_pixels))
    step = make_train_step(
        experiment.model,
        experiment.optimizer,
        experiment.draw,
        experiment.losses,
        experiment.cameras,
        experiment.pixel_rays,
    )
    turns = many and many_runs.runs_in_turn()
    if many and not turns:
        step = many_runs.step_of_all(step, own)

    def initial_state(run=0):
        create = functools.partial(create_state, experiment.model, experiment.optimizer, seeds[run])
        return jax.tree_util.Partial(create, cells[run])

    def initial_states():
        return jax.tree_util.Partial(
            lambda each: many_runs.stack_states([create() for create in each]),
            list(map(initial_state, range(len(seeds)))),
        )

    def compile_steps(count):
        def compile_step(state, data, microbatch_size):
            sizes = {"batch_size": options.batch_size, "microbatch_size": microbatch_size}
            return devices.compile_step(repeat_step(step, count), state, data, mode=options.parallel, **sizes)

        run, state, placed = memory.fit_step(
            compile_step,
            initial_states() if many and not turns else initial_state(),
            each_data[0] if turns else data,
            min(options.microbatch_size, options.batch_size // len(devices.devices_of(options.parallel))),
        )
        if gather:
            ids = functools.partial(experiment.pixel_ids, positions=np.arange(options.batch_size))
            run = _gather_ahead(run, jax.jit(lambda step, data: ids(step, data=data)), pixels)
        if turns:
            sharding = state.step.sharding
            # As the first one is made: another compilation would round the initial parameters differently.
            device = next(iter(sharding.device_set))
            others = [devices.unoptimized(initial_state(index), device)() for index in range(1, len(seeds))]
            states = (state, *devices.place(others, sharding))
            taken = devices.place([many_runs.taken_leaves(each, own) for each in each_data], sharding)
            return many_runs.in_turn(run, taken, own), states, placed
        return run, state, placed

    # Pixels that stay on the host are sent for one step at a time.
    num_steps = 1 if gather else options.steps_per_dispatch
    dispatch = _Dispatch(options, num_steps, compile_steps)
    key = _program_name(experiment, views)
    before = user_cache.last_seconds(key)
    with stages.stage("compiling the training step", "" if before is None else f", {before:.0f} s the last time"):
        placed = dispatch.compile(num_steps)
    seconds = {"prepare_seconds": prepared - started, "compile_seconds": time.perf_counter() - prepared}
    user_cache.keep_seconds(key, seconds["compile_seconds"])
    return dispatch, *placed, seconds


def _prepare_all(experiment, views, together):
    """Returns the cells and the data of each run; runs that share their Views share them, too."""
    first = experiment.prepare(views)
    prepared = [first]
    for run, own_views, _ in together[1:]:
        seed = np.uint32(run.config.seed % 2**32)
        prepared.append((first[0], first[1]._replace(seed=seed)) if own_views is views else run.prepare(own_views))
    return prepared


def _program_name(experiment, views):
    """Returns a name for the compiled step: the same for runs that differ in how long they train."""
    part_of_it = Changes.TRAINING | Changes.SPEED
    values = {name: value for name, option, _, value in declared(experiment.config) if option.changes & part_of_it}
    values = {**values, "seed": 0, "train.lr_steps": 0}
    return fingerprint(repr(values), views.pixels.shape, [device.device_kind for device in jax.devices()])


def _stay_on_host(pixels):
    """Returns whether pixels stay on the host, as they would fill over half of a device's free memory."""
    if jax.local_devices()[0].platform == "cpu":  # it maps them
        return False
    free = memory.available()
    return free is not None and pixels.nbytes > free / 2


def _gather_ahead(run, ids, pixels):
    """Returns a step for data whose views' pixels are BatchPixels: it receives only the pixels that it draws.

    Args:
        run: (state, data) -> (state, metrics), the step.
        ids: (step, data) -> [batch] int32, the pixels that a step draws; jitted.
        pixels: [P, C] of all views, on the host.
    """
    step, drawn, progress = None, None, None

    def run_with_pixels(state, data):
        nonlocal step, drawn, progress
        if step is None:
            step, progress = int(state.step), data.progress
            drawn = ids(step, data)
        drawn_with, progress = progress, data.progress
        template = data.views.pixels
        rows = devices.place(pixels[np.asarray(drawn)], template.rows.sharding)
        step += 1
        drawn = ids(step, data)  # before the step starts, as the device would compute this after it
        views = dataclasses.replace(data.views, pixels=dataclasses.replace(template, rows=rows))
        return run(state, data._replace(views=views, progress=drawn_with))  # on which the pixels depend

    return run_with_pixels


def _check_finite(row, options, folder):
    if row["nonfinite_in_a_row"] >= options.max_nonfinite:
        raise ValueError(
            f"{folder}: the loss or gradient of {row['nonfinite_in_a_row']} steps in a row up to {row['step']} is not "
            f"finite (loss {row['loss']}, gradient norm {row['grad_norm']}, learning rate {row['lr']:.2g}); these "
            "steps changed nothing: lower train.lr_init, or check images and poses"
        )


class _Clock:
    """Measures the seconds of training, without compiling and saving, continued from an earlier start."""

    def __init__(self, seconds: float, rays: int):
        self._started = time.perf_counter() - seconds
        self._last = (seconds, rays)

    def seconds(self) -> float:
        return time.perf_counter() - self._started

    def rate(self, rays: int) -> float:
        """Returns the rays per second since the last call."""
        (seconds, before), self._last = self._last, (self.seconds(), rays)
        return (rays - before) / max(self._last[0] - seconds, 1e-9)

    @contextlib.contextmanager
    def paused(self) -> Iterator[None]:
        entered = time.perf_counter()
        yield
        self._started += time.perf_counter() - entered


class _Pace:
    """The learning rate and the progress of a run of limited time: they reach their end when the time does.

    They depend on the fraction of the steps that are done or on that of the time that has passed, whichever is larger.
    Such a run depends on the clock. Several processes have several clocks, so theirs depend on the steps alone.
    """

    def __init__(self, experiment: build.Experiment, clock: _Clock, data: Any):
        self.scale, self._data, self._clock = 1.0, data, clock
        self._options = experiment.config.train

    def data_of(self, step: int) -> Any:
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


class _PreviewTimes:
    """When previews are due: every so many seconds of training, and less often in long runs or where they are slow."""

    def __init__(self, every: float, seconds: float):
        self._every, self._next = every, 0.0
        self._plan(seconds, 0.0)

    def is_due(self, seconds: float) -> bool:
        return bool(self._every) and seconds >= self._next

    @contextlib.contextmanager
    def timed(self, seconds: float) -> Iterator[None]:
        entered = time.perf_counter()
        yield
        self._plan(seconds, time.perf_counter() - entered)

    def _plan(self, seconds, spent):
        self._next = seconds + max(self._every, 0.1 * seconds, 10 * spent)
