"""Exports the cameras that a run has refined, and measures how well images fit them, as jaxnerf-check does.

    JAXNERF_SCENES=... python experiments/benchmark/refined_cameras.py [--dataset=fox] [--degrees=0.5] \
        [--seed=0] [--width=100] [--steps=1200] [--set=train.cpu_batch_size=384] [--out=runs/refined] \
        [--page=docs/results/cameras.md]

A copy of the dataset gets cameras that are turned and moved as by `poses.py --degrees`.
`capture` trains on it, jaxnerf-export writes the refined cameras, and the training images are compared with all three.
A finished run is not repeated.
"""

import pathlib
import subprocess
import sys

from absl import flags

sys.path.append(str(pathlib.Path(__file__).resolve().parents[1]))
import common
from benchmark import settings
from benchmark.changed_views import turned
from capture_check import planting

from jaxnerf.data import dataset
from jaxnerf.data.geometry.poses import gaze_center, neighbours
from jaxnerf.data.geometry.world import poses_of
from jaxnerf.data.images.load_images import split_indices
from jaxnerf.data.readers.base import read_capture
from jaxnerf.runtime import cli
from jaxnerf.tools.capture_check import cameras, images, tracks

HEADS = ("cameras", "confirmed matches", "off, px (median, at most 4)", f"within {tracks.INLIER:.0f} px")

_DATASET = flags.DEFINE_string("dataset", "fox", "Folder of a dataset with one transforms.json.")
_DEGREES = flags.DEFINE_float("degrees", 0.5, "Standard deviation of the turns.", lower_bound=0.0)
_WIDTH = flags.DEFINE_integer("width", 100, "px of an image's width, at least.", lower_bound=8)
_STEPS = flags.DEFINE_integer("steps", 1200, "Steps of training.", lower_bound=1)
_SEED = flags.DEFINE_integer("seed", 0, "Of the turns and of training.")
_SET = settings.define_set()
_OUT = flags.DEFINE_string("out", "runs/refined", "Folder of the copy and of the run.")
_TABLE = flags.DEFINE_string("table", "refined_cameras", "Name of the table in the marks of --page.")


def main(argv: list[str]) -> None:
    """Trains and exports what is missing, and prints the table."""
    del argv
    from jaxnerf.training.loop import train

    source = dataset.dataset_folder(_DATASET.value)
    out = pathlib.Path(_OUT.value) / f"{source.name}_{_WIDTH.value}_{_DEGREES.value:g}_{_STEPS.value}_{_SEED.value}"
    given, run, refined = out / "given", out / "run", out / "refined"
    if not given.exists():
        planting.copy(source, given)
        planting.edit_poses(given, lambda poses: turned(poses, _DEGREES.value, _SEED.value, gaze_center(poses)))
    options = {"data.dir": str(given.resolve()), "data.width": _WIDTH.value, "train.preview_every": 0.0}
    options |= {"train.max_seconds": 0.0, "train.max_steps": _STEPS.value, "train.lr_steps": _STEPS.value}
    config = common.configuration("capture", {**options, **dict(settings.parse(_SET.value))}, seed=_SEED.value)
    if not train(config, run):
        raise ValueError(f"{run}: training was stopped; the same command continues it")
    if not refined.exists():
        export = [sys.executable, "-m", "jaxnerf.tools.exporters.program", f"--workdir={run}"]
        subprocess.run([*export, "--kind=cameras", "--name=refined"], check=True)
        found = next(path for path in run.rglob("refined") if path.is_dir())
        planting.copy(source, refined, without=["transforms.json"])
        (refined / "transforms.json").write_bytes((found / "transforms.json").read_bytes())
    folders = {"of the dataset": source, f"off by {_DEGREES.value:g} degrees": given, "these, refined": refined}
    rows = [(name, *fit(folder)) for name, folder in folders.items()]
    common.publish([*common.markdown(HEADS, rows), "", *common.provenance()], _TABLE.value)


def fit(folder: pathlib.Path) -> tuple[str, ...]:
    """Returns how many matches of the training images a third image confirms, and how well they fit the cameras."""
    capture = read_capture(folder)
    capture = capture._replace(frames=[capture.frames[index] for index in split_indices(capture, "train")])
    summaries, _ = images.read(capture)
    evidence = cameras.gather(capture, summaries, neighbours(poses_of(capture)))
    count, off = cameras.circle_error(evidence)
    return f"{count:,}", f"{off:.2f}", f"{evidence.fraction:.0%}"


if __name__ == "__main__":
    cli.run(main, stopped="within a run, which is saved; the same command continues")
