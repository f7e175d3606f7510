"""Scores runs at the size of their training images, at half of it, a quarter and an eighth.

    python experiments/multiscale/multiscale.py --out=runs/multiscale [--config=lego_fast] [--scenes=lego,mic]
        [--factor=4] [--steps=2000] [--page=docs/results/multiscale.md]

Each scene is trained on images shrunk by --factor, and at four sizes of them (`data.num_scales`) without and with
`prefilter`; with `lego_fast` the last also with a sample buffer of twice the usual size. Truth at each size is the mean
over the pixels of the original images. Supersampling renders several rays a pixel, on a regular grid, and averages
their colours. Each run has three checkpoints, for equal_seconds.py.
"""

import json
import math
import pathlib
import statistics
import sys
import time
from typing import Any

import jax
import numpy as np
from absl import flags

sys.path.append(str(pathlib.Path(__file__).resolve().parents[1]))
import common

from jaxnerf.core.cameras import pixel_grid
from jaxnerf.core.metrics import psnr
from jaxnerf.core.views import Views
from jaxnerf.evaluation import evaluate, restore, supersampling
from jaxnerf.runtime import cli

_FOUR = {"data.num_scales": 4}
_VARIANTS = {
    "lego_fast": {
        "full size": {},
        "four scales": {**_FOUR, "hash_grid.prefilter": False},
        "four scales, prefilter": {**_FOUR, "hash_grid.prefilter": True},
        "four scales, prefilter, 10 samples a ray": {
            **_FOUR,
            "hash_grid.prefilter": True,
            "occupancy.pool_samples_per_ray": 10.0,
        },
    },
    "lego_mlp_fast": {
        "full size": {},
        "four scales": {**_FOUR, "fine.prefilter": False},
        "four scales, prefilter": {**_FOUR, "fine.prefilter": True},
    },
}
_OUT = flags.DEFINE_string("out", None, "Folder of the runs; finished ones are not repeated.", required=True)
_CONFIG = flags.DEFINE_enum("config", "lego_fast", list(_VARIANTS), "Config of the runs.")
_SCENES = flags.DEFINE_list("scenes", ["lego", "mic"], "Datasets with images of 800 px.")
_FACTOR = flags.DEFINE_integer("factor", 4, "Full size is that of the images shrunk by this.", lower_bound=1)
_STEPS = flags.DEFINE_integer("steps", 2000, "Steps of training.", lower_bound=3)
_NUM_VIEWS = flags.DEFINE_integer("num_views", 25, "Test views to score, spread evenly.", lower_bound=1)
_SPLIT = flags.DEFINE_enum("split", "test", ["test", "held_out"], "The views to score; held_out: to choose settings.")
_SCALES = (1, 2, 4, 8)
_SIDES = ((1, 2), (1, 2), (1, 2, 4), (1, 2, 4, 8))  # rays along a pixel's side, at each scale
_LIMIT = math.isqrt(supersampling.MAX_RAYS)  # along a pixel's side, of jaxnerf-render
_NAMES = ("1", "1/2", "1/4", "1/8")
_MOMENTS = 3  # checkpoints of a run, all scored


def main(argv: list[str]) -> None:
    """Trains, scores and prints the tables of each scene."""
    del argv
    size = f"{800 // _FACTOR.value} px, {_STEPS.value} steps, {_NUM_VIEWS.value} {_SPLIT.value} views"
    usual = {scale: min(scale, _LIMIT) for scale in _SCALES}
    for scene in _SCENES.value:
        quality, forced = [], []
        for name, settings in _VARIANTS[_CONFIG.value].items():
            folder = f"{_CONFIG.value}_{scene}_{name.replace(' ', '_').replace(',', '')}"
            scores = measure(scene, settings, pathlib.Path(_OUT.value) / folder)["scores"]
            quality.append([name, *(f"{scores[f'{scale}x1']['psnr']:.2f}" for scale in _SCALES)])
            if not settings:
                forced += [supersampled(str(side**2), dict.fromkeys(_SCALES, side), scores) for side in _SCALES]
                forced.append(supersampled("as jaxnerf-render", usual, scores))
        lines = [*common.provenance(), "", f"{scene}, PSNR in dB, one ray a pixel; {size}:", ""]
        lines += common.markdown(("trained on", *_NAMES), quality)
        lines += ["", "Supersampling of the run trained at full size: PSNR in dB, and in brackets seconds a frame.", ""]
        lines += common.markdown(("rays a pixel", *_NAMES), forced)
        common.publish(lines, f"scales of {_CONFIG.value} on {scene}")


def supersampled(name: str, sides: dict[int, int], scores: dict[str, Any]) -> list[str]:
    """Returns the row of a table with so many rays along a pixel's side, by scale; "-" where none were rendered."""
    cells = [scores.get(f"{scale}x{side}") for scale, side in sides.items()]
    shown = [f"{cell['psnr']:.2f} ({cell['seconds']:.3f})" if cell else "-" for cell in cells]
    return [name, *shown]


def measure(scene: str, settings: dict[str, Any], folder: pathlib.Path) -> dict[str, Any]:
    """Trains a scene and scores it at all scales.

    Args:
        scene: name of the dataset.
        settings: of the config, by dotted name.
        folder: of the run and what was measured; a finished one is read.

    Returns:
        {"seconds": of training, "scores": {"SCALExSIDE": {"psnr": mean, "seconds": median of a frame}}, "moments":
        [{"seconds": of training, "SCALExSIDE": PSNR} of each checkpoint]}, with SIDE x SIDE rays a pixel.
    """
    steps = {"train.max_steps": _STEPS.value, "train.lr_steps": _STEPS.value, "train.preview_every": 0}
    every = math.ceil(_STEPS.value / _MOMENTS)
    steps |= {
        "train.save_every": every,
        "train.log_every": every,
        "train.max_to_keep": _MOMENTS,
        "train.max_seconds": 0.0,
    }
    hold_out = {} if _SPLIT.value == "test" else {"data.hold_out": 8}
    settings = {"data.dir": scene, "data.factor": _FACTOR.value, **steps, **hold_out, **settings}
    config = common.configuration(_CONFIG.value, settings)
    origin = {"config": common.plain_config(config), "num_views": _NUM_VIEWS.value, "split": _SPLIT.value}
    kept = common.read_json(folder / "measured.json")
    if kept:
        common.check_origin(kept["origin"], origin, folder, "give another folder, or the old settings")
        return kept["measured"]
    if not evaluate.train_and_evaluate(config, folder / "run"):
        raise KeyboardInterrupt
    rows = [json.loads(line) for line in (folder / "run" / "metrics.jsonl").read_text().splitlines()]
    seconds = {row["step"]: row["seconds"] for row in rows}
    run = restore.restore_run(folder / "run")
    at_one_size = config.data.num_scales == 1
    views = {scale: _views(config, scale, _SPLIT.value) for scale in _SCALES}
    moments = []
    for step in sorted(run.steps()):
        variables = run.variables(step)
        cases = [(1, 1), (8, 1), *([(8, _LIMIT)] if at_one_size else [])]
        found = {f"{scale}x{side}": score(run, variables, views[scale], side)["psnr"] for scale, side in cases}
        moments.append({"seconds": seconds[step], **found})
    scores = {
        f"{scale}x{side}": score(run, variables, views[scale], side)
        for scale, sides in zip(_SCALES, _SIDES, strict=True)
        for side in (sides if at_one_size else (1,))
    }
    measured = {"seconds": seconds[step], "scores": scores, "moments": moments}
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


def _views(config, scale, split):
    return common.load_split(common.changed(config, {"data.factor": scale * _FACTOR.value}), split)


if __name__ == "__main__":
    cli.run(main)
