"""Reader of the format of the NeRF paper's Blender renders: transforms_<split>.json beside PNG files."""

import math
import os
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path

import numpy as np

from jaxnerf.core.types import Camera, Views
from jaxnerf.data.geometry.poses import check_pose
from jaxnerf.data.images.image_files import image_form
from jaxnerf.data.images.load_images import load_frames
from jaxnerf.data.readers.base import Capture, Frame
from jaxnerf.data.readers.validation import (
    check_background,
    check_factor,
    check_inside,
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
    frames, forms = _frames(content, source, select)
    for frame, form in zip(frames, forms, strict=True):
        _check_image(frame.image, form, factor, background, _declared_size(content, source))
        if form[0][:2] != forms[0][0][:2] or form[1] != forms[0][1]:
            size, expected = (f"{width} x {height} {dtype}" for (height, width, _), dtype in (form, forms[0]))
            raise ValueError(
                f"{frame.image}: is {size}, expected {expected} as {frames[0].image.name}; render all alike"
            )
    frames = [frame._replace(bounds=(near, far)) for frame in frames]
    return load_frames(frames, factor, background=background, source=source)


def read_capture(folder: Path) -> Capture:
    """Returns the Capture of all splits in a folder; frames are named by split and file, such as train/r_0.

    Raises:
        ValueError: as `load_blender`.
    """
    frames, splits = [], {}
    for split in ("train", "val", "test"):
        if split != "train" and not (Path(folder) / f"transforms_{split}.json").is_file():
            continue
        source, content = _read_transforms(folder, split)
        listed = [frame._replace(name=f"{split}/{frame.name}") for frame in _frames(content, source)[0]]
        splits[split] = tuple(range(len(frames), len(frames) + len(listed)))
        frames += listed
    return Capture("blender", Path(folder), tuple(frames), splits)


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


def _angle(content, source):
    angle = required(content, "camera_angle_x", source)
    if not is_number(angle) or not 1e-6 < angle < math.pi - 1e-6:  # outside, the focal length is no float32
        hint = "convert it from degrees" if is_number(angle) and angle > 0 else "export it again"
        raise ValueError(f"{source}: camera_angle_x is {angle!r}, expected radians between 0 and pi; {hint}")
    return angle


def _frames(content, source, select=None):
    """Returns the Frames that a file lists, or those that are selected, and the `image_form` of each."""
    angle, listed = _angle(content, source), required(content, "frames", source)
    if not isinstance(listed, list) or not listed or not all(isinstance(frame, dict) for frame in listed):
        found = "an empty list" if listed == [] else f"{str(listed)[:40]!r}"
        raise ValueError(f"{source}: frames is {found}, expected one object {{...}} per image; export it again")
    frames, forms = [], []
    times = read_times([(f"{source}, frame {index}", frame) for index, frame in enumerate(listed)])
    for index in range(len(listed)) if select is None else select(len(listed)):
        where = f"{source}, frame {index}"
        path = _image_path(source, listed[index], where)
        pose = check_pose(required(listed[index], "transform_matrix", where), source=where)
        forms.append(image_form(path))
        height, width, _ = forms[-1][0]
        focal, center = np.full(2, 0.5 * width / math.tan(0.5 * angle)), np.array([width, height]) / 2
        camera = Camera(to_world=pose, focal=focal, center=center, height=height, width=width)
        frames.append(Frame(path.stem, path, camera, time=times[index]))
    return frames, forms


def _declared_size(content, source):
    """Returns the (height, width) that the file states; each is None if it is not stated."""
    declared = tuple(content.get(key) for key in ("h", "w"))
    for key, value in zip("hw", declared, strict=True):
        if value is not None and not (is_number(value) and value >= 1 and value == int(value)):
            raise ValueError(f"{source}: {key} is {value!r}, expected whole pixels; correct or remove it")
    return declared


def _image_path(source, frame, where):
    inside = check_inside(required(frame, "file_path", where), key="file_path", source=where)
    path = source.parent / inside
    tried = [path, path.with_name(path.name + ".png")]
    found = [candidate for candidate in tried if candidate.is_file()]
    if not found:
        raise ValueError(f"{where}: {tried[1]} does not exist, expected its image; copy it or remove the frame")
    return found[0]


def _check_image(path, form, factor, background, declared):
    """Raises a ValueError if an image has no alpha behind which to composite, or not the stated or a divisible size."""
    (height, width, channels), _ = form
    if background is not None and channels != 4:
        raise ValueError(
            f"{path}: has no alpha, expected RGBA; set data.background to 'none' (background=None) for RGB"
        )
    if any(side not in (None, have) for side, have in zip(declared, (height, width), strict=True)):
        expected = f"w = {declared[1]}, h = {declared[0]} as its JSON file states"
        raise ValueError(f"{path}: is {width} x {height}, expected {expected}; correct one of them")
    if height % factor or width % factor:
        common = math.gcd(height, width)
        works = ", ".join(str(k) for k in range(1, common + 1) if common % k == 0)
        found = f"factor {factor} does not divide {width} x {height}"
        raise ValueError(f"{path}: {found}, expected a divisor; choose one of {works}")


READER = Reader(read_capture, detect=lambda folder: (folder / "transforms_train.json").is_file())
