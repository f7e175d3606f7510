"""The photographs of frames as pixels and masks: what each becomes is known before any is decoded."""

import dataclasses
import functools
from concurrent.futures import ThreadPoolExecutor
from typing import NamedTuple

import numpy as np

from jaxnerf.data.images.image_files import average_blocks, fits, image_form, read_image, read_mask
from jaxnerf.data.images.pixel_cache import fill_pixels, workers


class Form(NamedTuple):
    """What a frame's image becomes, known from its file's first bytes."""

    full: tuple[int, int]  # (height, width) px of the file, upright
    size: tuple[int, int]  # of what it shrinks to
    channels: int
    dtype: np.dtype


def form_of(frame, shrink, background):
    """Returns the Form of a frame; ValueError where it does not fit its camera."""
    declared = frame.camera.height, frame.camera.width
    (height, width, channels), dtype = image_form(frame.image, stored=declared, turn=frame.turned)
    check_size(frame.image, (height, width), declared)
    if background is None:
        channels = 3
    if shrink == 1:
        return Form((height, width), (height, width), channels, dtype)
    if not height // shrink or not width // shrink:
        raise ValueError(f"{frame.image}: is {width} x {height}, too small for factor {shrink}")
    return Form((height, width), (height // shrink, width // shrink), channels, np.dtype(np.uint16))


def scaled_camera(frame, form, shrink):
    """Returns the Camera of what a frame's image shrinks to."""
    camera = frame.camera
    scale = np.array(form.full[::-1]) / (camera.width, camera.height) / shrink
    height, width = form.size
    return dataclasses.replace(
        camera, focal=camera.focal * scale, center=camera.center * scale, height=height, width=width
    )


def read_pixels(frames, forms, offset, shrink, background):
    """Returns the pixels [P, C] of all frames, of one type and with one number of channels."""
    channels = max(form.channels for form in forms)
    dtype = max((form.dtype for form in forms), key=lambda dtype: dtype.itemsize)
    both = list(zip(frames, forms, strict=True))
    return fill_pixels(
        [frame.image for frame in frames],
        [functools.partial(_read, frame, form, shrink, background, channels, dtype) for frame, form in both],
        shape=(sum(form.size[0] * form.size[1] for form in forms), channels),
        dtype=dtype,
        place=offset,
        depends=("photos", shrink, background, [(frame.turned, form) for frame, form in both]),
    )


def _read(frame, form, shrink, background, channels, dtype):
    """Returns the pixels [H, W, channels] of a frame."""
    camera = frame.camera
    pixels = read_image(frame.image, stored=(camera.height, camera.width), turn=frame.turned)
    if background is None:
        pixels = pixels[..., :3]
    if shrink > 1:
        height, width = (side * shrink for side in form.size)
        pixels = average_blocks(pixels[:height, :width], shrink, background=background)
    if pixels.dtype != dtype:
        pixels = pixels.astype(dtype) * dtype.type(257)
    if pixels.shape[-1] == channels:
        return pixels
    opaque = np.full((*pixels.shape[:2], 1), np.iinfo(dtype).max, dtype)
    return np.concatenate([pixels, opaque], axis=-1)


def read_masks(frames, forms, shrink):
    """Returns the mask [P] of all frames, None where none has one."""
    if all(frame.mask is None for frame in frames):
        return None

    def read(frame, form):
        if frame.mask is None:
            return np.ones(form.size, bool)
        mask = _read_mask(frame, form.full)
        return mask if shrink == 1 else _all_blocks(mask, *form.size, shrink)

    with ThreadPoolExecutor(workers()) as pool:
        return np.concatenate([mask.reshape(-1) for mask in pool.map(read, frames, forms)])


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
    if not fits(full, mask.shape) or any(times * have > side for have, side in zip(full, mask.shape, strict=True)):
        raise ValueError(
            f"{frame.mask}: is {mask.shape[1]} x {mask.shape[0]}, wanted {full[1]} x {full[0]} as "
            f"{frame.image.name}; make it again"
        )
    return _all_blocks(mask, *full, times)


def _all_blocks(mask, height, width, times):
    """Returns [height, width] bool: a pixel counts where all of its block of the mask does."""
    return mask[: height * times, : width * times].reshape(height, times, width, times).all((1, 3))
