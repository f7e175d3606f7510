"""The training loop: resume, step, log, save, stop cleanly."""

import contextlib
import dataclasses
import functools
import pathlib
import time

import jax
import numpy as np

from jaxnerf.core.metrics import decibels
from jaxnerf.data.batches import Gathered
from jaxnerf.engine import build, fitting, hosts, parallel, records, revival, workdir
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
    hosts.say(_header(experiment, views, state, survey_seconds, compile_seconds))
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
                row = _row(experiment, step, recent, clock, compile_seconds)
                log.append(row)
                progress.show(step, _text(row, options, late))
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
    possible, live, cells = experiment.survey(views)
    surveyed = time.perf_counter() - started
    views = dataclasses.replace(views, mask=None)  # live has it
    pixels, gather = views.pixels, fitting.has_no_room(views.pixels)
    if gather:
        rows = np.zeros_like(pixels, shape=(options.batch_size, pixels.shape[1]))
        views = dataclasses.replace(views, pixels=Gathered(rows=rows, shape=pixels.shape))
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
        (views, live, cells),
        parallel.block_of(options, experiment.samples_per_ray),
    )
    if gather:
        ids = functools.partial(experiment.ids, positions=np.arange(options.batch_size))
        run = fitting.gather_ahead(run, jax.jit(lambda step, data: ids(step, data=data)), pixels)
    return run, *placed, surveyed, time.perf_counter() - started - surveyed


def _row(experiment, step, recent, clock, compile_seconds):
    """Returns the metrics since the last row: means of the errors, the rest as it stands."""
    values = {name: np.array([float(metrics[name]) for metrics in recent]) for name in recent[0]}
    left_out = int(values["left_out"][-1]) if "left_out" in values else 0
    rays = step * experiment.train.batch_size - left_out
    return {
        "step": step,
        "seconds": clock.seconds(),
        "compile_seconds": compile_seconds,
        "rays": rays,
        "rays_per_second": clock.rate(rays),
        "loss": values["loss"].mean(),
        "psnr_coarse": float(decibels(values["mse_coarse"].mean())),
        "psnr_fine": float(decibels(values["mse"].mean())),
        "lr": float(experiment.schedule(step - 1)),
        "grad_norm": values["grad_norm"][-1],
        "nonfinite": int(values["nonfinite"][-1]),
        "nonfinite_in_a_row": int(values["nonfinite_in_a_row"][-1]),
        "left_out": left_out,
        **{name: int(values[name][-1]) for name in values if name == "revived" or name.startswith("dead_")},
    }


def _text(row, options, late):
    left = (options.max_steps - row["step"]) * options.batch_size / max(row["rays_per_second"], 1e-9)
    if options.max_seconds:
        left = min(left, options.max_seconds - row["seconds"])
    missed = f"  {row['nonfinite']} steps not finite" if row["nonfinite"] else ""
    if row["left_out"]:
        drawn = row["rays"] + row["left_out"]
        missed += f"  {row['left_out'] / drawn:.0%} of rays found the pool full"
    missed += "".join(f"  {name} network dead" for name in revival.dead_networks(row))
    missed += f"  networks begun anew: {row['revived']}" if row["revived"] else ""
    return (
        f"{row['psnr_fine']:.2f} dB  {row['rays_per_second']:,.0f} rays/s  "
        f"{_minutes(row['seconds'])} done, {_minutes(0.0 if late else left)} left{missed}"
    )


def _minutes(seconds):
    minutes, seconds = divmod(int(seconds), 60)
    return f"{minutes}:{seconds:02d}"


def _check_finite(row, options, folder):
    if row["nonfinite_in_a_row"] >= options.max_nonfinite:
        raise ValueError(
            f"{folder}: {row['nonfinite_in_a_row']} steps in a row up to {row['step']} had a loss or "
            f"gradient that is not finite (loss {row['loss']}, gradient norm {row['grad_norm']}, "
            f"learning rate {row['lr']:.2g}); nothing of them was kept: lower train.lr_init, or check "
            "images and poses"
        )


def _header(experiment, views, state, survey_seconds, compile_seconds):
    """Returns the lines that say once what runs on what."""
    devices = parallel.devices_of(experiment.train.parallel)
    machines = f", in {jax.process_count()} processes" if jax.process_count() > 1 else ""
    counts = {name: sum(leaf.size for leaf in jax.tree.leaves(part)) for name, part in state.params.items()}
    eyes = np.asarray(views.cameras.to_world)[:, :, 3]
    near, far = np.min(views.near), np.max(views.far)
    dtype = jax.tree.leaves(state.params)[0].dtype
    shares = ", ".join(f"{name} {count:,}" for name, count in counts.items())
    space = []
    if state.grid is not None:
        cells = "x".join(map(str, state.grid.possible.shape))
        share = float(state.grid.possible.mean())
        space = [f"space       {share:.1%} of {cells} cells possible, found in {survey_seconds:.1f} s"]
    return "\n".join(
        [
            f"device      {len(devices)} x {devices[0].device_kind} ({devices[0].platform}){machines}",
            f"precision   parameters {dtype}; compiled in {compile_seconds:.1f} s",
            f"parameters  {sum(counts.values()):,} ({shares})",
            f"views       {len(views.offset)}, {views.pixels.shape[0]:,} pixels, t from {near:g} to {far:g}",
            *space,
            f"cameras     within {_point(eyes.min(0))} to {_point(eyes.max(0))}",
            f"steps       {int(state.step)} of {experiment.train.max_steps} taken, "
            f"{experiment.train.batch_size} rays each",
        ]
    )


def _point(values):
    return "(" + ", ".join(f"{value:.2f}" for value in values) + ")"
