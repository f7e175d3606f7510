"""Datasets with a JSON file for each split: which files there are, and which camera facts they state."""

import os
from pathlib import Path

from jaxnerf.data.readers.intrinsics import STATED
from jaxnerf.data.readers.validation import read_json

SPLITS = ("train", "val", "test")
# What no file of the NeRF paper's Blender renders has: it shows that the cameras are those of another program.
_FOREIGN = (*STATED, "mask_path", "ply_file_path", "applied_transform", "applied_scale", "orientation_override")


def split_files(folder: str | os.PathLike) -> dict[str, Path]:
    """Returns {split: path} of the files transforms_<split>.json in a folder; {} if there is none for training."""
    paths = {split: Path(folder) / f"transforms_{split}.json" for split in SPLITS}
    found = {split: path for split, path in paths.items() if path.is_file()}
    return found if "train" in found else {}


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
