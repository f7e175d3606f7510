"""Camera paths through keyframes, and the files that `jaxnerf-render --path` reads."""

import json
import os
import pathlib
import re
from collections.abc import Sequence

import numpy as np

from jaxnerf.core.views import Views
from jaxnerf.data.geometry.path_poses import poses_through
from jaxnerf.data.geometry.world import poses_in_file
from jaxnerf.runtime import atomic_files
from jaxnerf.viewer.frame_renderer import MAX_SIDE, FrameCamera

FOLDER = "camera_paths"  # in the workdir
MAX_KEYFRAMES, MAX_FRAMES = 500, 10_000
_NAME = re.compile(r"[A-Za-z0-9_][A-Za-z0-9_.-]{0,63}")


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
    return [keyframes[0]._replace(to_world=pose, fov=float(fov)) for pose, fov in zip(poses, fovs, strict=True)]


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
    if not isinstance(name, str) or not _NAME.fullmatch(name):
        raise ValueError(f"the name is {str(name)[:80]!r}, expected up to 64 letters, digits, '_', '.' and '-'")
    width, height = cameras[0].width, cameras[0].height
    if not (0 < width <= MAX_SIDE and 0 < height <= MAX_SIDE):
        raise ValueError(f"the frames have {width} x {height} px, expected sides of 1 to {MAX_SIDE}")
    poses = poses_in_file(np.stack([camera.to_world for camera in cameras]), views.to_file)
    poses[:, :, 3] += views.file_origin
    frames = [
        {"transform_matrix": [*pose.tolist(), [0.0, 0.0, 0.0, 1.0]], "fl_x": camera.focal}
        for pose, camera in zip(poses, cameras, strict=True)
    ]
    folder = pathlib.Path(workdir) / FOLDER
    atomic_files.check_tree(folder)
    folder.mkdir(exist_ok=True)
    path = folder / f"{name}.json"
    atomic_files.write_text(path, json.dumps({"w": width, "h": height, "fps": fps, "frames": frames}, indent=1) + "\n")
    return path
