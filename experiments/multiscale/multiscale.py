"""Scores runs at the size of their training images, at half of it, a quarter and an eighth.

    python experiments/multiscale/multiscale.py --out=runs/multiscale [--scenes=lego,mic] [--factor=4] [--steps=2000]
        [--page=docs/results/multiscale.md]

Each scene is trained with `lego_fast` twice: on images shrunk by --factor alone, and on four scales of them, with as
many rays from each; options follow from the largest images. Truth at each size is the mean over the pixels of the
original images. Supersampling renders several rays a pixel, on a regular grid, and averages their colours.
"""

import dataclasses
import json
import pathlib
import statistics
import sys
import time
from collections.abc import Sequence
from typing import Any

import jax
import numpy as np
from absl import flags

sys.path.append(str(pathlib.Path(__file__).resolve().parents[1]))
import common

from jaxnerf.core.cameras import pixel_grid
from jaxnerf.core.metrics import psnr
from jaxnerf.core.views import Views
from jaxnerf.evaluation import evaluate, restore
from jaxnerf.runtime import cli
from jaxnerf.training import auto_config

_OUT = flags.DEFINE_string("out", None, "Folder of the runs; finished ones are not repeated.", required=True)
_SCENES = flags.DEFINE_list("scenes", ["lego", "mic"], "Datasets with images of 800 px.")
_FACTOR = flags.DEFINE_integer("factor", 4, "Full size is that of the images shrunk by this.", lower_bound=1)
_STEPS = flags.DEFINE_integer("steps", 2000, "Steps of training.", lower_bound=1)
_NUM_VIEWS = flags.DEFINE_integer("num_views", 25, "Test views to score, spread evenly.", lower_bound=1)
_SCALES = (1, 2, 4, 8)
_SIDES = ((1, 2), (1, 2), (1, 2, 4), (1, 2, 4, 8))  # rays along a pixel's side, at each scale
_NAMES = ("1", "1/2", "1/4", "1/8")


def main(argv: list[str]) -> None:
    """Trains, scores and prints both tables."""
    del argv
    quality, forced = [], []
    for scene in _SCENES.value:
        for trained_on, scales in (("full size", (1,)), ("four scales", _SCALES)):
            found = measure(scene, scales, pathlib.Path(_OUT.value) / f"{scene}_{len(scales)}")
            one = [found["scores"][f"{scale}x1"] for scale in _SCALES]
            quality.append([scene, trained_on, *(f"{score['psnr']:.2f}" for score in one), f"{found['seconds']:.0f}"])
            if len(scales) == 1:
                forced += [supersampled(scene, side, found["scores"]) for side in _SCALES]
    lines = [*common.provenance(), "", "PSNR of test views in dB, one ray a pixel:", ""]
    lines += common.markdown(("scene", "trained on", *_NAMES, "seconds of training"), quality)
    lines += ["", "Supersampling of the runs trained at full size: PSNR in dB, and in brackets seconds a frame.", ""]
    lines += common.markdown(("scene", "rays a pixel", *_NAMES), forced)
    common.publish(lines, "scales")


def supersampled(scene: str, side: int, scores: dict[str, Any]) -> list[str]:
    """Returns the row of a table with side x side rays a pixel at each scale; "-" where they were not rendered."""
    cells = [scores.get(f"{scale}x{side}") for scale in _SCALES]
    shown = [f"{cell['psnr']:.2f} ({cell['seconds']:.3f})" if cell else "-" for cell in cells]
    return [scene, str(side**2), *shown]


def measure(scene: str, scales: Sequence[int], folder: pathlib.Path) -> dict[str, Any]:
    """Trains a scene on some scales and scores it at all of them.

    Args:
        scene: name of the dataset.
        scales: by which the images of training are shrunk further, beyond --factor.
        folder: of the run and what was measured; a finished one is read.

    Returns:
        {"seconds": of training, "scores": {"SCALExSIDE": {"psnr": mean, "seconds": median of a frame}}}, with
        SIDE x SIDE rays a pixel.
    """
    steps = {"train.max_steps": _STEPS.value, "train.lr_steps": _STEPS.value, "train.preview_every": 0}
    settings = {"data.dir": scene, "data.factor": _FACTOR.value, **steps}
    config = common.configuration("lego_fast", settings)
    origin = {"config": common.plain_config(config), "scales": list(scales), "num_views": _NUM_VIEWS.value}
    kept = common.read_json(folder / "measured.json")
    if kept:
        common.check_origin(kept["origin"], origin, folder, "give another folder, or the old settings")
        return kept["measured"]
    parts = [_views(config, scale, "train") for scale in scales]
    config = auto_config.resolve(config, parts[0]).config  # sizes of the hash grid are those for the largest images
    if not evaluate.train_and_evaluate(config, folder / "run", views=joined(parts)):
        raise KeyboardInterrupt
    seconds = json.loads((folder / "run" / "metrics.jsonl").read_text().splitlines()[-1])["seconds"]
    run = restore.restore_run(folder / "run")
    variables = run.variables(run.steps()[-1])
    scores = {}
    for scale, sides in zip(_SCALES, _SIDES, strict=True):
        views = _views(config, scale, "test")
        for side in sides:
            scores[f"{scale}x{side}"] = score(run, variables, views, side)
    measured = {"seconds": seconds, "scores": scores}
    common.write_json(folder / "measured.json", {"origin": origin, "measured": measured})
    jax.clear_caches()
    return measured


def score(run, variables, views: Views, side: int) -> dict[str, float]:
    """Renders views with side x side rays a pixel; returns their mean PSNR and the median seconds of a frame."""
    found, taken = [], []
    count = len(views.names)
    for index in np.linspace(0, count - 1, min(_NUM_VIEWS.value, count)).round().astype(int):
        height, width = (int(value) for value in views.size[index])
        rays = run.experiment.view_rays(views, index, subpixels(height, width, side))
        if not found:
            run.render_image(variables, rays)  # compiles
        started = time.perf_counter()
        rgb = jax.block_until_ready(run.render_image(variables, rays).rgb)
        taken.append(time.perf_counter() - started)
        rgb = rgb.reshape(height, side, width, side, 3).mean((1, 3))
        found.append(float(psnr(rgb, views.image(index))))
    return {"psnr": statistics.fmean(found), "seconds": statistics.median(taken)}


def subpixels(height: int, width: int, side: int) -> jax.Array:
    """Returns positions [side H, side W, 2] in px, the centres of side x side equal parts of each pixel."""
    return pixel_grid(side * height, side * width) / side


def joined(parts: Sequence[Views]) -> Views:
    """Returns Views with the images of all parts, the same images at several sizes.

    Small ones are repeated, so that each part has as many pixels as the first, whose images are the largest: training
    draws pixels evenly, and each scale has the same weight (the rule of arXiv:2103.13415, Section 4).
    """
    parts = [part for part in parts for _ in range(round(len(parts[0].pixels) / len(part.pixels)))]
    if len(parts) == 1:
        return parts[0]
    starts = np.cumsum([0, *(len(part.pixels) for part in parts[:-1])])

    def all_of(name, of=lambda part: part):
        values = [getattr(of(part), name) for part in parts]
        return None if values[0] is None else np.concatenate(values)

    cameras = {name: all_of(name, lambda part: part.cameras) for name in ("to_world", "focal", "center", "distortion")}
    offsets = [part.offset + np.int32(start) for part, start in zip(parts, starts, strict=True)]
    return dataclasses.replace(
        parts[0],
        **{name: all_of(name) for name in ("pixels", "size", "near", "far", "mask", "free_depth", "time")},
        offset=np.concatenate(offsets),
        cameras=dataclasses.replace(parts[0].cameras, **cameras, height=None, width=None),
        names=tuple(f"{name}_{index}" for index, part in enumerate(parts) for name in part.names),
    )


def _views(config, scale, split):
    return common.load_split(common.changed(config, {"data.factor": scale * _FACTOR.value}), split)


if __name__ == "__main__":
    cli.run(main)
