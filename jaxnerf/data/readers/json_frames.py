"""Poses, cameras and splits of frames that JSON files list, for the readers of Blender's files and transforms.json."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from jaxnerf.core.types import Camera
from jaxnerf.data.geometry.poses import check_pose
from jaxnerf.data.readers.intrinsics import ignored_facts, read_camera
from jaxnerf.data.readers.validation import required

MIRROR = "also negate row 1 of every transform_matrix (the world is mirrored)"  # see `CameraFiles.mirror`


def read_poses(
    source: Path, frames: Sequence[tuple[str, Mapping[str, Any]]]
) -> tuple[list[Float[np.ndarray, "3 4"]], list[str]]:
    """Returns the pose of each frame (where, entries), and a note if some had to be made rotations again."""
    stated = [required(entries, "transform_matrix", where) for where, entries in frames]
    poses = [check_pose(matrix, source=where) for matrix, (where, _) in zip(stated, frames, strict=True)]
    return poses, rounding_notes(source, poses, stated)


def rounding_notes(source: Path, poses: Iterable[np.ndarray], stated: Iterable[Any]) -> list[str]:
    """Returns a note if `check_pose` returned other rotations than those that a file states."""
    pairs = zip(poses, stated, strict=True)
    other = [not np.array_equal(pose[:, :3], np.asarray(matrix)[:3, :3]) for pose, matrix in pairs]
    if not any(other):
        return []
    found = f"{sum(other)} of {len(other)} poses are no exact rotations, as if rounded to three decimals"
    return [f"{source}: {found}; the nearest rotations are used"]


def read_cameras(
    levels: list[tuple[Any, dict]], frames: Sequence[tuple[str, dict, Path]], poses: Sequence[np.ndarray]
) -> tuple[list[Camera], list[str]]:
    """Returns the camera of each frame, and a note for each of the file's camera facts that is not used.

    Args:
        levels: of the file, see `read_camera`.
        frames: (where, entries, image).
        poses: of the frames.
    """
    cameras, ignored = [], {}
    for (where, entries, image), pose in zip(frames, poses, strict=True):
        own = [*levels, (where, entries)]
        cameras.append(read_camera(own, to_world=pose, image=image))
        for key, line in ignored_facts(own, cameras[-1], image).items():
            ignored.setdefault(key, []).append(line)
    return cameras, [_with_count(lines) for lines in ignored.values()]


def _with_count(lines):
    return lines[0] if len(set(lines)) == 1 else f"{lines[0]}; so in {len(lines)} frames"


def read_splits(paths: Mapping[str, Path], read: Callable[[Path], Any]) -> tuple[dict[str, Any], list[str]]:
    """Returns what a function returns for the file of each split, and notes about the splits that cannot be read.

    Raises:
        ValueError: if that is the split "train".
    """
    files, notes = {}, []
    for split, path in paths.items():
        try:
            files[split] = read(path)
        except ValueError as error:
            if split == "train":
                raise
            notes.append(f"split {split!r} is skipped: {error}")
    return files, notes


def split_ranges(paths: Mapping[str, Path], frames: Mapping[str, Sequence]) -> dict[str, tuple[int, ...]]:
    """Returns the indices of each split's frames among the frames of all splits, in order; () of a skipped one."""
    splits, start = {}, 0
    for split in paths:
        count = len(frames.get(split, ()))
        splits[split] = tuple(range(start, start + count))
        start += count
    return splits
