"""A turn around a trained scene, as a video or GIF."""

import dataclasses
import functools
import importlib.util
import os
import pathlib
import warnings

import imageio.v3 as iio
import jax
import numpy as np

from jaxnerf.core.cameras import pixel_grid
from jaxnerf.core.paths import turntable
from jaxnerf.core.rendering import render_image
from jaxnerf.data.poses import gaze_center
from jaxnerf.engine.load import newest_step, open_run
from jaxnerf.engine.pictures import to_8_bits
from jaxnerf.engine.records import Progress


def render_turntable(
    folder, *, step=None, data_dir=None, num_frames=48, frames_per_second=24, chunk=None, overwrite=False
):
    """Renders a turn around the middle of the training cameras' gaze, at their mean height and distance.

    Args:
        folder: the workdir.
        step: of the checkpoint; the newest when None.
        data_dir: the scene's folder in place of the configuration's.
        num_frames: of the turn.
        frames_per_second: of the video.
        chunk: rays at once; the configuration's eval.chunk when None.
        overwrite: whether an earlier file of the same name is replaced.

    Returns:
        The path written: renders/turntable-<step>.mp4, or .gif without the video extra.

    Raises:
        ValueError: if there is no such run or checkpoint, or the file is already there.
    """
    run = open_run(folder, data_dir=data_dir)
    step = newest_step(run, folder, step)
    target = pathlib.Path(folder) / "renders" / f"turntable-{step}{_suffix()}"
    if target.exists() and not overwrite:
        raise ValueError(f"{target}: is there already; give --overwrite to render it again")
    views = run.experiment.load_views("train")
    render = functools.partial(run.render, run.weights(step))
    height, width = (int(value) for value in views.size[0])
    pixels = pixel_grid(height, width, offset=run.experiment.pixel_offset)
    frames, progress = [], Progress(num_frames)
    for pose in orbit(views.cameras, num_frames):
        camera = dataclasses.replace(jax.tree.map(lambda leaf: leaf[:1], views.cameras), to_world=pose[None])
        rays = run.experiment.view_rays(dataclasses.replace(views, cameras=camera), 0, pixels)
        image = render_image(render, rays, chunk=chunk or run.experiment.eval.chunk)
        frames.append(to_8_bits(image.rgb))
        progress.show(len(frames), "frames")
    progress.close()
    target.parent.mkdir(parents=True, exist_ok=True)
    partial = target.with_stem(target.stem + ".tmp")
    _write(partial, np.stack(frames), frames_per_second)
    os.replace(partial, target)
    return target


def orbit(cameras, num_frames):
    """Returns poses [N, 3, 4] around the point that stacked cameras look at; z is up.

    The point is the one nearest to all their axes; distance and height are their means.
    """
    poses = np.asarray(cameras.to_world, np.float64)
    eyes = poses[:, :, 3]
    center = gaze_center(poses)
    distances = np.linalg.norm(eyes - center, axis=-1)
    elevation = np.arcsin(np.clip((eyes - center)[:, 2] / distances, -1, 1)).mean()
    return turntable(num_frames, center=center, radius=distances.mean(), elevation=elevation)


def _suffix():
    """Returns .mp4 where imageio finds ffmpeg, else .gif."""
    return ".mp4" if importlib.util.find_spec("imageio_ffmpeg") else ".gif"


def _write(path, frames, frames_per_second):
    if path.suffix == ".gif":
        iio.imwrite(path, frames, duration=1000 / frames_per_second, loop=0)
        return
    height, width = (side - side % 2 for side in frames.shape[1:3])  # what the codec takes
    options = {"codec": "libx264", "macro_block_size": 1, "quality": 8, "pixelformat": "yuv420p"}
    with warnings.catch_warnings():
        # JAX warns of forks; this one becomes ffmpeg at once and runs nothing of ours.
        warnings.filterwarnings("ignore", "os.fork", RuntimeWarning)
        iio.imwrite(path, frames[:, :height, :width], fps=frames_per_second, **options)
