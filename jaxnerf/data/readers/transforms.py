"""Reader of the format of nerfstudio and instant-ngp: one transforms.json beside images."""

import os
import re
from pathlib import Path
from typing import NamedTuple

import numpy as np

from jaxnerf.data.geometry.poses import check_pose
from jaxnerf.data.images.image_files import IMAGE_SUFFIXES
from jaxnerf.data.readers.base import Capture, Frame
from jaxnerf.data.readers.intrinsics import number_in, read_camera, wrong_value
from jaxnerf.data.readers.ply import read_points
from jaxnerf.data.readers.validation import check_inside, is_number, read_json, read_times, required, short_repr
from jaxnerf.registry import Reader


def read_capture(folder: str | os.PathLike) -> Capture:
    """Returns the Capture of the images that <folder>/transforms.json lists.

    A field of a frame's camera overrides the file's field. Frames whose image is missing are skipped and noted.
    Of an absolute path, such as one of another computer, the longest end that exists in the folder is used; this
    is noted, too.
    The world is that of the file's poses: applied_transform and applied_scale are checked for their form, but
    neither undone nor stored.

    instant-ngp maps a point x of the file to x * scale + offset, permutes its axes cyclically and trains in the
    cube of side aabb_scale around 0.5. That cube, mapped back to the file's world, is the Capture's box.

    Args:
        folder: holds transforms.json. Relative paths in that file that lead out of the folder are errors.

    Returns:
        Capture. Its splits are the file's lists of names that are not empty. A camera's height and width are
        those that the file states; if center or focal depend on the size and it is not stated, they are the
        upright image's.

    Raises:
        ValueError: names file and frame, what was found, what is expected and what to do.
    """
    if not isinstance(folder, str | os.PathLike):
        raise ValueError(f"folder is {folder!r}, expected the path of a dataset's folder; pass one")
    source = Path(folder) / "transforms.json"
    content = read_json(source)
    entries, notes = _entries(content, source)
    kept = [entry for entry in entries if entry.image is not None]
    masks, times = _masks(entries, kept, source), read_times([(entry.where, entry.content) for entry in kept])
    _check_applied(content, source)
    points, points_notes = _points(content, source)
    box, box_notes = _box(content, source)
    return Capture(
        format="transforms",
        source=source,
        frames=tuple(
            Frame(entry.name, entry.image, _camera(content, source, entry), mask, time=time)
            for entry, mask, time in zip(kept, masks, times, strict=True)
        ),
        splits=_splits(content, source, entries, kept),
        points=points,
        box=box,
        notes=(*notes, *points_notes, *box_notes),
    )


class _Entry(NamedTuple):
    """A frame of the file.

    Attributes:
        where: file and index, for messages.
        path: the normalised file_path.
        image: the image file; None: missing.
        name: see `Frame.name`.
        content: the frame's JSON object.
    """

    where: str
    path: str
    image: Path | None
    name: str
    content: dict


def _entries(content, source):
    """Returns all entries, sorted by name, and notes."""
    frames = required(content, "frames", source)
    if not isinstance(frames, list) or not frames or not all(isinstance(frame, dict) for frame in frames):
        raise wrong_value(source, "frames", frames, "a list of one object {...} per image; export it again")
    places = [f"{source}, frame {index}" for index in range(len(frames))]
    stated = [required(frame, "file_path", where) for frame, where in zip(frames, places, strict=True)]
    paths = [
        _path(source.parent, path, key="file_path", source=where) for path, where in zip(stated, places, strict=True)
    ]
    images = [_find(source.parent, path) for path in paths]
    base = os.path.commonpath([os.path.dirname(path) for path in paths])
    names = []
    for path, image in zip(paths, images, strict=True):
        whole = image is not None and image.name != os.path.basename(path)  # the file_path has no extension
        names.append(os.path.relpath(path if whole else os.path.splitext(path)[0], base or "."))
    entries = sorted(map(_Entry, places, paths, images, names, frames), key=lambda entry: entry.name)
    for entry, other in zip(entries[:-1], entries[1:], strict=True):
        if entry.name == other.name:
            found = f"file_paths {entry.path!r} and {other.path!r} have one name"
            raise ValueError(f"{source}: {found}, expected different names; remove or rename one")
    depths = sum("depth_file_path" in frame or "depth_path" in frame for frame in frames)
    notes = [f"{source}: depth files of {depths} frames are not used"] if depths else []
    absolute = [index for index, path in enumerate(stated) if _parts_of_absolute(path)]
    if absolute:
        example = f"{short_repr(stated[absolute[0]])} as {paths[absolute[0]]}"
        notes.append(f"{source}: has {len(absolute)} absolute file_paths, read from its own folder: {example}")
    return entries, [*_missing(entries, source), *notes]


def _path(folder, name, *, key, source):
    """Returns a path of the file relative to its folder; see `check_inside`, and `read_capture` for absolute ones."""
    parts = _parts_of_absolute(name)
    if not parts or ".." in parts:
        return check_inside(name, key=key, source=source)
    ends = ["/".join(parts[start:]) for start in range(len(parts))] + [f"images/{parts[-1]}"]
    ends = list(dict.fromkeys(ends))
    for end in ends:
        if _find(folder, end):
            return check_inside(end, key=key, source=source)
    raise ValueError(
        f"{source}: {key} {short_repr(name)} leaves the folder, and {folder} has no {' or '.join(ends[-2:])} either; "
        "copy the file there, or correct the path"
    )


def _parts_of_absolute(name):
    """Returns the folders and the name of an absolute path of any system; [] if it is relative."""
    match = re.match(r"([A-Za-z]:)?[/\\](.*)", name, re.DOTALL) if isinstance(name, str) else None
    return [part for part in re.split(r"[/\\]", match[2]) if part not in ("", ".")] if match else []


def _find(folder, path):
    """Returns the file at a path in the folder, with or without extension; None if there is none."""
    for candidate in (path, *(path + extension for extension in IMAGE_SUFFIXES)):
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
        raise ValueError(f"{source}: {count} ({listed}), expected most of them; copy them or correct file_path")
    return [f"{source}: {count} and are skipped: {listed}"]


def _masks(entries, kept, source):
    """Returns the mask of each kept entry; either all have one or none."""
    without = [entry.where for entry in entries if "mask_path" not in entry.content]
    if len(without) == len(entries):
        return [None] * len(kept)
    if without:
        raise ValueError(f"{without[0]}: has no mask_path, other frames have; expected all or none; complete them")
    masks = []
    for entry in kept:
        path = _path(source.parent, entry.content["mask_path"], key="mask_path", source=entry.where)
        masks.append(_find(source.parent, path))
        if masks[-1] is None:
            raise ValueError(f"{entry.where}: mask {path!r} does not exist, expected its file; copy it")
    return masks


def _splits(content, source, entries, kept):
    known = {entry.path for entry in entries}
    places = {entry.path: index for index, entry in enumerate(kept)}
    places |= {os.path.relpath(entry.image, source.parent): index for index, entry in enumerate(kept)}
    splits = {}
    for split in ("train", "val", "test"):
        key = f"{split}_filenames"
        names = content.get(key, [])
        if not isinstance(names, list):
            raise wrong_value(source, key, names, "a list of file_paths; correct or remove it")
        chosen = set()
        for name in names:
            path = _path(source.parent, name, key=key, source=source)
            if path not in places:
                found = "which has no file" if path in known else "which is not among the frames"
                raise ValueError(
                    f"{source}: {key} has {path!r}, {found}; expected a frame with a file; copy or remove it"
                )
            chosen.add(places[path])
        if chosen:
            splits[split] = tuple(sorted(chosen))
    return splits or None


def _camera(content, source, entry):
    matrix = required(entry.content, "transform_matrix", entry.where)
    pose = check_pose(matrix, source=entry.where)
    return read_camera([(source, content), (entry.where, entry.content)], to_world=pose, image=entry.image)


def _points(content, source):
    """Returns the points of the file's PLY file, or None; and notes."""
    if "ply_file_path" not in content:
        return None, []
    path = source.parent / _path(source.parent, content["ply_file_path"], key="ply_file_path", source=source)
    if not os.path.isfile(path):
        return None, [f"{source}: ply_file_path {path.name} does not exist, so no points are used"]
    try:
        return read_points(path), []
    except ValueError as error:
        return None, [f"{error}; no points are used"]


def _box(content, source):
    """Returns instant-ngp's (lower [3], upper [3]) in the file's world, or None; and notes."""
    if "aabb_scale" not in content:
        return None, []
    if "aabb" in content or "normal_mts_args" in content:  # these define scale and offset differently
        return None, [f"{source}: aabb_scale is not used, as the file has aabb or normal_mts_args"]
    fields = {key: (content[key], source) for key in ("aabb_scale", "scale") if key in content}
    side = number_in(fields, "aabb_scale", "a number from 1e-6 to 1e6", 1e-6, 1e6)
    scale = number_in(fields, "scale", "a number from 1e-6 to 1e6", 1e-6, 1e6) if "scale" in content else 0.33
    offset = content.get("offset", 0.5)
    offset = offset if isinstance(offset, list) else [offset] * 3
    if len(offset) != 3 or not all(is_number(value) for value in offset):
        raise wrong_value(source, "offset", content["offset"], "three numbers; correct or remove it")
    # A cube around 0.5 is invariant under the cyclic permutation of the axes, which is therefore not undone.
    center, half = (0.5 - np.array(offset, np.float64)) / scale, 0.5 * side / scale
    return (center - half, center + half), []


def _check_applied(content, source):
    if "applied_transform" in content:
        rows = content["applied_transform"]
        lists = isinstance(rows, list) and len(rows) in (3, 4) and all(isinstance(row, list) for row in rows)
        if not lists or not all(len(row) == 4 and all(map(is_number, row)) for row in rows):
            raise wrong_value(source, "applied_transform", rows, "3 or 4 rows of 4 numbers; correct or remove it")
    if "applied_scale" in content:
        number_in({"applied_scale": (content["applied_scale"], source)}, "applied_scale", "more than 0", 1e-30)


READER = Reader(read_capture, detect=lambda folder: (folder / "transforms.json").is_file())
