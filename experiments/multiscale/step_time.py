"""Compares the time of a training step with `prefilter` to that without it.

    python experiments/multiscale/step_time.py [--scene=lego] [--factor=2] [--rounds=5]
        [--page=docs/results/multiscale.md]

Both steps draw from images at four sizes and have sample buffers of one size. They are timed in turn, over as many
steps as lie between updates of the occupancy grid; the ratio is taken within a round.
"""

import pathlib
import statistics
import sys
import time

import jax
from absl import flags

sys.path.append(str(pathlib.Path(__file__).resolve().parents[1]))
import common

from jaxnerf.runtime import cli

_SCENE = flags.DEFINE_string("scene", "lego", "The dataset.")
_FACTOR = flags.DEFINE_integer("factor", 2, "Images are shrunk by it.", lower_bound=1)
_ROUNDS = flags.DEFINE_integer("rounds", 5, "Timings of each step, after one that does not count.", lower_bound=1)
_PERIOD = 64
_CASES = {"lego_fast": "hash_grid.prefilter", "lego_mlp_fast": "fine.prefilter"}


def main(argv: list[str]) -> None:
    """Times the steps and prints the table."""
    del argv
    rows = []
    for name, option in _CASES.items():
        steps = [compile_step(name, {option: value}) for value in (False, True)]
        rounds = [[period(step) for step in steps] for _ in range(1 + _ROUNDS.value)][1:]
        off, on = (statistics.median(each[index] for each in rounds) / _PERIOD for index in range(2))
        ratio = statistics.median(each[1] / each[0] for each in rounds)
        rows.append((name, f"{1e3 * off:.1f}", f"{1e3 * on:.1f}", f"{ratio:.2f}"))
        jax.clear_caches()
    head = ("config", "ms a step, off", "on", "ratio")
    common.publish([*common.provenance(), "", *common.markdown(head, rows)], "step time")


def compile_step(name, settings):
    """Returns a Step of a config at four sizes of the images, and its state."""
    given = {"data.dir": _SCENE.value, "data.factor": _FACTOR.value, "data.num_scales": 4}
    step = common.compile_step(common.configuration(name, {**given, **settings}))
    return [step, step.state]


def period(running):
    """Takes steps from where a [Step, state] is, and returns the seconds."""
    step, state = running
    started = time.perf_counter()
    for _ in range(_PERIOD):
        state, metrics = step.run(state, step.data, step.positions)
        jax.block_until_ready(metrics)
    running[1] = state
    return time.perf_counter() - started


if __name__ == "__main__":
    cli.run(main)
