"""Measures what each part of a training step, and a frame, gain from more CPU cores.

    JAXNERF_SCENES=... python experiments/speed/cores.py --out=DIR [--cores=1,2] [--runs=fox,lego] [--rounds=3]

Each measurement is a process of its own on so many cores, and the numbers of cores take turns, so that a machine that
gets slower does so for all. Writes DIR/<run>-<cores>-<round>.json and prints a table of medians. What DIR holds is not
measured again. With --page the table replaces what lies between <!-- cores --> and <!-- end of cores --> in that file.
"""

import os
import pathlib
import statistics
import subprocess
import sys
from collections.abc import Mapping, Sequence
from typing import Any

from absl import flags

sys.path.append(str(pathlib.Path(__file__).resolve().parents[1]))
import common
from speed import step_parts

from jaxnerf.runtime import cli

_OUT = flags.DEFINE_string("out", None, "Folder of the measurements.", required=True)
_CORES = flags.DEFINE_list("cores", ["1", "2"], "Numbers of cores, ascending.")
_RUNS = flags.DEFINE_list("runs", list(step_parts.RUNS), "Runs of step_parts.py.")
_ROUNDS = flags.DEFINE_integer("rounds", 3, "Measurements of each run with each number of cores.", lower_bound=1)
_ONE = flags.DEFINE_string("one", None, "Measures this run here, into the file --out.")
_WARM_UP, _STEPS = 1000, 64


def main(argv: list[str]) -> None:
    """Measures what is missing, then prints the table."""
    del argv
    out = pathlib.Path(_OUT.value)
    if _ONE.value:
        config = common.configuration(*step_parts.RUNS[_ONE.value])
        common.write_json(out, step_parts.measure(config, warm_up=_WARM_UP, num_steps=_STEPS))
        return
    runs = common.chosen("--runs", _RUNS.value, list(step_parts.RUNS))
    counts = [int(count) for count in _CORES.value]
    for turn in range(_ROUNDS.value):
        for name in runs:
            for count in counts:
                path = _path(out, name, count, turn)
                if not path.exists():
                    command = [sys.executable, __file__, f"--one={name}", f"--out={path}"]
                    with common.few_cores(count):
                        subprocess.run(command, check=True, env=dict(os.environ))
    measured = {
        name: {
            count: [common.read_json(_path(out, name, count, turn)) for turn in range(_ROUNDS.value)]
            for count in counts
        }
        for name in runs
    }
    lines = [*common.provenance(), ""]
    for name, by_count in measured.items():
        lines += [f"{name}:", "", *table(by_count), ""]
    common.publish(lines[:-1], "cores")


def _path(out, name, count, turn):
    return out / f"{name.replace(', ', '_').replace(' ', '')}-{count}-{turn}.json"


def table(by_count: Mapping[int, Sequence[Mapping[str, Any]]]) -> list[str]:
    """Returns the lines of the table of a run: {cores: results of step_parts.measure}, the least cores first."""
    least, *more = by_count
    medians = {count: _medians(results) for count, results in by_count.items()}
    heads = ["ms a step", f"{least} core(s)"]
    heads += [head for count in more for head in (f"{count} cores", "times faster", "serial")]
    rows = []
    for part in medians[least]:
        before = medians[least][part]
        row = [part, f"{before:.2f}"]
        for count in more:
            after = medians[count].get(part, 0.0)
            gain = before / after if after else 0.0
            row += [f"{after:.2f}", f"{gain:.2f}", f"{serial_fraction(gain, count / least):.0%}" if gain else "-"]
        rows.append(row)
    return common.markdown(heads, rows)


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
