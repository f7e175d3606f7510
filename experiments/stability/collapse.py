"""Counts how often a training collapses to an image of one colour, with and without reinitialization.

    python experiments/stability/collapse.py [--seeds=20] [--steps=600] [--out=runs/collapse] [--page=FILE.md]
    python experiments/stability/collapse.py --painted [--seeds=10] [--steps=480] [--out=...] [--page=FILE.md]

Trains the embedded scene with a network that tends to die (ReLU density, eight narrow layers without a skip, a high
learning rate), each seed with train.max_reinits=0 and with the default. Prints one row per run, then the table;
--out keeps both as collapse.json. With --page the table between <!-- collapse --> and <!-- end of collapse --> is
replaced. A run has collapsed when its network is dead at the end; see jaxnerf/training/dead_networks.py.

With --painted it trains a hash grid on the embedded scene, small and pale in front of a white, black or grey
background that is painted into images without alpha, with the learning rate of configs/capture.py. Each seed trains
with a plain sigmoid and with `color_activation`, both without reinitialization. A run has collapsed when its images
are at most 2 dB better than images of the background alone. The table is <!-- painted --> to <!-- end of painted -->.
"""

import dataclasses
import hashlib
import json
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

from jaxnerf import Views, pixel_grid, psnr
from jaxnerf.data import synthetic
from jaxnerf.fields import hash_grid
from jaxnerf.runtime import cli
from jaxnerf.tools.embedded_scene.render import render_views
from jaxnerf.training import auto_config, build, dead_networks
from jaxnerf.training.state import create_state

HEADS = ("train.max_reinits", "runs", "dead at the end", "reinitialized", "found at step", "PSNR", "worst")
PAINTED_HEADS = ("background", "output", "runs", "collapsed", "background alone", "PSNR", "worst")
BACKGROUNDS = {"white": 1.0, "black": 0.0, "grey": 0.5}
OUTPUTS = {"sigmoid": jax.nn.sigmoid, "color_activation": hash_grid.color_activation}
_CONTRAST = 0.5  # of the scene with the background: pale colours are closest to saturation
_FIELD_OF_VIEW = 2.5  # times the usual one: 92 % of the pixels show the background alone
_PAINTED = flags.DEFINE_bool("painted", False, "Train on images with a painted background.")
_SEEDS = flags.DEFINE_integer("seeds", 20, "Number of runs with each setting.", lower_bound=1)
_STEPS = flags.DEFINE_integer("steps", 600, "Steps of a run.", lower_bound=1)
_OUT = flags.DEFINE_string("out", None, "Folder of collapse.json.")


def main(argv: list[str]) -> None:
    """Runs all seeds with both settings and reports."""
    del argv
    if _PAINTED.value:
        painted()
        return
    study = Study(_STEPS.value)
    rows = []
    for seed in range(_SEEDS.value):
        for allowed in (0, common.configuration("default").train.max_reinits):
            rows.append(study.run(seed, allowed))
            print(json.dumps(rows[-1]), flush=True)
    lines = common.markdown(HEADS, [summary(group) for group in by_setting(rows)]) + ["", unaffected(rows)]
    if _OUT.value:
        common.write_json(pathlib.Path(_OUT.value) / "collapse.json", {"rows": rows, "table": lines})
    common.publish(lines, "collapse")


def fragile_config(steps: int):
    """Returns a config with which networks tend to die."""
    return common.configuration(
        "default",
        {
            "data.size": 40,
            "fine.depth": 8,
            "fine.width": 32,
            "fine.skip_layer": 8,
            "fine.num_freqs": 5,
            "fine.use_viewdirs": False,
            "sampling.num_coarse": 16,
            "sampling.num_fine": 0,
            "train.batch_size": 128,
            "train.max_steps": steps,
            "train.lr_steps": steps,
            "train.lr_init": 0.06,
            "train.lr_final": 0.001,
        },
    )


class Study:
    """The runs of one config, compiled once: the seed is an argument of the step."""

    def __init__(self, steps: int):
        config = fragile_config(steps)
        self._step = common.compile_step(config)
        config, _ = auto_config.resolve_for_device(self._step.config)
        self._experiment = build.build(config)
        self._views = self._experiment.load_split("test")
        model = self._experiment.model
        self._render = jax.jit(lambda params, rays: model.view(params, None, rays).rgb)

    def run(self, seed: int, allowed: int) -> dict[str, Any]:
        """Trains a seed and returns its metrics.

        Args:
            seed: of the initial parameters and the rays.
            allowed: train.max_reinits.
        """
        config = common.changed(self._experiment.config, {"seed": seed, "train.max_reinits": allowed})
        experiment = dataclasses.replace(self._experiment, config=config)
        reinitialize = dead_networks.make_reinitializer(experiment, f"seed {seed}")
        state = create_state(experiment.model, experiment.optimizer, seed)
        data = self._step.data._replace(seed=np.uint32(seed))
        started, found, counted = time.perf_counter(), [], 0
        for step in range(1, config.train.max_steps + 1):
            state, metrics = reinitialize(step, *self._step.run(state, data, self._step.positions))
            if step % dead_networks.CHECK_EVERY == 0 and int(metrics["num_reinits"]) > counted:
                found, counted = [*found, step], int(metrics["num_reinits"])
        leaves = [np.asarray(leaf).tobytes() for leaf in jax.tree.leaves(state.params)]
        return {
            "seed": seed,
            "max_reinits": allowed,
            "psnr": self._score(state.params),
            "dead": dead_networks.dead_networks(metrics),
            "num_reinits": counted,
            "found": found,
            "seconds": time.perf_counter() - started,
            "parameters": hashlib.sha256(b"".join(leaves)).hexdigest(),
        }

    def _score(self, params):
        values = []
        for index, (height, width) in enumerate(np.asarray(self._views.size)):
            rays = self._experiment.view_rays(self._views, index, pixel_grid(height, width))
            values.append(float(psnr(self._render(params, rays), self._views.image(index))))
        return statistics.mean(values)


def painted() -> None:
    """Runs all seeds in front of all backgrounds with both outputs and reports."""
    rows = []
    for output in OUTPUTS:
        study = PaintedStudy(_STEPS.value, output)
        for background in BACKGROUNDS:
            for seed in range(_SEEDS.value):
                rows.append(study.run(seed, background))
                print(json.dumps(rows[-1]), flush=True)
    groups = [
        [row for row in rows if (row["background"], row["output"]) == (background, output)]
        for background in BACKGROUNDS
        for output in OUTPUTS
    ]
    lines = common.markdown(PAINTED_HEADS, list(map(painted_summary, groups)))
    if _OUT.value:
        common.write_json(pathlib.Path(_OUT.value) / "painted.json", {"rows": rows, "table": lines})
    common.publish(lines, "painted")


def painted_config(steps: int):
    """Returns configs/capture.py with sizes that train in seconds."""
    return common.configuration(
        "capture",
        {
            "data.format": "synthetic",
            "data.size": 48,
            "data.factor": 1,
            "data.world": "around",
            "data.background": "none",
            "scene.background": (),  # one compiled step serves all painted backgrounds
            "data.ndc": False,
            "train.batch_size": 128,
            "train.max_steps": steps,
            "occupancy.step_size": 0.05,
            "occupancy.resolution": 48,
            "hash_grid.resolutions": (12, 24, 48),
            "hash_grid.view_width": 64,
        },
    )


def painted_views(size: int, background: str) -> Views:
    """Returns views of the still life, [P, 3] uint8, in front of a painted background; cameras have a distance of 1."""
    views = synthetic.load_synthetic(size=size)
    stack = dataclasses.replace(views.cameras, focal=views.cameras.focal / np.float32(_FIELD_OF_VIEW))
    rgba = render_views(stack, num_segments=128) / 65535
    behind = BACKGROUNDS[background]
    rgb = behind + _CONTRAST * rgba[:, 3:] * (rgba[:, :3] - behind)
    to_world = np.array(stack.to_world)
    to_world[..., 3] /= np.linalg.norm(to_world[..., 3], axis=-1, keepdims=True)
    return dataclasses.replace(
        views,
        pixels=np.round(255 * rgb).astype(np.uint8),
        cameras=dataclasses.replace(stack, to_world=to_world),
        near=np.full_like(views.near, 0.01),
        far=np.full_like(views.far, 10.0),
        background=None,
    )


class PaintedStudy:
    """The runs with one output of the colour, compiled once: the seed and the pixels are arguments of the step."""

    def __init__(self, steps: int, output: str):
        self._output, self._views = output, {name: painted_views(48, name) for name in BACKGROUNDS}
        kept, hash_grid.color_activation = hash_grid.color_activation, OUTPUTS[output]
        try:
            self._step = common.compile_step(painted_config(steps), self._views["white"])
        finally:
            hash_grid.color_activation = kept
        config, _ = auto_config.resolve_for_device(self._step.config)
        self._experiment = build.build(config)

    def run(self, seed: int, background: str) -> dict[str, Any]:
        """Trains a seed and returns its metrics; "psnr" is that of the last 40 batches."""
        experiment, views = self._experiment, self._views[background]
        state = create_state(experiment.model, experiment.optimizer, seed)
        views_of_step = dataclasses.replace(self._step.data.views, pixels=jax.numpy.asarray(views.pixels))
        data = self._step.data._replace(seed=np.uint32(seed), views=views_of_step)
        errors, dead = [], 0
        for _ in range(experiment.config.train.max_steps):
            state, metrics = self._step.run(state, data, self._step.positions)
            errors.append(float(metrics["mse_fine"]))
            dead = max(dead, int(metrics["dead_fine"]))
        alone = np.square(views.pixels / 255 - BACKGROUNDS[background]).mean()
        return {
            "background": background,
            "output": self._output,
            "seed": seed,
            "psnr": float(-10 * np.log10(np.mean(errors[-40:]))),
            "psnr_alone": float(-10 * np.log10(alone)),
            "most_dead_steps": dead,
        }


def painted_summary(rows: list[dict]) -> tuple[str, ...]:
    """Returns the cells of the runs with one background and output."""
    scores, alone = [row["psnr"] for row in rows], rows[0]["psnr_alone"]
    return (
        rows[0]["background"],
        f"`{rows[0]['output']}`",
        str(len(rows)),
        str(sum(score < alone + 2 for score in scores)),
        f"{alone:.2f} dB",
        f"{statistics.median(scores):.2f} dB",
        f"{min(scores):.2f} dB",
    )


def by_setting(rows: list[dict]) -> tuple[list[dict], list[dict]]:
    """Returns the rows of the runs without and with reinitialization."""
    return [row for row in rows if not row["max_reinits"]], [row for row in rows if row["max_reinits"]]


def summary(rows: list[dict]) -> tuple[str, ...]:
    """Returns the cells of the runs with one setting."""
    scores, found = [row["psnr"] for row in rows], [step for row in rows for step in row["found"]]
    return (
        str(rows[0]["max_reinits"]),
        str(len(rows)),
        str(sum(bool(row["dead"]) for row in rows)),
        f"{sum(row['num_reinits'] for row in rows)} times in {sum(row['num_reinits'] > 0 for row in rows)} runs",
        f"{statistics.median(found):g} (first {min(found)}, last {max(found)})" if found else "-",
        f"{statistics.median(scores):.2f} dB",
        f"{min(scores):.2f} dB",
    )


def unaffected(rows: list[dict]) -> str:
    """Returns a sentence about the runs in which no network died."""
    pairs = [pair for pair in zip(*by_setting(rows), strict=True) if not pair[1]["num_reinits"]]
    equal = sum(a["parameters"] == b["parameters"] for a, b in pairs)
    return (
        f"Of {len(pairs)} runs in which no network died, {equal} end with the same parameters both ways, bit for bit."
    )


if __name__ == "__main__":
    cli.run(main)
