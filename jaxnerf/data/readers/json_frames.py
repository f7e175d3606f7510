"""Frames that JSON files list, and files of splits, for the readers of Blender's files and transforms.json."""

import os
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from jaxnerf.core.types import Camera
from jaxnerf.data.geometry.poses import check_pose
from jaxnerf.data.readers.intrinsics import STATED, ignored_facts, read_camera, wrong_value
from jaxnerf.data.readers.validation import is_number, read_json, required

SPLITS = ("train", "val", "test")
# What no file of the NeRF paper's Blender renders has: it shows that the cameras are those of another program.
_FOREIGN = (*STATED, "mask_path", "ply_file_path", "applied_transform", "applied_scale", "orientation_override")
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


def split_files(folder: str | os.PathLike) -> dict[str, Path]:
    """Returns {split: path} of the files transforms_<split>.json in a folder; {} if there is none for training."""
    paths = {split: Path(folder) / f"transforms_{split}.json" for split in SPLITS}
    found = {split: path for split, path in paths.items() if path.is_file()}
    return found if "train" in found else {}


def time_range(folder: str | os.PathLike) -> tuple[float, float] | None:
    """Returns the first and the last time that the files of all splits in a folder state; None if they state none."""
    times = []
    for path in split_files(folder).values():
        try:
            frames = listed_frames(read_json(path), path)
        except ValueError:  # reported where that split is read
            continue
        times += [entries["time"] for _, entries in frames if is_number(entries.get("time"))]
    return (min(times), max(times)) if times else None


def full_cameras(folder: str | os.PathLike) -> str:
    """Returns which fields of a dataset's split files a Blender render does not state; "" if there are none.

    The cameras of Blender's renders have one field, camera_angle_x, and a world in which near is 2 and far 6. Files
    that state more are read as transforms.json is: world, near and far follow from the cameras and points.
    """
    for path in split_files(folder).values():
        try:
            content = read_json(path)
        except ValueError:  # reported by the reader
            continue
        frames = content.get("frames") if isinstance(content.get("frames"), list) else []
        stated = set(content).union(*(frame for frame in frames if isinstance(frame, dict)))
        keys = [key for key in _FOREIGN if key in stated]
        if "camera_angle_x" not in stated and "camera_angle_y" in stated:
            keys.append("camera_angle_y")
        if keys:
            return f"{path.name} states {', '.join(keys[:4])}{', ...' if len(keys) > 4 else ''}"
    return ""


def listed_frames(content: Mapping[str, Any], source: Path) -> list[tuple[str, dict[str, Any]]]:
    """Returns (where, entries) of each frame that a file lists; where: for messages."""
    frames = required(content, "frames", source)
    if not isinstance(frames, list) or not frames or not all(isinstance(frame, dict) for frame in frames):
        raise wrong_value(source, "frames", frames, "a list of one object {...} per image; export it again")
    return [(f"{source}, frame {index}", frame) for index, frame in enumerate(frames)]
