"""Measures how reproducible a run is: the same seed twice, other seeds, other numbers of devices.

    python experiments/stability/reproducibility.py --out=DIR [--steps=600] [--seeds=0,1,2,3,4] [--page=FILE.md]

Trains configs/embedded_small.py (the embedded scene): each seed in a process of its own, the first twice, and the first
on four virtual CPU devices. Compares parameters bit for bit, gives the spread of PSNR over the seeds, and the drift of
the parameters between one device and four after DRIFT steps, with the learning rate of embedded_small.py and with the
paper's. Runs that DIR holds are not repeated. With --page the lines replace what lies between
<!-- reproducibility --> and <!-- end of reproducibility --> in that file.
"""

import json
import os
import pathlib
import subprocess
import sys
from typing import NamedTuple

import jax
import numpy as np
from absl import flags

sys.path.append(str(pathlib.Path(__file__).resolve().parents[1]))
import common

from jaxnerf.evaluation.restore import restore_run
from jaxnerf.runtime import cli

DRIFT = 50  # steps
# The paper's values, in place of those of embedded_small.py, whose learning rate is sixteen times as high.
_PAPER_ADAM = ("lr_init", "lr_final", "lr_decay_power", "lr_steps", "warmup_steps", "beta2")
_DEVICES = "--xla_force_host_platform_device_count="
_OUT = flags.DEFINE_string("out", None, "Folder of the runs.", required=True)
_STEPS = flags.DEFINE_integer("steps", 600, "Steps of every run.", lower_bound=DRIFT)
_SEEDS = flags.DEFINE_list("seeds", ["0", "1", "2", "3", "4"], "Two or more seeds.")
_ONE = flags.DEFINE_string("one", None, "Internal: workdir,seed,steps,Adam of the run to train in this process.")


class Difference(NamedTuple):
    """The difference between the parameters of two runs.

    Attributes:
        differ: number of parameters that are not equal bit for bit.
        count: number of parameters.
        median: of the absolute differences.
        most: their 99th percentile.
        largest: their maximum.
    """

    differ: int
    count: int
    median: float
    most: float
    largest: float


def main(argv: list[str]) -> None:
    """Trains the runs, each in a process, then compares them."""
    del argv
    if _ONE.value:
        folder, seed, steps, adam = _ONE.value.rsplit(",", 3)
        return train(folder, int(seed), int(steps), adam)
    out, seeds = pathlib.Path(_OUT.value), common.seeds_of("--seeds", _SEEDS.value, least=2)
    first = seeds[0]
    for seed in seeds:
        _start(out / f"seed-{seed}", seed)
    _start(out / "again", first)
    _start(out / "four_devices", first, devices=4)
    for devices in (1, 4):
        _start(out / f"paper_adam_{devices}", first, devices=devices, adam="paper")
    one = out / f"seed-{first}"
    scores = {seed: _score(out / f"seed-{seed}") for seed in seeds}
    lines = report(
        scores,
        again=difference(*(_parameters(folder, _STEPS.value) for folder in (one, out / "again"))),
        four=_score(out / "four_devices"),
        drift=difference(*(_parameters(folder, DRIFT) for folder in (one, out / "four_devices"))),
        paper_drift=difference(*(_parameters(out / f"paper_adam_{devices}", DRIFT) for devices in (1, 4))),
        steps=_STEPS.value,
    )
    common.publish(lines, "reproducibility")


def report(
    scores: dict[int, float], *, again: Difference, four: float, drift: Difference, paper_drift: Difference, steps: int
) -> list[str]:
    """Returns the lines of the results.

    Args:
        scores: {seed: PSNR}; the first seed's run is the one that was repeated.
        again: difference between the first seed's run and its repetition.
        four: PSNR on four devices.
        drift: difference between the first seed's run and that on four devices, after DRIFT steps.
        paper_drift: as drift, of runs with the paper's Adam.
        steps: of every run.
    """
    mean, deviation = common.spread(list(scores.values()))
    low, high = min(scores.values()), max(scores.values())
    first = next(iter(scores.values()))
    inside = "within" if abs(four - first) <= high - low else "OUTSIDE"
    same = f"all {again.count:,} parameters are equal, bit for bit"
    if again.differ:
        same = f"{again.differ:,} of {again.count:,} parameters differ, by up to {again.largest:.1e}"
    listed = ", ".join(f"{value:.2f}" for value in scores.values())
    return [
        f"`embedded_small.py` by Adam alone for {steps:,} steps:",
        "",
        f"- the same seed in two processes: {same};",
        f"- {len(scores)} seeds: {mean:.2f} +- {deviation:.2f} dB ({listed});",
        f"- one device and four: {first:.2f} and {four:.2f} dB, {inside} the seeds' spread of "
        f"{high - low:.2f} dB. Float32 adds up in another order there: after {DRIFT} steps of Adam "
        f"{_drifted(drift)}; at the paper's learning rate {_drifted(paper_drift)}.",
    ]


def _drifted(drift):
    return (
        f"half of the parameters differ by more than {drift.median:.1e}, one in a hundred by more than "
        f"{drift.most:.1e}, the worst by {drift.largest:.1e}"
    )


def train(folder: str, seed: int, steps: int, adam: str) -> None:
    """Trains and scores a run, with a checkpoint at DRIFT. adam: "own", or "paper" for DRIFT steps only."""
    changes = {"train.save_every": DRIFT, "train.max_to_keep": 10**6, "train.muon": 0.0}  # Adam alone
    if adam == "paper":
        paper = common.configuration("default").train
        changes |= {"train.max_steps": DRIFT, **{f"train.{name}": paper[name] for name in _PAPER_ADAM}}
    else:
        changes |= {"train.max_steps": steps, "train.lr_steps": steps}
    if common.run(common.configuration("embedded_small", changes, seed=seed), folder) is None:
        raise ValueError(f"{folder}: stopped; the same command resumes")


def _start(folder, seed, devices=1, adam="own"):
    environment = {**os.environ, "JAX_PLATFORMS": "cpu"}
    others = [flag for flag in environment.get("XLA_FLAGS", "").split() if not flag.startswith(_DEVICES)]
    environment["XLA_FLAGS"] = " ".join([*others, f"{_DEVICES}{devices}"])
    one = f"--one={folder},{seed},{_STEPS.value},{adam}"
    command = [sys.executable, __file__, f"--out={folder.parent}", one]
    code = subprocess.run(command, env=environment).returncode
    if code:
        raise ValueError(f"{folder}: its process ended with {code}, see above; the same command resumes")


def _score(folder):
    return json.loads((folder / "scored.json").read_text())["results"]["psnr"]


def difference(one: np.ndarray, other: np.ndarray) -> Difference:
    """Returns the Difference between two arrays [N] of float32."""
    sizes = np.abs(one - other)
    bits = (one.view(np.uint32) != other.view(np.uint32)).sum()
    return Difference(int(bits), one.size, *(float(np.quantile(sizes, part)) for part in (0.5, 0.99, 1.0)))


def _parameters(folder, step):
    """Returns all parameters of a run at a step, [N]."""
    leaves = jax.tree.leaves(jax.device_get(restore_run(folder).variables(step)[0]))
    return np.concatenate([leaf.ravel() for leaf in leaves])


if __name__ == "__main__":
    cli.run(main, stopped="after saving the finished runs; the same command resumes")
