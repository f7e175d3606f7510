"""Trains and scores walks: PSNR and SSIM of views that were not trained on, after some seconds of one core's time.

    JAXNERF_SCENES=... taskset -c 0 python experiments/room/walks.py --runs=walk:300,walk_points:300 \
        [--out=runs/walks] [--width=240] [--set=NAME=VALUE]... [--split=test] [--page=docs/results/captures.md]

A run is a folder, or a name below $JAXNERF_SCENES, and its seconds, CPU time of one core, or, as walk:3000steps, its
steps: beside other programs CPU time is no measure of a machine's speed. Each is configs/capture.py
with its own learning rates. The split "held_out" is every 8th training view, then not trained on. --set changes all
runs of a call. What walks.json in --out has is not measured again. A sheet of scored views is beside it, below each the
image.
"""

import ast
import math
import pathlib
import sys

import numpy as np
from absl import flags
from PIL import Image

sys.path.append(str(pathlib.Path(__file__).resolve().parents[1]))
import common

from jaxnerf.core.metrics import ssim
from jaxnerf.data import dataset
from jaxnerf.runtime import cli
from jaxnerf.tools.needs import trial
from jaxnerf.training.config import changed, read_config

HEADS = ("dataset", "changed", "px", "seconds", "PSNR, dB", "SSIM", "steps", "passes", "seconds a frame")
_OUT = flags.DEFINE_string("out", "runs/walks", "Folder of the runs and the table.")
_RUNS = flags.DEFINE_list("runs", ["walk:120"], "Folder:seconds of training, or folder:STEPSsteps.")
_WIDTH = flags.DEFINE_integer("width", 240, "px, of the images.", lower_bound=8)
_SET = flags.DEFINE_multi_string("set", [], "Fields of the config, as train.lr_init=0.01.")
_SPLIT = flags.DEFINE_string("split", "test", "The views that are scored: held_out or test.")
_SIDE = 240  # px, the width of a view in the sheet


def main(argv: list[str]) -> None:
    """Trains what is missing, then reports everything that is there."""
    del argv
    out = pathlib.Path(_OUT.value)
    out.mkdir(parents=True, exist_ok=True)
    rows = common.read_json(out / "walks.json") if (out / "walks.json").exists() else {}
    trainers, table = {}, []
    for data_dir, seconds in (run.rsplit(":", 1) for run in _RUNS.value):
        name = "_".join([pathlib.Path(data_dir).name, str(_WIDTH.value), seconds, _SPLIT.value, *_SET.value])
        if name not in rows:
            if data_dir not in trainers:
                trainers = {data_dir: _trainer(data_dir)}
            rows[name] = _measure(trainers[data_dir], seconds, out / f"{name}.png")
            common.write_json(out / "walks.json", rows)
        table.append(rows[name])
    common.publish([*common.markdown(HEADS, table), "", *common.provenance()], "walks")


def _trainer(data_dir):
    overrides = {"data.dir": data_dir, "data.width": _WIDTH.value, "data.hold_out": 8 * (_SPLIT.value == "held_out")}
    overrides |= {name: ast.literal_eval(value) for name, value in (each.split("=", 1) for each in _SET.value)}
    config = read_config(common.configuration("capture"))
    config = changed(config, overrides)
    data, _, capture = dataset.resolve(config.data)
    views = dataset.load_split(data, "train", capture=capture)
    # All pixels are scored, as SSIM compares neighbours.
    return trial.Trainer(config, views, split=_SPLIT.value, most_pixels=math.inf)


def _measure(trainer, seconds, sheet):
    steps = int(seconds.removesuffix("steps")) if seconds.endswith("steps") else 0
    result, images = trainer.run({}, 0, 0.0 if steps else float(seconds), steps=steps)
    scored = trainer.held_out()
    truths = [np.asarray(scored.image(index))[..., :3] for index in range(len(images))]
    similar = [float(ssim(np.float32(image) / 255, truth)) for image, truth in zip(images, truths, strict=True)]
    _save_sheet(sheet, images, truths)
    rays = result.steps * trainer.resolved({}).config.train.batch_size
    scores = [f"{np.mean(result.psnr):.2f}", f"{np.mean(similar):.3f}", f"{result.steps:,}"]
    scores += [f"{rays / len(trainer.views.pixels):.2f}", f"{result.frame_seconds:.1f}"]
    name = pathlib.Path(trainer.config.data.dir).name
    seconds = f"{result.seconds:.0f}, other programs beside it" if steps else seconds
    return [name, ", ".join(_SET.value), f"{scored.size[0][1]}", seconds, *scores]


def _save_sheet(path, images, truths):
    chosen = np.unique(np.linspace(0, len(images) - 1, 12).astype(int))
    height = round(_SIDE * images[0].shape[0] / images[0].shape[1])
    target = Image.new("RGB", (_SIDE * 6, height * 4))
    for place, index in enumerate(chosen):
        for row, pixels in enumerate((images[index], np.uint8(np.rint(truths[index] * 255)))):
            view = Image.fromarray(pixels).resize((_SIDE, height))
            target.paste(view, (place % 6 * _SIDE, (2 * (place // 6) + row) * height))
    target.save(path)


if __name__ == "__main__":
    cli.run(main)
