"""The training loop: resume, step, log, save, stop cleanly."""

import contextlib
import os
import pathlib
import time
from collections.abc import Callable

import jax
import numpy as np

from jaxnerf.core.views import Views
from jaxnerf.runtime import devices, memory, processes, signals, stages
from jaxnerf.training import build, metric_log, stored_cameras, workdir
from jaxnerf.training.auto_config import resolve, resolve_for_device
from jaxnerf.training.checkpoint import Checkpoints
from jaxnerf.training.compiled_step import compile_training
from jaxnerf.training.config import Config, changed
from jaxnerf.training.dead_networks import make_reinitializer
from jaxnerf.training.pace import Clock, Pace, PreviewTimes
from jaxnerf.training.state import TrainState, rendered_shapes

# Steps in a row without a finite gradient after which a run fails. They change nothing, and each draws other rays: a
# bad pixel makes a few of them, bad poses or a learning rate that is too high make all.
_MAX_NONFINITE = 20


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
        ValueError: as `train_and_evaluate`.
    """
    started = time.perf_counter()
    with stages.stage("reading the dataset"):
        # Before a workdir is made: bad input leaves no trace.
        config, views, lines = resolve(config, views)
    on_device, device_lines = resolve_for_device(config)
    build.check_views(on_device, views)
    experiment, options = build.build(on_device), on_device.train
    devices.split_positions(options.batch_size, jax.device_count(), options.microbatch_size)
    anywhere = changed(config, {"data.dir": ""})  # its place may differ; its content is compared later
    processes.check_same("config", anywhere.to_json())
    with contextlib.ExitStack() as stack:

        def claim_workdir():
            stack.enter_context(workdir.workdir_lock(folder))
            workdir.save_config(folder, config)
            stored_cameras.save(folder, config, views)

        processes.run_on_first(claim_workdir, pathlib.Path(folder) / "config.json")
        lines += [processes.Detail(line) for line in device_lines]
        hidden = sum(isinstance(line, processes.Detail) for line in lines)
        if hidden and not processes.prints_details():
            lines.append(
                f"settings      {hidden} more values are inferred; --verbosity=1 prints them with their reasons"
            )
        processes.print_once(*lines, f"dataset       read in {time.perf_counter() - started:.1f} s")
        steps = Checkpoints(folder).steps()
        ended = processes.any_of(metric_log.has_ended(options, steps, folder))
        if finished := ended and not processes.any_of(_is_damaged(experiment, folder, steps[-1])):
            processes.print_once(f"steps         {metric_log.of_all(steps[-1], options)} done, so training is complete")
        else:
            finished = run_training(experiment, views, folder, preview=preview, observe=observe)
        memory.release()
        return finished and (at_end is None or at_end(views))


def _is_damaged(experiment, folder, step):
    """Returns whether a checkpoint cannot be rendered; `run_training` then sets it aside and takes its steps again."""
    averaged = experiment.config.train.averaging_power > 0
    try:
        Checkpoints(folder).load_rendered(step, rendered_shapes(experiment.model), averaged=averaged)
    except ValueError:
        return True
    return False


def run_training(
    experiment: build.Experiment,
    views: Views,
    folder: str | os.PathLike,
    *,
    preview: Callable[[TrainState, Views], str] | None = None,
    observe: Callable[[TrainState, Views], None] | None = None,
) -> bool:
    """Runs the loop of `train` on the Views of the split "train"; returns whether it has completed."""
    options = experiment.config.train
    compiled, state = compile_training(experiment, views)
    checkpoints = Checkpoints(folder, max_to_keep=options.max_to_keep)
    reinitialize_dead = make_reinitializer(experiment, folder)
    with stages.stage("reading the checkpoint"):
        state, unreadable = checkpoints.load_newest(state)
    done = int(state.step)
    log = metric_log.MetricLog(folder, first_step=done, write=processes.is_first())
    processes.print_once(*unreadable, *metric_log.header(experiment, views, state, compiled))
    progress = stages.Progress("training", metric_log.all_steps(options), processes.is_first())
    previews = PreviewTimes(options.preview_every if preview else 0.0, log.seconds)
    clock = Clock(log.seconds, done * options.batch_size - int(state.counters.get("rays_dropped", 0)))
    pace = Pace(options, clock, compiled.data)
    recent, first = [], True  # metrics since the last row of the log, and whether that is this start's first
    last = processes.any_of(done >= options.max_steps or 0 < options.max_seconds <= log.seconds)
    with signals.Interrupt() as interrupt, progress:
        while not last:
            count = compiled.count_after(done)
            with clock.paused():
                take_steps = compiled.of(count)
            state, metrics = take_steps(state, pace.data_of(done + 1))
            done += count
            progress.done = done
            state, metrics = reinitialize_dead(done, state, metrics)
            if observe is not None:
                observe(state, views)
            recent.append(metrics)
            jax.block_until_ready(recent[-2:][0])  # at most one dispatch in flight, so that stopping is prompt
            out_of_time = 0 < options.max_seconds <= clock.seconds()
            stopped = processes.any_of(out_of_time or interrupt.caught, done)
            last = done == options.max_steps or stopped
            save = done % options.save_every == 0 or last
            if done % options.log_every == 0 or save:  # a resumed run reads the clock from the checkpoint's row
                row = metric_log.row(experiment, done, recent, clock, pace, compiled.compile_seconds)
                log.append(row)
                if first and not last:
                    processes.print_once(metric_log.passes(row, options, np.asarray(views.size)))
                first = False
                text = metric_log.line(row, options, out_of_time=out_of_time)
                progress.show(done, text, metric_log.fraction_done(row, options))
                recent = []
                _check_finite(row, folder)
            if save:
                with clock.paused(), stages.stage("saving the checkpoint"):
                    memory.release()
                    checkpoints.save(state)
                    memory.release()
            if not last and processes.any_of(previews.is_due(clock.seconds()), done):
                jax.block_until_ready(state)  # its step counts
                with clock.paused(), previews.timed(clock.seconds()):
                    processes.print_once(preview(state, views))
    for part in (checkpoints, log):
        part.close()
    interrupted = processes.any_of(interrupt.caught)
    if interrupted:
        processes.print_once(f"stopped at step {done} and saved; the same command continues from there")
    return not interrupted


def _check_finite(row, folder):
    if row["nonfinite_in_a_row"] >= _MAX_NONFINITE:
        raise ValueError(
            f"{folder}: the loss or gradient of {row['nonfinite_in_a_row']} steps in a row up to {row['step']} is not "
            f"finite (loss {row['loss']}, gradient norm {row['grad_norm']}, learning rate {row['lr']:.2g}); these "
            "steps changed nothing: lower train.lr_init, or check images and poses"
        )
