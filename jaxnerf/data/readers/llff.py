"""Reader of LLFF's format: poses_bounds.npy beside folders of images."""

from pathlib import Path

import numpy as np

from jaxnerf.core.types import Camera
from jaxnerf.data.geometry.poses import check_pose
from jaxnerf.data.images.downscaled_copies import downscaled_folders, list_images
from jaxnerf.data.readers.base import CameraFiles, Capture, Frame
from jaxnerf.data.readers.json_frames import rounding_notes
from jaxnerf.data.readers.validation import MAX_FLOAT32, read_npy
from jaxnerf.registry import Reader

_FILES = CameraFiles(
    poses="the 3 x 5 matrix in every row of poses_bounds.npy",
    axes=np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]]),
    mirror="also negate row 1 of every 3 x 5 matrix except in column 5 (the world is mirrored)",
    focal="poses_bounds.npy: row 3 of every column 5 to about {x:.5g}",
    bounds="the last two columns of {source}",
)


def read_capture(folder: Path) -> Capture:
    """Returns the Capture in a folder that holds poses_bounds.npy, and images/ or folders images_N/.

    Raises:
        ValueError: names the file, what was found, what is expected and what to do.
    """
    source = folder / "poses_bounds.npy"
    poses, bounds, shapes, notes = _read_poses(source)
    paths = _image_paths(folder)
    if len(paths) != len(poses):
        raise ValueError(
            f"{paths[0].parent}: has {len(paths)} images, poses_bounds.npy has {len(poses)} rows; expected one row "
            "per image; copy the missing images or remove the others"
        )
    frames = []
    for path, pose, bound, (height, width, focal) in zip(paths, poses, bounds, shapes, strict=True):
        camera = Camera(
            to_world=pose,
            focal=np.full(2, focal),
            center=np.array([width, height]) / 2,
            height=int(height),
            width=int(width),
        )
        frames.append(Frame(path.stem, path, camera, follow_exif=False, bounds=tuple(bound.tolist())))
    return Capture("llff", source, tuple(frames), notes=tuple(notes), files=_FILES)


def _read_poses(path):
    """Returns poses [N, 3, 4] (x right, y up, looking along -z), bounds [N, 2], (h, w, f) [N, 3] and notes."""
    rows = read_npy(path, "floats [N, 17]")
    if rows.ndim != 2 or rows.shape[1] != 17 or not len(rows) or rows.dtype.kind != "f":
        nex = "NeX's form: append h, w and f of its hwf_cxcy.npy to each of the 3 rows of a matrix"
        todo = nex if rows.shape[1:] == (14,) else "export it again"
        raise ValueError(f"{path}: holds {rows.dtype} {rows.shape}, expected floats [N, 17]; {todo}")
    rows = rows.astype(np.float64)
    finite = np.abs(rows) < MAX_FLOAT32
    if not finite.all():
        bad = np.argwhere(~finite)[0][0]
        raise ValueError(f"{path}: row {bad} is not finite, expected finite numbers; export it again")
    matrices, bounds = rows[:, :15].reshape(-1, 3, 5), rows[:, 15:]
    for row, ((near, far), (height, width, focal)) in enumerate(zip(bounds, matrices[..., 4], strict=True)):
        if not 0 < near < far:
            raise ValueError(f"{path}: row {row} has bounds {near} to {far}, expected 0 < near < far; correct it")
        if not (1 <= height < 2**31 and 1 <= width < 2**31 and focal > 0):
            found = f"height {height}, width {width}, focal length {focal}"
            raise ValueError(f"{path}: row {row} has {found}, expected pixels above 0; export it again")
    # The file's axes are down, right, backwards.
    axes = [matrices[..., 1], -matrices[..., 0], matrices[..., 2], matrices[..., 3]]
    stated = np.stack(axes, axis=-1)
    poses = [check_pose(pose, source=f"{path}, row {row}", shape=(3, 4)) for row, pose in enumerate(stated)]
    return poses, bounds, matrices[..., 4], rounding_notes(path, poses, stated)


def _image_paths(folder):
    """Returns the image files by name, of images/ or else of the images_N/ with the smallest N."""
    smaller = downscaled_folders(folder)
    for place in [folder / "images", *(smaller[number] for number in sorted(smaller))]:
        if files := list_images(place):
            return files
    raise ValueError(f"{folder}: has no images/ or images_N/ with images, expected one; copy the images")


READER = Reader(read_capture, detect=lambda folder: (folder / "poses_bounds.npy").is_file())
