"""Reader of the format of the NeRF paper's Blender renders: transforms_<split>.json beside PNG files.

Files that state more of their cameras than these are detected as the format "transforms". If this reader is selected
for them, it reads their cameras all the same, in a world where near is 2 and far 6.
"""

import os
from pathlib import Path

import numpy as np
from jaxtyping import Float

from jaxnerf.data.geometry.poses import gaze_center
from jaxnerf.data.readers import base, json_frames
from jaxnerf.data.readers.base import CameraFiles, Capture, Frame
from jaxnerf.data.readers.image_paths import ImageFinder, nearly
from jaxnerf.data.readers.validation import read_json, read_times, required
from jaxnerf.registry import Reader

_RANGE = (2.0, 6.0)  # near and far of the NeRF paper's synthetic scenes, world units
_FILES = CameraFiles(
    poses="every transform_matrix of transforms_*.json",
    mirror=json_frames.MIRROR,
    focal="transforms_*.json: camera_angle_x to about {angle:.4g}",
)


def read_capture(folder: str | os.PathLike, *, split: str | None = None) -> Capture:
    """Returns the Capture of a folder that holds transforms_train.json, and such a file for each other split.

    Args:
        folder: of the dataset.
        split: "train", "val", "test" or any other whose file exists: only its frames are read, and their names are
            those of their files. None: those of all splits, named by split and file, such as train/r_0; a split other
            than "train" that cannot be read, as its images were never rendered, for example, is noted.

    Raises:
        ValueError: names the file, what was found, what is expected and what to do.
    """
    source, content = _read_transforms(folder, split or "train")  # whose error names the files that there are
    if split is None:
        source = Path(folder)
        paths = json_frames.split_files(source)
        read, notes = json_frames.read_splits(paths, lambda path: _frames(read_json(path), path))
        named = {
            name: [frame._replace(name=f"{name}/{frame.name}") for frame in frames]
            for name, (frames, _) in read.items()
        }
        frames, splits = sum(named.values(), []), json_frames.split_ranges(paths, named)
        notes = [*(note for _, own in read.values() for note in own), *notes]
    else:
        frames, notes = _frames(content, source)
        splits = {split: tuple(range(len(frames)))}
    poses = _training_poses(folder)
    bounds, reason = _bounds(poses)
    capture = Capture(
        format="blender",
        source=source,
        frames=tuple(frames),
        splits=splits,
        notes=tuple(notes),
        normalised=True,
        rendered=True,
        bounds=bounds,
        bounds_reason=reason,
        files=_FILES,
        time_range=json_frames.time_range(folder) if frames[0].time is not None else None,
    )
    return base.moved_near(capture, poses[:, :, 3])


def _training_poses(folder) -> Float[np.ndarray, "V 3 4"]:
    """Returns the poses of the split "train", or of the first without one, without looking for its images."""
    splits = json_frames.split_files(folder)
    split = "train" if "train" in splits or not splits else next(iter(splits))
    source, content = _read_transforms(folder, split)
    return np.stack(json_frames.read_poses(source, json_frames.listed_frames(content, source))[0])


def _bounds(poses):
    """Returns near and far, and why they are not the usual ones, from the poses of the training views.

    They are 2 and 6 as in the NeRF paper's scenes, whose cameras look at a point 4 units away. Where cameras look at a
    point that is not between them, as in a scene of other units, they are one half and three halves of its distance.
    """
    near, far = _RANGE
    offset = gaze_center(poses) - poses[:, :, 3]
    distance = float(np.median(np.linalg.norm(offset, axis=1)))
    ahead = -np.einsum("vi,vi->v", offset, poses[:, :, 2])
    looks_there = np.mean(ahead > 0.8 * np.linalg.norm(offset, axis=1)) > 0.8
    if near < distance < far or not (looks_there and distance > 0):
        apart = np.linalg.norm(np.ptp(poses[:, :, 3], axis=0))
        return _RANGE, f"although all cameras are within {apart:.3g}: see data.near" if 0 < apart < near / 100 else ""
    near, far = float(f"{distance / 2:.3g}"), float(f"{1.5 * distance:.3g}")
    return (near, far), f"as the cameras look at a point {2 * near:.4g} away"


def _read_transforms(folder, split):
    source = Path(folder) / f"transforms_{split}.json"
    if not source.is_file():
        existing = sorted(path.name for path in source.parent.glob("transforms*.json"))
        found = f"the folder has {', '.join(existing) or 'no transforms_*.json'}"
        if not source.parent.is_dir():
            found = "the folder does not exist"
        raise ValueError(f"{source}: no such file ({found}), expected split {split!r}; correct folder or split")
    return source, read_json(source)


def _frames(content, source):
    """Returns the Frames that a file lists, and notes."""
    entries, finder = json_frames.listed_frames(content, source), ImageFinder(source.parent)
    times = read_times(entries)
    images = [_image_path(finder, frame, where) for where, frame in entries]
    poses, notes = json_frames.read_poses(source, entries)
    shown = [(*entry, image) for entry, image in zip(entries, images, strict=True)]
    cameras, camera_notes = json_frames.read_cameras([(source, content)], shown, poses)
    frames = [
        Frame(image.stem, image, camera, time=time) for image, camera, time in zip(images, cameras, times, strict=True)
    ]
    return frames, [*finder.notes(source), *notes, *camera_notes]


def _image_path(finder, frame, where):
    path = finder.inside(required(frame, "file_path", where), key="file_path", source=where)
    if found := finder.find(path):
        return found
    todo = nearly(finder, path) or "; copy it or remove the frame"
    raise ValueError(f"{where}: {finder.folder / path}.png does not exist, expected its image{todo}")


READER = Reader(
    read_capture,
    detect=lambda folder: bool(json_frames.split_files(folder)) and not json_frames.full_cameras(folder),
)
