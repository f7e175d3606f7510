"""Captures in the format of LLFF: poses_bounds.npy beside folders of photographs."""

from pathlib import Path

import numpy as np

from jaxnerf.core.types import Camera
from jaxnerf.data.geometry import world
from jaxnerf.data.geometry.poses import check_pose
from jaxnerf.data.images import load_images
from jaxnerf.data.images.downscaled_copies import image_files, smaller_folders
from jaxnerf.data.readers.base import Capture, Frame
from jaxnerf.data.readers.npy import read_npy
from jaxnerf.registry import Reader


def load_views(folder, *, split="train", factor=1, hold=8, bound_share=0.75):
    """Returns one split of a forward-facing capture, recentred and scaled as in the released codes.

    Args:
        folder, bound_share: see read_capture and world.recenter.
        split, factor, hold: see photos.load_views.

    Returns:
        Views in the order of the names; near and far are the view's bounds, in world units along the axis.

    Raises:
        ValueError: names the file, what was found, what was wanted and what to do.
    """
    capture, _ = world.recenter(read_capture(folder), bound_share=bound_share)
    return load_images.load_views(capture, split=split, factor=factor, hold=hold)


def read_capture(folder):
    """Returns the Capture in a folder that holds poses_bounds.npy, and images/ or folders images_N/.

    Raises:
        ValueError: names the file, what was found, what was wanted and what to do.
    """
    folder = Path(folder)
    source = folder / "poses_bounds.npy"
    poses, bounds, shapes = _read_poses(source)
    paths = _image_paths(folder)
    if len(paths) != len(poses):
        raise ValueError(
            f"{paths[0].parent}: has {len(paths)} images, poses_bounds.npy has {len(poses)}; wanted one each"
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
        frames.append(Frame(path.stem, path, camera, turned=False, bounds=tuple(bound.tolist())))
    return Capture("llff", source, tuple(frames))


def _read_poses(path):
    """Returns poses [N, 3, 4] (x right, y up, looking along -z), bounds [N, 2] and (h, w, f) [N, 3]."""
    rows = read_npy(path, "floats [N, 17]")
    if rows.ndim != 2 or rows.shape[1] != 17 or not len(rows) or rows.dtype.kind != "f":
        raise ValueError(f"{path}: holds {rows.dtype} {rows.shape}, wanted floats [N, 17]; make it again")
    rows = rows.astype(np.float64)
    if not (np.abs(rows) < 3.4e38).all():
        bad = np.argwhere(~(np.abs(rows) < 3.4e38))[0][0]
        raise ValueError(f"{path}: row {bad} is not finite, wanted numbers; make it again")
    matrices, bounds = rows[:, :15].reshape(-1, 3, 5), rows[:, 15:]
    for row, ((near, far), (height, width, focal)) in enumerate(zip(bounds, matrices[..., 4], strict=True)):
        if not 0 < near < far:
            raise ValueError(f"{path}: row {row} has bounds {near} to {far}, wanted 0 < near < far; mend it")
        if not (1 <= height < 2**31 and 1 <= width < 2**31 and focal > 0):
            found = f"height {height}, width {width}, focal length {focal}"
            raise ValueError(f"{path}: row {row} has {found}, wanted pixels above 0; make it again")
    # The file's axes are down, right, backwards.
    axes = [matrices[..., 1], -matrices[..., 0], matrices[..., 2], matrices[..., 3]]
    poses = np.stack(axes, axis=-1)
    for row, pose in enumerate(poses):
        check_pose(pose, source=f"{path}, row {row}", shape=(3, 4))
    return poses, bounds, matrices[..., 4]


def _image_paths(folder):
    """Returns the image files by name, of images/ or else of the least shrunk images_N/."""
    smaller = smaller_folders(folder)
    for place in [folder / "images", *(smaller[number] for number in sorted(smaller))]:
        if files := image_files(place):
            return files
    raise ValueError(f"{folder}: has no images/ or images_N/ with images, wanted one; copy the photographs")


READER = Reader(read_capture, detect=lambda folder: (folder / "poses_bounds.npy").is_file())
