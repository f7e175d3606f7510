"""Prints what `cameras.refine` and `cameras.exposure` are where they are "auto", with right and with wrong cameras.

    JAXNERF_SCENES=... python experiments/benchmark/auto_cameras.py [--datasets=lego,mic,fern,fox,can] \
        [--degrees=0.3] [--width=200] [--seed=0] [--page=docs/results/cameras.md]

Each dataset is measured as it is, with cameras that are turned and moved as by `poses.py --degrees`, and with images
whose exposures are changed as by `exposures.py`. Nothing is trained. Times are CPU seconds of the process; the first
one of each kind of lens includes compiling.
"""

import pathlib
import sys
import time
from typing import Any

import numpy as np
from absl import flags

sys.path.append(str(pathlib.Path(__file__).resolve().parents[1]))
import common
from benchmark.changed_views import changed, factors, turned, with_poses

from jaxnerf.core.views import Views
from jaxnerf.data.facts import LookAt
from jaxnerf.data.image_agreement import Agreement, agreement
from jaxnerf.runtime import cli
from jaxnerf.training.camera_parameters import CameraOptions, resolve_cameras

HEADS = ("dataset", "changed", "matches", "off, px", "`refine`", "brightness", "tint", "`exposure`", "CPU s")
_AUTO = CameraOptions(refine="auto", exposure="auto")  # type: ignore

_DATASETS = flags.DEFINE_list("datasets", ["lego", "mic", "fern", "fox", "can"], "Folders of datasets.")
_DEGREES = flags.DEFINE_list("degrees", ["0.3"], "Standard deviations of the turns.")
_WIDTH = flags.DEFINE_integer("width", 200, "px of an image's width, at least.", lower_bound=8)
_SEED = flags.DEFINE_integer("seed", 0, "Of the turns and the factors.")
_TABLE = flags.DEFINE_string("table", "auto_cameras", "Name of the table in the marks of --page.")


def main(argv: list[str]) -> None:
    """Measures all datasets, and prints the table."""
    del argv
    rows = []
    for folder in _DATASETS.value:
        config = common.configuration("capture", {"data.dir": folder, "data.width": _WIDTH.value})
        views = common.load_split(config, "train")
        poses, name = np.asarray(views.cameras.to_world, np.float64), pathlib.Path(folder).name
        cases = {"-": views}
        for degrees in _DEGREES.value:
            moved = turned(poses, float(degrees), _SEED.value, LookAt(views).center)
            cases[f"{degrees} degrees"] = with_poses(views, moved)
        cases["exposures"] = changed(views, factors(len(views.size), _SEED.value))
        for case, each in cases.items():
            rows.append(row(name, case, each))
            print(" ".join(rows[-1]), flush=True)
    common.publish([*common.markdown(HEADS, rows), "", *common.provenance()], _TABLE.value)


def row(name: str, case: str, views: Views) -> tuple[Any, ...]:
    """Returns the cells of a row of the table."""
    start = time.process_time()
    found: Agreement = agreement(views)
    seconds = time.process_time() - start
    options, _ = resolve_cameras(_AUTO, views)
    refine, exposure = ("on" if value else "off" for value in (options.refine, options.exposure))
    numbers = f"{found.count:,}", f"{found.off:.2f}"
    colors = f"{np.expm1(found.brightness):.1%}", f"{np.expm1(found.tint):.1%}"
    return (name, case, *numbers, refine, *colors, exposure, f"{seconds:.1f}")


if __name__ == "__main__":
    cli.run(main)
