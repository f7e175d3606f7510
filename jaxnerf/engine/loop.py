"""The training loop: resume, step, log, save, stop cleanly."""

import contextlib
import dataclasses
import functools
import pathlib
import time

import jax
import numpy as np

from jaxnerf.data.batches import Gathered
from jaxnerf.engine import build, fitting, hosts, parallel, records, revival, status, workdir
from jaxnerf.engine.checkpoint import Checkpoints
from jaxnerf.engine.control import Clock, Interrupt
from jaxnerf.engine.evaluate import evaluate
from jaxnerf.engine.fit import fit_config, fit_data
from jaxnerf.engine.lock import alone
from jaxnerf.engine.state import create_state
from jaxnerf.engine.step import make_train_step


def train_and_evaluate(config, folder, *, views=None):
    """Trains as a configuration says, from the last checkpoint under folder if there is one.

    Args:
        config: ConfigDict, see configs/default.py.
        folder: the workdir; made if missing.
        views: of the split "train" where they were read already.

    Returns:
        Whether training and its scores came to their end (False: stopped by Ctrl-C or SIGTERM, saved).

    Raises:
        ValueError: on bad input, when another process trains in folder, or when too many steps in a row
            were not finite.
    """
    started = time.perf_counter()
    config, found = fit_data(config)
    hosts.say(*found)
    if views is None:  # before the workdir is made: bad input leaves nothing
        views = build.load_views(config.data, "train")
    config, chosen = fit_config(config, views)
    experiment = build.build(config)
    options = experiment.train
    devices = parallel.devices_of(options.parallel)
    parallel.split_positions(options.batch_size, len(devices), options.block_size)
    hosts.check_same("configuration", config.to_json_best_effort())
    with contextlib.ExitStack() as stack:

        def claim():
            stack.enter_context(alone(folder))
            workdir.claim(folder, config)

        hosts.first_does(claim, pathlib.Path(folder) / "config.json")
        hosts.say(f"views       read in {time.perf_counter() - started:.1f} s", *chosen)
        finished = train(experiment, views, folder)
        return finished and (not experiment.eval.at_end or _score(folder))


def train(experiment, views, folder):
    """Runs the loop of train_and_evaluate on Views that were read; returns whether it came to its end."""
    options = experiment.train
    run, state, data, survey_seconds, compile_seconds = _compile(experiment, views)
    checkpoints = Checkpoints(folder, keep=options.keep)
    state, unreadable = checkpoints.load_newest(state)
    hosts.say(*unreadable)
    first = int(state.step)
    log = records.Records(folder, first_step=first, write=hosts.is_first())
    before = log.rows[-1]["seconds"] if log.rows else 0.0
    hosts.say(status.header(experiment, views, state, survey_seconds, compile_seconds))
    progress = records.Progress(options.max_steps, show=hosts.is_first())
    clock = Clock(before, first * options.batch_size - int(state.counters.get("left_out", 0)))
    look = revival.make_look(experiment, folder)
    recent = []
    done = hosts.any_of(first >= options.max_steps or 0 < options.max_seconds <= before)
    with Interrupt() as interrupt:
        for step in range(first + 1, first + 1 if done else options.max_steps + 1):
            state, metrics = look(step, *run(state, data))
            recent.append(metrics)
            jax.block_until_ready(recent[-2:][0])  # one step in flight, no more: a stop is prompt
            late = 0 < options.max_seconds <= clock.seconds()
            stopped = hosts.any_of(late or interrupt.caught, step)
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
    caught = hosts.any_of(interrupt.caught)
    if caught:
        hosts.say(f"stopped at step {int(state.step)} and saved; the same command goes on from there")
    return not caught


def _score(folder):
    """Scores the last checkpoint unless it is scored already; returns whether it is."""
    if (pathlib.Path(folder) / "eval" / str(Checkpoints(folder).steps()[-1])).exists():
        return True
    try:
        evaluate(folder, shard=(jax.process_index(), jax.process_count()))
    except KeyboardInterrupt:
        hosts.say("stopped while scoring; what was trained is saved, the same command goes on scoring")
        return False
    return True


def _compile(experiment, views):
    options = experiment.train
    started = time.perf_counter()
    possible, data = experiment.survey(views)
    surveyed = time.perf_counter() - started
    pixels, gather = views.pixels, fitting.has_no_room(views.pixels)
    if gather:
        rows = np.zeros_like(pixels, shape=(options.batch_size, pixels.shape[1]))
        gathered = Gathered(rows=rows, shape=pixels.shape)
        data = data._replace(views=dataclasses.replace(data.views, pixels=gathered))
    step = make_train_step(experiment.model, experiment.optimizer, experiment.draw)
    compile_step = functools.partial(
        parallel.compile_step,
        step,
        batch_size=options.batch_size,
        samples_per_ray=experiment.samples_per_ray,
        mode=options.parallel,
    )
    state = functools.partial(create_state, experiment.model, experiment.optimizer, experiment.seed, possible)
    run, *placed = fitting.fit_step(
        lambda state, data, block: compile_step(state, data, block_size=block),
        state,
        data,
        parallel.block_of(options, experiment.samples_per_ray),
    )
    if gather:
        ids = functools.partial(experiment.ids, positions=np.arange(options.batch_size))
        run = fitting.gather_ahead(run, jax.jit(lambda step, data: ids(step, data=data)), pixels)
    return run, *placed, surveyed, time.perf_counter() - started - surveyed


def _check_finite(row, options, folder):
    if row["nonfinite_in_a_row"] >= options.max_nonfinite:
        raise ValueError(
            f"{folder}: {row['nonfinite_in_a_row']} steps in a row up to {row['step']} had a loss or "
            f"gradient that is not finite (loss {row['loss']}, gradient norm {row['grad_norm']}, "
            f"learning rate {row['lr']:.2g}); nothing of them was kept: lower train.lr_init, or check "
            "images and poses"
        )
