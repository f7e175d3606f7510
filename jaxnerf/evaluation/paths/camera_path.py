"""Camera paths through a dataset: from the cameras of its views, or from a file."""

import dataclasses
import math
import os
import pathlib
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from jaxnerf.core.cameras import pixel_grid
from jaxnerf.core.types import Camera
from jaxnerf.core.views import Views
from jaxnerf.data.facts import LookAt
from jaxnerf.data.geometry import path_poses
from jaxnerf.data.geometry.poses import axis_of, check_pose
from jaxnerf.data.geometry.world import direction_in_run, poses_in_run
from jaxnerf.data.readers.validation import is_number, read_json
from jaxnerf.runtime import atomic_files
from jaxnerf.runtime.fingerprint import fingerprint

_SHEPARD = 4  # the exponent of the distance in weights: the nearest cameras dominate
_FAR_AWAY = 1.1  # times as far as the farthest view, from where frames have bounds of their own
_MAX_FRAMES, _MAX_PIXELS = 100_000, 16_384
_STILL = 48  # frames of a still camera
_FPS = {"above": 0.01, "below": 1000}


class CameraPath(NamedTuple):
    """Pinhole cameras, one for each frame.

    Attributes:
        name: in the names of what is rendered.
        source: what the path was made from: its kind, or the fingerprint of its file.
        poses: [N, 3, 4] camera to world, in the run's world.
        focal: [N, 2] px.
        center: [N, 2] px.
        width: px.
        height: px.
        fps: frames per second, where a file states them.
        time: [N] in [0, 1], of a scene that moves; None: not known.
    """

    name: str
    source: str
    poses: np.ndarray
    focal: np.ndarray
    center: np.ndarray
    width: int
    height: int
    fps: float | None = None
    time: np.ndarray | None = None


def make_path(
    kind: str | pathlib.Path,
    views: Views,
    *,
    num_frames: int | None = None,
    closed: bool = False,
    up: str | None = None,
) -> CameraPath:
    """Makes a CameraPath with the lens and the size of the first view.

    Args:
        kind: "turntable", "arc", "spiral" or "ellipse", see `path_poses.make_poses`; "interpolate", through the
            views in the natural order of their names; "still", the first view's; or a file, see `read_path_file`.
        views: Views, for their cameras.
        num_frames: N; when None 48 for a turntable or a still camera, 96 for an arc, 120 for a spiral or ellipse, 6
            from view to view but at most 240.
        closed: whether "interpolate" returns from the last view to the first.
        up: the axis of the dataset's files that is up in a turntable, an arc or an ellipse, such as "+z"; None: as the
            cameras are held.

    Raises:
        ValueError: if there is no such kind or file, the file is wrong, or the cameras define no such path.
    """
    if str(kind).endswith(".json"):
        if num_frames:
            raise ValueError(f"{kind}: states its own frames, expected no --frames; drop the flag")
        return _from_file(pathlib.Path(kind), views)
    if kind not in path_poses.KINDS:
        names = ", ".join(path_poses.KINDS)
        raise ValueError(f"path is {kind!r}, expected one of {names}, or a file ending in .json")
    if kind == "interpolate":
        poses, focal = _through_views(views, num_frames, closed)
        return through_first_lens(kind, poses, views)._replace(focal=focal)
    if kind == "still":
        return through_first_lens(kind, np.repeat(views.cameras.to_world[:1], num_frames or _STILL, axis=0), views)
    poses = path_poses.make_poses(kind, views.cameras.to_world, num_frames, up_direction(up, views))
    return through_first_lens(kind, poses, views)


def through_first_lens(name: str, poses: Float[np.ndarray, "N 3 4"], views: Views) -> CameraPath:
    """Returns the CameraPath of poses with the lens and the size of the first view, and its name as its source."""
    height, width = (int(side) for side in views.size[0])
    focal, center = (
        np.tile(np.float64(each)[:1], (len(poses), 1)) for each in (views.cameras.focal, views.cameras.center)
    )
    return CameraPath(name, name, poses, focal, center, width, height)


def resize(path: CameraPath, width: int | None = None, height: int | None = None) -> CameraPath:
    """Returns the CameraPath in another size (px); square pixels stay square.

    One side alone scales the other with it. Given both, the vertical field of view stays, and the width adds
    or crops at the sides.
    """
    if not (width or height):
        return path
    scale = height / path.height if height else width / path.width
    width, height = width or max(round(path.width * scale), 1), height or max(round(path.height * scale), 1)
    center = path.center * [width / path.width, height / path.height]
    return path._replace(focal=path.focal * scale, center=center, width=width, height=height)


def posed_views(views: Views, path: CameraPath) -> Views:
    """Returns Views without pixels, in the poses of a CameraPath, all with the first view's pinhole.

    NDC depend on a camera's focal length and size, so no frame's own may replace them; see `path_pixels`. Near and
    far are those of the views nearby, see `frame_bounds`. For a scene that asks for them, frames have the time of
    the path, or 0, if the views have a time; and the image_index 0.
    """
    count = len(path.poses)
    near, far = frame_bounds(path.poses, views)
    height, width = (int(side) for side in views.size[0])
    cameras = Camera(
        to_world=np.asarray(path.poses, np.float32),
        focal=np.repeat(views.cameras.focal[:1], count, axis=0),
        center=np.repeat(views.cameras.center[:1], count, axis=0),
        height=height,
        width=width,
    )
    return dataclasses.replace(
        views,
        pixels=np.zeros((0, views.pixels.shape[-1]), views.pixels.dtype),
        offset=np.zeros(count, np.int32),
        size=np.tile(np.int32([[height, width]]), (count, 1)),
        cameras=cameras,
        near=near,
        far=far,
        mask=None,
        names=tuple(f"{index:04d}" for index in range(count)),
        time=None if views.time is None else np.float32(np.zeros(count) if path.time is None else path.time),
        image_index=np.zeros(count, np.int32),
    )


def frame_bounds(
    poses: Float[np.ndarray, "N 3 4"], views: Views
) -> tuple[Float[np.ndarray, " N"], Float[np.ndarray, " N"]]:
    """Returns near and far of frames, interpolated between the views (Shepard 1968).

    At the pose of a view they are that view's, so that the frame equals what evaluation renders. Elsewhere they are
    the distances to the near and far planes of the views nearby in position and direction, within the range of the
    views' near and of their far. For a frame that is much farther from what the views look at than all of them, the
    range ends so much later.
    """
    cameras = np.asarray(views.cameras.to_world, np.float64)
    bounds = np.stack([views.near, views.far], axis=-1).astype(np.float64)
    spread = np.linalg.norm(cameras[:, :, 3] - cameras[:, :, 3].mean(axis=0), axis=1).mean()
    look_at, result = LookAt(views), []
    away = np.linalg.norm(np.asarray(poses, np.float64)[:, :, 3] - look_at.center, axis=1)
    farthest = look_at.distance.max()
    beyond = np.where(away > _FAR_AWAY * farthest, away - farthest, 0)
    for pose in np.asarray(poses, np.float32).astype(np.float64):  # the precision of the views' poses
        moved = pose[:, 3] - cameras[:, :, 3]
        apart = np.linalg.norm(moved, axis=1) / max(spread, 1e-12)
        apart += np.linalg.norm(pose[:, 2] - cameras[:, :, 2], axis=1)
        weights = np.maximum(apart, 1e-12) ** -_SHEPARD
        result.append(weights @ (bounds + (moved @ pose[:, 2])[:, None]) / weights.sum())
    latest = bounds.max(axis=0) + beyond[:, None]
    near, far = np.clip(result, bounds.min(axis=0), latest).astype(np.float32).T
    return near, far


def path_pixels(posed: Views, path: CameraPath, index: int, *, offset: float = 0.5) -> np.ndarray:
    """Returns [H, W, 2], where the first view's pinhole sees what the pixels of a path's frame see."""
    pixels = np.asarray(pixel_grid(path.height, path.width, offset=offset), np.float64)
    points = (pixels - path.center[index]) / path.focal[index]
    return np.float32(points * posed.cameras.focal[index] + posed.cameras.center[index])


def up_direction(up: str | None, views: Views) -> np.ndarray | None:
    """Returns the unit vector of an axis of the dataset's files, "+x" to "-z", in the run's world; None of None."""
    return None if up is None else direction_in_run(axis_of(up), views.to_file)


def _relative(poses, origin):
    """Returns poses of files relative to the origin of the run's files, see `Views.file_origin`; float64."""
    return np.concatenate([poses[:, :, :3], (poses[:, :, 3] - origin)[:, :, None]], axis=-1)


def _from_file(file, views):
    found = read_path_file(file)
    poses = poses_in_run(_relative(found.poses, views.file_origin), views.to_file)
    same = through_first_lens(file.stem, poses, views)
    same = same._replace(source=fingerprint(atomic_files.read_bytes(file)), fps=found.fps)
    same = resize(same, found.width, found.height)
    is_stated = np.isfinite(found.focal)
    middle = np.where(is_stated, [same.width / 2, same.height / 2], same.center)
    focal, center = np.where(is_stated, found.focal, same.focal), found.center
    return same._replace(focal=focal, center=np.where(np.isfinite(center), center, middle), time=found.time)


def _through_views(views, num_frames, closed):
    """Returns poses [N, 3, 4] and focal [N, 2] through the views in the natural order of their names."""
    count = len(views.size)
    order = path_poses.natural_order(views.names) if views.names else np.arange(count)
    poses, times = path_poses.poses_through(np.asarray(views.cameras.to_world)[order], num_frames, closed=closed)
    height = np.float64(views.size)[order, :1]
    focal = np.float64(views.cameras.focal)[order] * (views.size[0, 0] / height)  # as if all were of one size
    focal = [np.interp(times, np.arange(count), side, period=count if closed else None) for side in focal.T]
    return poses, np.stack(focal, axis=-1)


class PathFile(NamedTuple):
    """The content of a path file; NaN or None where it states nothing.

    Attributes:
        poses: [N, 3, 4] float64, camera to world, in the world of the dataset's file.
        focal: [N, 2] px.
        center: [N, 2] px.
        width: px.
        height: px.
        fps: frames per second.
        time: [N] in [0, 1]; None: not stated by all frames.
    """

    poses: np.ndarray
    focal: np.ndarray
    center: np.ndarray
    width: int | None
    height: int | None
    fps: float | None
    time: np.ndarray | None = None


def read_path_file(path: str | os.PathLike) -> PathFile:
    """Reads the PathFile that a JSON file holds, in one of two formats.

    A list of frames: {"frames": [{"transform_matrix": 4 x 4, fl_x, fl_y, cx, cy, time}]}, camera to world, x right,
    y up, looking along -z; a time in [0, 1] is that of a scene that moves. Beside frames, w, h, fl_x, fl_y, cx, cy,
    camera_angle_x and fps apply to all.

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
    poses, focal, center, times = [], [], [], []
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
        times.append(_number(frame, "time", source, above=-1e-9, below=1 + 1e-9))
    made = _path_file(poses, focal, center, width, height, _number(content, "fps", path, **_FPS))
    return made if None in times else made._replace(time=np.clip(times, 0, 1))


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
