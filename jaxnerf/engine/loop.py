"""The training loop: resume, step, log, save, stop cleanly."""

import functools
import sys
import time

import jax
import numpy as np

from jaxnerf.core.metrics import decibels
from jaxnerf.engine import build, parallel, records, revival, workdir
from jaxnerf.engine.checkpoint import Checkpoints
from jaxnerf.engine.control import Clock, Interrupt
from jaxnerf.engine.evaluate import evaluate
from jaxnerf.engine.fit import fit_config, fit_data
from jaxnerf.engine.state import create_state
from jaxnerf.engine.step import make_train_step


def train_and_evaluate(config, folder):
    """Trains as a configuration says, from the last checkpoint under folder if there is one.

    Args:
        config: ConfigDict, see configs/default.py.
        folder: the workdir; made if missing.

    Returns:
        Whether training came to its end (False: stopped by Ctrl-C or SIGTERM, saved).

    Raises:
        ValueError: on bad input, or when too many steps in a row were not finite.
    """
    started = time.perf_counter()
    config, found = fit_data(config)
    print(*found, sep="\n", end="\n" if found else "", file=sys.stderr)
    views = build.load_views(config.data, "train")  # before the workdir is made: bad input leaves nothing
    config, chosen = fit_config(config, views)
    experiment = build.build(config)
    options = experiment.train
    devices = parallel.devices_of(options.parallel)
    parallel.split_positions(options.batch_size, len(devices), options.block_size)
    workdir.claim(folder, config)
    print(
        "\n".join([f"views       read in {time.perf_counter() - started:.1f} s", *chosen]),
        file=sys.stderr,
    )
    finished = train(experiment, views, folder)
    if finished and experiment.eval.at_end:
        evaluate(folder)
    return finished


def train(experiment, views, folder):
    """Runs the loop of train_and_evaluate on Views that were read; returns whether it came to its end."""
    options = experiment.train
    run, state, data, survey_seconds, compile_seconds = _compile(experiment, views)
    checkpoints = Checkpoints(folder, keep=options.keep)
    if checkpoints.steps():
        state = checkpoints.load(checkpoints.steps()[-1], state)
    first = int(state.step)
    log = records.Records(folder, first_step=first)
    before = log.rows[-1]["seconds"] if log.rows else 0.0
    print(_header(experiment, views, state, survey_seconds, compile_seconds), file=sys.stderr)
    progress = records.Progress(options.max_steps)
    clock = Clock(before, first * options.batch_size - int(state.counters.get("left_out", 0)))
    look = revival.make_look(experiment, folder)
    recent = []
    done = first >= options.max_steps or 0 < options.max_seconds <= before
    with Interrupt() as interrupt:
        for step in range(first + 1, first + 1 if done else options.max_steps + 1):
            state, metrics = look(step, *run(state, data))
            recent.append(metrics)
            jax.block_until_ready(recent[-2:][0])  # one step in flight, no more: a stop is prompt
            late = 0 < options.max_seconds <= clock.seconds()
            last = step == options.max_steps or late or interrupt.caught
            if step % options.log_every == 0 or last:
                row = _row(experiment, step, recent, clock, compile_seconds)
                log.append(row)
                progress.show(step, _text(row, options, late))
                recent = []
                _check_finite(row, options, folder)
            if step % options.save_every == 0 or last:
                with clock.paused():
                    checkpoints.save(state)
            if last:
                break
    progress.close()
    checkpoints.close()
    log.close()
    if interrupt.caught:
        print(
            f"stopped at step {int(state.step)} and saved; the same command goes on from there",
            file=sys.stderr,
        )
    return not interrupt.caught


def _compile(experiment, views):
    options = experiment.train
    started = time.perf_counter()
    possible, live, cells = experiment.survey(views)
    surveyed = time.perf_counter() - started
    step = make_train_step(experiment.model, experiment.optimizer, experiment.draw)
    placed = parallel.compile_step(
        step,
        functools.partial(create_state, experiment.model, experiment.optimizer, experiment.seed, possible),
        (views, live, cells),
        batch_size=options.batch_size,
        block_size=options.block_size,
        samples_per_ray=experiment.samples_per_ray,
        mode=options.parallel,
    )
    return *placed, surveyed, time.perf_counter() - started - surveyed


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
    device = jax.local_devices()[0]
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
            f"device      {jax.local_device_count()} x {device.device_kind} ({device.platform})",
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
