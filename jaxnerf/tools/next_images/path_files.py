"""Files of camera paths in a workdir, which jaxnerf-render and the viewer read."""

import json
import os
import pathlib
import re

from jaxnerf.core.views import Views
from jaxnerf.data.geometry.world import poses_in_file
from jaxnerf.evaluation.paths.camera_path import CameraPath
from jaxnerf.runtime import atomic_files

_FOLDER = "camera_paths"
_NAME = re.compile(r"[A-Za-z0-9_][A-Za-z0-9_.-]{0,63}")


def file_of(workdir: str | os.PathLike, name: str) -> pathlib.Path:
    """Returns <workdir>/camera_paths/<name>.json.

    Raises:
        ValueError: on a name of other characters than letters, digits, "_", "." and "-", or a folder that is a link.
    """
    if not isinstance(name, str) or not _NAME.fullmatch(name):
        raise ValueError(f"the name is {str(name)[:80]!r}, expected up to 64 letters, digits, '_', '.' and '-'")
    folder = pathlib.Path(workdir) / _FOLDER
    atomic_files.check_tree(folder)
    return folder / f"{name}.json"


def write_path_file(file: pathlib.Path, path: CameraPath, views: Views) -> None:
    """Writes a CameraPath as `read_path_file` reads it, in the world of the dataset's files; as 1 frame per second if
    the path states none.

    Args:
        file: ends in .json; it is replaced.
        path: in the run's world.
        views: of the run, which say where its world is in that of the files.
    """
    poses = poses_in_file(path.poses, views.to_file)
    poses[:, :, 3] += views.file_origin
    frames = [
        {"transform_matrix": [*pose.tolist(), [0.0, 0.0, 0.0, 1.0]]}
        | dict(zip(("fl_x", "fl_y", "cx", "cy"), [*map(float, focal), *map(float, center)], strict=True))
        for pose, focal, center in zip(poses, path.focal, path.center, strict=True)
    ]
    if path.time is not None:
        frames = [{**frame, "time": float(time)} for frame, time in zip(frames, path.time, strict=True)]
    content = {"w": path.width, "h": path.height, "fps": path.fps or 1.0, "frames": frames}
    atomic_files.write_text(file, json.dumps(content, indent=1) + "\n")
