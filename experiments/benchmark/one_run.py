"""Trains and scores one run of the benchmark, which run.py starts in a process of its own.

    JAXNERF_SCENES=... python experiments/benchmark/one_run.py --job=lego_100 --seconds=60 --workdir=DIR

Writes DIR/score.json. The same command continues an interrupted run. The process has its peak memory, compiled programs
and cores for itself.
"""

import pathlib
import platform
import re
import resource
import sys
import time

import jax
from absl import flags

sys.path.append(str(pathlib.Path(__file__).resolve().parents[1]))
import common
from benchmark import jobs, settings
from speed import training

from jaxnerf.runtime import cli
from jaxnerf.runtime.atomic_files import read_json

_JOB = flags.DEFINE_string("job", None, f"The job, of {', '.join(jobs.JOBS)}.", required=True)
_SECONDS = flags.DEFINE_float("seconds", None, "Seconds of training.", required=True, lower_bound=0.1)
_SET = settings.define_set()
_WORKDIR = flags.DEFINE_string("workdir", None, "Folder of the run.", required=True)
_STOPPED = 130  # the exit status of a run that a signal stopped
_KEPT = ("psnr_truncated", "psnr_float", "lpips", "settings", "conventions", "comparable_with", "images")


def main(argv: list[str]) -> int:
    """Trains and scores the run; returns the exit status."""
    del argv
    folder = pathlib.Path(_WORKDIR.value)
    name = common.chosen("--job", [_JOB.value], list(jobs.JOBS))[0]
    overrides = settings.parse(_SET.value)
    config = jobs.configuration(jobs.JOBS[name], overrides)
    try:
        point = training.run_to(_SECONDS.value, config, folder)
    finally:
        peak = keep_peak(folder)
    if point is None:
        return _STOPPED
    results = read_json(folder / "eval" / str(point["step"]) / "results.json", "score it again")
    origin = {"job": name, "overrides": {**jobs.JOBS[name].overrides, **overrides}}
    origin |= {"config": common.plain_config(jobs.at_time(config, _SECONDS.value))}
    about = {"commit": common.commit(), "datetime": time.strftime("%FT%T", time.gmtime()), "cpu": _cpu()}
    about |= {"machine": common.describe_machine(), "device": jax.devices()[0].device_kind}
    about |= {"backend": jax.default_backend(), "jax": jax.__version__}
    scores = {key: results[key] for key in _KEPT if key in results}
    common.write_json(folder / settings.SCORE, {**origin, **about, **point, **peak, **scores})
    return 0


def keep_peak(folder: pathlib.Path) -> dict[str, float | None]:
    """Returns the peak memory in MB of the processes of a run so far: this one, and those that were interrupted."""
    path = folder / "peak_memory.json"
    used = {"peak_memory_mb": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / _units_per_mb()}
    on_device = (jax.local_devices()[0].memory_stats() or {}).get("peak_bytes_in_use")
    used["peak_device_memory_mb"] = on_device and on_device / 1e6
    before = common.read_json(path)
    peak = {key: max(filter(None, (value, before.get(key))), default=None) for key, value in used.items()}
    if folder.exists():
        common.write_json(path, peak)
    return peak


def _cpu():
    """Returns the name of the processor, where Linux reports it."""
    path = pathlib.Path("/proc/cpuinfo")
    found = re.search(r"^model name\s*: (.*)$", path.read_text() if path.exists() else "", re.MULTILINE)
    return found.group(1).strip() if found else platform.processor() or platform.machine()


def _units_per_mb():
    return 1e6 if sys.platform == "darwin" else 1e6 / 1024  # Linux counts KiB


if __name__ == "__main__":
    cli.run(main, stopped="within a run; what is finished is saved, and the same command continues")
