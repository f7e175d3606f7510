"""Scores a run that was trained on a capture of the embedded room against its ground truth.

    python experiments/room/score_room.py --workdir=W --room=DIR [--trained_on=DIR] [--step=...] [--rays=256] \
        [--out=FILE] [--page=docs/results/captures.md] [--table=room]

For the held-out views near the path ("val") and the far novel views ("test"), prints and writes as JSON:

- PSNR of all pixels; of those that show a surface which two training views see; and of all after the affine map of
  colours, per image, that fits best: exposure is not known to a model of its own.
- The median error of the depth, over pixels that show a surface which two training views see, in world units of the
  capture and in cells of the occupancy grid. A cell is measured along the ray at the true surface, so that it is
  larger where space is contracted. The depth is the expected one, of which fog and missing opacity are part.
- The fraction of the compositing weight that lies in free space, more than one and more than four cells in front of the
  true surface.

Depth and weights are those of the field in the occupied cells, as it is rendered.
"""

import dataclasses
import functools
import pathlib
import sys
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from absl import flags

sys.path.append(str(pathlib.Path(__file__).resolve().parents[1]))
import common

from jaxnerf.core import contraction
from jaxnerf.core.cameras import pixel_grid
from jaxnerf.core.rendering import sample_inputs
from jaxnerf.core.types import Rays, SceneFn
from jaxnerf.core.views import Views
from jaxnerf.data.dataset import load_dataset
from jaxnerf.data.geometry.world import poses_in_file, poses_in_run
from jaxnerf.evaluation.metrics import image_metrics
from jaxnerf.evaluation.restore import TrainedRun, newest_step, restore_run
from jaxnerf.models.grid_schedule import GridSchedule
from jaxnerf.runtime import cli
from test_scenes import synthetic_capture

HEADS = (
    *("views", "PSNR, dB", "of seen surfaces", "colours aligned"),
    *("depth error, units", "in cells", "weight in free space", "more than 4 cells in front of the surface"),
)
PLACES = {"val": "near the path", "test": "far novel"}
_MIN_SEEN = 2  # training views that see a surface
_FREE = {"free_weight": 1, "free_weight_4_cells": 4}  # cells from the surface at which free space ends
_NUM_SAMPLES = 512  # positions on the part of a ray in free space

_WORKDIR = flags.DEFINE_string("workdir", None, "Folder that training wrote.", required=True)
_CAPTURE = flags.DEFINE_string("room", None, "Folder that make_room.py wrote.", required=True)
_TRAINED_ON = flags.DEFINE_string("trained_on", None, "The model that make_room.py wrote, if the run is trained on it.")
_TABLE = flags.DEFINE_string("table", "room", "Name of the table on --page.")
_STEP = flags.DEFINE_integer("step", None, "Of the checkpoint; the newest when not given.")
_RAYS = flags.DEFINE_integer("rays", 256, "Rays per view whose weight in free space is measured.", lower_bound=1)
_OUT = flags.DEFINE_string("out", None, "JSON file; replaces it. W/room_score.json by default.")


class Scored(NamedTuple):
    """The measurements of one view.

    Attributes:
        row: of the JSON file.
        depth_error: [N] world units of the capture, of the pixels with a seen surface.
        depth_error_cells: [N].
    """

    row: dict[str, Any]
    depth_error: np.ndarray
    depth_error_cells: np.ndarray


def main(argv: list[str]) -> None:
    """Scores a run and prints the table."""
    del argv
    truth = synthetic_capture.read_ground_truth(_CAPTURE.value)
    run = restore_run(_WORKDIR.value, data_dir=_TRAINED_ON.value or _CAPTURE.value)
    step = newest_step(run, _WORKDIR.value, _STEP.value)
    load = run.experiment.load_split
    if _TRAINED_ON.value:
        load = functools.partial(views_in_run, run, _CAPTURE.value)
    results = score(run, step, truth, num_rays=_RAYS.value, load=load)
    common.publish(table(results), _TABLE.value)
    out = pathlib.Path(_OUT.value or pathlib.Path(_WORKDIR.value, "room_score.json"))
    common.write_json(out, {"workdir": _WORKDIR.value, "room": _CAPTURE.value, "step": step, **results})
    print(f"wrote {out}")


def views_in_run(run: TrainedRun, folder: str, split: str) -> Views:
    """Returns the views of a capture's split in the world of a run that was trained on another form of the capture."""
    views, own = load_dataset(folder, split=split), run.experiment.load_split("train", max_views=1)
    poses = poses_in_run(poses_in_file(views.cameras.to_world, views.to_file), own.to_file)
    cameras = dataclasses.replace(views.cameras, to_world=np.float32(poses))
    near, far = np.full_like(views.near, np.min(own.near)), views.far * np.float32(unit_of(views) / unit_of(own))
    return dataclasses.replace(views, cameras=cameras, near=near, far=far, to_file=own.to_file)


def score(
    run: TrainedRun,
    step: int,
    truth: synthetic_capture.GroundTruth,
    *,
    num_rays: int = 256,
    load: Callable[[str], Views] | None = None,
) -> dict[str, dict[str, Any]]:
    """Returns {split: measurements}, with one row per image in "images".

    Args:
        run: restored, with a grid.
        step: of a checkpoint.
        truth: of the capture that it was trained on.
        num_rays: see --rays.
        load: split -> its Views in the run's world; None: as the run loads them.

    Raises:
        ValueError: if the run has no occupancy grid, or its images have another size than the ground truth.
    """
    if run.experiment.model.grid_schedule is None:
        raise ValueError("the run has no occupancy grid, expected the sampler 'occupancy', whose cells are the unit")
    variables, results = run.variables(step), {}
    scene = run.experiment.model.scene(*variables)
    optical_depths = jax.jit(functools.partial(optical_depth, scene))
    for split in PLACES:
        if not (truth.split == split).any():
            continue
        views = (load or run.experiment.load_split)(split)
        scored = [
            _score_view(run, variables, optical_depths, views, index, truth, num_rays)
            for index in range(len(views.names))
        ]
        rows = [each.row for each in scored]
        results[split] = {
            "views": len(rows),
            **{key: float(np.mean([row[key] for row in rows])) for key in rows[0] if key != "name"},
            "depth_error": float(np.median(np.concatenate([each.depth_error for each in scored]))),
            "depth_error_cells": float(np.median(np.concatenate([each.depth_error_cells for each in scored]))),
            "images": rows,
        }
    return results


def _score_view(run, variables, optical_depths, views, index, truth, num_rays):
    name = views.names[index]
    known = list(truth.names).index(name)
    height, width = (int(value) for value in views.size[index])
    depth = truth.depth[known]
    if depth.shape != (height, width):
        raise ValueError(f"{name} has {width} x {height} px, expected those of the ground truth; train with factor 1")
    rays = run.experiment.view_rays(views, index, pixel_grid(height, width))
    image = run.render_image(variables, rays)
    seen = truth.num_seen[known] >= _MIN_SEEN
    target = views.image(index)
    metrics = image_metrics(image.rgb, target)
    unit = unit_of(views)  # of the run's world, in the capture's
    true_t = depth / unit
    speed = np.linalg.norm(rays.directions, axis=-1)
    x = rays.origins + true_t[..., None] * rays.directions
    cells = np.asarray(cell_lengths(run.experiment.model.grid_schedule, x, rays.viewdirs))
    error = np.abs(np.asarray(image.depth) - true_t) * speed
    rng = np.random.default_rng(index)
    chosen = rng.choice(height * width, min(num_rays, height * width), replace=False)
    some = jax.tree.map(lambda leaf: jnp.reshape(leaf, (height * width, *leaf.shape[2:]))[chosen], rays)
    opacity = float(np.asarray(image.opacity).reshape(-1)[chosen].sum())
    fog = {}
    for key, distance in _FREE.items():
        end = (true_t - distance * cells / speed).reshape(-1)[chosen]
        in_front = np.asarray(optical_depths(some, some.near, end))
        fog[key] = float(-np.expm1(-in_front).sum() / max(opacity, 1e-6))
    row = {
        "name": name,
        "psnr": metrics["psnr"],
        "ssim": metrics["ssim"],
        "psnr_seen": image_metrics(image.rgb, target, seen)["psnr"],
        "psnr_aligned": image_metrics(align_colors(image.rgb, target), target)["psnr"],
        "opacity": float(np.mean(image.opacity)),
        **fog,
    }
    return Scored(row, (unit * error)[seen], (error / cells)[seen])


def unit_of(views: Views) -> float:
    """Returns the length of a unit of the views' world in units of the dataset's files."""
    return 1.0 if views.to_file is None else float(np.linalg.norm(np.asarray(views.to_file)[:3, 0]))


def cell_lengths(schedule: GridSchedule, x, viewdirs):
    """Returns the lengths [...] of an occupancy grid's cells along directions at positions, world units.

    Args:
        schedule: of the grid.
        x: [..., 3] world units.
        viewdirs: [..., 3] unit length.
    """
    lower, upper = jnp.asarray(schedule.lower), jnp.asarray(schedule.upper)
    middle, quarter = (lower + upper) / 2, (upper - lower) / 4

    def in_cells(x):
        scaled = (x - middle) / quarter
        return (contraction.contract(scaled) if schedule.contracted else scaled) * quarter / jnp.asarray(schedule.cell)

    with jax.numpy_rank_promotion("allow"):
        _, moved = jax.jvp(in_cells, (jnp.asarray(x, jnp.float32),), (jnp.asarray(viewdirs, jnp.float32),))
    return 1 / jnp.linalg.norm(moved, axis=-1)


def optical_depth(scene: SceneFn, rays: Rays, start, end, *, num_samples: int = _NUM_SAMPLES):
    """Returns the optical depth [R] of rays [R] from t = start to t = end, by the midpoint rule; 0 if end <= start."""
    length = jnp.maximum(end - start, 0)
    t = start[:, None] + length[:, None] * ((jnp.arange(num_samples) + 0.5) / num_samples)[None]
    x = rays.origins[:, None] + t[..., None] * rays.directions[:, None]
    inputs = sample_inputs("optical_depth", scene, rays, t, jnp.broadcast_to(length[:, None] / num_samples, t.shape))
    density, _ = scene(x, rays.viewdirs[:, None], **inputs)
    return density.mean(axis=-1) * length * jnp.linalg.norm(rays.directions, axis=-1)


def align_colors(image, target) -> np.ndarray:
    """Returns an image [H, W, 3] after the affine map of its colours that is closest to the target, in [0, 1]."""
    shape = np.shape(image)
    image, target = (np.asarray(pixels, np.float64).reshape(-1, 3) for pixels in (image, target))
    colors = np.concatenate([image, np.ones((len(image), 1))], axis=-1)
    mapped = colors @ np.linalg.lstsq(colors, target, rcond=None)[0]
    return np.float32(np.clip(mapped, 0, 1)).reshape(shape)


def table(results: dict[str, dict[str, Any]]) -> list[str]:
    """Returns the lines of the table of results."""
    rows = []
    for split, found in results.items():
        cells = [f"{found[key]:.2f}" for key in ("psnr", "psnr_seen", "psnr_aligned")]
        cells += [f"{found['depth_error']:.3f}", f"{found['depth_error_cells']:.2f}"]
        cells += [f"{100 * found[key]:.1f} %" for key in _FREE]
        rows.append((f"{PLACES[split]} ({found['views']})", *cells))
    return common.markdown(HEADS, rows)


if __name__ == "__main__":
    cli.run(main)
