"""Reader of the format of nerfstudio and instant-ngp: one transforms.json beside images."""

import os
from pathlib import Path
from typing import NamedTuple

import numpy as np

from jaxnerf.data.readers import json_frames
from jaxnerf.data.readers.base import CameraFiles, Capture, Frame
from jaxnerf.data.readers.image_paths import ImageFinder, fold, nearly
from jaxnerf.data.readers.intrinsics import number_in, wrong_value
from jaxnerf.data.readers.ply import read_points
from jaxnerf.data.readers.validation import is_number, read_json, read_times, required
from jaxnerf.registry import Reader

_FILES = CameraFiles(
    poses="every transform_matrix of the JSON files",
    mirror=json_frames.MIRROR,
    focal="{file}: fl_x, fl_y (or camera_angle_x) to about {x:.5g}, {y:.5g}",
)
_UNUSED = {  # facts of other programs that are no camera's, and what sets them instead
    "up": "data.up sets the axis that is up",
    "exposure": "cameras.exposure trains the exposure of each image",
    "background_color": "scene.background sets it",
}


def read_capture(folder: str | os.PathLike) -> Capture:
    """Returns the Capture of the images that <folder>/transforms.json lists, or transforms_{train,val,test}.json.

    The latter are read if they state more cameras' facts than Blender's renders do, see `full_cameras`.

    A field of a frame's camera overrides the file's field. Frames whose image is missing are skipped and noted,
    and so is a file of another split than "train" that cannot be read.
    Of an absolute path, such as one of another computer, the longest end that exists in the folder is used; this
    is noted, too.
    The world is that of the file's poses: applied_transform and applied_scale are checked for their form, but
    neither undone nor stored.

    instant-ngp maps a point x of the file to x * scale + offset, permutes its axes cyclically and trains in the
    cube of side aabb_scale around 0.5. That cube, mapped back to the file's world, is the Capture's box.

    Args:
        folder: holds transforms.json. Relative paths in that file that lead out of the folder are errors.

    Returns:
        Capture. Its splits are the files' if there are several, or the file's lists of names that are not empty.
        A camera's height and width are those that the file states; if center or focal depend on the size and it is
        not stated, they are the upright image's. Points and box are those of the first file.

    Raises:
        ValueError: names file and frame, what was found, what is expected and what to do.
    """
    folder, stated = Path(folder), json_frames.full_cameras(folder)
    if stated:
        return _read_splits(folder, stated)
    source, finder = folder / "transforms.json", ImageFinder(folder)
    file = _read_file(source, finder)
    splits, split_notes = _splits(file, finder)
    return Capture(
        format="transforms",
        source=source,
        frames=file.frames,
        splits=splits,
        points=file.points,
        box=file.box,
        notes=(*file.notes, *finder.notes(source), *split_notes),
        choices=tuple(_world(file)),
        files=_FILES,
    )


def _read_splits(folder, stated):
    """Returns the Capture of a file for each split; stated: see `full_cameras`."""
    paths, finder = json_frames.split_files(folder), ImageFinder(folder)
    files, notes = json_frames.read_splits(paths, lambda path: _read_file(path, finder))
    first = files["train"]
    frames = dict(zip(files, _common_names(files), strict=True))
    if (folder / "transforms.json").is_file():
        notes.append(f"{folder / 'transforms.json'}: not used beside {first.source.name}; rename that to read it")
    choice = f"{stated}: world, near and far follow from the cameras; --format=blender takes near 2 and far 6"
    alone = f"{first.source.name}: every 8th view is a test view, as there is no file of another split"
    held_out = [alone] if len(paths) == 1 else []
    return Capture(
        format="transforms",
        source=first.source,
        frames=sum(frames.values(), ()),
        splits=json_frames.split_ranges(paths, frames) if len(paths) > 1 else None,
        points=first.points,
        box=first.box,
        notes=(*_joined_notes(files.values()), *finder.notes(first.source), *notes),
        choices=(choice, *held_out, *_world(first)),
        files=_FILES,
    )


def _joined_notes(files):
    """Returns the notes of files; one that several files have is stated once, with their names."""
    found: dict[str, list[Path]] = {}
    for file in files:
        for note in file.notes:
            place, _, rest = note.partition(": ")
            found.setdefault(rest if place == str(file.source) else note, []).append(file.source)
    own = {note for file in files for note in file.notes}
    return [
        note if note in own else f"{', '.join([str(sources[0]), *(source.name for source in sources[1:])])}: {note}"
        for note, sources in found.items()
    ]


class _File(NamedTuple):
    """What one file states.

    Attributes:
        source: its path.
        content: its JSON object.
        base: the folder that holds all its images, from which they are named.
        entries: all, sorted by name.
        frames: of the entries with an image.
        points, box, notes: see `Capture`.
    """

    source: Path
    content: dict
    base: str
    entries: list
    frames: tuple[Frame, ...]
    points: np.ndarray | None
    box: tuple | None
    notes: tuple[str, ...]

    @property
    def kept(self):
        """The entries with an image."""
        return [entry for entry in self.entries if entry.image is not None]


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


def _read_file(source, finder):
    content = read_json(source)
    entries, base, notes = _entries(content, source, finder)
    kept = [entry for entry in entries if entry.image is not None]
    masks, times = _masks(entries, kept, finder), read_times([(entry.where, entry.content) for entry in kept])
    _check_applied(content, source)
    points, points_notes = _points(content, source, finder)
    box, box_notes = _box(content, source)
    poses, pose_notes = json_frames.read_poses(source, [(entry.where, entry.content) for entry in kept])
    cameras, camera_notes = json_frames.read_cameras(
        [(source, content)], [(entry.where, entry.content, entry.image) for entry in kept], poses
    )
    radii = [_crop_radius({**content, **entry.content}, entry.where) for entry in kept]
    frames = tuple(
        Frame(entry.name, entry.image, camera, mask, time=time, crop_radius=radius)
        for entry, camera, mask, time, radius in zip(kept, cameras, masks, times, radii, strict=True)
    )
    notes = (*notes, *pose_notes, *camera_notes, *points_notes, *box_notes)
    return _File(source, content, base, entries, frames, points, box, notes)


def _entries(content, source, finder):
    """Returns all entries, sorted by name, the folder that holds all their images, and notes."""
    places, frames = zip(*json_frames.listed_frames(content, source), strict=True)
    stated = [required(frame, "file_path", where) for frame, where in zip(frames, places, strict=True)]
    paths = [finder.inside(path, key="file_path", source=where) for path, where in zip(stated, places, strict=True)]
    images = [finder.find(path) for path in paths]
    base = os.path.commonpath([os.path.dirname(path) for path in paths])
    names = [os.path.relpath(_without_suffix(*pair), base or ".") for pair in zip(paths, images, strict=True)]
    entries = sorted(map(_Entry, places, paths, images, names, frames), key=lambda entry: entry.name)
    for entry, other in zip(entries[:-1], entries[1:], strict=True):
        if entry.name == other.name:
            found = f"file_paths {entry.path!r} and {other.path!r} have one name"
            raise ValueError(f"{source}: {found}, expected different names; remove or rename one")
    depths = sum("depth_file_path" in frame or "depth_path" in frame for frame in frames)
    notes = [f"{source}: depth files of {depths} frames are not used"] if depths else []
    notes += [
        f"{source}: {key} is not used: {why}"
        for key, why in _UNUSED.items()
        if any(key in level for level in (content, *frames))
    ]
    return entries, base, [*_missing(entries, source, finder), *notes]


def _crop_radius(fields, where):
    """Returns nerfstudio's radius around the middle of an image, outside of which a fisheye shows nothing, or None."""
    value, key = fields.get("fisheye_crop_radius"), "fisheye_crop_radius"
    return None if value is None else number_in({key: (value, where)}, key, "px above 0", 1e-3)


def _without_suffix(path, image):
    """Returns a file_path without extension; it may have none, and dots in its name."""
    name = os.path.basename(path)
    has_none = image is not None and image.name != name and fold(image.stem) == fold(name)
    return path if has_none else os.path.splitext(path)[0]


def _common_names(files):
    """Returns the frames of each file, named from the folder of all images, and after the split if names repeat."""
    base = os.path.commonpath([file.base for file in files.values()])
    named = {}
    for split, file in files.items():
        prefix = os.path.relpath(file.base or ".", base or ".")
        names = [os.path.normpath(f"{prefix}/{frame.name}") for frame in file.frames]
        named[split] = tuple(frame._replace(name=name) for frame, name in zip(file.frames, names, strict=True))
    names = [frame.name for frames in named.values() for frame in frames]
    if len(set(names)) == len(names):
        return list(named.values())
    return [tuple(frame._replace(name=f"{split}/{frame.name}") for frame in frames) for split, frames in named.items()]


def _missing(entries, source, finder):
    missing = [entry for entry in entries if entry.image is None]
    if not missing:
        return []
    names, hint = [entry.name for entry in missing], nearly(finder, *(entry.path for entry in missing))
    count = f"{len(names)} of {len(entries)} frames have no file"
    listed = ", ".join(names[:5]) + (f" and {len(names) - 5} more" if len(names) > 5 else "")
    if 2 * len(names) > len(entries):
        todo = hint or "; copy them or correct file_path"
        raise ValueError(f"{source}: {count} ({listed}), expected most of them{todo}")
    return [f"{source}: {count} and are skipped: {listed}{hint}"]


def _masks(entries, kept, finder):
    """Returns the mask of each kept entry; either all have one or none."""
    without = [entry.where for entry in entries if "mask_path" not in entry.content]
    if len(without) == len(entries):
        return [None] * len(kept)
    if without:
        raise ValueError(f"{without[0]}: has no mask_path, other frames have; expected all or none; complete them")
    masks = []
    for entry in kept:
        path = finder.inside(entry.content["mask_path"], key="mask_path", source=entry.where)
        masks.append(finder.find(path))
        if masks[-1] is None:
            hint = nearly(finder, path) or "; copy it"
            raise ValueError(f"{entry.where}: mask {path!r} does not exist, expected its file{hint}")
    return masks


def _splits(file, finder):
    """Returns the splits of the file's lists of names, None if it has none, and notes."""
    places = {entry.path: index for index, entry in enumerate(file.kept)}
    places |= {entry.image: index for index, entry in enumerate(file.kept)}
    absent = {entry.path for entry in file.entries if entry.image is None}
    splits, notes = {}, []
    for split in json_frames.SPLITS:
        key = f"{split}_filenames"
        names = file.content.get(key, [])
        if not isinstance(names, list):
            raise wrong_value(file.source, key, names, "a list of file_paths; correct or remove it")
        paths = [finder.inside(name, key=key, source=file.source) for name in names]
        chosen = {places.get(path, places.get(finder.find(path))) for path in paths if path not in absent}
        if None in chosen:
            wrong = next(path for path in paths if path not in absent and places.get(finder.find(path)) is None)
            found = f"{key} has {wrong!r}, which is not among the frames"
            raise ValueError(f"{file.source}: {found}; expected a frame; add or remove it")
        if skipped := len(absent & set(paths)):
            notes.append(f"{file.source}: {skipped} of {len(paths)} names in {key} have no file and are skipped")
        if paths:
            splits[split] = tuple(sorted(chosen))
    unused = len(file.kept) - len(set().union(*splits.values()))
    if "train" in splits and len(splits) > 1 and unused:
        notes.append(f"{file.source}: {unused} frames are in no list of names, so no split has them")
    return splits or None, notes


def _world(file):
    """Returns lines about fields that say how the file's world was made from another, and what of images is ignored."""
    keys = [key for key in ("applied_transform", "applied_scale", "orientation_override") if key in file.content]
    lines = []
    if keys:
        lines.append(f"{file.source.name}: {', '.join(keys)}: positions are those after it, as in the file's poses")
    if radii := {frame.crop_radius for frame in file.frames} - {None}:
        lines.append(f"{file.source.name}: pixels beyond fisheye_crop_radius, {max(radii):g} px, are ignored")
    return lines


def _points(content, source, finder):
    """Returns the points of the file's PLY file, or None; and notes."""
    if "ply_file_path" not in content:
        return None, []
    path = source.parent / finder.inside(content["ply_file_path"], key="ply_file_path", source=source)
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


READER = Reader(
    read_capture,
    detect=lambda folder: (folder / "transforms.json").is_file() or bool(json_frames.full_cameras(folder)),
)
