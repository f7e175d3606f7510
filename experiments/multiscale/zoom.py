"""Moves a camera away from a trained scene and measures how much the frames flicker.

    python experiments/multiscale/zoom.py --workdir=DIR,... [--page=docs/results/multiscale.md]

The camera starts at the first training view, and its distance grows to --times as much in equal ratios. Frames are
rendered with one ray a pixel, with as many as `jaxnerf-render` takes, and with up to 256, the reference. Flicker is
what changes from frame to frame and not in the reference: the root mean square, over pixels and pairs of successive
frames, of the difference between both changes.
"""

import pathlib
import sys
import time

import numpy as np
from absl import flags

sys.path.append(str(pathlib.Path(__file__).resolve().parents[1]))
import common

from jaxnerf.core.cameras import pixel_grid
from jaxnerf.data.facts import LookAt
from jaxnerf.evaluation import restore, supersampling
from jaxnerf.evaluation.output_images import to_8_bits, write_image
from jaxnerf.evaluation.paths import camera_path
from jaxnerf.runtime import cli

_WORKDIRS = flags.DEFINE_list("workdir", None, "The runs.", required=True)
_FRAMES = flags.DEFINE_integer("frames", 60, "Frames.", lower_bound=2)
_TIMES = flags.DEFINE_float("times", 8.0, "The last distance over the first.", lower_bound=1.0)
_CROP = flags.DEFINE_float(
    "crop",
    1.0,
    "Part of the image that is rendered, around its middle, of the sides.",
    lower_bound=0.01,
    upper_bound=1.0,
)
_IMAGE = flags.DEFINE_string(
    "image", "", "A PNG to write, its name before that of the run: every tenth frame, a row for each number of rays."
)
_LIMITS = {"1": 1, "as jaxnerf-render": supersampling.MAX_RAYS, "reference": 256}


def main(argv: list[str]) -> None:
    """Renders the frames and prints the table."""
    del argv
    rows = [row for workdir in _WORKDIRS.value for row in measure(pathlib.Path(workdir))]
    lines = [*common.provenance(), "", f"{_FRAMES.value} frames, the last from {_TIMES.value:g} times as far away:", ""]
    head = ("run", "rays a pixel", "flicker, of 255", "least PSNR of a frame", "seconds a frame")
    common.publish([*lines, *common.markdown(head, rows)], "zoom")


def measure(workdir: pathlib.Path) -> list[tuple[str, ...]]:
    """Renders the frames of a run; returns the rows of the table, one for each number of rays but the reference's."""
    run = restore.restore_run(workdir)
    variables, views = run.variables(run.steps()[-1]), run.experiment.load_split("train")
    path = zoom_out(views, _FRAMES.value, _TIMES.value)
    posed = camera_path.posed_views(views, path)
    footprint = supersampling.trained_footprint(run, views)
    videos, seconds = {}, {}
    pixels = middle(np.asarray(pixel_grid(path.height, path.width)), _CROP.value)
    for name, limit in _LIMITS.items():
        sides = footprint.rays_per_side(path.poses, path.focal, max_rays=limit)
        started = time.perf_counter()
        images = [
            supersampling.render_pixels(run, variables, posed, index, pixels, side=int(side))[0].rgb
            for index, side in enumerate(sides)
        ]
        videos[name], seconds[name] = np.stack(images), time.perf_counter() - started
    exact, rows = videos.pop("reference"), []
    for name, video in videos.items():
        psnr = -10 * np.log10(np.mean((video - exact) ** 2, axis=(1, 2, 3)).clip(1e-10))
        row = (f"{255 * flicker(video, exact):.2f}", f"{psnr.min():.1f}", f"{seconds[name] / len(video):.3f}")
        rows.append((workdir.parent.name, name, *row))
    if _IMAGE.value:
        strips = [np.concatenate(video[::10], axis=1) for video in (*videos.values(), exact)]
        path = pathlib.Path(_IMAGE.value)
        write_image(path.with_stem(f"{path.stem}_{workdir.parent.name}"), to_8_bits(np.concatenate(strips)))
    return rows


def flicker(video, exact):
    """Returns the root mean square of what changes between frames [N, H, W, 3] and not so in the exact ones."""
    return np.sqrt(np.mean((np.diff(video, axis=0) - np.diff(exact, axis=0)) ** 2))


def middle(pixels, part):
    """Returns the middle of pixels [H, W, 2], a part of their height and width."""
    height, width = (max(round(part * side), 1) for side in pixels.shape[:2])
    top, left = (pixels.shape[0] - height) // 2, (pixels.shape[1] - width) // 2
    return pixels[top : top + height, left : left + width]


def zoom_out(views, count, times):
    """Returns the CameraPath from the first view's camera away from what the cameras look at, without turning."""
    pose = np.asarray(views.cameras.to_world[0], np.float64)
    center = LookAt(views).center
    scales = np.geomspace(1, times, count)
    poses = np.stack([np.column_stack([pose[:, :3], center + scale * (pose[:, 3] - center)]) for scale in scales])
    focal, middle = (np.tile(np.float64(each)[:1], (count, 1)) for each in (views.cameras.focal, views.cameras.center))
    height, width = (int(side) for side in views.size[0])
    return camera_path.CameraPath("zoom", "zoom", poses, focal, middle, width, height)


if __name__ == "__main__":
    cli.run(main)
