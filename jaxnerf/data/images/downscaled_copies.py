"""Smaller copies of photographs, in folders images_N as tools leave them, and which factor fits."""

import dataclasses
import math

import numpy as np

from jaxnerf.data.images.image_files import image_size

IMAGES = (".png", ".jpg", ".jpeg", ".webp")


def image_files(folder):
    """Returns the images in a folder, by name."""
    return sorted(path for path in folder.glob("*") if path.suffix.lower() in IMAGES)


def smaller_folders(folder):
    """Returns N -> path of the folders images_N in a scene's folder."""
    found = {path.name.removeprefix("images_"): path for path in folder.glob("images_*") if path.is_dir()}
    return {int(number): path for number, path in found.items() if number.isascii() and number.isdigit()}


def choose_copies(frames, factor):
    """Returns the frames, with the smallest images that a factor allows, and what is left of the factor.

    Their cameras have sizes then. How many times smaller a folder's images are is taken from the images.

    Raises:
        ValueError: if the factor is none that the folders can give.
    """
    frames = tuple(with_size(frame) for frame in frames)
    there = _copies(frames)
    fitting = [times for times in there if factor % times == 0]
    if not fitting:
        found = ", ".join(str(times) for times in sorted(there))
        raise ValueError(
            f"{frames[0].image.parent.parent}: has images that are {found} times smaller than their cameras, "
            f"data.factor is {factor}; wanted a multiple of one of these"
        )
    times = max(fitting)
    chosen = [frame._replace(image=there[times].get(frame.image, frame.image)) for frame in frames]
    return tuple(chosen), factor // times


def factor_for(capture, width):
    """Returns the factor that brings a capture's photographs nearest to a width [px], and their own."""
    frames = [with_size(frame) for frame in capture.frames]
    full = max(frame.camera.width for frame in frames)
    if width < 1:
        raise ValueError(f"data.width is {width}, wanted at least 1 px; or set data.factor")
    factors = np.arange(1, max(math.ceil(2 * full / width), 2) + 1)
    if capture.format == "blender":  # whose reader cuts nothing off
        common = math.gcd(*(side for frame in frames for side in (frame.camera.height, frame.camera.width)))
        valid = factors[common % factors == 0]
    else:
        smallest = min(_copies(frames))
        valid = np.unique([factors // times * times for times in _copies(frames)])
        valid = valid[valid >= smallest] if (valid >= smallest).any() else np.array([smallest])
    return int(valid[np.argmin(np.abs(np.log(valid * width / full)))]), full


def with_size(frame):
    """Returns the frame with a height and width in its camera: those of its image where it states none."""
    if None not in (frame.camera.height, frame.camera.width):
        return frame
    width, height = image_size(frame.image, turn=frame.turned)
    return frame._replace(camera=dataclasses.replace(frame.camera, height=height, width=width))


def _copies(frames):
    """Returns {how many times smaller than their cameras: {image: its copy}} of what lies there."""
    first = frames[0]
    there = {_times(first, first.image): {}}
    parent = first.image.parent
    if len({frame.image.parent for frame in frames}) > 1 or not parent.name.startswith("images"):
        return there
    for folder in (parent.parent / "images", *smaller_folders(parent.parent).values()):
        pairs = _paired([frame.image for frame in frames], folder) if folder != parent else None
        if pairs:
            there.setdefault(_times(first, pairs[first.image]), pairs)
    return there


def _paired(images, folder):
    """Returns {image: the file of a folder that shows the same}, None where that is not certain."""
    files = image_files(folder)
    named = {path.stem: path for path in files}
    if all(image.stem in named for image in images):
        return {image: named[image.stem] for image in images}
    # Tools that rename what they shrink keep the order; with some names alike it is another set of images.
    before = image_files(images[0].parent)
    alike = {path.stem for path in before} & set(named)
    if len(before) != len(files) or alike or not set(images) <= set(before):
        return None
    return dict(zip(before, files, strict=True))


def _times(frame, path):
    """Returns how many times smaller than its frame's camera an image is, however it is turned."""
    return max(round(max(frame.camera.height, frame.camera.width) / max(image_size(path))), 1)
