"""Writes the images of docs/guides/your_own_images.md: a test view, and its rendering by a good run and by two bad ones.

    python experiments/results/symptoms.py --data_dir=fox --out=docs/guides --seconds=60

The bad runs are trained on a fraction of the images, and with poses of which every second one is rotated. OUT/NAME.jpg
shows the test view in the middle, cropped to a square. Prints the PSNR of each run; finished runs are not repeated.
"""

import json
import pathlib
import sys
import tempfile

import imageio.v3 as iio
import numpy as np
from absl import flags

sys.path.append(str(pathlib.Path(__file__).resolve().parents[1]))
import common
from capture_check import planting
from results import table

from jaxnerf.data.dataset import dataset_folder
from jaxnerf.runtime import cli
from jaxnerf.runtime.atomic_files import partial_file

_DATA_DIR = flags.DEFINE_string("data_dir", None, "Folder of the dataset, or its name.", required=True)
_OUT = flags.DEFINE_string("out", None, "Folder of the images.", required=True)
_RUNS = flags.DEFINE_string("runs", "runs/symptoms", "Folder of the runs.")
_SECONDS = flags.DEFINE_float("seconds", 60.0, "Seconds of training of each run.", lower_bound=1.0)
_FEW = 8  # training images of the run with fog
_DEGREES = 2.0  # by which every second camera turns to the side


def main(argv: list[str]) -> None:
    """Trains, scores and shows the three runs."""
    del argv
    source, runs = dataset_folder(_DATA_DIR.value), pathlib.Path(_RUNS.value)
    with tempfile.TemporaryDirectory() as folder:
        turned = planting.copy(source, pathlib.Path(folder) / source.name)
        planting.edit_poses(turned, turn_every_second)
        show(runs / "good", source, {}, truth="test_view")
        show(runs / "fog", source, {"data.num_views": _FEW})
        show(runs / "double_edges", turned, {})


def turn_every_second(poses: np.ndarray) -> np.ndarray:
    """Returns poses [V, 3, 4] of which the second, fourth and so on are rotated about the camera's y axis."""
    angle, poses = np.radians(_DEGREES), poses.copy()
    rotation = np.array([[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]])
    poses[1::2, :, :3] = poses[1::2, :, :3] @ rotation
    return poses


def show(folder: pathlib.Path, dataset: pathlib.Path, changes: dict, *, truth: str = "") -> None:
    """Trains a run and writes its rendering of the test view in the middle; with `truth` also the view, by that name."""
    fixed = {"data.dir": str(dataset), "train.max_seconds": _SECONDS.value, "train.preview_every": 0}
    results = common.run(common.configuration("capture", fixed | changes), folder)
    print(json.dumps({folder.name: results["psnr"], "seconds": results["training_seconds"]}))
    scored = table.scored(folder)[-1].parent
    names = sorted(path.name for path in (scored / "color").glob("*.png"))
    shown = {"color": folder.name} | ({"gt-color": truth} if truth else {})
    for kind, name in shown.items():
        pixels = iio.imread(scored / kind / names[len(names) // 2])
        height, width = pixels.shape[:2]
        top, side = (height - min(height, width)) // 2, min(height, width)
        with partial_file(pathlib.Path(_OUT.value) / f"{name}.jpg") as partial:
            iio.imwrite(partial, pixels[top : top + side, :side], extension=".jpg", plugin="pillow", quality=90)


if __name__ == "__main__":
    cli.run(main)
