"""Renders a trained run along a camera path, resumes where it was interrupted, and makes a video."""

import dataclasses
import glob
import importlib.util
import os
import pathlib
import sys
import time
import warnings
from collections.abc import Callable, Iterable
from typing import Any, NamedTuple

import imageio.v2
import numpy as np

from jaxnerf.core.views import Views
from jaxnerf.data.geometry import path_poses
from jaxnerf.data.images.image_files import read_stored
from jaxnerf.evaluation import output_images
from jaxnerf.evaluation.paths import camera_path
from jaxnerf.evaluation.paths.camera_path import CameraPath
from jaxnerf.evaluation.restore import TrainedRun, check_moves, newest_step, refined_views
from jaxnerf.evaluation.supersampling import MAX_RAYS, render_pixels, trained_footprint, training_cameras
from jaxnerf.runtime import atomic_files, shards
from jaxnerf.runtime.fingerprint import fingerprint
from jaxnerf.runtime.stages import Progress
from jaxnerf.training.metric_log import minutes

VIDEO_KINDS = ("auto", "mp4", "gif", "none")
_FPS = 24.0


@dataclasses.dataclass(frozen=True)
class Frames:
    """What is rendered.

    Attributes:
        path: see `camera_path.make_path`; when None `path_poses.default_kind` selects one, and it is printed.
        num_frames, closed, up: see `camera_path.make_path`; without up, it is that of the run's option `data.up`.
        width, height: px, see `camera_path.resize`.
        time: the first and the last in [0, 1] of a scene that moves, equally spaced in between; when None those of the
            path's file, or 0 and 1.
        seconds: of the video; without num_frames, it has 24 frames a second. None: it follows from the frames.
        max_rays_per_pixel: a pixel that covers more of the scene than a ray of training is the mean over as many rays
            as training has there, and at most so many, see `Footprint.rays_per_side`.
    """

    path: str | None = None
    num_frames: int | None = None
    closed: bool = False
    up: str | None = None
    width: int | None = None
    height: int | None = None
    time: tuple[float, float] | None = None
    seconds: float | None = None
    max_rays_per_pixel: int = MAX_RAYS


@dataclasses.dataclass(frozen=True)
class Output:
    """What is written of the frames.

    Attributes:
        name: in place of the path's in the names of folder and video.
        rgba: whether rgba/0000.png is written, too: straight alpha, without the background.
        depth: whether there is a video of the depth, too.
        video: its kind, see `video_suffix`.
        fps: frames per second; when None those of `Frames.seconds`, or the path file's, or 24.
        overwrite: whether frames of that name are deleted first.
        shard: (index, count): only every count-th frame, from frame `index` on. The process that finds all
            frames finished makes the depth images and the videos.
    """

    name: str | None = None
    rgba: bool = False
    depth: bool = False
    video: str = "auto"
    fps: float | None = None
    overwrite: bool = False
    shard: tuple[int, int] = shards.WHOLE


def render_path(
    run: TrainedRun,
    workdir: str | os.PathLike,
    frames: Frames,
    output: Output,
    *,
    step: int | None = None,
    predictor: Callable[[TrainedRun], Any] | None = None,
) -> list[pathlib.Path]:
    """Renders a camera path to <workdir>/renders/<path>-<step>/ and a video beside that folder.

    The folder holds color/0000.png; depth/0000.tiff, float32, the expected distance along the ray in
    world units of the dataset's file, where the transmittance that remains counts at the far end of the ray (in
    NDC that is infinity, so a ray that hits nothing has inf); depth/0000.png, an image of it with one range for
    the whole path; and path.json, everything that the frames depend on. Existing frames are not rendered again.

    Args:
        run: restored from the workdir.
        workdir: the folder that training wrote.
        frames: what is rendered.
        output: what is written of it.
        step: of the checkpoint; the newest when None.
        predictor: TrainedRun -> `uncertainty.predict.Predictor`. The predicted errors are then written, too, as
            uncertainty/0000.tiff, float32, in units of colour, and uncertainty/0000.png, black where they are 0 and
            white where they are largest in the whole path, apart from a hundredth of its pixels; and a video of these.

    Returns:
        The paths written: the folder and the videos.

    Raises:
        ValueError: if there is no such checkpoint or path, or frames of that name have another provenance.
    """
    suffix, name = video_suffix(output.video), output.name
    if name and (pathlib.Path(name).name != name or name.startswith(".")):
        raise ValueError(f"name is {name!r}, expected a plain file name; drop folders and a leading dot")
    step = newest_step(run, workdir, step)
    shown = _shown(run, workdir, run.variables(step), frames)
    target = pathlib.Path(workdir) / "renders" / f"{name or shown.path.name}-{step}"
    atomic_files.check_tree(target.parent)
    shards.refuse_overwrite(output.overwrite, output.shard, target)
    shown = shown._replace(predictor=predictor and predictor(run))
    shards.make_folder(target, {**_provenance(shown, frames), "step": step}, overwrite=output.overwrite)
    missing = _write_frames(target, shown, output)
    written = [target]
    if missing:
        index, count = output.shard
        print(f"shard {index}/{count} is done, {missing} frames of others are missing", file=sys.stderr)
        return written
    for folder, wanted in (("color", True), ("depth", output.depth), ("uncertainty", predictor)):
        if wanted and suffix:
            end = "" if folder == "color" else f"-{folder}"
            written.append(target.with_name(f"{target.name}{end}{suffix}"))
            files = [target / folder / f"{index:04d}.png" for index in range(len(shown.path.poses))]
            write_video(written[-1], files, output.fps or shown.path.fps or _FPS)
    return written


class _Shown(NamedTuple):
    """A checkpoint of a run, with refined Views, and the cameras that it is rendered from, with rays per side [N]."""

    run: TrainedRun
    variables: Any
    views: Views
    path: CameraPath
    sides: np.ndarray
    predictor: Any = None


def _shown(run, workdir, variables, frames):
    """Makes the path of frames; prints what has been chosen for it."""
    views = refined_views(run, run.experiment.load_split("train", images=False), "train", variables[0])
    up = frames.up or run.experiment.config.data.up or None
    kind, count = select_kind(frames.path, views, up), frames.num_frames
    if frames.seconds and not kind.endswith(".json"):
        count = count or max(round(frames.seconds * _FPS), 1)
    path = camera_path.make_path(kind, views, num_frames=count, closed=frames.closed, up=up)
    path = _timed(camera_path.resize(path, frames.width, frames.height), frames, run.experiment.model)
    footprint = trained_footprint(run, training_cameras(run, workdir, variables[0]))
    sides = footprint.rays_per_side(path.poses, path.focal, max_rays=frames.max_rays_per_pixel)
    _print_rays(sides)
    return _Shown(run, variables, views, path, sides)


def _timed(path, frames, model):
    """Returns the path with the times that frames show, and frames per second of the duration; prints a default."""
    count = len(path.poses)
    if frames.seconds:
        path = path._replace(fps=count / frames.seconds)
    if "time" not in model.needs:
        if frames.time is not None:
            check_moves(model, "{:g} to {:g}".format(*frames.time))
        return path._replace(time=None)
    if frames.time is None and path.time is not None:
        return path
    if frames.time is None:
        print("time: from 0 to 1, as the scene moves; --time=T or --time=FIRST:LAST selects others", file=sys.stderr)
    return path._replace(time=np.linspace(*(frames.time or (0.0, 1.0)), count))


def _write_frames(target, shown, output):
    """Renders those frames of a shard that are not in a folder yet; see `render_path`.

    Returns:
        How many frames of other shards are missing; 0 when the images of depths and errors are written, too.
    """
    path, predictor = shown.path, shown.predictor
    kinds = {"depth": "tiff", "color": "png"} | ({"rgba": "png"} if output.rgba else {})
    kinds |= {"uncertainty": "tiff"} if predictor else {}
    files = [[target / kind / f"{index:04d}.{end}" for kind, end in kinds.items()] for index in range(len(path.poses))]
    for kind in kinds:
        (target / kind).mkdir(parents=True, exist_ok=True)
    frames = shards.indices_of(range(len(files)), output.shard)
    readable = output_images.readable([files[index] for index in frames], [(path.height, path.width)] * len(frames))
    todo = [index for index, finished in zip(frames, readable, strict=True) if not finished]
    compiled = None
    with Progress(f"frames of {target}", len(frames)) as progress:
        progress.done = len(frames) - len(todo)
        for done, (index, planes) in enumerate(_planes(shown, todo, rgba=output.rgba), len(frames) - len(todo) + 1):
            for file, plane in zip(files[index], planes, strict=True):
                output_images.write_image(file, plane)
            compiled, left = compiled or (time.monotonic(), done), ""
            if done > compiled[1]:  # the first frame takes longer
                seconds = (time.monotonic() - compiled[0]) / (done - compiled[1])
                left = f", {minutes(seconds * (len(frames) - done))} left"
            progress.show(done, f"frames of {target}{left}")
    missing = sum(not all(file.is_file() for file in group) for group in files)
    if not missing:
        _write_depth_images([group[0] for group in files])
        if predictor:
            _write_error_images([group[-1] for group in files])
        atomic_files.sweep(target)
    return missing


def _planes(shown, indices, *, rgba):
    """Yields the index of each frame, and its distance, colour and what else is written of it."""
    run, path = shown.run, shown.path
    posed = camera_path.posed_views(shown.views, path)
    for index in indices:
        pixels = camera_path.path_pixels(posed, path, index, offset=run.experiment.config.data.pixel_offset)
        size = float(np.sqrt(np.prod(posed.cameras.focal[index] / path.focal[index])))
        sides = {"side": int(shown.sides[index]), "size": size}
        image, distance = render_pixels(run, shown.variables, posed, index, pixels, **sides)
        planes = [np.asarray(distance, np.float32), output_images.to_8_bits(image.rgb)]
        if rgba:
            planes.append(output_images.straight_alpha(image.rgb, image.opacity, run.experiment.background))
        if shown.predictor:
            planes.append(shown.predictor.error(run.experiment.view_rays(posed, index, pixels)))
        yield index, planes


def select_kind(kind, views, up):
    """Returns the kind of path, the default for None. Prints that one, and whether a turntable leaves the cameras."""
    poses, up = np.asarray(views.cameras.to_world), camera_path.up_direction(up, views)
    if kind is None:
        kind, reason = path_poses.default_kind(poses, up)
        print(f"path: {kind}, as {reason}; --path selects another", file=sys.stderr)
    elif kind == "turntable":
        default, reason = path_poses.default_kind(poses, up)
        if default != kind:
            print(f"path: a turntable leaves the cameras, as {reason}; --path={default} does not", file=sys.stderr)
    return kind


def _print_rays(sides):
    """Prints how many rays a pixel has, if some pixels have several."""
    if sides.max() > 1:
        rays = sides[sides > 1] ** 2
        count = f"{rays.min()}" if rays.min() == rays.max() else f"{rays.min()} to {rays.max()}"
        where = f" in {len(rays)} of {len(sides)} frames" if len(rays) < len(sides) else ""
        why = "as dense as those of training; --max_rays_per_pixel=1 renders one"
        print(f"rays: {count} per pixel{where}, {why}", file=sys.stderr)


def _provenance(shown, frames):
    """Returns everything that the frames depend on, for path.json."""
    path, sides, views = shown.path, shown.sides, shown.views
    provenance = {"path": path.source, "frames": len(path.poses), "width": path.width, "height": path.height}
    if path.source == "interpolate":
        provenance["closed"] = frames.closed
    if sides.max() > 1:
        provenance["rays_per_pixel"] = fingerprint(sides)
    if path.time is not None:
        provenance["time"] = fingerprint(path.time)
    if shown.predictor:
        provenance["uncertainty"] = shown.predictor.identity
    return {
        **provenance,
        **shown.run.settings,
        "config": fingerprint(shown.run.identity),
        "parameters": fingerprint(shown.variables[0]),
        "cameras": fingerprint(views.cameras, views.near, views.far, views.to_file, *views.names),
    }


def _write_depth_images(files):
    near, far = output_images.depth_range(map(read_stored, files))
    for file in files:
        output_images.write_image(file.with_suffix(".png"), output_images.depth_image(read_stored(file), near, far))


def _write_error_images(files):
    largest = max(output_images.largest_error(map(read_stored, files)), 1e-12)
    for file in files:
        output_images.write_image(file.with_suffix(".png"), output_images.to_8_bits(read_stored(file) / largest))


def video_suffix(kind: str) -> str | None:
    """Returns ".mp4" or ".gif", or None for "none"; "auto" is MP4 where imageio finds ffmpeg.

    Raises:
        ValueError: on another kind, or on "mp4" without ffmpeg.
    """
    if kind not in VIDEO_KINDS:
        raise ValueError(f"video is {kind!r}, expected one of {', '.join(VIDEO_KINDS)}")
    ffmpeg = importlib.util.find_spec("imageio_ffmpeg")
    if kind == "mp4" and not ffmpeg:
        raise ValueError("video is 'mp4', but imageio finds no ffmpeg; pip install imageio-ffmpeg")
    if kind == "none":
        return None
    return ".mp4" if ffmpeg and kind != "gif" else ".gif"


def write_video(path: pathlib.Path, frames: Iterable[pathlib.Path], fps: float) -> None:
    """Writes a video, whole or not at all.

    Args:
        path: ends in .mp4 or .gif.
        frames: paths of PNGs of one size, grey or RGB; read one at a time.
        fps: frames per second. A GIF stores the duration of a frame in hundredths of a second.
    """
    unfinished = f".tmp{path.suffix}"  # ffmpeg infers the format from it
    with atomic_files.partial_file(path, unfinished) as partial, warnings.catch_warnings():
        # JAX warns of forks; this one runs ffmpeg at once and no Python.
        warnings.filterwarnings("ignore", "os.fork", RuntimeWarning)
        with imageio.v2.get_writer(partial, **_video_options(path.suffix, fps)) as writer:
            for frame in frames:
                pixels = read_stored(frame)
                pixels = np.repeat(pixels[..., None], 3, axis=-1) if pixels.ndim == 2 else pixels
                writer.append_data(_even(pixels) if path.suffix == ".mp4" else pixels)
    atomic_files.sweep(path.parent, f"{glob.escape(path.name)}.*{unfinished}")


def _video_options(suffix, fps):
    if suffix == ".gif":
        return {"duration": 1000 / fps, "loop": 0}
    return {"fps": fps, "codec": "libx264", "macro_block_size": 1, "quality": 8, "pixelformat": "yuv420p"}


def _even(pixels):
    """Crops an image to even sides, which the codec requires; a side of 1 is repeated."""
    pixels = np.pad(pixels, [(0, int(side == 1)) for side in pixels.shape[:2]] + [(0, 0)], mode="edge")
    height, width = (side - side % 2 for side in pixels.shape[:2])
    return pixels[:height, :width]
