"""Measures what parts of the training of a capture gain and cost: PSNR of held-out and training views, depth, time.

    JAXNERF_SCENES=... python experiments/ablation/captures.py --out=DIR [--data_dir=can] [--steps=3000] [--seeds=0] \
        [--only="capture,depth off"] [--page=docs/results/settings.md --table=NAME]

Trains configs/capture.py for --steps steps with one setting changed at a time, on the training views without every 8th,
and scores those. The depth error is |t - D| / D at the observations of the dataset's sparse points in the held-out
views: the median, and the fraction above 5 %. These points were found with the held-out images, too, so a gain of the
depth loss is partly one on training data. Writes DIR/ablation.json and prints a table. The same command resumes what
was interrupted; other seeds or variants are added.
"""

import pathlib
import sys

import jax
import jax.numpy as jnp
import numpy as np
from absl import flags

sys.path.append(str(pathlib.Path(__file__).resolve().parents[1]))
import common

from jaxnerf.core.cameras import pixel_grid, project
from jaxnerf.core.metrics import mse
from jaxnerf.evaluation import evaluate, restore
from jaxnerf.runtime import cli
from jaxnerf.training import metric_log

VARIANTS = {
    "capture": {},
    "black behind the scene": {"scene.background": ()},
    "depth off": {"losses.depth": 0.0},
    "depth 0.1 to the end": {"losses.depth": 0.1},
    "distortion off": {"losses.distortion": 0.0},
    "distortion 0.003": {"losses.distortion": 0.003},
    "distortion 0.01": {"losses.distortion": 0.01},
    "opaque 0.01": {"losses.opaque": 0.01},
    "total_variation 0.1": {"losses.total_variation": 0.1},
    "total_variation 1": {"losses.total_variation": 1.0},
    "cells that no view sees may be occupied": {"occupancy.min_views": 0},
    "exposure": {"cameras.exposure": True},
    "refine": {"cameras.refine": True},
}
HEADS = ("change", "held-out PSNR", "training PSNR", "depth error", "depth off by over 5 %", "ms a step")
_OUT = flags.DEFINE_string("out", None, "Folder of the runs and the measurements.", required=True)
_DATA_DIR = flags.DEFINE_string("data_dir", "can", "The capture: a folder, or a name below $JAXNERF_SCENES.")
_STEPS = flags.DEFINE_integer("steps", 3000, "Steps of every run.", lower_bound=1)
_SEEDS = flags.DEFINE_list("seeds", ["0"], "Seeds; every variant is trained with each.")
_TABLE = flags.DEFINE_string("table", "parts", "Name of the table in --page.")
_ONLY = flags.DEFINE_list("only", None, "Names of the variants to train; all when not given.")
_HELD_OUT, _MAX_VIEWS, _STRIDE = 8, 8, 3  # every so-many-th view; views that are scored; px between scored pixels
_OFF = 0.05


def main(argv: list[str]) -> None:
    """Trains what is missing, then reports everything that is there."""
    del argv
    out = pathlib.Path(_OUT.value)
    names = common.chosen("--only", _ONLY.value or list(VARIANTS), list(VARIANTS))
    kept = common.read_json(out / "ablation.json")
    described = {"data_dir": _DATA_DIR.value, "steps": _STEPS.value}
    if kept.setdefault("settings", described) != described:
        raise ValueError(
            f"{out / 'ablation.json'}: has runs of {kept['settings']}, not {described}; give another --out"
        )
    for seed in common.seeds_of("--seeds", _SEEDS.value):
        for name in names:
            row = kept.setdefault("variants", {}).setdefault(name, {})
            if str(seed) not in row:
                print(f"seed {seed}: {name}", file=sys.stderr, flush=True)
                row[str(seed)] = _measure(name, seed, out / f"{name.replace(' ', '_')}-{seed}")
                common.write_json(out / "ablation.json", kept)
    common.publish(report(kept.get("variants", {})), _TABLE.value)


def _configuration(name, seed):
    steps = {"train.max_steps": _STEPS.value, "train.lr_steps": _STEPS.value, "train.max_seconds": 0.0}
    data = {"data.dir": _DATA_DIR.value, "data.hold_out": _HELD_OUT}
    quiet = {"train.preview_every": 0.0, "eval.summary_seconds": 0.0}
    return common.configuration("capture", {**steps, **data, **quiet, **VARIANTS[name]}, seed=seed)


def _measure(name, seed, folder):
    """Returns the measurements of one run."""
    if not evaluate.train_and_evaluate(_configuration(name, seed), folder):
        raise ValueError(f"stopped; {folder} is saved, and the same command resumes")
    run = restore.restore_run(folder)
    variables = run.variables(run.steps()[-1])
    views = {split: run.experiment.load_split(split) for split in ("held_out", "train")}
    found = {split: _psnr(run, variables, views[split]) for split in views}
    errors = _depth_errors(run, variables, views["held_out"])
    if errors.size:
        found |= {"depth": float(np.median(errors)), "off": float((errors > _OFF).mean())}
    seconds = metric_log.read_rows(folder)[-1]["seconds"]
    jax.clear_caches()  # no other run has this step and this renderer
    return found | {"ms": 1e3 * seconds / _STEPS.value}


def _psnr(run, variables, views):
    """Returns the mean PSNR of some views, of every third row and column of each."""
    values = []
    for index in np.unique(np.linspace(0, len(views.offset) - 1, _MAX_VIEWS).astype(int)):
        height, width = (int(value) for value in views.size[index])
        pixels = pixel_grid(height, width, offset=run.experiment.config.data.pixel_offset)[::_STRIDE, ::_STRIDE]
        image = run.render_image(variables, run.experiment.view_rays(views, index, pixels))
        error = mse(jnp.clip(image.rgb, 0, 1), views.image(index)[::_STRIDE, ::_STRIDE])
        values.append(-10 * np.log10(float(error)))
    return float(np.mean(values))


def _depth_errors(run, variables, views):
    """Returns the relative errors [M] of the expected depth at the observations of sparse points."""
    errors, sparse = [np.zeros(0)], views.sparse
    counts = np.zeros(0, int) if sparse is None else np.bincount(sparse.view, minlength=len(views.offset))
    for index in np.flatnonzero(counts):
        own = np.resize(np.flatnonzero(sparse.view == index), counts.max())  # one shape to compile
        rays = run.experiment.view_rays(views, index, sparse.pixel[own])
        found = np.asarray(run.render_image(variables, rays).depth)
        camera = jax.tree.map(lambda leaf, index=index: leaf[index], views.cameras)
        depth = np.asarray(project(camera, sparse.positions[sparse.point[own]])[1])
        errors.append((np.abs(found - depth) / depth)[: counts[index]])
    return np.concatenate(errors)


def report(kept: dict) -> list[str]:
    """Returns the lines of the table; figures are means over seeds."""
    rows = []
    for name, runs in kept.items():
        mean = {key: np.mean([run[key] for run in runs.values()]) for key in next(iter(runs.values()))}
        depth = (f"{mean['depth']:.4f}", f"{100 * mean['off']:.1f} %") if "depth" in mean else ("-", "-")
        rows.append((name, f"{mean['held_out']:.2f}", f"{mean['train']:.2f}", *depth, f"{mean['ms']:.1f}"))
    return common.markdown(HEADS, rows)


if __name__ == "__main__":
    cli.run(main)
