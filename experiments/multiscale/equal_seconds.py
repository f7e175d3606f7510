"""Compares runs of multiscale.py after equal seconds of training, with the times of their steps and frames.

    python experiments/multiscale/equal_seconds.py --runs=DIR,DIR,... [--rounds=4] [--page=docs/results/multiscale.md]

Steps and frames of all runs are timed in turn in one process, so that other jobs on the machine delay all of them
alike; ratios to the first run are taken within a round. The seconds of a checkpoint are its steps times the time of a
step, and the PSNR between checkpoints is interpolated.
"""

import pathlib
import statistics
import sys
import time
from typing import Any

import jax
import numpy as np
from absl import flags

sys.path.append(str(pathlib.Path(__file__).resolve().parents[1]))
import common

from jaxnerf.core.cameras import pixel_grid
from jaxnerf.evaluation import restore
from jaxnerf.runtime import cli

_RUNS = flags.DEFINE_list("runs", None, "Folders of runs in the --out of multiscale.py.", required=True)
_ROUNDS = flags.DEFINE_integer("rounds", 4, "Timings of each, after one that does not count.", lower_bound=1)
_NAME = flags.DEFINE_string("name", "equal seconds", "Name of the tables in the page.")
_PERIOD = 64  # steps between updates of the occupancy grid, timed together
_MOMENTS = 3


def main(argv: list[str]) -> None:
    """Times the runs and prints both tables."""
    del argv
    runs = {pathlib.Path(folder).name: Timed(pathlib.Path(folder)) for folder in _RUNS.value}
    rounds = [{name: (run.step(), run.frame()) for name, run in runs.items()} for _ in range(1 + _ROUNDS.value)][1:]
    found = {name: [statistics.median(each[name][part] for each in rounds) for part in range(2)] for name in runs}
    first, rows = next(iter(runs)), []
    for name, (step, frame) in found.items():
        ratio = statistics.median(each[name][0] / each[first][0] for each in rounds)
        rows.append((name, f"{1e3 * step:.1f}", f"{ratio:.2f}", f"{frame:.3f}"))
    lines = [*common.provenance(), "", *common.markdown(("run", "ms a step", "ratio", "s a frame at full size"), rows)]
    total = min(runs[name].steps[-1] * step for name, (step, _) in found.items())
    moments = [total * part / _MOMENTS for part in range(1, _MOMENTS + 1)]
    rows = [row for name, run in runs.items() for row in run.rows(moments, found[name][0])]
    lines += ["", "PSNR in dB, at full size and at 1/8, after so many seconds of training:", ""]
    lines += common.markdown(("run", "rays a pixel at 1/8", *(f"{moment:.0f} s" for moment in moments)), rows)
    common.publish(lines, _NAME.value)


class Timed:
    """A run whose steps and frames are timed, and the PSNR of its checkpoints."""

    def __init__(self, folder: pathlib.Path):
        self.name, self.moments = folder.name, common.read_json(folder / "measured.json")["measured"]["moments"]
        self.run = restore.restore_run(folder / "run")
        self.steps = sorted(self.run.steps())
        self.variables = self.run.variables(self.steps[-1])
        views = self.run.experiment.load_split("test")
        height, width = (int(side) for side in views.size[0])
        self.rays = self.run.experiment.view_rays(views, 0, pixel_grid(height, width))
        self.compiled = common.compile_step(self.run.experiment.config)
        self.state = self.compiled.state

    def step(self) -> float:
        """Takes some steps and returns the seconds of one."""
        started = time.perf_counter()
        for _ in range(_PERIOD):
            self.state, metrics = self.compiled.run(self.state, self.compiled.data, self.compiled.positions)
            jax.block_until_ready(metrics)
        return (time.perf_counter() - started) / _PERIOD

    def frame(self) -> float:
        """Renders a frame with one ray a pixel and returns the seconds."""
        return common.seconds(lambda: self.run.render_image(self.variables, self.rays).rgb)

    def rows(self, moments: list[float], step: float) -> list[list[str]]:
        """Returns rows of the PSNR after so many seconds, one for each number of rays a pixel at 1/8."""
        return [
            [
                self.name,
                str(int(key[2:]) ** 2),
                *psnr_at(moments, [step * each for each in self.steps], self.moments, key),
            ]
            for key in self.moments[0]
            if key.startswith("8x")
        ]


def psnr_at(moments: list[float], seconds: list[float], scores: list[dict[str, Any]], key: str) -> list[str]:
    """Returns the PSNR at full size and at another, interpolated between checkpoints; "-" before the first."""
    values = [np.interp(moments, seconds, [score[name] for score in scores]) for name in ("1x1", key)]
    early = 0.99 * seconds[0]  # rounding
    pairs = zip(moments, *values, strict=True)
    return [f"{large:.2f} / {small:.2f}" if at >= early else "-" for at, large, small in pairs]


if __name__ == "__main__":
    cli.run(main)
