"""Camera paths through keyframes, and the files that `jaxnerf-render --path` reads."""

import os
import pathlib
from collections.abc import Sequence

import numpy as np

from jaxnerf.core.views import Views
from jaxnerf.data.geometry.path_poses import poses_through
from jaxnerf.evaluation.paths.camera_path import CameraPath, make_path
from jaxnerf.tools.next_images.path_files import file_of, write_path_file
from jaxnerf.tools.viewer.frame_renderer import MAX_SIDE, FrameCamera

MAX_KEYFRAMES, MAX_FRAMES = 500, 10_000


def cameras_through(
    keyframes: Sequence[FrameCamera], *, seconds: float, fps: float, closed: bool = False
) -> list[FrameCamera]:
    """Interpolates between keyframes, which are equally far apart in time.

    Args:
        keyframes: two or more different cameras; the size of the first one is that of all frames.
        seconds: of the whole path.
        fps: frames per second.
        closed: whether the path returns from the last keyframe to the first.

    Raises:
        ValueError: on too few or too many keyframes or frames, or numbers that are none.
    """
    if not 2 <= len(keyframes) <= MAX_KEYFRAMES:
        raise ValueError(f"the path has {len(keyframes)} keyframes, expected 2 to {MAX_KEYFRAMES}; add or remove some")
    if not (0.01 < fps <= 240 and 0 < seconds and 2 <= round(seconds * fps) <= MAX_FRAMES):
        raise ValueError(f"the path has {seconds:g} s of {fps:g} frames per second, expected 2 to {MAX_FRAMES} frames")
    poses, times = poses_through(
        np.stack([camera.to_world for camera in keyframes]), round(seconds * fps), closed=closed
    )
    places = np.arange(len(keyframes))
    period = len(keyframes) if closed else None
    fovs = np.interp(times, places, [camera.fov for camera in keyframes], period=period)
    instants = np.interp(times, places, [camera.time for camera in keyframes], period=period)
    return [
        keyframes[0]._replace(to_world=pose, fov=float(fov), time=float(time))
        for pose, fov, time in zip(poses, fovs, instants, strict=True)
    ]


def save_path(
    workdir: str | os.PathLike, name: str, cameras: Sequence[FrameCamera], *, fps: float, views: Views
) -> pathlib.Path:
    """Writes the frames of a path to <workdir>/camera_paths/<name>.json and returns the file's path.

    Args:
        workdir: of the run.
        name: letters, digits, "_", "." and "-".
        cameras: the frames, in the run's world.
        fps: frames per second.
        views: of the run, which say where its world is in that of the dataset's files.

    Raises:
        ValueError: on another name, a size beyond the limit, or a folder that is a link.
    """
    width, height = cameras[0].width, cameras[0].height
    if not (0 < width <= MAX_SIDE and 0 < height <= MAX_SIDE):
        raise ValueError(f"the frames have {width} x {height} px, expected sides of 1 to {MAX_SIDE}")
    path = CameraPath(
        name=name,
        source="keyframes",
        poses=np.stack([camera.to_world for camera in cameras]),
        focal=np.float64([[camera.focal] * 2 for camera in cameras]),
        center=np.tile(np.float64([[width / 2, height / 2]]), (len(cameras), 1)),
        width=width,
        height=height,
        fps=fps,
        time=None if views.time is None else np.array([camera.time for camera in cameras]),
    )
    file = file_of(workdir, name)
    file.parent.mkdir(exist_ok=True)
    write_path_file(file, path, views)
    return file


def load_keyframes(workdir: str | os.PathLike, name: str, views: Views) -> list[FrameCamera]:
    """Returns the frames of <workdir>/camera_paths/<name>.json, to be used as keyframes.

    Raises:
        ValueError: on another name, no such file, too many frames, or a file that is no path.
    """
    file = file_of(workdir, name)
    if not file.is_file():
        known = ", ".join(sorted(path.stem for path in file.parent.glob("*.json"))[:20]) or "none"
        raise ValueError(f"{file}: there is no such path, expected one of: {known}; correct the name")
    path = make_path(file, views)
    if len(path.poses) > MAX_KEYFRAMES:
        raise ValueError(f"{file}: has {len(path.poses)} frames, expected at most {MAX_KEYFRAMES} keyframes")
    width, height = (min(side, MAX_SIDE) for side in (path.width, path.height))
    fovs = 2 * np.arctan(0.5 * path.height / path.focal[:, 1])
    instants = np.zeros(len(fovs)) if path.time is None else path.time
    return [
        FrameCamera(pose, float(fov), width, height, float(time))
        for pose, fov, time in zip(path.poses, fovs, instants, strict=True)
    ]
