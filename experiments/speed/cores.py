"""Measures what more CPU cores gain: each part of a training step, whole runs, frames and the set-up.

    JAXNERF_SCENES=... python experiments/speed/cores.py --out=DIR [--cores=1,2] [--runs=fox,lego] [--rounds=3]

Each measurement is a process of its own on so many cores, and the numbers of cores take turns, so that a machine that
gets slower does so for all. Writes DIR/<run>-<kind>-<cores>-<round>.json and prints the tables of medians. What DIR
holds is not measured again. A run of --seconds on several cores has a run of --gain times the seconds on one core
beside it; held-out views score both. Frames are those of the run on the fewest cores. Of the runs of --beside two are
trained at once, too, on the most cores. With --page the tables replace what lies between <!-- cores --> and <!-- end of
cores --> in that file, or, in the README, a short one those between the marks "all_cores".
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
from gpu import profiles
from speed import step_parts

from jaxnerf.core.cameras import pixel_grid
from jaxnerf.evaluation import evaluate, restore
from jaxnerf.evaluation.supersampling import render_pixels
from jaxnerf.runtime import cli
from jaxnerf.training import auto_config, build
from jaxnerf.training.compiled_step import compile_training

_OUT = flags.DEFINE_string("out", None, "Folder of the measurements.", required=True)
_CORES = flags.DEFINE_list("cores", ["1", "2"], "Numbers of cores, ascending.")
_RUNS = flags.DEFINE_list("runs", [], "Runs of step_parts.py, such as lego_400; all by default.")
_ROUNDS = flags.DEFINE_integer("rounds", 3, "Measurements of each run with each number of cores.", lower_bound=1)
_SECONDS = flags.DEFINE_float("seconds", 60, "Of training of a whole run; 0: no whole runs.", lower_bound=0)
_GAIN = flags.DEFINE_float("gain", 1.75, "How many times as long the fewest cores train.", lower_bound=1)
_PARTS = flags.DEFINE_list("parts", None, "Runs whose parts of a step are measured, too; those of --runs by default.")
_BESIDE = flags.DEFINE_list("beside", [], "Runs of which two are trained beside each other, for --seconds / 3.")
_TINY = flags.DEFINE_bool("tiny", False, "Tiny sizes, as a test.")
_ONE = flags.DEFINE_list("one", None, "kind,run,seconds,workdir: measures this here, into the file --out.")
_WARM_UP, _STEPS, _VIEWS, _FRAMES = 1000, 64, 8, 5
_PREDICTED = (4, 8, 16)  # cores
_ROWS = {
    "ms_per_step": ("ms a step", "{:.1f}"),
    "rays_per_second": ("rays a second", "{:,.0f}"),
    "frame": ("s a frame", "{:.2f}"),
    "setup": ("s of set-up", "{:.2f}"),
}
_TIMES = {"ms_per_step": "a step", "frame": "a frame", "setup": "set-up"}


def main(argv: list[str]) -> None:
    """Measures what is missing, then prints the tables."""
    del argv
    out = pathlib.Path(_OUT.value)
    if _ONE.value:
        kind, name, seconds, workdir = _ONE.value
        measure = {"parts": _parts, "run": _whole_run, "frame": _frame, "beside": _beside, "rate": _rate}[kind]
        common.write_json(out, measure(name, float(seconds), workdir))
        return
    known = [_short(name) for name in step_parts.RUNS]
    runs = common.chosen("--runs", _RUNS.value or known, known)
    beside = common.chosen("--beside", _BESIDE.value, known)
    counts = [int(count) for count in _CORES.value]
    in_parts = runs if _PARTS.value is None else common.chosen("--parts", _PARTS.value, runs)
    plan = []
    for turn in range(_ROUNDS.value):
        for kinds, names in ((["run", "frame"] * bool(_SECONDS.value), runs), (["parts"], in_parts)):
            plan += [(turn, *each) for each in itertools.product(kinds, names, counts)]
        plan += [(turn, "beside", name, counts[-1]) for name in beside]
    for turn, kind, name, count in plan:
        path = _path(out, name, kind, count, turn)
        if not path.exists():
            seconds = _SECONDS.value * (_GAIN.value if count == counts[0] else 1)
            workdir = _path(out, name, "run", counts[0] if kind == "frame" else count, turn).with_suffix("")
            command = [sys.executable, __file__, f"--one={kind},{name},{seconds},{workdir}", f"--out={path}"]
            with common.few_cores(count):
                subprocess.run([*command, f"--tiny={_TINY.value}"], check=True, env=dict(os.environ))

    def read(name, kind, counts=tuple(counts)):
        found = ([_path(out, name, kind, count, turn) for turn in range(_ROUNDS.value)] for count in counts)
        return dict(zip(counts, ([common.read_json(path) for path in paths] for paths in found), strict=True))

    lines, short = [*common.provenance(), ""], []
    parts = {name: read(name, "parts") for name in in_parts}
    if _SECONDS.value:
        whole = {}
        for name in runs:
            found, frames = read(name, "run"), read(name, "frame")
            pairs = {count: zip(found[count], frames[count], strict=True) for count in counts}
            whole[name] = {count: [each | frame for each, frame in pair] for count, pair in pairs.items()}
        lines += [*runs_table(whole), ""]
        if len(counts) > 1:
            lines += [*predictions_table(whole, parts), ""]
        short = short_table(whole)
    if parts:
        lines += [*parts_table(parts), ""]
    if beside:
        lines += [*beside_table({name: read(name, "beside", counts[-1:])[counts[-1]] for name in beside}), ""]
    if common.PAGE.value and "<!-- all_cores -->" in pathlib.Path(common.PAGE.value).read_text():
        common.publish(short, "all_cores")
    else:
        common.publish(lines[:-1], "cores")


def _short(name):
    """Returns the name of a run of step_parts.py without its unit: lego_400."""
    return name.removesuffix(" px").replace(", ", "_")


def _path(out, name, kind, count, turn):
    return out / f"{name}-{kind}-{count}-{turn}.json"


def _config(name):
    return profiles.configuration(
        *step_parts.RUNS[{_short(each): each for each in step_parts.RUNS}[name]], tiny=_TINY.value
    )


def _parts(name, seconds, workdir):
    del seconds, workdir
    num_parts = min(len(os.sched_getaffinity(0)), 2)  # as in training on two cores
    return step_parts.measure(_config(name), warm_up=_WARM_UP, num_steps=_STEPS, num_parts=num_parts)


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


def _beside(name, seconds, workdir):
    """Returns the rays a second of a run alone, and of two at once together, with all cores and half of them each."""
    del workdir
    cores = sorted(os.sched_getaffinity(0))
    halves = [cores[: len(cores) // 2], cores[len(cores) // 2 :]]
    arrangements = {"alone": [cores], "all": [cores, cores], "halves": halves}
    return {key: _at_once(name, seconds / 3, each) for key, each in arrangements.items()}


def _at_once(name, seconds, cores_of_each):
    """Returns the rays a second, all together, of trainings that begin at once, each on some cores."""
    before, processes = os.sched_getaffinity(0), []
    for cores in cores_of_each:
        os.sched_setaffinity(0, cores)  # which the process inherits
        command = [sys.executable, __file__, f"--one=rate,{name},{seconds},", f"--out={os.devnull}"]
        command.append(f"--tiny={_TINY.value}")
        processes.append(subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True))
    os.sched_setaffinity(0, before)
    for process in processes:
        while process.stdout.readline().strip() != "ready":
            if process.poll() is not None:
                raise ValueError(f"{name}: a training that was to begin at once with others failed")
    for process in processes:
        print(flush=True, file=process.stdin)
    return sum(float(process.stdout.read().split()[-1]) for process in processes)


def _rate(name, seconds, workdir):
    """Trains when a line comes on the standard input, for so long; prints the rays a second."""
    del workdir
    config, views, _ = auto_config.resolve(_config(name))
    config, _ = auto_config.resolve_for_device(config)
    step, state = compile_training(build.build(config), views)
    run, done = step.of(1), 0

    def take(count):
        nonlocal state
        for _ in range(count):
            state, _ = run(state, step.data)
        jax.block_until_ready(state)

    take(_STEPS)
    print("ready", flush=True)
    input()
    started = time.perf_counter()
    while (passed := time.perf_counter() - started) < seconds:
        take(16)
        done += 16
    print(done * config.train.batch_size / passed)
    return {}


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


def short_table(measured: Mapping[str, Mapping[int, Sequence[Mapping[str, Any]]]]) -> list[str]:
    """Returns the lines of the README's table: steps and frames a second on the least and on the most cores."""
    rows = []
    for name, by_count in measured.items():
        ends = list(by_count.values())[0], list(by_count.values())[-1]
        row = [name.replace("_", ", ") + " px"]
        for key, form in (("ms_per_step", "{:.0f}"), ("frame", "{:.1f}")):
            scale = 1000 if key == "ms_per_step" else 1
            few, many = (scale / statistics.median(each[key] for each in found) for found in ends)
            row.append(f"{form.format(few)}, {form.format(many)} ({many / few:.2f})")
        rows.append(row)
    counts = ", ".join(map(str, (min(by_count), max(by_count))))
    return common.markdown([f"{counts} cores (times faster)", "training steps a second", "frames a second"], rows)


def predictions_table(
    measured: Mapping[str, Mapping[int, Sequence[Mapping[str, Any]]]],
    parts: Mapping[str, Mapping[int, Sequence[Mapping[str, Any]]]],
) -> list[str]:
    """Returns the lines of the table of what Amdahl's law predicts for more cores, from the first two numbers of them.

    Args:
        measured: see `runs_table`.
        parts: see `parts_table`; of these, the prediction is the sum of the parts of a step.
    """

    def cell(before, after, ratio):
        """Returns the serial part of the sum of some times, and the gains."""
        serial = [serial_fraction(a / b, ratio) if b else 0.0 for a, b in zip(before, after, strict=True)]
        gains = (
            sum(before) / sum(a * (s + (1 - s) / n) for a, s in zip(before, serial, strict=True)) for n in _PREDICTED
        )
        whole = sum(a * s for a, s in zip(before, serial, strict=True)) / sum(before)
        return f"{whole:.0%}: " + ", ".join(f"{gain:.1f}" for gain in gains)

    rows = []
    for name, by_count in measured.items():
        (least, few), (more, many) = list(by_count.items())[:2]
        columns = [[[statistics.median(each[key] for each in found)] for found in (few, many)] for key in _TIMES]
        cells = [cell(*column, more / least) for column in columns]
        if name in parts:
            before, after = (_medians(parts[name][count]) for count in (least, more))
            names = sorted(before.keys() - {"whole step"})
            cells.insert(
                1, cell(*([found.get(part, 0.0) for part in names] for found in (before, after)), more / least)
            )
        elif parts:
            cells.insert(1, "-")
        rows.append([name, *cells])
    heads = [f"serial: times faster on {', '.join(map(str, _PREDICTED))} cores", *_TIMES.values()]
    if parts:
        heads.insert(2, "a step by its parts")
    return common.markdown(heads, rows)


def beside_table(measured: Mapping[str, Sequence[Mapping[str, float]]]) -> list[str]:
    """Returns the lines of the table of two runs beside each other: {name: results}."""
    keys = {"alone": "one run", "all": "two, all cores each", "halves": "two, half of the cores each"}
    rows = [
        [name, *(f"{statistics.median(each[key] for each in found):,.0f}" for key in keys)]
        for name, found in measured.items()
    ]
    return common.markdown(["rays a second, together", *keys.values()], rows)


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
