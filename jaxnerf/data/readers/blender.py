"""Reader of the format of the NeRF paper's Blender renders: transforms_<split>.json beside PNG files.

Files that state more of their cameras than these are detected as the format "transforms". If this reader is selected
for them, it reads their cameras all the same, in a world where near is 2 and far 6.
"""

import dataclasses
import math
import os
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float

from jaxnerf.core.views import Views
from jaxnerf.data.images.image_files import image_form
from jaxnerf.data.images.load_images import load_frames
from jaxnerf.data.readers import base
from jaxnerf.data.readers.base import Capture, Frame
from jaxnerf.data.readers.image_paths import ImageFinder, nearly
from jaxnerf.data.readers.json_frames import read_cameras, read_poses, read_splits, split_ranges
from jaxnerf.data.readers.split_files import full_cameras, split_files
from jaxnerf.data.readers.validation import (
    check_background,
    check_factor,
    check_range,
    is_number,
    read_json,
    read_times,
    required,
)
from jaxnerf.registry import Reader


def load_blender(
    folder: str | os.PathLike,
    *,
    split: str = "train",
    factor: int = 1,
    near: float = 2.0,
    far: float = 6.0,
    background: Sequence[float] | None = (1.0, 1.0, 1.0),
    select: Callable[[int], Iterable[int]] | None = None,
) -> Views:
    """Reads one split of a Blender dataset with all its pixels, see `fill_pixels`.

    Args:
        folder: the dataset's folder, which holds transforms_<split>.json.
        split: "train", "val", "test" or any other whose file exists.
        factor: images are averaged over factor x factor pixels, which must divide them.
        near, far: in t, where rays begin and end; directions have length 1 along the camera's axis.
        background: red, green, blue in [0, 1] behind alpha. None drops alpha; files without alpha need it.
        select: maps the number of frames to the indices of those to read; None: all.

    Returns:
        Views in the order of the frames. Factor 1 keeps the files' 8 or 16 bits, others return 16.

    Raises:
        ValueError: names the file, what was found, what is expected and what to do.
    """
    factor, background = check_factor(factor), check_background(background)
    check_range(near, far)
    source, content = _read_transforms(folder, split)
    frames, forms, _ = _frames(content, source, select)
    for frame, form in zip(frames, forms, strict=True):
        _check_image(frame, form, factor, background)
        if form[0][:2] != forms[0][0][:2] or form[1] != forms[0][1]:
            size, expected = (f"{width} x {height} {dtype}" for (height, width, _), dtype in (form, forms[0]))
            raise ValueError(
                f"{frame.image}: is {size}, expected {expected} as {frames[0].image.name}; render all alike"
            )
    origin = base.origin_near(training_poses(folder)[:, :, 3])
    frames = [base.moved(frame, origin)._replace(bounds=(near, far)) for frame in frames]
    views = load_frames(frames, factor, background=background, source=source)
    return views if origin is None else dataclasses.replace(views, file_origin=tuple(map(float, origin)))


def training_poses(folder: str | os.PathLike) -> Float[np.ndarray, "V 3 4"]:
    """Returns the poses of the split "train", or of the first without one, without looking for its images.

    Raises:
        ValueError: as `load_blender`.
    """
    splits = split_files(Path(folder))
    split = "train" if "train" in splits or not splits else next(iter(splits))
    source, content = _read_transforms(folder, split)
    return np.stack(read_poses(source, _listed(content, source))[0])


def read_capture(folder: Path) -> Capture:
    """Returns the Capture of all splits in a folder; frames are named by split and file, such as train/r_0.

    A split other than "train" that cannot be read, as its images were never rendered, for example, is noted.

    Raises:
        ValueError: as `load_blender`.
    """
    _read_transforms(folder, "train")  # whose error names the files that there are
    paths = split_files(folder)
    read, notes = read_splits(paths, lambda path: _frames(read_json(path), path))
    frames = {
        split: [frame._replace(name=f"{split}/{frame.name}") for frame in listed]
        for split, (listed, _, _) in read.items()
    }
    notes = [*(note for *_, own in read.values() for note in own), *notes]
    listed = tuple(frame for part in frames.values() for frame in part)
    return Capture("blender", Path(folder), listed, split_ranges(paths, frames), notes=tuple(notes))


def _read_transforms(folder, split):
    if not isinstance(folder, str | os.PathLike):
        raise ValueError(f"folder is {folder!r}, expected the path of a dataset's folder; pass one")
    source = Path(folder) / f"transforms_{split}.json"
    if not source.is_file():
        existing = sorted(path.name for path in source.parent.glob("transforms*.json"))
        found = f"the folder has {', '.join(existing) or 'no transforms_*.json'}"
        if not source.parent.is_dir():
            found = "the folder does not exist"
        raise ValueError(f"{source}: no such file ({found}), expected split {split!r}; correct folder or split")
    return source, read_json(source)


def _check_angle(content, source):
    """Raises a ValueError if a file has a wrong angle, or neither an angle nor a focal length anywhere."""
    if "camera_angle_x" not in content:
        frames = content.get("frames") if isinstance(content.get("frames"), list) else []
        stated = set(content).union(*(frame for frame in frames if isinstance(frame, dict)))
        if any(key in stated for key in ("fl_x", "camera_angle_x", "camera_angle_y")):
            return
    angle = required(content, "camera_angle_x", source)
    if not is_number(angle) or not 1e-6 < angle < math.pi - 1e-6:  # outside, the focal length is no float32
        hint = "convert it from degrees" if is_number(angle) and angle > 0 else "export it again"
        raise ValueError(f"{source}: camera_angle_x is {angle!r}, expected radians between 0 and pi; {hint}")


def _frames(content, source, select=None):
    """Returns the Frames that a file lists, or those that are selected, the `image_form` of each, and notes."""
    _check_angle(content, source)
    listed = _listed(content, source)
    times = read_times(listed)
    chosen = [int(index) for index in (range(len(listed)) if select is None else select(len(listed)))]
    entries, finder = [listed[index] for index in chosen], ImageFinder(source.parent)
    images = [_image_path(finder, frame, where) for where, frame in entries]
    poses, notes = read_poses(source, entries)
    forms = [image_form(path) for path in images]
    sized = [
        (where, _with_size(frame, content, form[0]), image)
        for (where, frame), image, form in zip(entries, images, forms, strict=True)
    ]
    cameras, camera_notes = read_cameras([(source, content)], sized, poses)
    frames = [
        Frame(image.stem, image, camera, time=times[index])
        for index, image, camera in zip(chosen, images, cameras, strict=True)
    ]
    return frames, forms, [*finder.notes(source), *notes, *camera_notes]


def _listed(content, source):
    """Returns (where, entries) of each frame of a file."""
    listed = required(content, "frames", source)
    if not isinstance(listed, list) or not listed or not all(isinstance(frame, dict) for frame in listed):
        found = "an empty list" if listed == [] else f"{str(listed)[:40]!r}"
        raise ValueError(f"{source}: frames is {found}, expected one object {{...}} per image; export it again")
    return [(f"{source}, frame {index}", frame) for index, frame in enumerate(listed)]


def _with_size(frame, content, form):
    """Returns the frame's entries with the size of its image where neither it nor the file states one."""
    return {key: side for key, side in (("h", form[0]), ("w", form[1])) if key not in content} | frame


def _image_path(finder, frame, where):
    path = finder.inside(required(frame, "file_path", where), key="file_path", source=where)
    if found := finder.find(path):
        return found
    todo = nearly(finder, path) or "; copy it or remove the frame"
    raise ValueError(f"{where}: {finder.folder / path}.png does not exist, expected its image{todo}")


def _check_image(frame, form, factor, background):
    """Raises a ValueError if an image has no alpha behind which to composite, or not the stated or a divisible size."""
    (height, width, channels), _ = form
    path, declared = frame.image, (frame.camera.height, frame.camera.width)
    if background is not None and channels != 4:
        raise ValueError(
            f"{path}: has no alpha, expected RGBA; set data.background to 'none' (background=None) for RGB"
        )
    if declared != (height, width):
        expected = f"w = {declared[1]}, h = {declared[0]} as its JSON file states"
        raise ValueError(f"{path}: is {width} x {height}, expected {expected}; correct one of them")
    if height % factor or width % factor:
        common = math.gcd(height, width)
        works = ", ".join(str(k) for k in range(1, common + 1) if common % k == 0)
        found = f"factor {factor} does not divide {width} x {height}"
        raise ValueError(f"{path}: {found}, expected a divisor; choose one of {works}")


def _detect(folder):
    return bool(split_files(folder)) and not full_cameras(folder)


READER = Reader(read_capture, detect=_detect)
