"""Captures in the format of nerfstudio and instant-ngp: one transforms.json beside photographs."""

import os
from pathlib import Path
from typing import NamedTuple

import numpy as np

from jaxnerf.data.geometry.poses import check_pose
from jaxnerf.data.images.downscaled_copies import IMAGES
from jaxnerf.data.readers.base import Capture, Frame
from jaxnerf.data.readers.intrinsics import number, read_camera, wrong
from jaxnerf.data.readers.ply import read_points
from jaxnerf.data.readers.validation import check_inside, is_number, read_json, required
from jaxnerf.registry import Reader


def read_capture(folder):
    """Returns the photographs that <folder>/transforms.json lists, with their cameras.

    What a frame states of its camera goes before what the file states for all, field by field. Frames whose
    file is missing are left out, which the notes say. The world is the file's own: what its
    applied_transform and applied_scale did is checked for its form and otherwise not undone, and not kept.

    instant-ngp takes a point x of the file to x * scale + offset, its axes cycled, and trains in the cube of
    side aabb_scale around 0.5; that cube, taken back, is the Capture's box.

    Args:
        folder: holds transforms.json; no path in that leads out of it.

    Returns:
        Capture. Its splits are the file's lists of names, those that are not empty. A camera has the size
        that the file states, or, where its center or focal needs one, the image's as it is to be looked at.

    Raises:
        ValueError: names file and frame, what was found, what was wanted and what to do.
    """
    if not isinstance(folder, str | os.PathLike):
        raise ValueError(f"folder is {folder!r}, wanted the path of a capture's folder; pass one")
    source = Path(folder) / "transforms.json"
    scene = read_json(source)
    entries, notes = _entries(scene, source)
    kept = [entry for entry in entries if entry.image is not None]
    masks = _masks(entries, kept, source)
    _check_applied(scene, source)
    points, more = _points(scene, source)
    box, most = _box(scene, source)
    return Capture(
        format="transforms",
        source=source,
        frames=tuple(
            Frame(entry.name, entry.image, _camera(scene, source, entry), mask)
            for entry, mask in zip(kept, masks, strict=True)
        ),
        splits=_splits(scene, source, entries, kept),
        points=points,
        box=box,
        notes=(*notes, *more, *most),
    )


class _Entry(NamedTuple):
    """A frame of the file."""

    where: str  # file and number, for messages
    path: str  # the file_path, normalised
    image: Path | None  # None: no such file
    name: str
    content: dict


def _entries(scene, source):
    """Returns all entries by name, and notes."""
    frames = required(scene, "frames", source)
    if not isinstance(frames, list) or not frames or not all(isinstance(frame, dict) for frame in frames):
        raise wrong(source, "frames", frames, "a list of one object {...} per image; export it again")
    places = [f"{source}, frame {index}" for index in range(len(frames))]
    paths = [
        check_inside(required(frame, "file_path", where), key="file_path", source=where)
        for frame, where in zip(frames, places, strict=True)
    ]
    images = [_find(source.parent, path) for path in paths]
    base = os.path.commonpath([os.path.dirname(path) for path in paths])
    names = []
    for path, image in zip(paths, images, strict=True):
        whole = image is not None and image.name != os.path.basename(path)  # its extension was left out
        names.append(os.path.relpath(path if whole else os.path.splitext(path)[0], base or "."))
    entries = sorted(map(_Entry, places, paths, images, names, frames), key=lambda entry: entry.name)
    for entry, other in zip(entries[:-1], entries[1:], strict=True):
        if entry.name == other.name:
            found = f"file_paths {entry.path!r} and {other.path!r} have one name"
            raise ValueError(f"{source}: {found}, wanted names that differ; remove or rename one")
    depths = sum("depth_file_path" in frame or "depth_path" in frame for frame in frames)
    notes = [f"{source}: depth files of {depths} frames are not used"] if depths else []
    return entries, [*_missing(entries, source), *notes]


def _find(folder, path):
    """Returns the file at a path inside the folder, which may lack its extension; None if there is none."""
    for candidate in (path, *(path + extension for extension in IMAGES)):
        if os.path.isfile(folder / candidate):
            return folder / candidate
    return None


def _missing(entries, source):
    names = [entry.name for entry in entries if entry.image is None]
    if not names:
        return []
    count = f"{len(names)} of {len(entries)} frames have no file"
    listed = ", ".join(names[:5]) + (f" and {len(names) - 5} more" if len(names) > 5 else "")
    if 2 * len(names) > len(entries):
        raise ValueError(f"{source}: {count} ({listed}), wanted most of them; copy them or correct file_path")
    return [f"{source}: {count} and are left out: {listed}"]


def _masks(entries, kept, source):
    """Returns the mask of every kept entry, all None or none."""
    without = [entry.where for entry in entries if "mask_path" not in entry.content]
    if len(without) == len(entries):
        return [None] * len(kept)
    if without:
        raise ValueError(f"{without[0]}: has no mask_path, as others have; wanted all or none; complete them")
    masks = []
    for entry in kept:
        path = check_inside(entry.content["mask_path"], key="mask_path", source=entry.where)
        masks.append(_find(source.parent, path))
        if masks[-1] is None:
            raise ValueError(f"{entry.where}: mask {path!r} does not exist, wanted its file; copy it")
    return masks


def _splits(scene, source, entries, kept):
    known = {entry.path for entry in entries}
    places = {entry.path: index for index, entry in enumerate(kept)}
    places |= {os.path.relpath(entry.image, source.parent): index for index, entry in enumerate(kept)}
    splits = {}
    for split in ("train", "val", "test"):
        key = f"{split}_filenames"
        names = scene.get(key, [])
        if not isinstance(names, list):
            raise wrong(source, key, names, "a list of file_paths; correct or remove it")
        chosen = set()
        for name in names:
            path = check_inside(name, key=key, source=source)
            if path not in places:
                found = "which has no file" if path in known else "which is not among the frames"
                raise ValueError(f"{source}: {key} has {path!r}, {found}; wanted a frame; copy or remove it")
            chosen.add(places[path])
        if chosen:
            splits[split] = tuple(sorted(chosen))
    return splits or None


def _camera(scene, source, entry):
    matrix = required(entry.content, "transform_matrix", entry.where)
    pose = check_pose(matrix, source=entry.where)
    return read_camera([(source, scene), (entry.where, entry.content)], to_world=pose, image=entry.image)


def _points(scene, source):
    """Returns the points of the PLY file that is named, or None; and notes."""
    if "ply_file_path" not in scene:
        return None, []
    path = source.parent / check_inside(scene["ply_file_path"], key="ply_file_path", source=source)
    if not os.path.isfile(path):
        return None, [f"{source}: ply_file_path {path.name} does not exist, so there are no points"]
    try:
        return read_points(path), []
    except ValueError as error:
        return None, [f"{error}; no points are used"]


def _box(scene, source):
    """Returns instant-ngp's (lower [3], upper [3]) in the file's world, or None; and notes."""
    if "aabb_scale" not in scene:
        return None, []
    if "aabb" in scene or "normal_mts_args" in scene:  # set scale and offset in yet other ways
        return None, [f"{source}: aabb_scale is not used, as the file has aabb or normal_mts_args"]
    fields = {key: (scene[key], source) for key in ("aabb_scale", "scale") if key in scene}
    side = number(fields, "aabb_scale", "a number from 1e-6 to 1e6", 1e-6, 1e6)
    scale = number(fields, "scale", "a number from 1e-6 to 1e6", 1e-6, 1e6) if "scale" in scene else 0.33
    offset = scene.get("offset", 0.5)
    offset = offset if isinstance(offset, list) else [offset] * 3
    if len(offset) != 3 or not all(is_number(value) for value in offset):
        raise wrong(source, "offset", scene["offset"], "three numbers; correct or remove it")
    # The cube is the same in every order of the axes, so their cycle needs no undoing.
    center, half = (0.5 - np.array(offset, np.float64)) / scale, 0.5 * side / scale
    return (center - half, center + half), []


def _check_applied(scene, source):
    if "applied_transform" in scene:
        rows = scene["applied_transform"]
        lists = isinstance(rows, list) and len(rows) in (3, 4) and all(isinstance(row, list) for row in rows)
        if not lists or not all(len(row) == 4 and all(map(is_number, row)) for row in rows):
            raise wrong(source, "applied_transform", rows, "3 or 4 rows of 4 numbers; correct or remove it")
    if "applied_scale" in scene:
        number({"applied_scale": (scene["applied_scale"], source)}, "applied_scale", "more than 0", 1e-30)


READER = Reader(read_capture, detect=lambda folder: (folder / "transforms.json").is_file())
