"""Measures what cleaning does: PSNR near the training views and far from them against --max_uncertainty.

    JAXNERF_SCENES=... python experiments/uncertainty/cleaning.py [--folder=runs/uncertainty] \
        [--scenes=room20,room70,lego8,can,demo] [--limits=1,0.95,0.9,0.8,0.7,0.5,auto] [--views=12] \
        [--page=docs/results/uncertainty.md]

It trains what it needs in --folder, see uncertainty_runs.py, and keeps it there. The views of room20 and room70 are
rendered from the embedded room, so that views that no training view is close to have an exact ground truth, too.
"""

import pathlib
import statistics
import sys
import time

import jax
import numpy as np
from absl import flags

sys.path.append(str(pathlib.Path(__file__).resolve().parents[1]))
sys.path.append(str(pathlib.Path(__file__).resolve().parent))
import common
import uncertainty_runs as runs

from jaxnerf.core.cameras import pixel_grid
from jaxnerf.evaluation.metrics import image_metrics, pixel_mask
from jaxnerf.evaluation.restore import newest_step, refined_views, restore_run
from jaxnerf.runtime import cli
from jaxnerf.tools.uncertainty.cleaning import cleaned

_NEAR_AND_FAR = {"val": "near", "test": "far"}
SCENES = {
    "room20": _NEAR_AND_FAR,
    "room70": _NEAR_AND_FAR,
    "lego8": {"test": "far"},
    "can": {"test": "near"},
    "demo": {"test": "near"},
}
HEADS = ("scene", "limit", "cells removed, %", "PSNR near, dB", "change", "PSNR far, dB", "change", "s per frame")

_FOLDER = flags.DEFINE_string("folder", "runs/uncertainty", "Of the runs, which are kept.")
_SCENES = flags.DEFINE_list("scenes", list(SCENES), f"Of {', '.join(SCENES)}.")
_LIMITS = flags.DEFINE_list(
    "limits", ["1", "0.95", "0.9", "0.8", "0.7", "0.5", "auto"], "Of --max_uncertainty; the first one is 1."
)
_VIEWS = flags.DEFINE_integer("views", 12, "Views of each split, spread evenly over all.", lower_bound=1)


def main(argv: list[str]) -> None:
    """Trains, measures and prints the table."""
    del argv
    folder, rows = pathlib.Path(_FOLDER.value), []
    for scene in common.chosen("--scenes", _SCENES.value, SCENES):
        workdir, first, whole = runs.trained(scene, folder), {}, None
        for limit in [each if each == "auto" else float(each) for each in _LIMITS.value]:
            found, cells, seconds = measure(workdir, limit, SCENES[scene])
            first, whole = first or found, whole or cells
            scores = [part for place in ("near", "far") for part in _change(found.get(place), first.get(place))]
            rows.append([scene, str(limit), f"{100 * (1 - cells / whole):.1f}", *scores, f"{seconds:.3f}"])
    common.publish([*common.provenance(), "", *common.markdown(HEADS, rows)], "cleaning")


def _change(score, first):
    return ["-", "-"] if score is None else [f"{score:.2f}", f"{score - first:+.2f}"]


def measure(workdir: pathlib.Path, limit: float | str, places: dict[str, str]) -> tuple[dict[str, float], int, float]:
    """Returns the mean PSNR by place, the occupied cells, and the median time of a frame.

    Args:
        workdir: of the run.
        limit: --max_uncertainty.
        places: by split, where its views are.
    """
    run = cleaned(restore_run(workdir), workdir, limit)
    variables, experiment, found, seconds = run.variables(newest_step(run, workdir)), run.experiment, {}, []
    for split, place in places.items():
        views, scores = refined_views(run, experiment.load_split(split), split, variables[0]), []
        count = len(views.names)
        for index in np.unique(np.linspace(0, count - 1, min(_VIEWS.value, count)).astype(int)):
            height, width = (int(side) for side in views.size[index])
            pixels = pixel_grid(height, width, offset=experiment.config.data.pixel_offset)
            rays = experiment.view_rays(views, index, pixels)
            image = jax.block_until_ready(run.render_image(variables, rays))
            started = time.perf_counter()
            jax.block_until_ready(run.render_image(variables, rays))
            seconds.append(time.perf_counter() - started)
            scores.append(image_metrics(image.rgb, views.image(index), pixel_mask(views, index))["psnr"])
        found[place] = statistics.fmean(scores)
    return found, int(variables[1].occupied.sum()), statistics.median(seconds)


if __name__ == "__main__":
    cli.run(main)
