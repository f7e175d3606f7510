"""From the photographs of a Capture to Views: reading, shrinking, masks, lenses, who is held out."""

import dataclasses
from concurrent.futures import ThreadPoolExecutor
from typing import NamedTuple

import numpy as np

from jaxnerf.core.structs import Camera, Views
from jaxnerf.data.checks import check_background, check_factor
from jaxnerf.data.copies import choose_copies
from jaxnerf.data.images import average_blocks, fits, read_image, read_mask

_LENSES = {"pinhole": 0, "opencv": 5, "fisheye": 4}  # coefficients


class _Photo(NamedTuple):
    pixels: np.ndarray  # [H, W, C]
    mask: np.ndarray | None  # [H, W] bool
    camera: Camera  # of these pixels


def split_indices(capture, split, *, hold=8):
    """Returns the indices [N] of a split's frames.

    The capture's own splits count where it has some; training has all the others where it is not named, and
    so has the test where only training is. Otherwise every hold-th by name, from the first, is held out as
    "test"; "val" is the same, and so it is where a capture has only one of the two.

    Raises:
        ValueError: if there is no such split, or nothing in it.
    """
    if split not in ("train", "val", "test"):
        raise ValueError(f"{capture.source}: split is {split!r}, wanted 'train', 'val' or 'test'; give one")
    if capture.splits:
        other = {"val": "test", "test": "val"}.get(split, split)
        rest = np.setdiff1d(np.arange(len(capture.frames)), sum(capture.splits.values(), ()))
        chosen = np.array(capture.splits.get(split, capture.splits.get(other, rest)), int)
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
    frames, shrink = choose_copies(capture.frames, factor)
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
    pixels = _alike([photo.pixels for photo in photos])
    return Views(
        pixels=pixels,
        offset=np.append(0, ends[:-1]).astype(np.int32),
        size=sizes.astype(np.int32),
        cameras=stack_cameras([photo.camera for photo in photos], [frame.name for frame in chosen]),
        near=bounds[:, 0],
        far=bounds[:, 1],
        mask=masks,
        names=tuple(frame.name for frame in chosen),
        background=background if pixels.shape[-1] == 4 else None,
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


def _read(frame, shrink, background):
    """Returns the _Photo of a frame."""
    camera = frame.camera
    declared = camera.height, camera.width
    pixels = read_image(frame.image, stored=declared, turn=frame.turned)
    if background is None:
        pixels = pixels[..., :3]
    full = pixels.shape[:2]
    check_size(frame.image, full, declared)
    mask = None if frame.mask is None else _read_mask(frame, full)
    if shrink > 1:
        pixels, mask = _shrink(frame.image, pixels, mask, shrink, background)
    scale = np.array(full[::-1]) / declared[::-1] / shrink
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
    if not fits(found, declared):
        raise ValueError(
            f"{path}: is {found[1]} x {found[0]}, its camera is for {declared[1]} x {declared[0]}; wanted "
            "that size or a whole part of it; copy the original or correct the camera"
        )


def _read_mask(frame, full):
    """Returns the mask [H, W] of a frame at its image's size; a mask for the original shrinks with it."""
    mask = read_mask(frame.mask, stored=full)
    times = max(round(mask.shape[0] / full[0]), 1)
    if not fits(full, mask.shape) or any(
        times * have > side for have, side in zip(full, mask.shape, strict=True)
    ):
        raise ValueError(
            f"{frame.mask}: is {mask.shape[1]} x {mask.shape[0]}, wanted {full[1]} x {full[0]} as "
            f"{frame.image.name}; make it again"
        )
    return _all_blocks(mask, *full, times)


def _all_blocks(mask, height, width, times):
    """Returns [height, width] bool: a pixel counts where all of its block of the mask does."""
    return mask[: height * times, : width * times].reshape(height, times, width, times).all((1, 3))


def _shrink(path, pixels, mask, shrink, background):
    height, width = (side // shrink * shrink for side in pixels.shape[:2])
    if not height or not width:
        raise ValueError(f"{path}: is {pixels.shape[1]} x {pixels.shape[0]}, too small for factor {shrink}")
    small = average_blocks(pixels[:height, :width], shrink, background=background)
    return small, None if mask is None else _all_blocks(mask, height // shrink, width // shrink, shrink)


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
