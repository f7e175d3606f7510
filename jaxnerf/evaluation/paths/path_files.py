"""Reads camera paths from JSON files: frames that a user lists, or a path drawn in nerfstudio's viewer."""

import math
import os
import pathlib
from typing import NamedTuple

import numpy as np

from jaxnerf.data.geometry.poses import check_pose
from jaxnerf.data.readers.validation import is_number, read_json

_MAX_FRAMES, _MAX_PIXELS = 100_000, 16_384
_FPS = {"above": 0.01, "below": 1000}


class PathFile(NamedTuple):
    """The content of a path file; NaN or None where it states nothing.

    Attributes:
        poses: [N, 3, 4] float64, camera to world, in the world of the dataset's file.
        focal: [N, 2] px.
        center: [N, 2] px.
        width: px.
        height: px.
        fps: frames per second.
    """

    poses: np.ndarray
    focal: np.ndarray
    center: np.ndarray
    width: int | None
    height: int | None
    fps: float | None


def read_path_file(path: str | os.PathLike) -> PathFile:
    """Reads the PathFile that a JSON file holds, in one of two formats.

    A list of frames: {"frames": [{"transform_matrix": 4 x 4, fl_x, fl_y, cx, cy}]}, camera to world, x right,
    y up, looking along -z. Beside frames, w, h, fl_x, fl_y, cx, cy, camera_angle_x and fps apply to all.

    nerfstudio's: {"camera_path": [{"camera_to_world": 16 numbers, row by row, "fov": vertical, degrees}],
    "render_height", "render_width", "fps", "seconds"}. Its numbers are in the dataset's world only if
    nerfstudio was run without centring, turning and scaling the poses.

    Raises:
        ValueError: names the file and the entry, what was found and what is expected.
    """
    path = pathlib.Path(path)
    content = read_json(path)
    for key, read in (("camera_path", _read_nerfstudio), ("frames", _read_frames)):
        if key in content:
            frames = content[key]
            if not isinstance(frames, list) or not 0 < len(frames) <= _MAX_FRAMES:
                raise ValueError(f"{path}: {key} is not a list of 1 to {_MAX_FRAMES} objects; correct it")
            for index, frame in enumerate(frames):
                if not isinstance(frame, dict):
                    raise ValueError(f"{path}, {key}[{index}]: is {frame!r}, expected an object {{...}}; correct it")
            return read(content, frames, path)
    there = ", ".join(sorted(content)) or "nothing"
    raise ValueError(f"{path}: has {there}, expected frames or camera_path; see the documentation of camera paths")


def _read_frames(content, frames, path):
    width, height = _number(content, "w", path, whole=True), _number(content, "h", path, whole=True)
    angle = _number(content, "camera_angle_x", path, above=1e-4, below=math.pi)
    fallback = {}
    if angle and width:
        fallback["fl_x"] = 0.5 * width / math.tan(0.5 * angle)
    elif angle:
        raise ValueError(f"{path}: has camera_angle_x but no w, expected both; add w, or give fl_x")
    fallback.update({key: content[key] for key in ("fl_x", "fl_y", "cx", "cy") if key in content})
    poses, focal, center = [], [], []
    for index, frame in enumerate(frames):
        source = f"{path}, frames[{index}]"
        poses.append(check_pose(_required(frame, "transform_matrix", source), source=source))
        if "fl_x" in frame:  # all of its own lens: a fl_y for all frames would not belong to it
            frame = {**{key: fallback[key] for key in ("cx", "cy") if key in fallback}, **frame}
        else:
            frame = {**fallback, **frame}
        x = _number(frame, "fl_x", source)
        y = _number(frame, "fl_y", source) or x
        if y and not x:
            raise ValueError(f"{source}: has fl_y but no fl_x, expected both or fl_x alone; add fl_x")
        focal.append([x, y])
        center.append([_number(frame, key, source, above=-math.inf) for key in ("cx", "cy")])
    return _path_file(poses, focal, center, width, height, _number(content, "fps", path, **_FPS))


def _read_nerfstudio(content, frames, path):
    _required(content, "render_height", path)
    height = _number(content, "render_height", path, whole=True)
    width = _number(content, "render_width", path, whole=True)
    poses, focal = [], []
    for index, frame in enumerate(frames):
        source = f"{path}, camera_path[{index}]"
        matrix = _required(frame, "camera_to_world", source)
        if isinstance(matrix, list) and len(matrix) == 16:
            matrix = [matrix[row : row + 4] for row in range(0, 16, 4)]
        poses.append(check_pose(matrix, source=source))
        _required(frame, "fov", source)
        fov = math.radians(_number(frame, "fov", source, above=0.01, below=180))
        focal.append([0.5 * height / math.tan(0.5 * fov)] * 2)
        aspect = _number(frame, "aspect", source, above=1e-4, below=1e4) or 1.0
        width = width or max(round(height * aspect), 1)
    kind = content.get("camera_type", "perspective")
    if kind != "perspective":
        raise ValueError(f"{path}: camera_type is {kind!r}, expected 'perspective'; no other is supported")
    width = _number({"render_width": width}, "render_width", path, whole=True)
    seconds = _number(content, "seconds", path, above=0.01)
    fps = _number({"fps": seconds and len(frames) / seconds, **content}, "fps", path, **_FPS)
    return _path_file(poses, focal, [[None, None]] * len(frames), width, height, fps)


def _path_file(poses, focal, center, width, height, fps):
    focal, center = (np.array(values, np.float64) for values in (focal, center))  # None becomes NaN
    return PathFile(np.stack(poses), focal, center, width, height, fps)


def _required(entries, key, source):
    if entries.get(key) is None:
        there = ", ".join(sorted(name for name in entries if name != key)) or "nothing"
        raise ValueError(f"{source}: has {there}, expected {key}, too; add it")
    return entries[key]


def _number(entries, key, source, *, above=0.0, below=math.inf, whole=False):
    """Returns entries[key] after checking that it is a number in the range; None where there is none."""
    value = entries.get(key)
    if value is None:
        return None
    if whole:
        if not is_number(value) or value != int(value) or not 1 <= value <= _MAX_PIXELS:
            raise ValueError(f"{source}: {key} is {value!r}, expected 1 to {_MAX_PIXELS} pixels; correct it")
        return int(value)
    if not is_number(value) or not above < value < below:
        span = f" between {above:g} and {below:g}" if below < math.inf else f" above {above:g}"
        raise ValueError(f"{source}: {key} is {value!r}, expected a number{span}; correct it")
    return float(value)
