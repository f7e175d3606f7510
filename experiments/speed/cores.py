"""Measures what more CPU cores gain: each part of a training step, whole runs, frames and the set-up.

    JAXNERF_SCENES=... python experiments/speed/cores.py --out=DIR [--cores=1,2] [--runs=fox,lego] [--rounds=3]

Each measurement is a process of its own on so many cores, and the numbers of cores take turns, so that a machine that
gets slower does so for all. Writes DIR/<run>-<kind>-<cores>-<round>.json and prints the tables of medians. What DIR
holds is not measured again. A run of --seconds on several cores has a run of --gain times the seconds on one core
beside it; held-out views score both. Frames are those of the run on the fewest cores. With --page the tables replace
what lies between <!-- cores --> and <!-- end of cores --> in that file.
"""

import itertools
import os
import pathlib
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping, Sequence
from typing import Any

import jax
from absl import flags

sys.path.append(str(pathlib.Path(__file__).resolve().parents[1]))
import common
from speed import step_parts

from jaxnerf.core.cameras import pixel_grid
from jaxnerf.evaluation import evaluate, restore
from jaxnerf.evaluation.supersampling import render_pixels
from jaxnerf.runtime import cli
from jaxnerf.training import auto_config, build

_OUT = flags.DEFINE_string("out", None, "Folder of the measurements.", required=True)
_CORES = flags.DEFINE_list("cores", ["1", "2"], "Numbers of cores, ascending.")
_RUNS = flags.DEFINE_list("runs", [], "Runs of step_parts.py, such as lego_400; all by default.")
_ROUNDS = flags.DEFINE_integer("rounds", 3, "Measurements of each run with each number of cores.", lower_bound=1)
_SECONDS = flags.DEFINE_float("seconds", 60, "Of training of a whole run; 0: no whole runs.", lower_bound=0)
_GAIN = flags.DEFINE_float("gain", 1.75, "How many times as long the fewest cores train.", lower_bound=1)
_PARTS = flags.DEFINE_bool("parts", True, "Whether the parts of a step are measured, too.")
_ONE = flags.DEFINE_list("one", None, "kind,run,seconds,workdir: measures this here, into the file --out.")
_WARM_UP, _STEPS, _VIEWS, _FRAMES = 1000, 64, 8, 5
_ROWS = {
    "ms_per_step": ("ms a step", "{:.1f}"),
    "rays_per_second": ("rays a second", "{:,.0f}"),
    "frame": ("s a frame", "{:.2f}"),
    "setup": ("s of set-up", "{:.2f}"),
}


def main(argv: list[str]) -> None:
    """Measures what is missing, then prints the tables."""
    del argv
    out = pathlib.Path(_OUT.value)
    if _ONE.value:
        kind, name, seconds, workdir = _ONE.value
        measure = {"parts": _parts, "run": _whole_run, "frame": _frame}[kind]
        common.write_json(out, measure(name, float(seconds), workdir))
        return
    known = [_short(name) for name in step_parts.RUNS]
    runs = common.chosen("--runs", _RUNS.value or known, known)
    counts, kinds = (
        [int(count) for count in _CORES.value],
        ["run", "frame"] * bool(_SECONDS.value) + ["parts"] * _PARTS.value,
    )
    for turn in range(_ROUNDS.value):
        for kind, name, count in itertools.product(kinds, runs, counts):
            path = _path(out, name, kind, count, turn)
            if not path.exists():
                seconds = _SECONDS.value * (_GAIN.value if count == counts[0] else 1)
                workdir = _path(out, name, "run", counts[0] if kind == "frame" else count, turn).with_suffix("")
                command = [sys.executable, __file__, f"--one={kind},{name},{seconds},{workdir}", f"--out={path}"]
                with common.few_cores(count):
                    subprocess.run(command, check=True, env=dict(os.environ))

    def read(name, kind):
        found = ([_path(out, name, kind, count, turn) for turn in range(_ROUNDS.value)] for count in counts)
        return dict(zip(counts, ([common.read_json(path) for path in paths] for paths in found), strict=True))

    lines = [*common.provenance(), ""]
    if "run" in kinds:
        found = {name: (read(name, "run"), read(name, "frame")) for name in runs}
        merged = {
            name: {
                count: [each | frame for each, frame in zip(by_count[count], frames[count], strict=True)]
                for count in counts
            }
            for name, (by_count, frames) in found.items()
        }
        lines += [*runs_table(merged), ""]
    if "parts" in kinds:
        lines += [*parts_table({name: read(name, "parts") for name in runs}), ""]
    common.publish(lines[:-1], "cores")


def _short(name):
    """Returns the name of a run of step_parts.py without its unit: lego_400."""
    return name.removesuffix(" px").replace(", ", "_")


def _path(out, name, kind, count, turn):
    return out / f"{name}-{kind}-{count}-{turn}.json"


def _config(name):
    return common.configuration(*step_parts.RUNS[{_short(each): each for each in step_parts.RUNS}[name]])


def _parts(name, seconds, workdir):
    del seconds, workdir
    return step_parts.measure(_config(name), warm_up=_WARM_UP, num_steps=_STEPS)


def _whole_run(name, seconds, workdir):
    """Trains a run for so long; returns its steps, the held-out PSNR and the seconds of the set-up."""
    changes = {"train.max_seconds": seconds, "train.max_steps": 10**6, "data.hold_out": _VIEWS}
    config = common.changed(_config(name), changes)
    prepare_seconds = min(_prepare(config) for _ in range(2))  # the first compiles
    if not evaluate.train_and_evaluate(config, workdir):
        raise KeyboardInterrupt
    run, variables, views = _restored(workdir)
    step, rays = run.steps()[-1], run.experiment.config.train.batch_size
    return {
        "steps": step,
        "psnr": common.mean_psnr(run, variables, views, most=_VIEWS),
        "ms_per_step": 1e3 * seconds / step,
        "rays_per_second": step * rays / seconds,
        "setup": prepare_seconds,
    }


def _frame(name, seconds, workdir):
    """Returns the seconds of a frame of a run."""
    del name, seconds
    run, variables, views = _restored(workdir)
    pixels = pixel_grid(*(int(side) for side in views.size[0]))
    found = common.times(lambda: render_pixels(run, variables, views, 0, pixels)[0].rgb, _FRAMES)
    return {"frame": statistics.median(found)}


def _restored(workdir):
    run = restore.restore_run(workdir)
    return run, run.variables(run.steps()[-1]), run.experiment.load_split("held_out")


def _prepare(config):
    """Returns the seconds of the set-up with an empty cache of images; compiled programs are in memory."""
    before = os.environ.get("XDG_CACHE_HOME")
    with tempfile.TemporaryDirectory() as folder:
        os.environ["XDG_CACHE_HOME"] = folder
        try:
            started = time.perf_counter()
            config, views, _ = auto_config.resolve(config)
            config, _ = auto_config.resolve_for_device(config)
            jax.block_until_ready(build.build(config).prepare(views)[1])
            return time.perf_counter() - started
        finally:
            os.environ.pop("XDG_CACHE_HOME") if before is None else os.environ.update(XDG_CACHE_HOME=before)


def runs_table(measured: Mapping[str, Mapping[int, Sequence[Mapping[str, Any]]]]) -> list[str]:
    """Returns the lines of the table of whole runs: {name: {cores: results}}, the least cores first.

    A cell has the medians for each number of cores, and how many times as fast each is as the least.
    """
    rows = []
    for name, by_count in measured.items():
        row = [name]
        for key, (_, form) in _ROWS.items():
            least, *more = (statistics.median(each[key] for each in found) for found in by_count.values())
            gains = (value / least if key == "rays_per_second" else least / value for value in more)
            cells = [f"{form.format(value)} ({gain:.2f})" for value, gain in zip(more, gains, strict=True)]
            row.append(", ".join([form.format(least), *cells]))
        psnr = (statistics.median(each["psnr"] for each in found) for found in by_count.values())
        rows.append([*row, ", ".join(f"{value:.2f}" for value in psnr)])
    heads = [f"{', '.join(map(str, by_count))} cores (times faster)", *(label for label, _ in _ROWS.values())]
    return common.markdown([*heads, "held-out PSNR, dB"], rows)


def parts_table(measured: Mapping[str, Mapping[int, Sequence[Mapping[str, Any]]]]) -> list[str]:
    """Returns the lines of the table of a step's parts: {name: {cores: results of step_parts.measure}}.

    A cell has the ms for each number of cores, and the serial part of the time on the least.
    """
    medians = {
        name: {count: _medians(found) for count, found in by_count.items()} for name, by_count in measured.items()
    }
    parts = list(dict.fromkeys(part for by_count in medians.values() for each in by_count.values() for part in each))
    rows = []
    for part in parts:
        row = [part]
        for by_count in medians.values():
            (least, before), *more = ((count, found.get(part, 0.0)) for count, found in by_count.items())
            cells = [f"{before:.1f}"]
            for count, after in more:
                serial = f"{serial_fraction(before / after, count / least):.0%}" if before and after else "-"
                cells.append(f"{after:.1f} ({serial})")
            row.append(", ".join(cells))
        rows.append(row)
    return common.markdown(["ms a step (serial)", *medians], rows)


def serial_fraction(gain: float, cores: float) -> float:
    """Returns the part of the time on one core that only one core works, by Amdahl's law, in [0, 1]."""
    return min(max((cores / gain - 1) / (cores - 1), 0.0), 1.0)


def _medians(results):
    """Returns the ms of the whole step, without the profiler, and of each part: medians over the rounds."""
    whole = statistics.median(result["ms"] for result in results)
    parts = {part for result in results for part in result["parts"]}
    medians = {part: statistics.median(result["parts"].get(part, 0.0) for result in results) for part in parts}
    return {"whole step": whole, **dict(sorted(medians.items(), key=lambda item: -item[1]))}


if __name__ == "__main__":
    cli.run(main)
