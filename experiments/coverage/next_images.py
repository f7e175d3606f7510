"""Adds images to a training set by coverage, at random, and by distance, and prints the PSNR after each addition.

    python experiments/coverage/next_images.py --scenes=lego --seeds=0,1,2,3,4 --page=docs/results/few_views.md
    python experiments/coverage/next_images.py --scenes=room --room=DIR      # of experiments/room/make_room.py

A scene's training images are the pool. Each seed begins with its own random images. A method then adds --add images at
a time, and a run is trained from scratch on all that it has:

- coverage: those whose views are least familiar to the run of the images so far, see docs/guides/next_images.md;
- random: any others;
- farthest: those whose cameras are farthest from the nearest camera so far, in position (over the mean distance of all
  cameras from their mean) plus viewing direction (unit vectors).

No method sees the images before it adds them. Finished runs in --out are not repeated.
"""

import functools
import pathlib
import statistics
import sys
from collections.abc import Callable

import jax
import numpy as np
from absl import flags

sys.path.append(str(pathlib.Path(__file__).resolve().parents[1]))
import common

from jaxnerf.core.cameras import pixel_grid
from jaxnerf.core.views import Views
from jaxnerf.evaluation.evaluate import train_and_evaluate
from jaxnerf.evaluation.metrics import pixel_mask
from jaxnerf.evaluation.restore import newest_step, restore_run
from jaxnerf.evaluation.supersampling import render_pixels
from jaxnerf.runtime import cli
from jaxnerf.tools.next_images.coverage import ViewCoverage, choose_views
from jaxnerf.training import auto_config

_SCENES = flags.DEFINE_list("scenes", ["lego"], "lego, room.")
_CAPTURE = flags.DEFINE_string("room", "runs/room", "Folder that experiments/room/make_room.py wrote.")
_SEEDS = flags.DEFINE_list("seeds", ["0", "1", "2", "3", "4"], "Of the first images, the random ones and the training.")
_START = flags.DEFINE_integer("start", 10, "Images at first.", lower_bound=2)
_ADD = flags.DEFINE_integer("add", 5, "Images that are added at a time.", lower_bound=1)
_END = flags.DEFINE_integer("end", 20, "Images in the end.", lower_bound=3)
_STEPS = flags.DEFINE_integer("steps", 500, "Training steps of each run.", lower_bound=1)
_OUT = flags.DEFINE_string("out", "runs/next_images", "Folder of the runs.")

METHODS = ("coverage", "random", "farthest")
BASE = ("random", "farthest")
_MOST_TEST_VIEWS = 25
# Of runs with all images, as those of the room below, so that no program depends on which images there are.
_LEGO = {
    "scene.lower": (-0.771, -1.2698, -0.6803),
    "scene.upper": (0.771, 1.2698, 1.1338),
    "occupancy.resolution": 125,
    "occupancy.step_size": 0.0203168,
    "hash_grid.resolutions": (15, 31, 62, 125),
    "hash_grid.table_size": 2**17,
    "hash_grid.width": 64,
    "hash_grid.view_width": 64,
}


def config_of(scene: str, indices: list[int], seed: int):
    """Returns the config of a run on some images of a scene's pool."""
    if scene == "lego":
        config = common.configuration("lego_fast", _LEGO, seed=seed)
    else:
        # Everything else is that of a run with all images, but there are parameters of as many cameras as images.
        config = common.changed(_resolved_capture(), {"cameras.num_images": "auto", "seed": seed})
    steps = _STEPS.value
    common_fields = {"train.max_steps": steps, "train.lr_steps": steps, "train.save_every": steps}
    more = {"data.view_indices": tuple(indices), "train.max_seconds": 0.0, "train.preview_every": 0.0}
    return common.changed(config, {**common_fields, **more, "eval.at_end": False, "eval.summary_seconds": 0.0})


@functools.cache
def _resolved_capture():
    """Returns the config of a run with all images of the room: its box, and what depends on it."""
    config = common.configuration("capture", {"data.dir": _CAPTURE.value})
    return auto_config.resolve(config, common.load_split(config, "train"))[0]


def psnr_of(run, variables, views: Views) -> float:
    """Returns the mean PSNR, dB, over at most 25 test views, spread evenly."""
    found, count = [], len(views.names)
    for index in np.unique(np.linspace(0, count - 1, min(_MOST_TEST_VIEWS, count)).astype(int)):
        height, width = (int(side) for side in views.size[index])
        pixels = pixel_grid(height, width, offset=run.experiment.config.data.pixel_offset)
        rgb = render_pixels(run, variables, views, index, pixels)[0].rgb
        mask = pixel_mask(views, index)
        squares = (np.clip(np.asarray(rgb), 0, 1) - np.asarray(views.image(index))) ** 2
        found.append(-10 * np.log10((squares if mask is None else squares[np.asarray(mask, bool)]).mean()))
    return float(np.mean(found))


def by_coverage(run, variables, pool: Views, indices: list[int], rest: list[int], rng) -> list[int]:
    """Returns the images to add, by the coverage of the run."""
    del rng
    coverage = ViewCoverage(run, variables)
    for index in indices:
        coverage.add(pool, index)
    scores = {index: coverage.score(pool, index) for index in rest}
    return [index for index, _ in choose_views(coverage, pool, scores, _ADD.value)]


def at_random(run, variables, pool: Views, indices: list[int], rest: list[int], rng) -> list[int]:
    """Returns random images to add."""
    del run, variables, pool, indices
    return rng.choice(rest, _ADD.value, replace=False).tolist()


def by_distance(run, variables, pool: Views, indices: list[int], rest: list[int], rng) -> list[int]:
    """Returns the images to add, by their distance from those that there are."""
    del run, variables, rng
    poses = np.asarray(pool.cameras.to_world, np.float64)
    spread = np.linalg.norm(poses[:, :, 3] - poses[:, :, 3].mean(axis=0), axis=1).mean()
    features = np.concatenate([poses[:, :, 3] / spread, poses[:, :, 2]], axis=1)
    parts = features.reshape(len(poses), 2, 3)
    apart = np.linalg.norm(parts[:, None] - parts, axis=-1).sum(axis=-1)
    chosen: list[int] = []
    for _ in range(_ADD.value):
        left = [index for index in rest if index not in chosen]
        chosen.append(left[int(apart[left][:, indices + chosen].min(axis=1).argmax())])
    return chosen


CHOOSE: dict[str, Callable] = {"coverage": by_coverage, "random": at_random, "farthest": by_distance}


def measure(scene: str, seed: int, method: str, *, out: pathlib.Path) -> dict[str, float]:
    """Returns the PSNR by the number of images."""
    record = out / f"{scene}_{seed}_{method}.json"
    known = common.read_json(record)
    origin = {"start": _START.value, "add": _ADD.value, "end": _END.value, "steps": _STEPS.value}
    if known and known["origin"] == origin:
        return known["psnr"]
    pool = common.load_split(config_of(scene, [], 0), "train")
    rng = np.random.default_rng(seed)
    indices = sorted(rng.choice(len(pool.names), _START.value, replace=False).tolist())
    found, history = {}, list(indices)
    while True:
        config = config_of(scene, sorted(indices), seed)
        first = len(indices) == _START.value  # is the same for all methods
        folder = out / (f"{scene}_{seed}_start{_START.value}" if first else f"{scene}_{seed}_{method}_{len(indices)}")
        if not (folder / "checkpoints" / str(_STEPS.value)).exists():
            train_and_evaluate(config, folder)
        run = restore_run(folder)
        variables = run.variables(newest_step(run, folder))
        found[str(len(indices))] = psnr_of(run, variables, common.load_split(config, "test"))
        print(scene, seed, method, len(indices), f"{found[str(len(indices))]:.2f} dB", flush=True)
        if len(indices) + _ADD.value > _END.value:
            break
        rest = [index for index in range(len(pool.names)) if index not in indices]
        added = CHOOSE[method](run, variables, pool, indices, rest, rng)
        indices, history = indices + added, history + added
        jax.clear_caches()
    common.write_json(record, {"origin": origin, "psnr": found, "images": history})
    return found


def area(psnr: dict[str, float]) -> float:
    """Returns the mean of the PSNR over the number of images, by the trapezoidal rule: the area under the curve."""
    counts = np.array([int(count) for count in psnr])
    return float(np.trapezoid(list(psnr.values()), counts) / (counts[-1] - counts[0]))


def table(scene: str, results: dict[str, dict[int, dict[str, float]]]) -> list[str]:
    """Returns the lines of the table of a scene."""
    counts = list(next(iter(results["random"].values())))
    areas = {method: {seed: area(psnr) for seed, psnr in by_seed.items()} for method, by_seed in results.items()}
    rows = []
    for method, by_seed in results.items():
        cells = [f"{statistics.fmean(psnr[count] for psnr in by_seed.values()):.2f}" for count in counts]
        mean, deviation = common.spread(list(areas[method].values()))
        versus = [
            _versus(areas[method], areas[other]) if other != method else "-" for other in results if other in BASE
        ]
        whole = f"{mean:.2f} ± {deviation:.2f}" if len(by_seed) > 1 else f"{mean:.2f}"
        rows.append([method, *cells, whole, *versus])
    versus = [f"above {other} (seeds)" for other in results if other in BASE]
    heads = [f"{scene}: images", *counts, "mean over them", *versus]
    return common.markdown(heads, rows)


def _versus(areas, others):
    """Returns the mean difference over the seeds, and in how many of them it is positive."""
    more = common.differences(areas, others)
    return f"{statistics.fmean(more):+.2f} ({sum(each > 0 for each in more)} of {len(more)})"


def main(argv):
    del argv
    out = pathlib.Path(_OUT.value)
    seeds = common.seeds_of("--seeds", _SEEDS.value)
    lines = []
    for scene in common.chosen("--scenes", _SCENES.value, ("lego", "room")):
        results = {method: {seed: measure(scene, seed, method, out=out) for seed in seeds} for method in METHODS}
        lines += [*table(scene, results), ""]
    common.publish([*lines, *common.provenance()], f"next_images {'_'.join(_SCENES.value)}")


if __name__ == "__main__":
    cli.run(main, stopped="between two runs; the same command continues from there")
