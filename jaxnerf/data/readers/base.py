"""The result of every reader: posed images in the world of the dataset's files, not yet decoded."""

import dataclasses
import inspect
import math
import os
from collections.abc import Iterable
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from jaxnerf.core.types import Camera
from jaxnerf.data.images.image_files import IMAGE_SUFFIXES, MASK_PREFIX, is_hidden
from jaxnerf.data.readers.colmap_model import check_complete
from jaxnerf.data.readers.image_paths import fold
from jaxnerf.registry import READERS
from jaxnerf.runtime.atomic_files import files_below
from jaxnerf.runtime.fingerprint import fingerprint as content_fingerprint

TIME_UNUSED = "images state one, which is not used: the scene is trained as if nothing moved; --config=moving uses it"
_FAR_AWAY = 100.0  # distance of cameras from an origin over how far they are apart
_MASK_FOLDERS = ("images_mask", "images_masks", "masks")


class Frame(NamedTuple):
    """One image and its camera.

    Attributes:
        name: the image's path below the folder of images, without extension, with / between folders.
        image: an existing file.
        camera: float64. Height and width are those that the format states for the image, or None.
        mask: an existing image; pixels are ignored where it is at most half as bright as its brightest pixel. None: no
            pixel is ignored.
        follow_exif: whether EXIF orientation is applied where only the upright image has the camera's size. COLMAP's
            pixel coordinates, for example, always refer to the pixels as they are stored.
        bounds: nearest and farthest matter along the camera's axis, world units; None: not known.
        seen: [M] indices into the Capture's points that this image shows; None: not known.
        seen_at: [M, 2] px, where it shows them.
        time: when it was taken in a scene that moves, in [0, 1] once `read_capture` has scaled it; None: not stated,
            which holds for all frames or none.
        ignored: an existing image; pixels are ignored where it is not black, too. None: none is.
        crop_radius: px of the camera, around the image's middle, beyond which pixels are ignored, too; None: none is.
    """

    name: str
    image: Path
    camera: Camera
    mask: Path | None = None
    follow_exif: bool = True
    bounds: tuple[float, float] | None = None
    seen: Int[np.ndarray, " M"] | None = None
    seen_at: Float[np.ndarray, "M 2"] | None = None
    time: float | None = None
    ignored: Path | None = None
    crop_radius: float | None = None


class CameraFiles(NamedTuple):
    """How the files of a format state cameras, for messages that say what to change in them.

    Attributes:
        poses: the matrices, in words.
        axes: [3, 3], the camera axes of jaxnerf in those of the files.
        lines: the part of a matrix that holds one axis: "columns" or "rows".
        mirror: how to mirror the world in one coordinate.
        focal: how to set a focal length of {x}, {y} px, {factor} times the stated one, and the angle {angle}, in
            radians, that it gives the width of the image. {file} is the name of the Capture's source.
        bounds: where near and far of each frame are stated; {source} is the Capture's.
    """

    poses: str = "every pose"
    axes: Float[np.ndarray, "3 3"] = np.eye(3)
    lines: str = "columns"
    mirror: str = "also mirror the world"
    focal: str = "{file}: the focal length to about {x:.5g}, {y:.5g} px"
    bounds: str = "the bounds in {source}"


class Capture(NamedTuple):
    """The images of a dataset, sorted by name.

    A reader sets the first three fields, and of the others those that it knows.

    Attributes:
        format: the name under which the reader is registered.
        source: the file or folder that the cameras were read from.
        frames: all images.
        splits: indices into frames by the name of the split; None: the dataset defines none.
        points: [N, 3] float64, points on surfaces, world units; None: not known.
        box: (lower [3], upper [3]), outside which the format states that there is no matter; None: not known.
        notes: one line for each part of the dataset that was skipped or found at another place, with the reason.
        choices: one line for each choice of the reader that the files leave open, with the reason.
        origin: [3] the point of the files' world, in their units, that is the origin of this one; None: theirs is.
        normalised: whether training takes place in the files' world, as the format defines where the scene is.
        rendered: whether a program has rendered the images: all have alpha and one size, which a factor divides.
        bounds: (near, far) of frames without their own, world units, where the format defines them; None: they follow
            from points and cameras.
        bounds_reason: why the bounds are not those that the format usually has; "": they are.
        files: how the files state the cameras.
        time_range: the first and the last time of all splits, where the frames are those of one; None: as they state.
    """

    format: str
    source: Path
    frames: tuple[Frame, ...]
    splits: dict[str, tuple[int, ...]] | None = None
    points: Float[np.ndarray, "N 3"] | None = None
    box: tuple[np.ndarray, np.ndarray] | None = None
    notes: tuple[str, ...] = ()
    choices: tuple[str, ...] = ()
    origin: Float[np.ndarray, "3"] | None = None
    normalised: bool = False
    rendered: bool = False
    bounds: tuple[float, float] | None = None
    bounds_reason: str = ""
    files: CameraFiles = CameraFiles()
    time_range: tuple[float, float] | None = None


def fingerprint(capture: Capture) -> str:
    """Returns a line that changes whenever the names, cameras, masks' names or splits of a Capture's images change."""
    parts = [repr(capture.splits)]
    for frame in capture.frames:
        camera = frame.camera
        parts.append(repr((frame.name, camera.lens, camera.height, camera.width)))
        arrays = (camera.to_world, camera.focal, camera.center, camera.distortion)
        parts += [np.float32(array) for array in arrays if array is not None]
        if frame.mask is not None:
            parts.append(f"mask {frame.mask.name}")
        parts += [
            f"{name} {value}"
            for name, value in (("ignored", frame.ignored and frame.ignored.name), ("crop", frame.crop_radius))
            if value
        ]
        if frame.time is not None:
            parts.append(f"time {frame.time}")
    return f"{len(capture.frames)} images, {content_fingerprint(*parts)[:8]}"


def frame_times(times: Iterable[float | None]) -> Float[np.ndarray, " V"] | None:
    """Returns the times of frames as float32; None if any has none."""
    times = list(times)
    return None if None in times else np.float32(times)


def detect_formats(folder: str | os.PathLike) -> list[str]:
    """Returns the names of all formats that a folder holds, in the order in which they are registered.

    Raises:
        ValueError: if there is none.
    """
    folder = Path(folder)
    found = [name for name in READERS.names() if READERS.get(name).detect(folder)]
    if not found:
        check_complete(folder)
        places = [place for place in (folder, folder / "images") if place.is_dir()]
        folders = [place for place in places for path in place.iterdir() if path.suffix.lower() in IMAGE_SUFFIXES]
        if folders:
            raise ValueError(
                f"{folder}: holds images without cameras, expected the camera of each; find them with "
                f"jaxnerf-cameras --images={folders[0]} --out=DATASET, and give that folder"
            )
        raise ValueError(
            f"{folder}: holds no dataset, expected transforms_train.json (Blender), transforms.json, a COLMAP "
            "model in sparse/0 or dense/0/sparse, or poses_bounds.npy (LLFF); correct the folder, or import the "
            "module that registers another format with --plugins=MODULE"
        )
    return found


def read_capture(folder: str | os.PathLike, format: str = "auto", *, split: str | None = None) -> Capture:
    """Reads the Capture in a folder, in a given format or in the first that is detected.

    If the cameras are far from the origin of the files' world, as in geographic coordinates, the Capture has another
    origin near them, see `origin_near`: float32, in which Views are, does not hold such positions. Times that
    are not all in [0, 1], such as the numbers of frames, are scaled to it.

    Args:
        folder: of the dataset.
        format: the name of a registered reader, or "auto".
        split: whose frames are enough; a reader of `has_split_files` reads only its file.

    Raises:
        ValueError: names the file, what was found, what is expected and what to do.
    """
    if format == "auto":
        wrong = []
        for name in detect_formats(folder):
            try:
                capture = read_capture(folder, name, split=split)
            except ValueError as error:
                wrong.append(error)
                continue
            if not wrong:
                return capture
            # Such as a COLMAP model beside a transforms.json with the paths of another machine.
            raise ValueError(f"{wrong[0]}; --format={name} reads this folder") from None
        raise wrong[0]
    read = READERS.get(format).read
    if has_split_files(format):
        return _with_scaled_times(_with_ignored(read(Path(folder), split=split)))
    return moved_near(_with_masks(_with_ignored(_with_scaled_times(read(Path(folder)))), Path(folder)))


def has_split_files(format: str) -> bool:
    """Returns whether each split of a format has a file of its own: its reader asks for `split`.

    Such a reader also finds masks and the origin by itself. The images of one split do not depend on the others'.
    """
    return "split" in inspect.signature(READERS.get(format).read).parameters


def origin_near(positions: Float[np.ndarray, "V 3"]) -> Float[np.ndarray, "3"] | None:
    """Returns a round point near cameras at positions, or None if these are near 0.

    They are far if their distance from 0 is more than 100 times how far they are apart, in the median, so that single
    cameras without a position, at 0, do not count. The point depends only on the positions, so all splits of a
    dataset have one origin if it is computed from the training views.
    """
    middle = np.median(positions, axis=0)
    spread, distance = np.median(np.linalg.norm(positions - middle, axis=1)), np.linalg.norm(middle)
    if not distance > _FAR_AWAY * spread > 0:
        return None
    unit = 10.0 ** math.floor(math.log10(spread))
    return np.array([float(f"{value:.12g}") for value in np.round(middle / unit) * unit])


def moved_near(capture: Capture, positions: Float[np.ndarray, "V 3"] | None = None) -> Capture:
    """Returns the Capture with an origin near its training cameras, if that of the files is far away.

    Args:
        capture: in the files' world.
        positions: of the training cameras; None: the Capture has them.
    """
    if positions is None:
        train = (capture.splits or {}).get("train") or range(len(capture.frames))
        positions = np.float64([capture.frames[index].camera.to_world for index in train])[:, :, 3]
    origin = origin_near(positions)
    if origin is None:
        return capture
    place = ", ".join(f"{value:.10g}" for value in origin)
    line = f"positions are relative to ({place}): the cameras are far from the files' origin"
    return capture._replace(
        frames=tuple(_moved(frame, origin) for frame in capture.frames),
        points=None if capture.points is None else capture.points - origin,
        box=None if capture.box is None else tuple(corner - origin for corner in capture.box),
        choices=(*capture.choices, line),
        origin=origin,
    )


def _moved(frame, origin):
    """Returns a frame whose camera's position is relative to an origin."""
    pose = np.array(frame.camera.to_world, np.float64)
    pose[:, 3] -= origin
    return frame._replace(camera=dataclasses.replace(frame.camera, to_world=pose))


def _with_scaled_times(capture):
    """Returns the Capture with times in [0, 1], of all splits alike, and a line that says so if they were not."""
    times = [frame.time for frame in capture.frames if frame.time is not None]
    first, last = capture.time_range or (min(times, default=0), max(times, default=1))
    if 0 <= first and last <= 1:
        return capture
    line = f"times from {first:g} to {last:g}, those of all splits, are scaled to [0, 1]"
    frames = tuple(
        frame if frame.time is None else frame._replace(time=(frame.time - first) / ((last - first) or 1.0))
        for frame in capture.frames
    )
    return capture._replace(frames=frames, choices=(*capture.choices, line))


def _with_ignored(capture):
    """Returns the Capture with the masks of instant-ngp beside its images, unless its format states masks."""
    if any(frame.mask is not None for frame in capture.frames):
        return capture
    paths = [frame.image.with_name(f"{MASK_PREFIX}{frame.image.stem}.png") for frame in capture.frames]
    paths = [path if os.path.isfile(path) else None for path in paths]
    if not (found := [path for path in paths if path is not None]):
        return capture
    note = f"{found[0]}: pixels where it is not black are ignored; {len(found)} of {len(paths)} images have such a mask"
    frames = [frame._replace(ignored=path) for frame, path in zip(capture.frames, paths, strict=True)]
    return capture._replace(frames=tuple(frames), choices=(*capture.choices, note))


def _with_masks(capture, folder):
    """Returns the Capture with the masks that lie in its folder, unless its format states masks."""
    if any(frame.mask is not None for frame in capture.frames):
        return capture
    masks, notes = _find_masks(folder, [(frame.name, frame.image.suffix) for frame in capture.frames])
    frames = capture.frames
    if masks is not None:
        frames = tuple(frame._replace(mask=mask) for frame, mask in zip(frames, masks, strict=True))
    return capture._replace(frames=frames, notes=(*capture.notes, *notes))


def _find_masks(folder, images):
    """Returns the mask of each image, None if there are none; and a note for each folder that holds no image's mask.

    Images are given as (name, suffix). The mask of ("side/0001", ".jpg") is masks/side/0001.png or, as COLMAP names it,
    masks/side/0001.jpg.png.
    """
    notes = []
    for place in (folder / name for name in _MASK_FOLDERS):
        if not place.is_dir():
            continue
        paths = (path for path in files_below(place) if path.suffix.lower() in IMAGE_SUFFIXES)
        paths = sorted(path for path in paths if not is_hidden(path.name))
        files = {fold(path.relative_to(place).with_suffix("").as_posix()): path for path in paths}
        masks = [files.get(fold(name)) or files.get(fold(name + suffix)) for name, suffix in images]
        if None not in masks:
            return masks, notes
        first, count = images[masks.index(None)][0], sum(mask is not None for mask in masks)
        if count:
            raise ValueError(
                f"{place}: has no {first}.png, but masks of {count} of {len(masks)} images, expected one for each; "
                "add the missing ones, or rename the folder to train without masks"
            )
        notes.append(f"{place}: has no {first}.png and no other image's mask, so its files are not used")
    return None, notes
