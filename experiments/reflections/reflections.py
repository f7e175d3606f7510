"""Trains the embedded scene with and without reflections, and measures PSNR, times and errors of normals.

    python experiments/reflections/reflections.py --out=runs/reflections [--finishes=shiny,matt] [--steps=2000]
        [--page=docs/results/reflections.md --table=reflections]

A step with reflections takes longer, so that a run without them takes as many steps more: both steps are timed in
turn, before training, and so are the images of all runs, after it. Another run without them has the same number of
steps. The truth of normals is the closed form at its own median depth. What is compared with it: the density's normals
by automatic differentiation, those by differences over a step of the ray marching, those through the depths of
neighbouring pixels, and what the field predicts. The views that are held out of training are farther from the others
than the test views are.
"""

import functools
import pathlib
import statistics
import sys

import jax
import numpy as np
from absl import flags

sys.path.append(str(pathlib.Path(__file__).resolve().parents[1]))
import common

from jaxnerf.core.cameras import pixel_grid
from jaxnerf.core.metrics import psnr, round_to_8_bits
from jaxnerf.core.normals import density_normals
from jaxnerf.core.rendering import points_on_rays, render_rays
from jaxnerf.evaluation import restore
from jaxnerf.fields.base import field_normals
from jaxnerf.fields.still_life import FINISHES, still_life
from jaxnerf.runtime import cli
from jaxnerf.tools.exporters.surfaces import DepthImage

_OUT = flags.DEFINE_string("out", None, "Folder of the runs; finished ones are not repeated.", required=True)
_FINISHES = flags.DEFINE_list("finishes", ["shiny", "matt"], "Finishes of the embedded scene.")
_STEPS = flags.DEFINE_integer("steps", 2000, "Steps of the runs with reflections.", lower_bound=1)
_TABLE = flags.DEFINE_string("table", "reflections", "Name of the table in the marks of --page.")
_TIMED = flags.DEFINE_integer("timed", 60, "Steps of each kind that are timed.", lower_bound=2)
_NUM_VIEWS = 3  # whose normals are measured
_OPAQUE = 0.9  # opacity from which a pixel shows a surface
_NEAR = 0.05  # world units, between the surface of the run and the true one
_SAMPLES = 384  # of the closed form, per ray
_HEADS = ("finish", "reflections", "steps", "ms a step", "ms a frame", "test views, dB", "held-out views, dB")
_HEADS += ("density", "differences", "depths", "predicted")


def main(argv: list[str]) -> None:
    """Trains, scores and prints the table."""
    del argv
    rows = []
    for finish in common.chosen("--finishes", _FINISHES.value, list(FINISHES)):
        configs = {reflects: configuration(finish, reflects) for reflects in (False, True)}
        folder = pathlib.Path(_OUT.value) / f"{finish}_{_STEPS.value}"
        times = step_times(configs, folder / "times.json")
        equal = round(_STEPS.value * times["on"] / times["off"])
        steps = {"off": equal, "off, equal steps": _STEPS.value, "on": _STEPS.value}
        runs, scores = {}, {}
        for name, count in steps.items():
            config = common.changed(configs[name == "on"], {"train.max_steps": count, "train.lr_steps": count})
            workdir = folder / name.replace(", ", "_").replace(" ", "_")
            results = common.run(config, workdir, split="test")
            runs[name] = restore.restore_run(workdir)
            scores[name] = results["psnr"], mean_psnr(runs[name], common.load_split(config, "held_out"))
        test = common.load_split(config, "test")
        frames = frame_times(runs, test)
        for name, run in runs.items():
            errors = normal_errors(run, test)
            cells = [f"{np.mean(each):.1f} ({np.median(each):.1f})" if len(each) else "" for each in errors]
            rows.append(
                [
                    finish,
                    name,
                    str(steps[name]),
                    f"{1000 * times[name.split(',')[0]]:.1f}",
                    f"{1000 * frames[name]:.1f}",
                    *(f"{score:.2f}" for score in scores[name]),
                    *cells,
                ]
            )
    common.publish([*common.provenance(), "", *common.markdown(_HEADS, rows)], _TABLE.value)


def configuration(finish: str, reflects: bool):
    """Returns the config of a run, as of experiments/scene_needs."""
    data = {"data.format": "synthetic", "data.dir": "", "data.factor": 1, "data.finish": finish}
    train = {"train.max_seconds": 0.0, "train.save_every": 10**6, "eval.at_end": False}
    return common.configuration(
        "lego_fast", {**data, **train, "data.hold_out": 8, "hash_grid.reflections": reflects, "train.lr_steps": 1000}
    )


def step_times(configs, path: pathlib.Path) -> dict[str, float]:
    """Returns the median seconds of a step "on" and "off", which run in turn; kept in a file."""
    kept = common.read_json(path)
    if kept:
        return kept
    steps = {name: common.compile_step(configs[name == "on"]) for name in ("on", "off")}
    states = {name: step.state for name, step in steps.items()}
    found = {name: [] for name in steps}
    for _ in range(_TIMED.value):
        for name, step in steps.items():

            def call(name=name, step=step):
                states[name], metrics = step.run(states[name], step.data, step.positions)
                return metrics

            found[name].append(common.seconds(call))
    times = {name: statistics.median(values[_TIMED.value // 4 :]) for name, values in found.items()}
    common.write_json(path, times)
    return times


def frame_times(runs, views) -> dict[str, float]:
    """Returns the median seconds of an image of each run, over all views, which the runs render in turn."""
    variables = {name: run.variables(run.steps()[-1]) for name, run in runs.items()}
    found = {name: [] for name in runs}
    for index, size in enumerate(views.size):
        for name, run in runs.items():
            rays = run.experiment.view_rays(views, index, pixel_grid(*(int(side) for side in size)))
            found[name].append(common.seconds(functools.partial(run.render_image, variables[name], rays)))
    return {name: statistics.median(values) for name, values in found.items()}


def mean_psnr(run, views) -> float:
    """Returns the mean PSNR of all views."""
    variables, found = run.variables(run.steps()[-1]), []
    for index in range(len(views.size)):
        pixels = pixel_grid(*(int(side) for side in views.size[index]))
        image = run.render_image(variables, run.experiment.view_rays(views, index, pixels)).rgb
        found.append(float(psnr(round_to_8_bits(np.clip(image, 0, 1)), views.image(index)[..., :3])))
    return statistics.fmean(found)


def normal_errors(run, views) -> list[np.ndarray]:
    """Returns the angular errors in degrees, [P] for each kind of normals; none of a kind that the run lacks."""
    variables = run.variables(run.steps()[-1])
    model, params = run.experiment.model, variables[0]
    scene, predict = model.scene(*variables), field_normals(model.fields["fine"], params)
    exact = jax.jit(lambda rays: render_rays(None, still_life, rays, num_samples=_SAMPLES, median_depth=True))
    by_gradient = jax.jit(lambda x, v: density_normals(scene, x, v))
    spacing = model.grid_schedule.step_size
    by_differences = jax.jit(lambda x, v: density_normals(scene, x, v, spacing=spacing))
    truth_at = jax.jit(lambda x, v: density_normals(still_life, x, v))
    found = [[] for _ in range(4)]
    for index in range(_NUM_VIEWS):
        height, width = (int(side) for side in views.size[index])
        rays = run.experiment.view_rays(views, index, pixel_grid(height, width))
        seen = run.render_image(variables, rays, median_depth=True)
        true = [exact(jax.tree.map(lambda leaf, row=row: leaf[row], rays)) for row in range(height)]
        opacity, depth = (
            np.stack([np.asarray(getattr(each, n)) for each in true]) for n in ("opacity", "median_depth")
        )
        x, place = points_on_rays(rays, seen.median_depth[..., None])[..., 0, :], points_on_rays(rays, depth[..., None])
        v = rays.viewdirs
        truth = np.asarray(truth_at(place[..., 0, :], v))
        kept = (opacity > _OPAQUE) & (np.asarray(seen.opacity) > _OPAQUE)
        kept &= np.abs(depth - np.asarray(seen.median_depth)) < _NEAR
        camera = jax.tree.map(lambda leaf, index=index: np.asarray(leaf)[index], views.cameras)
        z = np.where(np.asarray(seen.opacity) > _OPAQUE, np.asarray(seen.median_depth), np.inf)
        image = DepthImage(None, camera, z, np.zeros((height, width, 3), np.uint8), z, np.asarray(x))
        across, cosine = image.normals()
        kept &= cosine > 0  # edges, where neighbouring pixels have no common surface
        all_normals = [by_gradient(x, v), by_differences(x, v), across]
        all_normals += [] if predict is None else [jax.jit(predict)(x, v)]
        for values, normals in zip(found, all_normals, strict=False):
            aligned = np.clip((np.asarray(normals) * truth).sum(axis=-1)[kept], -1, 1)
            values.append(np.degrees(np.arccos(aligned)))
    return [np.concatenate(values) if values else np.zeros(0) for values in found]


if __name__ == "__main__":
    cli.run(main, stopped="after saving; the same command resumes")
