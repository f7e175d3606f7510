"""Measures predicted errors of trained runs against true ones: coverage, interval, AUSE, and the time of laplace.

    JAXNERF_SCENES=... python experiments/uncertainty/run.py [--folder=runs/uncertainty] [--scenes=still,lego] \
        [--views=25] [--page=docs/results/uncertainty.md]

It trains what it needs in --folder, see uncertainty_runs.py, and keeps it there. Intervals are for 90 % of the errors,
and calibrated on held-out training views; test views are scored once.
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
from jaxnerf.evaluation.metrics import object_mask, pixel_mask
from jaxnerf.evaluation.restore import newest_step, refined_views, restore_run
from jaxnerf.evaluation.uncertainty import laplace
from jaxnerf.evaluation.uncertainty.base import UncertaintySource
from jaxnerf.evaluation.uncertainty.calibration import figures, pixel_error, score_order
from jaxnerf.evaluation.uncertainty.predict import make_predictor
from jaxnerf.runtime import cli

SCENES = ("still", "lego")
HEADS = ("scene", "estimator", "coverage, %", "mean half width", "AUSE (RMSE)", "AUSE (MAE)", "on the object", "(MAE)")
TIMES = ("scene", "training, s", "laplace, s", "of the training's time")

_FOLDER = flags.DEFINE_string("folder", "runs/uncertainty", "Of the runs, which are kept.")
_SCENES = flags.DEFINE_list("scenes", list(SCENES), f"Of {', '.join(SCENES)}.")
_VIEWS = flags.DEFINE_integer("views", 25, "Test views of each scene, spread evenly over all.", lower_bound=1)


def main(argv: list[str]) -> None:
    """Trains, measures and prints the tables."""
    del argv
    folder, rows, times = pathlib.Path(_FOLDER.value), [], []
    for scene in common.chosen("--scenes", _SCENES.value, SCENES):
        workdir, members = runs.trained(scene, folder), runs.members_of(scene, folder)
        for name, found in measure(workdir, members):
            covered = ["-", "-"]
            if "coverage" in found:
                covered = [f"{100 * found['coverage']:.1f}", f"{found['interval']:.4f}"]
            keys = ("ause_rmse", "ause_mae", "ause_rmse_object", "ause_mae_object")
            rows.append([scene, name, *covered, *(f"{found[key]:.3f}" if key in found else "-" for key in keys)])
        training, seconds = runs.training_seconds(workdir), laplace_seconds(workdir)
        times.append([scene, f"{training:.0f}", f"{seconds:.1f}", f"{100 * seconds / training:.0f} %"])
    lines = [*common.provenance(), "", *common.markdown(HEADS, rows), "", *common.markdown(TIMES, times)]
    common.publish(lines, "predicted errors")


def measure(workdir: pathlib.Path, members: list[str]):
    """Yields (estimator, figures) of a run, those of the baselines last."""
    run = restore_run(workdir)
    variables, experiment = run.variables(newest_step(run, workdir)), run.experiment
    views = refined_views(run, experiment.load_split("test"), "test", variables[0])
    predictors = {
        "laplace": make_predictor(run, workdir, "laplace", say=logging.info),
        "ensemble": make_predictor(run, workdir, "ensemble", members=members, say=logging.info),
    }
    rows = {name: [] for name in (*predictors, "1 - opacity", "constant")}
    count = len(views.names)
    for index in np.unique(np.linspace(0, count - 1, min(_VIEWS.value, count)).astype(int)):
        height, width = (int(side) for side in views.size[index])
        rays = experiment.view_rays(views, index, pixel_grid(height, width, offset=experiment.config.data.pixel_offset))
        image, truth = run.render_image(variables, rays), views.image(index)
        mask, on_object = pixel_mask(views, index), object_mask(views, index)
        for name, predictor in predictors.items():
            rows[name].append(predictor.scored(rays, image.rgb, truth, mask, on_object)[1])
        kept = np.ones((height, width), bool) if mask is None else np.asarray(mask, bool)
        error = pixel_error(image.rgb, truth)
        rows["1 - opacity"].append(score_order(error, 1 - image.opacity, kept, on_object))
        rows["constant"].append(score_order(error, np.zeros_like(error), kept, on_object))
    for name, found in rows.items():
        yield name, figures(found)


def laplace_seconds(workdir: pathlib.Path) -> float:
    """Returns the time of a pass over training rays that is compiled already, without reading the views."""
    run = restore_run(workdir)
    step = newest_step(run, workdir)
    source = UncertaintySource.of(run, workdir, step, run.variables(step))
    jax.block_until_ready(laplace.fit_deformation(source))
    return common.seconds(lambda: laplace.fit_deformation(source))


if __name__ == "__main__":
    cli.run(main)
