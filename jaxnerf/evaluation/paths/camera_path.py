"""Camera paths through a dataset: from the cameras of its views, or from a file."""

import dataclasses
import pathlib
import re
from typing import NamedTuple

import jax
import numpy as np

from jaxnerf.core import poses as core_poses
from jaxnerf.core.cameras import pixel_grid
from jaxnerf.core.types import Camera, Views
from jaxnerf.data.geometry.poses import gaze_center, up_of
from jaxnerf.evaluation.paths.path_files import read_path_file
from jaxnerf.runtime.fingerprint import fingerprint

_interpolate = jax.jit(core_poses.interpolate, static_argnames=("num_frames", "closed"))


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
    """

    name: str
    source: str
    poses: np.ndarray
    focal: np.ndarray
    center: np.ndarray
    width: int
    height: int
    fps: float | None = None


def make_path(
    kind: str | pathlib.Path, views: Views, *, num_frames: int | None = None, closed: bool = False
) -> CameraPath:
    """Makes a CameraPath with the lens and the size of the first view.

    Args:
        kind: "turntable", a circle at the cameras' mean distance and elevation around what they look at;
            "spiral", as in the LLFF code; "ellipse", through the spread of the cameras' positions;
            "interpolate", through the views in the order of their names; or a file, see `read_path_file`.
        views: Views, for their cameras.
        num_frames: N; when None 48 for a turntable, 120 for a spiral or ellipse, 6 from view to view.
        closed: whether "interpolate" returns from the last view to the first.

    Raises:
        ValueError: if there is no such kind or file, or the file is wrong.
    """
    if str(kind).endswith(".json"):
        if num_frames:
            raise ValueError(f"{kind}: states its own frames, expected no --frames; drop the flag")
        return _from_file(pathlib.Path(kind), views)
    if kind not in (*_KINDS, "interpolate"):
        names = ", ".join((*_KINDS, "interpolate"))
        raise ValueError(f"path is {kind!r}, expected one of {names}, or a file ending in .json")
    if kind == "interpolate":
        poses, focal = _through_views(views, num_frames, closed)
    else:
        make, frames = _KINDS[kind]
        poses = np.asarray(make(np.asarray(views.cameras.to_world, np.float64), views, num_frames or frames))
        focal = np.tile(np.float64(views.cameras.focal)[:1], (len(poses), 1))
    height, width = (int(side) for side in views.size[0])
    center = np.tile(np.float64(views.cameras.center)[:1], (len(poses), 1))
    return CameraPath(kind, kind, poses, focal, center, width, height)


def default_kind(views: Views, angle: float = 60.0) -> str:
    """Returns "spiral" where all cameras look within an angle (degrees) of their mean, else "turntable"."""
    axes = np.asarray(views.cameras.to_world, np.float64)[:, :, 2]
    mean = axes.sum(axis=0)
    least = np.cos(np.radians(angle)) * np.linalg.norm(mean)
    return "spiral" if (axes @ mean > least).all() else "turntable"


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

    NDC depend on a camera's focal length and size, so no frame's own may replace them; see `path_pixels`.
    """
    count = len(path.poses)
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
        near=np.full(count, np.min(views.near), np.float32),
        far=np.full(count, np.max(views.far), np.float32),
        mask=None,
        names=tuple(f"{index:04d}" for index in range(count)),
    )


def path_pixels(posed: Views, path: CameraPath, index: int, *, offset: float = 0.5) -> np.ndarray:
    """Returns [H, W, 2], where the first view's pinhole sees what the pixels of a path's frame see."""
    pixels = np.asarray(pixel_grid(path.height, path.width, offset=offset), np.float64)
    points = (pixels - path.center[index]) / path.focal[index]
    return np.float32(points * posed.cameras.focal[index] + posed.cameras.center[index])


def _from_file(file, views):
    found = read_path_file(file)
    height, width = (int(side) for side in views.size[0])
    same = CameraPath(
        name=file.stem,
        source=fingerprint(file.read_bytes()),
        poses=_in_run(found.poses, views.to_file),
        focal=np.tile(np.float64(views.cameras.focal)[:1], (len(found.poses), 1)),
        center=np.tile(np.float64(views.cameras.center)[:1], (len(found.poses), 1)),
        width=width,
        height=height,
        fps=found.fps,
    )
    same = resize(same, found.width, found.height)
    own = np.isfinite(found.focal)
    middle = np.where(own, [same.width / 2, same.height / 2], same.center)
    focal, center = np.where(own, found.focal, same.focal), found.center
    return same._replace(focal=focal, center=np.where(np.isfinite(center), center, middle))


def _in_run(poses, to_file):
    """Transforms poses [N, 3, 4] from the file's world to the run's; both are equal where to_file is None."""
    if to_file is None:
        return poses
    to_file = np.asarray(to_file, np.float64)
    linear = to_file[:3, :3]
    rotation = linear / np.cbrt(abs(np.linalg.det(linear)))
    eyes = np.linalg.solve(linear, (poses[:, :, 3] - to_file[:3, 3]).T).T
    return np.concatenate([rotation.T @ poses[:, :, :3], eyes[:, :, None]], axis=-1)


def _turntable(poses, views, num_frames):
    """Circles the point nearest to all optical axes, at the cameras' mean distance and elevation."""
    center, up = gaze_center(poses), up_of(poses)
    offsets = poses[:, :, 3] - center
    distances = np.linalg.norm(offsets, axis=-1)
    elevation = np.arcsin(np.clip(offsets @ up / np.maximum(distances, 1e-30), -1, 1)).mean()
    return core_poses.turntable(num_frames, center=center, radius=distances.mean(), elevation=elevation, up=up)


def _spiral(poses, views, num_frames):
    """Follows the LLFF code: amplitudes are the cameras' 90th percentiles, the focus is at 3/4 in disparity."""
    pose = np.float64(core_poses.mean_pose(poses))
    radii = np.percentile(np.abs((poses[:, :, 3] - pose[:, 3]) @ pose[:, :3]), 90, axis=0)
    far = 5 * np.max(views.far)
    near = max(0.9 * np.min(views.near), far / 1000)  # a near of 0 would put the focus at the eye
    return core_poses.spiral(num_frames, pose=pose, radii=radii, focus=1 / (0.25 / near + 0.75 / far))


def _ellipse(poses, views, num_frames):
    """Passes through the cameras' spread in the horizontal plane, at their mean height; looks as the turntable."""
    eyes, up = poses[:, :, 3], up_of(poses)
    middle = eyes.mean(axis=0)
    across = (eyes - middle) @ (np.eye(3) - np.outer(up, up))
    _, spread, axes = np.linalg.svd(across, full_matrices=False)
    # Points all around an ellipse have a variance of half its squared half axis.
    axes = axes[:2] * (spread[:2] * np.sqrt(2 / len(eyes)))[:, None]
    axes = np.concatenate([axes, np.zeros((2 - len(axes), 3))])  # of a single view
    return core_poses.ellipse(num_frames, middle=middle, axes=axes, target=gaze_center(poses), up=up)


_KINDS = {"turntable": (_turntable, 48), "spiral": (_spiral, 120), "ellipse": (_ellipse, 120)}  # default frames


def _through_views(views, num_frames, closed):
    """Returns poses [N, 3, 4] and focal [N, 2] through the views in the order of their names."""

    def natural(index):  # r_2 before r_10
        return [int(part) if part.isdecimal() else part for part in re.split(r"(\d+)", views.names[index])]

    order = sorted(range(len(views.size)), key=natural) if views.names else np.arange(len(views.size))
    count = len(order)
    num_frames = num_frames or (6 * count if closed else 6 * (count - 1) + 1)
    poses = _interpolate(num_frames, poses=np.asarray(views.cameras.to_world)[order], closed=closed)
    height = np.float64(views.size)[order, :1]
    focal = np.float64(views.cameras.focal)[order] * (views.size[0, 0] / height)  # as if all were of one size
    times = np.asarray(core_poses.path_times(num_frames, count, closed=closed))
    focal = [np.interp(times, np.arange(count), side, period=count if closed else None) for side in focal.T]
    return np.asarray(poses), np.stack(focal, axis=-1)
