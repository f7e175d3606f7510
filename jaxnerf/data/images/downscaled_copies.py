"""Downscaled copies of a dataset's images, in the folders images_N that tools write, and factors that fit them."""

import dataclasses
import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from jaxnerf.data.images.image_files import IMAGE_SUFFIXES, image_size, is_hidden
from jaxnerf.data.readers.base import Capture, Frame


def list_images(folder: Path) -> list[Path]:
    """Returns the image files of a folder that are not hidden, sorted by name."""
    paths = (path for path in folder.glob("*") if path.suffix.lower() in IMAGE_SUFFIXES)
    return sorted(path for path in paths if not is_hidden(path.name) and path.is_file())


def downscaled_folders(folder: Path) -> dict[int, Path]:
    """Returns {N: path} of the folders images_N in a dataset's folder."""
    found = {path.name.removeprefix("images_"): path for path in folder.glob("images_*") if path.is_dir()}
    return {int(number): path for number, path in found.items() if number.isascii() and number.isdigit()}


def choose_copies(frames: Sequence[Frame], factor: int) -> tuple[tuple[Frame, ...], int]:
    """Replaces the images of frames by the smallest copies that a factor allows.

    The scale of a folder is measured on its images; its name is not trusted.

    Returns:
        The frames, whose cameras all have a height and width; and the factor that remains to be applied.

    Raises:
        ValueError: if the factor is a multiple of no folder's scale.
    """
    frames = tuple(with_size(frame) for frame in frames)
    copies = _copies(frames)
    fitting = [times for times in copies if factor % times == 0]
    if not fitting:
        found = ", ".join(str(times) for times in sorted(copies))
        raise ValueError(
            f"{frames[0].image.parent.parent}: has images that are {found} times smaller than their cameras, "
            f"data.factor is {factor}, expected a multiple of one of these; correct data.factor"
        )
    times = max(fitting)
    chosen = [frame._replace(image=copies[times].get(frame.image, frame.image)) for frame in frames]
    return tuple(chosen), factor // times


def factor_for(capture: Capture, width: int) -> tuple[int, int]:
    """Returns the factor that brings a dataset's images closest to a width [px], and their full width [px]."""
    frames = [with_size(frame) for frame in capture.frames]
    full = max(frame.camera.width for frame in frames)
    factors = np.arange(1, max(math.ceil(2 * full / width), 2) + 1)
    if capture.rendered:  # such images are not cropped
        common = math.gcd(*(side for frame in frames for side in (frame.camera.height, frame.camera.width)))
        valid = factors[common % factors == 0]
    else:
        scales = list(_copies(frames))
        valid = np.unique([factors // times * times for times in scales])
        valid = valid[valid >= min(scales)] if (valid >= min(scales)).any() else np.array([min(scales)])
    return int(valid[np.argmin(np.abs(np.log(valid * width / full)))]), full


def with_size(frame: Frame) -> Frame:
    """Returns the frame with a height and width in its camera: the image's if the format states none."""
    if None not in (frame.camera.height, frame.camera.width):
        return frame
    width, height = image_size(frame.image, follow_exif=frame.follow_exif, center=np.asarray(frame.camera.center))
    return frame._replace(camera=dataclasses.replace(frame.camera, height=height, width=width))


def _copies(frames):
    """Returns {scale: {image: its copy}}; a scale is how many times smaller than the cameras the copies are."""
    first = frames[0]
    copies = {_scale(first, first.image): {}}
    parent = first.image.parent
    if len({frame.image.parent for frame in frames}) > 1 or not parent.name.startswith("images"):
        return copies
    for folder in (parent.parent / "images", *downscaled_folders(parent.parent).values()):
        pairs = _pair([frame.image for frame in frames], folder) if folder != parent else None
        if pairs:
            copies.setdefault(_scale(first, pairs[first.image]), pairs)
    return copies


def _pair(images, folder):
    """Returns {image: its copy in a folder}, or None if the assignment is ambiguous."""
    files = list_images(folder)
    by_name = {path.stem: path for path in files}
    if all(image.stem in by_name for image in images):
        return {image: by_name[image.stem] for image in images}
    # Tools that rename the copies keep their order. If some names agree, the folder holds other images.
    originals = list_images(images[0].parent)
    common = {path.stem for path in originals} & set(by_name)
    if len(originals) != len(files) or common or not set(images) <= set(originals):
        return None
    return dict(zip(originals, files, strict=True))


def _scale(frame, path):
    """Returns how many times smaller than its frame's camera an image is, in either orientation."""
    return max(round(max(frame.camera.height, frame.camera.width) / max(image_size(path))), 1)
