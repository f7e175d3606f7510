"""Measures predicted errors of trained runs against true ones: coverage, interval, AUSE, PSNR, and laplace's time.

    JAXNERF_SCENES=... python experiments/uncertainty/run.py [--folder=runs/uncertainty] [--scenes=still,lego] \
        [--views=25] [--page=docs/results/uncertainty.md]

It trains what it needs in --folder, see uncertainty_runs.py, and keeps it there. Intervals are for 90 % of the errors,
and calibrated on held-out training views; test views are scored once. Of the embedded room, room70, views near the
training views and views far from all of them are scored, which no run has seen. The predicted PSNR of a view is that of
the mean square of its pixels' predicted errors.
"""

import pathlib
import sys

import jax
import numpy as np
from absl import flags, logging

sys.path.append(str(pathlib.Path(__file__).resolve().parents[1]))
sys.path.append(str(pathlib.Path(__file__).resolve().parent))
import common
import uncertainty_runs as runs

from jaxnerf.core.cameras import pixel_grid
from jaxnerf.evaluation.metrics import pixel_mask
from jaxnerf.evaluation.restore import newest_step, refined_views, restore_run
from jaxnerf.evaluation.supersampling import render_pixels
from jaxnerf.runtime import cli
from jaxnerf.tools.uncertainty import laplace
from jaxnerf.tools.uncertainty.base import UncertaintySource
from jaxnerf.tools.uncertainty.calibration import figures, object_mask, pixel_error, score_order
from jaxnerf.tools.uncertainty.predict import make_predictor

SCENES = {
    "still": {"test": "still"},
    "lego": {"test": "lego"},
    "room70": {"val": "room, near", "test": "room, far"},
    "fern": {"test": "fern"},
    "fox": {"test": "fox"},
}
HEADS = ("scene", "estimator", "coverage, %", "mean half width", "AUSE (RMSE)", "AUSE (MAE)", "on the object", "(MAE)")
PSNR = ("views", "number", "estimator", "true PSNR", "predicted", "median difference of a view")
TIMES = ("scene", "training, s", "laplace, s", "of the training's time")

_FOLDER = flags.DEFINE_string("folder", "runs/uncertainty", "Of the runs, which are kept.")
_SCENES = flags.DEFINE_list("scenes", ["still", "lego"], f"Of {', '.join(SCENES)}.")
_VIEWS = flags.DEFINE_integer("views", 25, "Test views of each scene, spread evenly over all.", lower_bound=1)


def main(argv: list[str]) -> None:
    """Trains, measures and prints the tables."""
    del argv
    folder, rows, levels, times = pathlib.Path(_FOLDER.value), [], [], []
    scenes = common.chosen("--scenes", _SCENES.value, SCENES)
    for scene in scenes:
        workdir, members, every = runs.trained(scene, folder), runs.members_of(scene, folder), {}
        for place, name, found, psnr in measure(workdir, members, SCENES[scene]):
            covered = ["-", "-"]
            if "coverage" in found:
                covered = [f"{100 * found['coverage']:.1f}", f"{found['interval']:.4f}"]
                levels.append([place, str(len(psnr)), name, *_compared(psnr)])
                every.setdefault(name, []).extend(psnr)
            keys = ("ause_rmse", "ause_mae", "ause_rmse_object", "ause_mae_object")
            rows.append([place, name, *covered, *(f"{found[key]:.3f}" if key in found else "-" for key in keys)])
        if len(SCENES[scene]) > 1:
            levels += [[f"{scene}, all", str(len(psnr)), name, *_compared(psnr)] for name, psnr in every.items()]
        training, seconds = runs.training_seconds(workdir), laplace_seconds(workdir)
        times.append([scene, f"{training:.0f}", f"{seconds:.1f}", f"{100 * seconds / training:.0f} %"])
    tables = (common.markdown(heads, lines) for heads, lines in ((HEADS, rows), (PSNR, levels), (TIMES, times)))
    lines = common.provenance()
    for table in tables:
        lines += ["", *table]
    common.publish(lines, f"predicted errors {' '.join(scenes)}")


def _compared(psnr):
    true, predicted = np.array(psnr).T
    return [f"{true.mean():.2f}", f"{predicted.mean():.2f}", f"{np.median(np.abs(predicted - true)):.2f}"]


def measure(workdir: pathlib.Path, members: list[str], places: dict[str, str]):
    """Yields (place, estimator, figures, [(true, predicted PSNR) of each view]) of a run, the baselines last.

    Args:
        workdir: of the run.
        members: see `UncertaintySource`.
        places: by split, the name of its views.
    """
    run = restore_run(workdir)
    variables = run.variables(newest_step(run, workdir))
    predictors = {"laplace": make_predictor(run, workdir, "laplace", say=logging.info)}
    if members:
        predictors["ensemble"] = make_predictor(run, workdir, "ensemble", members=members, say=logging.info)
    for split, place in places.items():
        views = refined_views(run, run.experiment.load_split(split), split, variables[0])
        rows, psnr = _scored(run, variables, views, predictors)
        for name, found in rows.items():
            yield place, name, figures(found), psnr.get(name)


def _scored(run, variables, views, predictors):
    """Returns the rows of each view by estimator and baseline, and the true and predicted PSNR by estimator."""
    rows = {name: [] for name in (*predictors, "1 - opacity", "constant")}
    psnr, count = {name: [] for name in predictors}, len(views.names)
    for index in np.unique(np.linspace(0, count - 1, min(_VIEWS.value, count)).astype(int)):
        height, width = (int(side) for side in views.size[index])
        pixels = pixel_grid(height, width, offset=run.experiment.config.data.pixel_offset)
        rays = run.experiment.view_rays(views, index, pixels)
        image, truth = render_pixels(run, variables, views, index, pixels)[0], views.image(index)
        mask, on_object = pixel_mask(views, index), object_mask(views, index)
        kept = np.ones((height, width), bool) if mask is None else np.asarray(mask, bool)
        error = pixel_error(image.rgb, truth)
        for name, predictor in predictors.items():
            predicted, row = predictor.scored(rays, image.rgb, truth, views, index)
            rows[name].append(row)
            psnr[name].append([-10 * np.log10((each[kept] ** 2).mean()) for each in (error, predicted)])
        rows["1 - opacity"].append(score_order(error, 1 - image.opacity, kept, on_object))
        rows["constant"].append(score_order(error, np.zeros_like(error), kept, on_object))
    return rows, psnr


def laplace_seconds(workdir: pathlib.Path) -> float:
    """Returns the time of a pass over training rays that is compiled already, without reading the views."""
    run = restore_run(workdir)
    step = newest_step(run, workdir)
    source = UncertaintySource.of(run, workdir, step, run.variables(step))
    jax.block_until_ready(laplace.fit_deformation(source))
    return common.seconds(lambda: laplace.fit_deformation(source))


if __name__ == "__main__":
    cli.run(main)
