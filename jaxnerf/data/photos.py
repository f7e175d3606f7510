"""From the photographs of a Capture to Views: reading, shrinking, masks, lenses, who is held out."""

import dataclasses
from concurrent.futures import ThreadPoolExecutor
from typing import NamedTuple

import numpy as np

from jaxnerf.core.structs import Camera, Views
from jaxnerf.data.checks import check_background, check_factor
from jaxnerf.data.images import average_blocks, image_size, read_image, read_mask

IMAGES = (".png", ".jpg", ".jpeg", ".webp")
_LENSES = {"pinhole": 0, "opencv": 5, "fisheye": 4}  # coefficients


class _Photo(NamedTuple):
    pixels: np.ndarray  # [H, W, C]
    mask: np.ndarray | None  # [H, W] bool
    camera: Camera  # of these pixels


def split_indices(capture, split, *, hold=8):
    """Returns the indices [N] of a split's frames.

    The capture's own splits count where it has some. Otherwise every hold-th by name, from the first, is
    held out as "test"; "val" is the same, and so it is where a capture has only one of the two.

    Raises:
        ValueError: if there is no such split, or nothing in it.
    """
    if split not in ("train", "val", "test"):
        raise ValueError(f"{capture.source}: split is {split!r}, wanted 'train', 'val' or 'test'; give one")
    if capture.splits:
        other = {"val": "test", "test": "val"}.get(split, split)
        chosen = np.array(capture.splits.get(split, capture.splits.get(other, ())), int)
    else:
        held = np.arange(len(capture.frames)) % hold == 0
        chosen = np.flatnonzero(~held if split == "train" else held)
    if not len(chosen):
        raise ValueError(
            f"{capture.source}: split {split!r} of {len(capture.frames)} images is empty; add images"
        )
    return chosen


def load_views(capture, *, split="train", factor=1, hold=8, background=None):
    """Returns one split of a capture, with all its pixels in memory.

    Args:
        capture: Capture, with bounds in every frame.
        split, hold: see split_indices.
        factor: whole number; images are averaged down by it, cut at the right and below where it does not
            divide them. A folder images_N beside, with an N that divides it, is used where there is one.
        background: red, green, blue in [0, 1] behind images with alpha. None drops alpha.

    Returns:
        Views in the order of the names; near and far are the frames' bounds. With images of 8 bits and of
        16, or with alpha and without, all become those with more. One size gives the cameras a height and
        width, several leave them None.

    Raises:
        ValueError: names the file, what was found, what was wanted and what to do.
    """
    factor, background = check_factor(factor), check_background(background)
    frames, shrink = _smaller_copies(capture.frames, factor)
    chosen = [frames[index] for index in split_indices(capture, split, hold=hold)]

    def read(frame):
        return _read(frame, shrink, background)

    with ThreadPoolExecutor(2) as pool:  # Pillow and zlib work outside Python's lock
        photos = list(pool.map(read, chosen))
    sizes = np.array([photo.pixels.shape[:2] for photo in photos])
    ends = np.cumsum(sizes.prod(axis=1))
    if ends[-1] >= 2**31:  # offsets and pixel ids are int32
        raise ValueError(f"{capture.source}: has {ends[-1]} pixels, wanted less than 2^31; raise factor")
    masks = None
    if any(photo.mask is not None for photo in photos):
        masks = [np.ones(p.pixels.shape[:2], bool) if p.mask is None else p.mask for p in photos]
        masks = np.concatenate([mask.reshape(-1) for mask in masks])
    bounds = np.float32([frame.bounds for frame in chosen])
    return Views(
        pixels=_alike([photo.pixels for photo in photos]),
        offset=np.append(0, ends[:-1]).astype(np.int32),
        size=sizes.astype(np.int32),
        cameras=stack_cameras([photo.camera for photo in photos], [frame.name for frame in chosen]),
        near=bounds[:, 0],
        far=bounds[:, 1],
        mask=masks,
        names=tuple(frame.name for frame in chosen),
        background=background if photos[0].pixels.shape[-1] == 4 else None,
    )


def stack_cameras(cameras, names):
    """Returns one Camera [V] in float32 of several; ValueError if no one lens model holds all of them."""
    lenses = {camera.lens for camera in cameras}
    lens = max(lenses, key=list(_LENSES).index)
    if lens == "fisheye" and len(lenses) > 1:
        kinds = ", ".join(f"{name} {camera.lens}" for name, camera in zip(names[:9], cameras, strict=False))
        raise ValueError(f"the images mix lenses ({kinds}), wanted fisheye alone or none; undistort them")
    distortion = None
    if lens != "pinhole":
        distortion = np.zeros((len(cameras), _LENSES[lens]), np.float32)
        for row, camera in zip(distortion, cameras, strict=True):
            given = () if camera.distortion is None else camera.distortion
            row[: len(given)] = given
    sizes = {(camera.height, camera.width) for camera in cameras}
    height, width = sizes.pop() if len(sizes) == 1 else (None, None)
    numbers = {
        name: np.float32([getattr(camera, name) for camera in cameras])
        for name in ("to_world", "focal", "center")
    }
    return Camera(**numbers, distortion=distortion, lens=lens, height=height, width=width)


def full_width(capture):
    """Returns how wide the widest photograph is, in px, where all are as large as their cameras say."""
    return max(frame.camera.width or image_size(frame.image)[0] for frame in capture.frames)


def image_files(folder):
    """Returns the images in a folder, by name."""
    return sorted(path for path in folder.glob("*") if path.suffix.lower() in IMAGES)


def smaller_folders(folder):
    """Returns N -> path of the folders images_N in a scene's folder."""
    found = {path.name.removeprefix("images_"): path for path in folder.glob("images_*") if path.is_dir()}
    return {int(number): path for number, path in found.items() if number.isascii() and number.isdigit()}


def _smaller_copies(frames, factor):
    """Returns the frames with images as small as the factor allows, and what is left of the factor."""
    folders = {frame.image.parent for frame in frames}
    first = frames[0].image.parent
    if len(folders) > 1 or not (first.name == "images" or first.name.startswith("images_")):
        return frames, factor
    there = smaller_folders(first.parent)
    if first.name == "images":
        there.setdefault(1, first)
    fitting = [number for number in there if number and factor % number == 0]
    if not fitting:
        names = ", ".join(f"images_{number}" for number in sorted(there))
        raise ValueError(
            f"{first.parent}: has {names} and no images, factor is {factor}; choose data.factor among these"
        )
    number = max(fitting)
    if there[number] == first:
        return frames, factor // number
    # Tools that shrink images rename them, too, or only change their kind; they keep the order.
    files, before = image_files(there[number]), image_files(first)
    if len(files) != len(before):
        if 1 in there:
            return frames, factor
        raise ValueError(f"{there[number]}: has {len(files)} images, {first.name} has {len(before)}; mend it")
    copies = dict(zip(before, files, strict=True))
    return tuple(frame._replace(image=copies[frame.image]) for frame in frames), factor // number


def _read(frame, shrink, background):
    """Returns the _Photo of a frame."""
    camera = frame.camera
    declared = None if None in (camera.height, camera.width) else (camera.height, camera.width)
    pixels = read_image(frame.image, stored=declared)
    if background is None:
        pixels = pixels[..., :3]
    full = pixels.shape[:2]
    if declared is not None:
        check_size(frame.image, full, declared)
    mask = None
    if frame.mask is not None:
        mask = read_mask(frame.mask, stored=full)
        if mask.shape != full:
            raise ValueError(
                f"{frame.mask}: is {mask.shape[1]} x {mask.shape[0]}, wanted {full[1]} x {full[0]} as "
                f"{frame.image.name}; make it again"
            )
    if shrink > 1:
        pixels, mask = _shrink(frame.image, pixels, mask, shrink, background)
    scale = np.array(full[::-1]) / (declared or full)[::-1] / shrink
    camera = dataclasses.replace(
        camera,
        focal=camera.focal * scale,
        center=camera.center * scale,
        height=pixels.shape[0],
        width=pixels.shape[1],
    )
    return _Photo(pixels, mask, camera)


def check_size(path, found, declared):
    """Raises a ValueError unless an image is as large as its camera, or all of it that many times smaller."""
    times = max(round(declared[0] / found[0]), 1)
    if any(abs(want / times - have) >= 1 for want, have in zip(declared, found, strict=True)):
        raise ValueError(
            f"{path}: is {found[1]} x {found[0]}, its camera is for {declared[1]} x {declared[0]}; wanted "
            "that size or a whole part of it; copy the original or correct the camera"
        )


def _shrink(path, pixels, mask, shrink, background):
    height, width = (side // shrink * shrink for side in pixels.shape[:2])
    if not height or not width:
        raise ValueError(f"{path}: is {pixels.shape[1]} x {pixels.shape[0]}, too small for factor {shrink}")
    small = average_blocks(pixels[:height, :width], shrink, background=background)
    if mask is not None:  # a pixel counts where all of it does
        mask = mask[:height, :width].reshape(height // shrink, shrink, width // shrink, shrink).all((1, 3))
    return small, mask


def _alike(images):
    """Returns the pixels [P, C] of images, of one type and with one number of channels."""
    channels = max(image.shape[-1] for image in images)
    dtype = max((image.dtype for image in images), key=lambda dtype: dtype.itemsize)
    total = sum(image.shape[0] * image.shape[1] for image in images)
    pixels, first = np.full((total, channels), np.iinfo(dtype).max, dtype), 0
    for image in images:
        count = image.shape[0] * image.shape[1]
        part = image.reshape(count, -1)
        if image.dtype != dtype:
            part = part.astype(dtype) * dtype.type(257)
        pixels[first : first + count, : part.shape[1]] = part
        first += count
    return pixels
