"""Whether a run can be had again: the same seed twice, other seeds, and other numbers of devices.

    python experiments/reproducibility.py --out=DIR [--steps=600] [--seeds=0,1,2,3,4] [--readme=README.md]

Trains configs/quickstart.py (the embedded scene) for so many steps: each seed in a process of its own, the
first twice, and the first on four devices, which one CPU can play. Compares parameters bit for bit, gives the
spread of PSNR over the seeds, and the drift of the parameters between one device and four after DRIFT steps,
with the learning rate of quickstart.py and with the paper's.
What is in DIR is not run again. With --readme the lines replace what lies between <!-- reproducibility -->
and <!-- end of reproducibility --> in that file.
"""

import json
import os
import pathlib
import subprocess
import sys
from typing import NamedTuple

import numpy as np
import paired_runs
import table  # which defines --readme
from absl import flags

from jaxnerf.runtime import cli

DRIFT = 50  # steps
MARKS = ("<!-- reproducibility -->", "<!-- end of reproducibility -->")
# Of default.py, the paper's, in quickstart.py, whose learning rate is sixteen times as high.
_PAPER_ADAM = ("lr_init", "lr_final", "lr_steps", "warmup_steps", "beta2")
_DEVICES = "--xla_force_host_platform_device_count="
_OUT = flags.DEFINE_string("out", None, "Folder of the runs.", required=True)
_STEPS = flags.DEFINE_integer("steps", 600, "Of every run.", lower_bound=DRIFT)
_SEEDS = flags.DEFINE_list("seeds", ["0", "1", "2", "3", "4"], "Two or more.")
_ONE = flags.DEFINE_string("one", None, "Internal: workdir,seed,steps,Adam of the run to make here.")


class Difference(NamedTuple):
    """Of the parameters of two runs."""

    differ: int  # not equal bit for bit
    count: int
    median: float
    most: float  # all but one in a hundred are within it
    largest: float


def main(argv):
    """Makes the runs, each in a process, then compares them."""
    del argv
    if _ONE.value:
        folder, seed, steps, adam = _ONE.value.rsplit(",", 3)
        return train(folder, int(seed), int(steps), adam)
    if len(set(_SEEDS.value)) < 2 or not all(seed.strip().isdigit() for seed in _SEEDS.value):
        raise ValueError(f"--seeds is {','.join(_SEEDS.value)!r}, wanted two or more whole numbers as 0,1,2")
    out, seeds = pathlib.Path(_OUT.value), list(dict.fromkeys(int(seed) for seed in _SEEDS.value))
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
    print("\n".join(lines))
    if flags.FLAGS.readme:
        table.replace(pathlib.Path(flags.FLAGS.readme), lines, MARKS)


def report(scores, *, again, four, drift, paper_drift, steps):
    """Returns the lines that say it.

    Args:
        scores: {seed: PSNR}; the first seed's run is the one that was repeated.
        again, drift: Difference to the first seed's run, of the same again and of four devices.
        four: PSNR on four devices.
        paper_drift: as drift, of runs with the paper's Adam.
        steps: of every run.
    """
    mean, deviation = paired_runs.spread(list(scores.values()))
    low, high = min(scores.values()), max(scores.values())
    first = next(iter(scores.values()))
    inside = "within" if abs(four - first) <= high - low else "OUTSIDE"
    same = f"all {again.count:,} parameters are equal, bit for bit"
    if again.differ:
        same = f"{again.differ:,} of {again.count:,} parameters differ, by up to {again.largest:.1e}"
    listed = ", ".join(f"{value:.2f}" for value in scores.values())
    return [
        f"`quickstart.py` by Adam alone for {steps:,} steps:",
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


def train(folder, seed, steps, adam):
    """Trains and scores a run, with a checkpoint at DRIFT. adam: "own", or "paper": its first DRIFT steps."""
    changes = {
        "train.save_every": DRIFT,
        "train.max_to_keep": 10**6,
        "train.muon": 0.0,
    }  # by the paper's Adam alone
    if adam == "paper":
        paper = paired_runs.configuration("default").train
        changes |= {"train.max_steps": DRIFT, **{f"train.{name}": paper[name] for name in _PAPER_ADAM}}
    else:
        changes |= {"train.max_steps": steps, "train.lr_steps": steps}
    if paired_runs.run(paired_runs.configuration("quickstart", changes, seed=seed), folder) is None:
        raise ValueError(f"{folder}: stopped; the same command goes on from there")


def _start(folder, seed, devices=1, adam="own"):
    environment = {**os.environ, "JAX_PLATFORMS": "cpu"}
    others = [flag for flag in environment.get("XLA_FLAGS", "").split() if not flag.startswith(_DEVICES)]
    environment["XLA_FLAGS"] = " ".join([*others, f"{_DEVICES}{devices}"])
    one = f"--one={folder},{seed},{_STEPS.value},{adam}"
    command = [sys.executable, __file__, f"--out={folder.parent}", one]
    code = subprocess.run(command, env=environment).returncode
    if code:
        raise ValueError(f"{folder}: its process ended with {code}, see above; the same command goes on")


def _score(folder):
    return json.loads((folder / "scored.json").read_text())["results"]["psnr"]


def difference(one, other):
    """Returns the Difference of two arrays [N] of float32."""
    sizes = np.abs(one - other)
    bits = (one.view(np.uint32) != other.view(np.uint32)).sum()
    return Difference(int(bits), one.size, *(float(np.quantile(sizes, share)) for share in (0.5, 0.99, 1.0)))


def _parameters(folder, step):
    """Returns all parameters of a run at a step, [N]."""
    import jax

    from jaxnerf.evaluation.restore import restore_run

    leaves = jax.tree.leaves(jax.device_get(restore_run(folder).weights(step)[0]))
    return np.concatenate([leaf.ravel() for leaf in leaves])


if __name__ == "__main__":
    cli.run(main, stopped="and kept what was finished; the same command goes on from there")
