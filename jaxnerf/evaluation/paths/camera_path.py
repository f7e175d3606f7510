"""Camera paths through a capture: from its views' cameras, or from a file."""

import dataclasses
import hashlib
import pathlib
from typing import NamedTuple

import numpy as np

from jaxnerf.core.cameras import pixel_grid
from jaxnerf.core.types import Camera
from jaxnerf.evaluation.paths.from_views import KINDS, through_views
from jaxnerf.evaluation.paths.path_files import read_path_file


class CameraPath(NamedTuple):
    """Pinhole cameras, one a frame."""

    name: str  # of what is rendered
    source: str  # what it was made from: its kind, or the hash of its file
    poses: np.ndarray  # [N, 3, 4] in the run's world
    focal: np.ndarray  # [N, 2] px
    center: np.ndarray  # [N, 2] px
    width: int  # px
    height: int
    fps: float | None = None  # frames a second, where a file says so


def make_path(kind, views, *, num_frames=None, closed=False):
    """Returns a CameraPath, seen through the lens and in the size of the first view.

    Args:
        kind: "turntable", a turn at the cameras' mean height and distance around what they look at;
            "spiral", as in the LLFF code; "ellipse", through the spread of the cameras' places;
            "interpolate", through the views in the order of their names; or a file, see read_path_file.
        views: Views, for their cameras.
        num_frames: N; when None 48 a turn, 120 a spiral or ellipse, 6 from view to view.
        closed: whether "interpolate" goes on from the last view to the first.

    Raises:
        ValueError: if there is no such kind or file, or the file is wrong.
    """
    if str(kind).endswith(".json"):
        if num_frames:
            raise ValueError(f"{kind}: has its own frames, wanted no --frames; leave it out")
        return _from_file(pathlib.Path(kind), views)
    if kind not in (*KINDS, "interpolate"):
        names = ", ".join((*KINDS, "interpolate"))
        raise ValueError(f"path is {kind!r}, wanted one of {names}, or a file ending in .json")
    if kind == "interpolate":
        poses, focal = through_views(views, num_frames, closed)
    else:
        make, frames = KINDS[kind]
        poses = np.asarray(make(np.asarray(views.cameras.to_world, np.float64), views, num_frames or frames))
        focal = np.tile(np.float64(views.cameras.focal)[:1], (len(poses), 1))
    height, width = (int(side) for side in views.size[0])
    center = np.tile(np.float64(views.cameras.center)[:1], (len(poses), 1))
    return CameraPath(kind, kind, poses, focal, center, width, height)


def default_kind(views, angle=60.0):
    """Returns "spiral" where all cameras look within an angle (degrees) of their mean, else "turntable"."""
    axes = np.asarray(views.cameras.to_world, np.float64)[:, :, 2]
    mean = axes.sum(axis=0)
    least = np.cos(np.radians(angle)) * np.linalg.norm(mean)
    return "spiral" if (axes @ mean > least).all() else "turntable"


def resize(path, width=None, height=None):
    """Returns the CameraPath in another size (px); square pixels stay square.

    One side alone takes the other with it. Given both, as much is seen from top to bottom as before, and
    the width adds or cuts at the sides.
    """
    if not (width or height):
        return path
    scale = height / path.height if height else width / path.width
    width, height = width or max(round(path.width * scale), 1), height or max(round(path.height * scale), 1)
    center = path.center * [width / path.width, height / path.height]
    return path._replace(focal=path.focal * scale, center=center, width=width, height=height)


def posed_views(views, path):
    """Returns Views of no pixels, in the poses of a CameraPath, all with the first view's pinhole.

    NDC are drawn from a camera's lens and size, so no frame's own may take their place: path_pixels does.
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


def path_pixels(posed, path, index, *, offset=0.5):
    """Returns [H, W, 2], where the first view's pinhole sees what the pixels of a path's frame see."""
    pixels = np.asarray(pixel_grid(path.height, path.width, offset=offset), np.float64)
    points = (pixels - path.center[index]) / path.focal[index]
    return np.float32(points * posed.cameras.focal[index] + posed.cameras.center[index])


def _from_file(file, views):
    found = read_path_file(file)
    height, width = (int(side) for side in views.size[0])
    same = CameraPath(
        name=file.stem,
        source=hashlib.sha256(file.read_bytes()).hexdigest(),
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
    """Returns poses [N, 3, 4] of the file's world in the run's: turned and moved back, distances scaled."""
    if to_file is None:
        return poses
    to_file = np.asarray(to_file, np.float64)
    linear = to_file[:3, :3]
    rotation = linear / np.cbrt(abs(np.linalg.det(linear)))
    eyes = np.linalg.solve(linear, (poses[:, :, 3] - to_file[:3, 3]).T).T
    return np.concatenate([rotation.T @ poses[:, :, :3], eyes[:, :, None]], axis=-1)
