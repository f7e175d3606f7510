"""Trains a run for some seconds, scores it, and says what it took."""

import pathlib
import time
from typing import Any

from jaxnerf.evaluation.evaluate import score_run, train_and_evaluate
from jaxnerf.evaluation.restore import restore_run
from jaxnerf.options import replaced
from jaxnerf.runtime.atomic_files import read_json, to_json, write_text
from jaxnerf.tools.curve import machine
from jaxnerf.training import metric_log, workdir
from jaxnerf.training.config import Config, RunConfig, read_config

SCORE, PEAK = "score.json", "peak_memory.json"  # in the workdir of a run that is trained and scored
_KEPT = ("step", "psnr", "ssim", "seconds_per_frame", "views", "parameters")
_MORE = ("psnr_truncated", "psnr_float", "lpips", "settings", "conventions", "comparable_with", "images")


def at_time(config: Config, time_limit: float) -> RunConfig:
    """Returns a config that trains for so many seconds."""
    config = read_config(config)
    return replaced(config, train=replaced(config.train, max_seconds=float(time_limit)))


def run_to(time_limit: float, config: Config, where: pathlib.Path) -> dict[str, Any] | None:
    """Returns the scores of a run after so many seconds of training, or None if it was interrupted.

    The learning rate reaches its end when the time does, so a run of each length says what its time buys; what a
    longer run has reached by then is less.

    Args:
        time_limit: seconds of training, without compilation and set-up.
        config: of the run.
        where: its workdir; an interrupted run continues. Comparable seconds are scaled by the machine's speed just
            before and after the run.
    """
    fresh = not metric_log.read_rows(where)
    speed, started = [machine.matrix_gflops()], time.perf_counter()
    if not train_and_evaluate(at_time(config, time_limit), where):
        return None
    wall = time.perf_counter() - started
    speed.append(machine.matrix_gflops())
    result = score_run(restore_run(where), where, overwrite=True)
    trained, compiling = result["training_seconds"], result["compile_seconds"]
    return {
        "time_limit": time_limit,
        "ended": result["step"] >= workdir.load_config(where).train.max_steps,
        "seconds": trained,
        "comparable": machine.comparable(trained, sum(speed) / 2),
        "gflops": speed,
        "compile_seconds": compiling,
        "setup_seconds": wall - trained - compiling if fresh else None,  # not known of a run that was interrupted
        "rays": result["rays_seen"],
        **{key: result[key] for key in _KEPT},
        **{key: result[key] for key in _MORE if key in result},
    }


def covers(point: dict[str, Any], time_limit: float) -> bool:
    """Returns whether a run of so many seconds need not be measured: it was, or a shorter one ended by itself."""
    return point["time_limit"] == time_limit or (point["ended"] and point["time_limit"] < time_limit)


def keep_peak(folder: pathlib.Path) -> dict[str, float | None]:
    """Returns the peak memory in MB of the processes of a run so far: this one, and those that were interrupted."""
    path = folder / PEAK
    before = read_json(path, "remove it") if path.exists() else {}
    used = machine.peak_memory()
    peak = {key: max(filter(None, (value, before.get(key))), default=None) for key, value in used.items()}
    if folder.exists():
        write_text(path, to_json(peak) + "\n")
    return peak
