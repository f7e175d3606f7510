"""The training loop: resume, step, log, save, stop cleanly."""

import contextlib
import dataclasses
import functools
import pathlib
import time

import jax
import numpy as np

from jaxnerf.data.ray_batches import Gathered
from jaxnerf.runtime import chunking, processes
from jaxnerf.runtime.devices import compile_step as compile_on_devices
from jaxnerf.runtime.devices import devices_of, split_positions
from jaxnerf.training import build, dead_networks, metric_log, status, workdir
from jaxnerf.training.auto_config import resolve, resolve_for_device
from jaxnerf.training.checkpoint import Checkpoints
from jaxnerf.training.control import Clock, Interrupt
from jaxnerf.training.lock import workdir_lock
from jaxnerf.training.state import create_state
from jaxnerf.training.step import make_train_step


def train(config, folder, *, views=None, at_end=None):
    """Trains as a configuration says, from the last checkpoint under folder if there is one.

    Args:
        config: ConfigDict, see configs/default.py.
        folder: the workdir; made if missing.
        views: of the split "train" where they have been read.
        at_end: called with the workdir when training has ended, if `eval.at_end` is set; it returns whether
            it came to its own end.

    Returns:
        Whether training came to its end (False: stopped by Ctrl-C or SIGTERM, and saved).

    Raises:
        ValueError: on bad input, when another process trains in folder, or when too many steps in a row
            were not finite.
    """
    started = time.perf_counter()
    config, views, lines = resolve(config, views)  # before the workdir is made: bad input leaves nothing
    on_device, _ = resolve_for_device(config)
    experiment = build.build(on_device)
    options = experiment.train
    devices = devices_of(options.parallel)
    split_positions(options.batch_size, len(devices), options.microbatch_size)
    processes.check_same("configuration", config.to_json_best_effort())
    with contextlib.ExitStack() as stack:

        def claim():
            stack.enter_context(workdir_lock(folder))
            workdir.claim(folder, config)

        processes.first_does(claim, pathlib.Path(folder) / "config.json")
        processes.say(*lines, f"dataset       read in {time.perf_counter() - started:.1f} s")
        finished = run_training(experiment, views, folder)
        return finished and (at_end is None or not experiment.eval.at_end or at_end(folder))


def run_training(experiment, views, folder):
    """Runs the loop of train_and_evaluate on Views that were read; returns whether it came to its end."""
    options = experiment.train
    run, state, data, survey_seconds, compile_seconds = _compile(experiment, views)
    checkpoints = Checkpoints(folder, max_to_keep=options.max_to_keep)
    state, unreadable = checkpoints.load_newest(state)
    processes.say(*unreadable)
    first = int(state.step)
    log = metric_log.MetricLog(folder, first_step=first, write=processes.is_first())
    before = log.rows[-1]["seconds"] if log.rows else 0.0
    processes.say(status.header(experiment, views, state, survey_seconds, compile_seconds))
    progress = metric_log.Progress(options.max_steps, show=processes.is_first())
    clock = Clock(before, first * options.batch_size - int(state.counters.get("rays_dropped", 0)))
    look = dead_networks.make_reinitializer(experiment, folder)
    recent = []
    done = processes.any_of(first >= options.max_steps or 0 < options.max_seconds <= before)
    with Interrupt() as interrupt:
        for step in range(first + 1, first + 1 if done else options.max_steps + 1):
            state, metrics = look(step, *run(state, data))
            recent.append(metrics)
            jax.block_until_ready(recent[-2:][0])  # one step in flight, no more: a stop is prompt
            late = 0 < options.max_seconds <= clock.seconds()
            stopped = processes.any_of(late or interrupt.caught, step)
            last = step == options.max_steps or stopped
            save = step % options.save_every == 0 or last
            if step % options.log_every == 0 or save:  # a checkpoint's row holds its clock
                row = status.row(experiment, step, recent, clock, compile_seconds)
                log.append(row)
                progress.show(step, status.line(row, options, late))
                recent = []
                _check_finite(row, options, folder)
            if save:
                with clock.paused():
                    checkpoints.save(state)
            if last:
                break
    progress.close()
    checkpoints.close()
    log.close()
    caught = processes.any_of(interrupt.caught)
    if caught:
        processes.say(f"stopped at step {int(state.step)} and saved; the same command goes on from there")
    return not caught


def _compile(experiment, views):
    options = experiment.train
    started = time.perf_counter()
    valid, data = experiment.prepare(views)
    surveyed = time.perf_counter() - started
    pixels, gather = views.pixels, chunking.has_no_room(views.pixels)
    if gather:
        rows = np.zeros_like(pixels, shape=(options.batch_size, pixels.shape[1]))
        gathered = Gathered(rows=rows, shape=pixels.shape)
        data = data._replace(views=dataclasses.replace(data.views, pixels=gathered))
    step = make_train_step(experiment.model, experiment.optimizer, experiment.draw, experiment.losses)
    compile_step = functools.partial(
        compile_on_devices,
        step,
        batch_size=options.batch_size,
        mode=options.parallel,
    )
    state = functools.partial(create_state, experiment.model, experiment.optimizer, experiment.seed, valid)
    run, *placed = chunking.fit_step(
        lambda state, data, block: compile_step(state, data, microbatch_size=block),
        state,
        data,
        min(options.microbatch_size, options.batch_size // len(devices_of(options.parallel))),
    )
    if gather:
        ids = functools.partial(experiment.pixel_ids, positions=np.arange(options.batch_size))
        run = chunking.gather_ahead(run, jax.jit(lambda step, data: ids(step, data=data)), pixels)
    return run, *placed, surveyed, time.perf_counter() - started - surveyed


def _check_finite(row, options, folder):
    if row["nonfinite_in_a_row"] >= options.max_nonfinite:
        raise ValueError(
            f"{folder}: {row['nonfinite_in_a_row']} steps in a row up to {row['step']} had a loss or "
            f"gradient that is not finite (loss {row['loss']}, gradient norm {row['grad_norm']}, "
            f"learning rate {row['lr']:.2g}); nothing of them was kept: lower train.lr_init, or check "
            "images and poses"
        )
