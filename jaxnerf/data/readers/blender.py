"""Reader of the format of the NeRF paper's Blender renders: transforms_<split>.json beside PNG files."""

import functools
import math
import os
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path

import numpy as np

from jaxnerf.core.types import Camera, Views
from jaxnerf.data.geometry.poses import check_pose
from jaxnerf.data.images.image_files import average_tiles, image_size, read_image
from jaxnerf.data.images.pixel_cache import fill_pixels
from jaxnerf.data.readers.base import Capture, Frame, frame_times
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
    angle, frames = _angle(content, source), _frames(content, source)
    times = read_times(frames)
    chosen = list(range(len(frames)) if select is None else select(len(frames)))
    frames, times = ([each[index] for index in chosen] for each in (frames, times))
    paths = [_image_path(source, frame, where) for where, frame in frames]
    matrices = [(required(frame, "transform_matrix", where), where) for where, frame in frames]
    poses = [check_pose(matrix, source=where) for matrix, where in matrices]
    pixels, offset, (height, width) = _read_pixels(paths, factor, background, _declared_size(content, source))
    count = len(paths)
    return Views(
        pixels=pixels,
        offset=offset,
        size=np.tile(np.int32([[height, width]]), (count, 1)),
        cameras=Camera(
            to_world=np.stack(poses).astype(np.float32),
            focal=np.full((count, 2), 0.5 * width / math.tan(0.5 * angle), np.float32),
            center=np.tile(np.float32([[width / 2, height / 2]]), (count, 1)),
            height=height,
            width=width,
        ),
        near=np.full(count, near, np.float32),
        far=np.full(count, far, np.float32),
        names=tuple(path.stem for path in paths),
        background=background,
        time=frame_times(times),
    )


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
        angle, first = _angle(content, source), len(frames)
        listed = _frames(content, source)
        for (where, frame), time in zip(listed, read_times(listed), strict=True):
            path = _image_path(source, frame, where)
            pose = check_pose(required(frame, "transform_matrix", where), source=where)
            width, height = image_size(path)
            camera = Camera(
                to_world=pose,
                focal=np.full(2, 0.5 * width / math.tan(0.5 * angle)),
                center=np.array([width, height]) / 2,
                height=height,
                width=width,
            )
            frames.append(Frame(f"{split}/{path.stem}", path, camera, time=time))
        splits[split] = tuple(range(first, len(frames)))
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


def _frames(content, source):
    frames = required(content, "frames", source)
    if not isinstance(frames, list) or not frames or not all(isinstance(frame, dict) for frame in frames):
        found = "an empty list" if frames == [] else f"{str(frames)[:40]!r}"
        raise ValueError(f"{source}: frames is {found}, expected one object {{...}} per image; export it again")
    return [(f"{source}, frame {index}", frame) for index, frame in enumerate(frames)]


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


def _read_pixels(paths, factor, background, declared):
    """Returns pixels [V H W, C], each image's first pixel [V] int32, and their common (height, width)."""
    first = _read_frame(paths[0], factor, background, declared)
    _check_count(paths, first)

    def read(path):
        image = _read_frame(path, factor, background, declared)
        if image.shape != first.shape or image.dtype != first.dtype:
            size, expected = (f"{a.shape[1]} x {a.shape[0]} {a.dtype}" for a in (image, first))
            raise ValueError(
                f"{path}: is {size} after factor {factor}, expected {expected} as {paths[0].name}; render all alike"
            )
        return image

    height, width, channels = first.shape
    offset = np.arange(len(paths), dtype=np.int32) * np.int32(height * width)
    pixels = fill_pixels(
        paths,
        [functools.partial(read, path) for path in paths],
        shape=(len(paths) * height * width, channels),
        dtype=first.dtype,
        offsets=offset,
        depends=("blender", factor, background),
    )
    return pixels, offset, (height, width)


def _read_frame(path, factor, background, declared):
    image = read_image(path)
    height, width, channels = image.shape
    if background is not None and channels != 4:
        raise ValueError(
            f"{path}: has no alpha, expected RGBA; set data.background to 'none' (background=None) for RGB"
        )
    if any(side not in (None, have) for side, have in zip(declared, (height, width), strict=True)):
        expected = f"w = {declared[1]}, h = {declared[0]} as its JSON file states"
        raise ValueError(f"{path}: is {width} x {height}, expected {expected}; correct one of them")
    if background is None:
        image = image[..., :3]
    try:
        return image if factor == 1 else average_tiles(image, factor, background=background)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from None


def _check_count(paths, image):
    height, width, _ = image.shape
    if len(paths) * height * width >= 2**31:  # offsets and pixel ids are int32
        found = f"{len(paths)} images of {width} x {height}"
        raise ValueError(f"{paths[0].parent}: has {found}, expected fewer than 2^31 pixels; raise data.factor")


READER = Reader(read_capture, detect=lambda folder: (folder / "transforms_train.json").is_file())
