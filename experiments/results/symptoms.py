"""Writes the images of docs/guides/your_own_images.md: a test view, and its renderings by a good run and by bad ones.

    python experiments/results/symptoms.py --data_dir=fox --view=0012 --out=docs/guides/symptoms

The bad runs are trained on a few of the images, and with poses of which every second one is rotated. Writes
OUT/NAME.jpg for each, cropped to a square, and prints the PSNR. A run that was interrupted continues.
"""

import pathlib
import sys
import tempfile

import imageio.v3 as iio
import numpy as np
from absl import flags

sys.path.append(str(pathlib.Path(__file__).resolve().parents[1]))
import common
from capture_check import planting

from jaxnerf.core.cameras import pixel_grid
from jaxnerf.data.dataset import dataset_folder
from jaxnerf.evaluation.evaluate import train_and_evaluate
from jaxnerf.evaluation.metrics import image_metrics
from jaxnerf.evaluation.restore import restore_run
from jaxnerf.evaluation.supersampling import render_pixels
from jaxnerf.runtime import cli
from jaxnerf.runtime.atomic_files import partial_file

_DATA_DIR = flags.DEFINE_string("data_dir", None, "Folder of the dataset, or its name.", required=True)
_OUT = flags.DEFINE_string("out", None, "Folder of the images.", required=True)
_VIEW = flags.DEFINE_string("view", None, "A part of the name of the test view that is shown.", required=True)
_RUNS = flags.DEFINE_string("runs", "runs/symptoms", "Folder of the runs.")
_STEPS = flags.DEFINE_integer("steps", 2500, "Steps of each run.", lower_bound=1)
_FEW = 8  # training images of the run with fog
_DEGREES = 2.0  # by which every second camera turns to the side


def main(argv: list[str]) -> None:
    """Trains and shows the three runs."""
    del argv
    source, out = dataset_folder(_DATA_DIR.value), pathlib.Path(_OUT.value)
    out.mkdir(parents=True, exist_ok=True)
    show(out / "good.jpg", source, {}, truth=out / "test_view.jpg")
    show(out / "fog.jpg", source, {"data.num_views": _FEW})
    with tempfile.TemporaryDirectory() as folder:
        turned = planting.copy(source, pathlib.Path(folder) / source.name)
        planting.edit_poses(turned, turn_every_second)
        show(out / "double_edges.jpg", turned, {})


def turn_every_second(poses: np.ndarray) -> np.ndarray:
    """Returns poses [V, 3, 4] of which the second, fourth and so on are rotated about the camera's y axis."""
    angle, poses = np.radians(_DEGREES), poses.copy()
    rotation = np.array([[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]])
    poses[1::2, :, :3] = poses[1::2, :, :3] @ rotation
    return poses


def show(path: pathlib.Path, dataset: pathlib.Path, changes: dict, *, truth: pathlib.Path | None = None) -> None:
    """Trains a run and writes its rendering of the view; with `truth` also the view itself."""
    fixed = {"data.dir": str(dataset), "hash_grid.table_size": 2**17, "train.max_seconds": 0.0}
    fixed |= {"train.max_steps": _STEPS.value, "train.lr_steps": _STEPS.value, "eval.summary_seconds": 0.0}
    config = common.configuration("capture", fixed | changes)
    folder = pathlib.Path(_RUNS.value) / path.stem
    train_and_evaluate(config, folder)
    run = restore_run(folder)
    views = run.experiment.load_split("test")
    (index,) = (index for index, name in enumerate(views.names) if _VIEW.value in name)
    height, width = (int(side) for side in views.size[index])
    pixels = pixel_grid(height, width, offset=run.experiment.config.data.pixel_offset)
    variables = run.variables(run.steps()[-1])
    rgb = np.asarray(render_pixels(run, variables, views, index, pixels)[0].rgb)
    image = views.image(index)
    print(f"{path.stem}: {image_metrics(rgb, image)['psnr']:.2f} dB on {views.names[index]}")
    for place, colors in ((path, rgb), (truth, image)):
        if place:
            side = min(height, width)
            with partial_file(place) as partial:
                square = np.uint8(255 * colors[:side, :side] + 0.5)
                iio.imwrite(partial, square, extension=".jpg", plugin="pillow", quality=90)


if __name__ == "__main__":
    cli.run(main)
