"""Measures predicted errors of trained runs against true ones, and prints a table: coverage, interval and AUSE.

python experiments/uncertainty/run.py --runs=DIR+MEMBER+MEMBER,DIR
"""

import pathlib

import numpy as np
from absl import app, flags, logging

from jaxnerf.core.cameras import pixel_grid
from jaxnerf.evaluation.metrics import pixel_mask
from jaxnerf.evaluation.restore import newest_step, refined_views, restore_run
from jaxnerf.evaluation.uncertainty.calibration import figures, pixel_error, sparsification
from jaxnerf.evaluation.uncertainty.predict import make_predictor

_RUNS = flags.DEFINE_list("runs", None, "Workdirs that were trained with config.data.hold_out; + joins members.")
_VIEWS = flags.DEFINE_integer("views", 25, "Test views of each run, spread evenly over all.")


def measure(workdir, members):
    """Yields (estimator, figures) of a run, those of the baselines last."""
    run = restore_run(workdir)
    step = newest_step(run, workdir)
    variables, experiment = run.variables(step), run.experiment
    views = refined_views(run, experiment.load_split("test"), "test", variables[0])
    predictors = {"laplace": make_predictor(run, workdir, "laplace", say=logging.info)}
    if members:
        predictors["ensemble"] = make_predictor(run, workdir, "ensemble", members=members, say=logging.info)
    rows = {name: [] for name in (*predictors, "1 - opacity", "constant")}
    count = len(views.names)
    for index in np.unique(np.linspace(0, count - 1, min(_VIEWS.value, count)).astype(int)):
        height, width = (int(side) for side in views.size[index])
        rays = experiment.view_rays(views, index, pixel_grid(height, width, offset=experiment.config.data.pixel_offset))
        image, truth, mask = run.render_image(variables, rays), views.image(index), pixel_mask(views, index)
        for name, predictor in predictors.items():
            rows[name].append(predictor.scored(rays, image.rgb, truth, mask)[1])
        kept = np.ones((height, width), bool) if mask is None else np.asarray(mask, bool)
        error = pixel_error(image.rgb, truth)[kept]
        rows["1 - opacity"].append(sparsification(error, 1 - np.asarray(image.opacity)[kept]))
        rows["constant"].append(sparsification(error, np.zeros_like(error)))
    for name, found in rows.items():
        yield name, figures(found)


def main(argv):
    del argv
    print("| run | estimator | coverage, % | mean half width | AUSE (RMSE) | AUSE (MAE) |\n" + "| --- " * 6 + "|")
    for names in _RUNS.value:
        workdir, *members = names.split("+")
        for name, found in measure(workdir, members):
            covered = f"{100 * found['coverage']:.1f} | {found['interval']:.4f}" if "coverage" in found else "- | -"
            errors = f"{found['ause_rmse']:.3f} | {found['ause_mae']:.3f}"
            print(f"| {pathlib.Path(workdir).name} | {name} | {covered} | {errors} |", flush=True)


if __name__ == "__main__":
    app.run(main)
