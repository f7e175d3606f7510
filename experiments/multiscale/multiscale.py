"""Scores runs at the size of their training images, at half of it, a quarter and an eighth.

    python experiments/multiscale/multiscale.py --out=runs/multiscale [--config=lego_fast] [--scenes=lego,mic]
        [--factor=4] [--steps=2000] [--page=docs/results/multiscale.md]

Each scene is written at four sizes, as the multi-scale dataset of arXiv:2103.13415 (multiscale_images.py), and trained
on: on the largest images alone, and on all without and with `prefilter`; with `lego_fast` the last also with a sample
buffer of twice the usual size. All are scored on the test images of the four sizes. Supersampling renders several rays
a pixel, on a regular grid, and averages their colours.
"""

import math
import pathlib
import statistics
import sys
import time
from typing import Any

import jax
import numpy as np
from absl import flags

sys.path += [str(folder) for folder in pathlib.Path(__file__).resolve().parents[:2]]
import common
from multiscale_images import write_scales

from jaxnerf.core.cameras import pixel_grid
from jaxnerf.core.metrics import psnr
from jaxnerf.core.views import Views
from jaxnerf.data.dataset import dataset_folder
from jaxnerf.evaluation import evaluate, restore, supersampling
from jaxnerf.runtime import cli

_VARIANTS = {
    "lego_fast": {
        "full size": {},
        "four scales": {"hash_grid.prefilter": False},
        "four scales, prefilter": {"hash_grid.prefilter": True},
        "four scales, prefilter, 10 samples a ray": {
            "hash_grid.prefilter": True,
            "occupancy.pool_samples_per_ray": 10.0,
        },
    },
    "lego_mlp_fast": {
        "full size": {},
        "four scales": {"fine.prefilter": False},
        "four scales, prefilter": {"fine.prefilter": True},
    },
}
_OUT = flags.DEFINE_string("out", None, "Folder of the images and runs; finished ones are kept.", required=True)
_CONFIG = flags.DEFINE_enum("config", "lego_fast", list(_VARIANTS), "Config of the runs.")
_SCENES = flags.DEFINE_list("scenes", ["lego", "mic"], "Datasets with images of 800 px.")
_FACTOR = flags.DEFINE_integer("factor", 4, "Full size is that of the images shrunk by this.", lower_bound=1)
_STEPS = flags.DEFINE_integer("steps", 2000, "Steps of training.", lower_bound=3)
_NUM_VIEWS = flags.DEFINE_integer("num_views", 25, "Test views to score at each size, spread evenly.", lower_bound=1)
_REPEAT = flags.DEFINE_integer("repeat", 4, "How often an image is listed, see multiscale_images.py.", lower_bound=1)
_SCALES = (1, 2, 4, 8)
_SIDES = ((1, 2), (1, 2), (1, 2, 4), (1, 2, 4, 8))  # rays along a pixel's side, at each scale
_LIMIT = math.isqrt(supersampling.MAX_RAYS)  # along a pixel's side, of jaxnerf-render
_NAMES = ("1", "1/2", "1/4", "1/8")
# The world, near and far of Blender's scenes; the cameras state more than Blender's do, so the format is another one.
_READ = {"data.format": "transforms", "data.factor": 1, "data.world": "file", "data.near": 2.0, "data.far": 6.0}


def main(argv: list[str]) -> None:
    """Writes the images, trains, scores and prints the tables of each scene."""
    del argv
    size = f"{800 // _FACTOR.value} px, {_STEPS.value} steps, {_NUM_VIEWS.value} test views"
    usual = {scale: min(scale, _LIMIT) for scale in _SCALES}
    for scene in _SCENES.value:
        images = pathlib.Path(_OUT.value) / f"{scene}_{_FACTOR.value}_{_REPEAT.value}"
        write_scales(dataset_folder(scene), images, factor=_FACTOR.value, num_scales=len(_SCALES), repeat=_REPEAT.value)
        quality, forced = [], []
        for name, settings in _VARIANTS[_CONFIG.value].items():
            folder = f"{_CONFIG.value}_{scene}_{name.replace(' ', '_').replace(',', '')}"
            scores = measure(scene, images, settings, pathlib.Path(_OUT.value) / folder)["scores"]
            mean = statistics.fmean(scores[f"{scale}x1"]["psnr"] for scale in _SCALES)
            quality.append([name, *(f"{scores[f'{scale}x1']['psnr']:.2f}" for scale in _SCALES), f"{mean:.2f}"])
            if not settings:
                forced += [supersampled(str(side**2), dict.fromkeys(_SCALES, side), scores) for side in _SCALES]
                forced.append(supersampled("as jaxnerf-render", usual, scores))
        lines = [*common.provenance(), "", f"{scene}, PSNR in dB, one ray a pixel; {size}:", ""]
        lines += common.markdown(("trained on", *_NAMES, "mean"), quality)
        lines += ["", "Supersampling of the run trained at full size: PSNR in dB, and in brackets seconds a frame.", ""]
        lines += common.markdown(("rays a pixel", *_NAMES), forced)
        common.publish(lines, f"scales of {_CONFIG.value} on {scene}")


def supersampled(name: str, sides: dict[int, int], scores: dict[str, Any]) -> list[str]:
    """Returns the row of a table with so many rays along a pixel's side, by scale; "-" where none were rendered."""
    cells = [scores.get(f"{scale}x{side}") for scale, side in sides.items()]
    shown = [f"{cell['psnr']:.2f} ({cell['seconds']:.3f})" if cell else "-" for cell in cells]
    return [name, *shown]


def measure(scene: str, images: pathlib.Path, settings: dict[str, Any], folder: pathlib.Path) -> dict[str, Any]:
    """Trains a scene and scores it at all scales.

    Args:
        scene: name of the dataset.
        images: the folder of its images at all sizes.
        settings: of the config, by dotted name; {}: the images of the largest size alone are trained on.
        folder: of the run and what was measured; a finished one is read.

    Returns:
        {"scores": {"SCALExSIDE": {"psnr": mean, "seconds": median of a frame}}}, with SIDE x SIDE rays a pixel.
    """
    steps = {"train.max_steps": _STEPS.value, "train.lr_steps": _STEPS.value, "train.save_every": _STEPS.value}
    steps |= {"train.preview_every": 0, "train.max_seconds": 0.0, "train.rays_per_side": 1}
    scales = common.configuration(_CONFIG.value, {"data.dir": str(images), **_READ, **steps, **settings})
    largest = {"data.dir": scene, "data.factor": _FACTOR.value}
    config = scales if settings else common.configuration(_CONFIG.value, {**largest, **steps})
    origin = {"config": common.plain_config(config), "num_views": _NUM_VIEWS.value, "repeat": _REPEAT.value}
    kept = common.read_json(folder / "measured.json")
    if kept:
        common.check_origin(kept["origin"], origin, folder, "give another folder, or the old settings")
        return kept["measured"]
    if not evaluate.train_and_evaluate(config, folder / "run"):
        raise KeyboardInterrupt
    run = restore.restore_run(folder / "run")
    variables, views = run.variables(run.steps()[-1]), common.load_split(scales, "test")
    scores = {
        f"{scale}x{side}": score(run, variables, views, index, side)
        for index, (scale, sides) in enumerate(zip(_SCALES, _SIDES, strict=True))
        for side in ((1,) if settings else sides)
    }
    common.write_json(folder / "measured.json", {"origin": origin, "measured": {"scores": scores}})
    jax.clear_caches()
    return {"scores": scores}


def score(run, variables, views: Views, scale: int, side: int) -> dict[str, float]:
    """Renders views of a scale with side x side rays a pixel; returns their mean PSNR and median seconds of a frame."""
    found, taken = [], []
    chosen = [index for index, name in enumerate(views.names) if name.endswith(f"_d{scale}")]
    for place in np.linspace(0, len(chosen) - 1, min(_NUM_VIEWS.value, len(chosen))).round().astype(int):
        index = chosen[place]
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


if __name__ == "__main__":
    cli.run(main)
