"""Scores runs of scenes that move: test and validation views, time frozen, and flicker beside the truth.

    JAXNERF_SCENES=... python experiments/moving/score_moving.py --out=runs/moving [--seconds=60] \
        [--runs=runs/benchmark/dnerf_lego_400/1800s-COMMIT,...] [--page=docs/results/benchmark.md]

--runs are workdirs of finished runs, as experiments/benchmark/run.py makes them, and "trained at" is the commit that
did. Each is scored on its splits "test" and "val" by the mean PSNR of colours of 8 bits, and again on "test" with the
time frozen at 0 and at 0.5.

The moving bodies are those of docs/extending/moving_scene.md in closed form: 48 training images of 32 px, each from
another camera at a time of its own, and 6 test images from other cameras at other times. OUT/bodies is the dataset,
OUT/run the run of `--config=moving` for so many seconds. Flicker is the root mean square, over the pixels of a still
camera, of the change from one of 97 times to the next beyond the change of the truth, which stands beside it. The
figures that others publish for the same images follow.
"""

import collections
import dataclasses
import pathlib
import sys

import jax.numpy as jnp
import numpy as np
from absl import flags

sys.path += [str(pathlib.Path(__file__).resolve().parents[up] / name) for up, name in ((1, ""), (2, "tests/extending"))]
import common
import moving_bodies
from benchmark import tables

from jaxnerf.core.cameras import pixel_grid
from jaxnerf.core.metrics import psnr, round_to_8_bits
from jaxnerf.evaluation.evaluate import train_and_evaluate
from jaxnerf.evaluation.restore import newest_step, restore_run
from jaxnerf.evaluation.supersampling import render_pixels
from jaxnerf.runtime import cli
from jaxnerf.tools.curve.measure import SCORE

_RUNS = flags.DEFINE_list("runs", [], "Workdirs of finished runs.")
_OUT = flags.DEFINE_string("out", "runs/moving", "Folder of the moving bodies and their run.")
_SECONDS = flags.DEFINE_float("seconds", 60.0, "Of training on the moving bodies.", lower_bound=1.0)
_NUM_TIMES = 97
HEADS = (
    "run",
    "trained at",
    "px",
    "s",
    "steps",
    "test, dB",
    "validation, dB",
    "test at time 0, dB",
    "test at time 0.5, dB",
)


def main(argv: list[str]) -> None:
    """Trains on the moving bodies, scores all runs, and prints the tables."""
    del argv
    out = pathlib.Path(_OUT.value)
    if not (out / "bodies").exists():
        moving_bodies.write_dataset(out / "bodies")
    options = {"data.dir": str(out / "bodies"), "data.format": "blender", "train.max_seconds": _SECONDS.value}
    train_and_evaluate(common.configuration("moving", options), out / "run")
    rows = [row(workdir, pathlib.Path(workdir).parent.name) for workdir in _RUNS.value]
    rows.append(row(out / "run", "moving bodies"))
    change, extra = flicker(restore_run(out / "run"))
    lines = [*common.provenance(), "", *common.markdown(HEADS, rows)]
    lines += [
        "",
        f"Moving bodies, from one of {_NUM_TIMES} times to the next: the truth changes by {change:.4f}, root mean "
        f"square over all pixels, and the rendering by {extra:.4f} beyond it.",
    ]
    scores = [common.read_json(pathlib.Path(workdir) / SCORE) for workdir in _RUNS.value]
    if scores:
        by_job = collections.defaultdict(list)
        for score in scores:
            by_job[score["job"]].append(score)
        lines += ["", *tables.beside(by_job)]
    common.publish(lines, "moving")


def row(workdir, name):
    """Returns the figures of a finished run."""
    run = restore_run(workdir)
    config, step = run.experiment.config, newest_step(run, workdir)
    commit = common.read_json(pathlib.Path(workdir) / SCORE).get("commit", common.commit())
    test, validation = (mean_psnr(run, split) for split in ("test", "val"))
    frozen = [mean_psnr(restore_run(workdir, time=time), "test") for time in (0.0, 0.5)]
    side = int(run.experiment.load_split("test").size[0, 0])
    figures = ["-" if np.isnan(value) else f"{value:.2f}" for value in (test, validation, *frozen)]
    return [name, commit, str(side), f"{config.train.max_seconds:g}", f"{step:,}", *figures]


def mean_psnr(run, split):
    """Returns the mean PSNR, dB, of the newest checkpoint on a split; NaN where the dataset has no such split."""
    try:
        views = run.experiment.load_split(split)
    except ValueError:
        return float("nan")
    variables, values = run.variables(run.steps()[-1]), []
    for index, (height, width) in enumerate(views.size):
        rgb = image(run, variables, views, index, height, width)
        values.append(float(psnr(round_to_8_bits(rgb), views.image(index))))
    return float(np.mean(values))


def image(run, variables, views, index, height, width):
    """Returns the colours [H, W, 3] of a view."""
    return jnp.asarray(render_pixels(run, variables, views, index, pixel_grid(int(height), int(width)))[0].rgb)


def flicker(run):
    """Returns the root mean square of the truth's change between times, and of what the run's change differs by."""
    views, variables = run.experiment.load_split("test"), run.variables(run.steps()[-1])
    height, width = (int(side) for side in views.size[0])
    truth, shown = [], []
    for time in np.linspace(0, 1, _NUM_TIMES, dtype=np.float32):
        at = dataclasses.replace(views, time=np.full(len(views.size), time))
        shown.append(np.asarray(image(run, variables, at, 0, height, width)))
        rgba = np.asarray(moving_bodies.render_image(views.cameras.to_world[0], time, pixel_grid(height, width)))
        truth.append(rgba[..., :3] * rgba[..., 3:] + 1 - rgba[..., 3:])
    change = np.diff(truth, axis=0)
    return float(np.sqrt((change**2).mean())), float(np.sqrt(((np.diff(shown, axis=0) - change) ** 2).mean()))


if __name__ == "__main__":
    cli.run(main, stopped="within a run; the same command continues it")
