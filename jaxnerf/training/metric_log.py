"""The record of a run: metrics.jsonl, event files for TensorBoard, and the lines that the terminal shows."""

import json
import logging
import math
import os
import pathlib
import sys
from typing import Any

import jax
import numpy as np
from jaxtyping import Int

from jaxnerf.core.metrics import decibels
from jaxnerf.core.views import Views
from jaxnerf.runtime import cores
from jaxnerf.runtime.atomic_files import naming, open_regular, parse_json, partial_file, read_bytes, write_text
from jaxnerf.runtime.processes import Detail
from jaxnerf.training.dead_networks import dead_networks
from jaxnerf.training.options import UNLIMITED_STEPS
from jaxnerf.training.pace import Clock, Pace
from jaxnerf.training.state import TrainState

_logger = logging.getLogger(__name__)
_READ_AGAIN = ("step", "seconds", "rays", "compile_seconds")  # by a run that resumes, its evaluation or its summary


class MetricLog:
    """The rows of metrics.jsonl, one JSON object per line, ascending in step; also written as events."""

    def __init__(self, workdir: str | os.PathLike, *, first_step: int, write: bool = True):
        """Opens the file to append, without rows after first_step.

        Lines that are not valid rows are dropped with a message, and the damaged file is kept.

        Args:
            workdir: of the run.
            first_step: at which training resumes.
            write: False keeps rows in memory only; of several processes the first one writes.
        """
        self._path = pathlib.Path(workdir) / "metrics.jsonl"
        rows, damaged, cut = _parse(self._path)
        self.rows = [row for row in rows if row["step"] <= first_step]
        self._write, self._events = write, None
        if not write:
            return
        if damaged:
            kept = self._path.with_name("metrics.jsonl.damaged")
            with partial_file(kept) as partial:
                partial.write_bytes(read_bytes(self._path))
            lines = f"{len(damaged)} lines from line {damaged[0]} on that are not rows"
            print(f"{self._path}: dropped {lines}; the file is kept as {kept.name}", file=sys.stderr)
        if cut:
            print(f"{self._path}: dropped an incomplete last line", file=sys.stderr)
        write_text(self._path, "".join(json.dumps(row) + "\n" for row in self.rows))
        from jaxnerf.tools.interop.tensorboard import EventFile

        self._events = EventFile(workdir, first_step=first_step)

    @property
    def seconds(self) -> float:
        """Returns the seconds of training at the last row; 0 before the first."""
        return self.rows[-1]["seconds"] if self.rows else 0.0

    def append(self, row: dict[str, Any]) -> None:
        """Adds a row: "step" and other numbers. NaN and infinity are written as Python's json writes them."""
        self.rows.append(row)
        if not self._write:
            return
        with naming(self._path), open_regular(self._path, "a") as file:
            file.write(json.dumps(row) + "\n")
        self._events.append(row)

    def close(self) -> None:
        if self._events is not None:
            self._events.close()


def read_rows(workdir: str | os.PathLike) -> list[dict[str, Any]]:
    """Returns the complete rows of a workdir's metrics.jsonl; its last line may be incomplete while a run writes."""
    path = pathlib.Path(workdir) / "metrics.jsonl"
    rows, damaged, _ = _parse(path)
    if damaged:
        _logger.warning("%s: skipped %d lines from line %d on", path, len(damaged), damaged[0])
    return rows


def _parse(path):
    """Returns rows, the numbers of lines that are not rows, and whether the last line is incomplete."""
    *lines, last = read_bytes(path).split(b"\n") if path.exists() else [b""]
    found = [_parse_row(line) for line in lines]
    damaged = [number for number, row in enumerate(found, 1) if row is None]
    if _parse_row(last):
        found.append(_parse_row(last))
    return [row for row in found if row], damaged, bool(last) and not _parse_row(last)


def _parse_row(line):
    """Returns the row that a line in bytes holds: numbers, those that a run reads again finite; or None."""
    try:
        row = parse_json(line)
    except ValueError:
        return None
    if not isinstance(row, dict) or type(row.get("step")) is not int:
        return None
    numbers = all(type(value) is float or (type(value) is int and abs(value) < 2**63) for value in row.values())
    finite = numbers and all(0 <= row.get(name, 0) < 2**63 for name in _READ_AGAIN)
    return row if finite and "seconds" in row else None


def header(experiment: Any, views: Views, state: TrainState, compiled: Any) -> list[str]:
    """Returns the lines that describe a run before its first step; compiled: its CompiledStep."""
    options, devices = experiment.config.train, jax.devices()
    processes = f", in {jax.process_count()} processes" if jax.process_count() > 1 else ""
    if devices[0].platform == "cpu":
        processes = f" on {(count := cores.usable())} core{'s' * (count > 1)}{processes}"
    counts = {name: sum(leaf.size for leaf in jax.tree.leaves(part)) for name, part in state.params.items()}
    parts = ", ".join(f"{name} {count:,}" for name, count in counts.items())
    dtype = jax.tree.leaves(state.params)[0].dtype
    eyes = np.asarray(views.cameras.to_world)[:, :, 3]
    low, high = (", ".join(f"{value:.2f}" for value in corner) for corner in (eyes.min(0), eyes.max(0)))
    lines = [
        f"device        {len(devices)} x {devices[0].device_kind} ({devices[0].platform}){processes}",
        Detail(f"parameters    {sum(counts.values()):,} {dtype} ({parts})"),
        f"views         {len(views.offset)} with {views.pixels.shape[0]:,} pixels, "
        f"t from {np.min(views.near):g} to {np.max(views.far):g}",
        Detail(f"cameras       from ({low}) to ({high})"),
    ]
    if state.grid is not None:
        cells = "x".join(map(str, state.grid.valid.shape))
        fraction = float(state.grid.valid.mean())
        lines.append(
            Detail(f"grid          {fraction:.1%} of {cells} cells valid, in {compiled.prepare_seconds:.1f} s")
        )
    lines += [
        f"compiled      in {compiled.compile_seconds:.1f} s",
        f"steps         {of_all(int(state.step), options)} done, {options.batch_size} rays per step in "
        f"microbatches of {min(options.microbatch_size, options.batch_size // len(devices) // compiled.num_threads)}",
    ]
    return lines


def row(
    experiment: Any, step: int, recent: list[dict[str, Any]], clock: Clock, pace: Pace, compile_seconds: float
) -> dict[str, Any]:
    """Returns the row of metrics at a step.

    Args:
        experiment: of the run.
        step: steps taken.
        recent: the metrics of the steps since the last row, numbers or arrays [steps of a dispatch]. Losses and
            errors are averaged over them; of all other metrics the last values count.
        clock, pace: of the run.
        compile_seconds: that compiling the step took.
    """
    recent = jax.device_get(recent)  # one transfer for all
    values = {name: np.concatenate([np.ravel(part[name]).astype(float) for part in recent]) for name in recent[0]}
    last = {name: value[-1] for name, value in values.items()}
    rays_dropped = int(last.get("rays_dropped", 0))
    rays = step * experiment.config.train.batch_size - rays_dropped
    return {
        "step": step,
        "seconds": clock.seconds(),
        "compile_seconds": compile_seconds,
        "rays": rays,
        "rays_per_second": clock.rate(rays),
        "loss": values["loss"].mean(),
        **{name: value.mean() for name, value in values.items() if name.startswith("loss_")},
        **{f"psnr_{name}": float(decibels(values[f"mse_{name}"].mean())) for name in experiment.model.image_networks},
        "lr": float(experiment.schedule(step - 1)) * pace.scale,
        "grad_norm": last["grad_norm"],
        "nonfinite": int(last["nonfinite"]),
        "nonfinite_in_a_row": int(last["nonfinite_in_a_row"]),
        "rays_dropped": rays_dropped,
        **{name: int(last[name]) for name in last if name == "num_reinits" or name.startswith("dead_")},
    }


def has_ended(options: Any, steps: list[int], workdir: str | os.PathLike) -> bool:
    """Returns whether the last of a run's checkpoints is that of its end, by its steps or by its clock."""
    rows = read_rows(workdir) if steps else []
    late = rows and rows[-1]["step"] == steps[-1] and 0 < options.max_seconds <= rows[-1]["seconds"]
    return bool(steps) and (steps[-1] >= options.max_steps or bool(late))


def all_steps(options: Any) -> int | None:
    """Returns the number of steps of a run, or None if only train.max_seconds limits it; options: section `train`."""
    return None if options.max_seconds and options.max_steps >= UNLIMITED_STEPS else options.max_steps


def of_all(step: int, options: Any) -> str:
    """Returns "1,000 of 2,000", or "1,000" where the number of all steps is not known."""
    total = all_steps(options)
    return f"{step:,}" + (f" of {total:,}" if total else "")


def fraction_done(row: dict[str, Any], options: Any) -> float:
    """Returns the fraction of a run that is done at a row of metrics: by its steps or its time, whichever is larger."""
    by_time = row["seconds"] / options.max_seconds if options.max_seconds else 0.0
    return max(row["step"] / options.max_steps, by_time)


def line(row: dict[str, Any], options: Any, *, out_of_time: bool) -> str:
    """Returns a row as a line for the terminal.

    Args:
        row: see `row`.
        options: the config's section `train`.
        out_of_time: whether train.max_seconds has passed.
    """
    left = _seconds_left(row, options)
    notes = f"  {row['nonfinite']} nonfinite steps" if row["nonfinite"] else ""
    if row["rays_dropped"]:
        fraction = row["rays_dropped"] / (row["rays"] + row["rays_dropped"])
        notes += f"  {fraction:.0%} of rays dropped"
    notes += "".join(f"  {name} network dead" for name in dead_networks(row))
    notes += f"  {row['num_reinits']} networks reinitialized" if row["num_reinits"] else ""
    return (
        f"{final_psnr(row):.2f} dB  {row['rays_per_second']:,.0f} rays/s  "
        f"{minutes(row['seconds'])} elapsed, {minutes(0.0 if out_of_time else left)} left{notes}"
    )


def passes(row: dict[str, Any], options: Any, size: Int[np.ndarray, "V 2"]) -> str:
    """Returns a line: how often a run reads each pixel at the pace of a row, and the width that it would read twice.

    Args:
        row: see `row`.
        options: the config's section `train`.
        size: [V, 2] height and width of the images, px.
    """
    rays = row["rays"] + row["rays_per_second"] * _seconds_left(row, options)
    total = int(np.prod(np.asarray(size, np.int64), axis=1).sum())
    line = f"passes        {rays / total:.2g} over {total:,} pixels at this pace"
    width = max(int(size[:, 1].mean() * math.sqrt(rays / total / 2)), 1)
    return line + (f"; images {width} px wide would be read twice" if rays < total else "")


def _seconds_left(row, options):
    left = (options.max_steps - row["step"]) * options.batch_size / max(row["rays_per_second"], 1e-9)
    return min(left, options.max_seconds - row["seconds"]) if options.max_seconds else left


def final_psnr(row: dict[str, Any]) -> float | None:
    """Returns the PSNR of the final rendering, dB, of a row of metrics; None if the row has none."""
    return next((value for name, value in reversed(row.items()) if name.startswith("psnr_")), None)


def minutes(seconds: float) -> str:
    """Returns a duration as minutes and seconds, such as 1:05."""
    minutes, seconds = divmod(int(seconds), 60)
    return f"{minutes}:{seconds:02d}"
