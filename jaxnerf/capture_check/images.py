"""The photographs of a capture, opened as training would, and what is kept of each."""

from concurrent.futures import ThreadPoolExecutor
from typing import NamedTuple

import numpy as np

from jaxnerf.capture_check import features
from jaxnerf.capture_check.findings import Finding
from jaxnerf.data.images.decode import check_size
from jaxnerf.data.images.image_files import read_image, read_mask

_THUMB = 24  # px, side of what stands for a photograph when looking for others like it


class Photo(NamedTuple):
    """What is kept of a photograph."""

    size: tuple[int, int]  # (height, width) px on disk
    channels: int
    factor: int  # it was shrunk by
    features: features.Features  # in the px that the camera counts
    thumbnail: np.ndarray  # [24, 24] grey
    sharpness: float


def read(capture):
    """Returns the Photo of every frame, None where it cannot be read, and Findings."""

    def one(item):
        try:
            return _read(item[1]), None
        except ValueError as error:
            return None, _unreadable(item[0], str(error))

    with ThreadPoolExecutor(2) as pool:  # most of it is numpy and zlib outside Python's lock
        both = list(pool.map(one, enumerate(capture.frames)))
    return [photo for photo, _ in both], [finding for _, finding in both if finding]


def _read(frame):
    camera = frame.camera
    declared = None if None in (camera.height, camera.width) else (camera.height, camera.width)
    pixels = read_image(frame.image, stored=declared, turn=frame.turned)
    size = pixels.shape[:2]
    if declared is not None:
        check_size(frame.image, size, declared)
    grey, factor = features.shrink(pixels)
    corners = features.find(grey, factor)
    if frame.mask is not None:
        mask = read_mask(frame.mask, stored=size)
        if mask.shape != size:
            raise ValueError(
                f"{frame.mask}: is {mask.shape[1]} x {mask.shape[0]}, wanted {size[1]} x {size[0]} as "
                f"{frame.image.name}; make it again"
            )
        x, y = np.minimum(corners.pixels.astype(int), np.array(size[::-1]) - 1).T
        corners = features.Features(corners.pixels[mask[y, x]], corners.descriptors[mask[y, x]])
    scale = np.array(declared or size)[::-1] / size[::-1]
    corners = corners._replace(pixels=corners.pixels * scale)
    bend = 4 * grey[1:-1, 1:-1] - grey[2:, 1:-1] - grey[:-2, 1:-1] - grey[1:-1, 2:] - grey[1:-1, :-2]
    sharpness = float(bend.std()) if bend.size else 0.0
    return Photo(size, pixels.shape[-1], factor, corners, _thumbnail(grey), sharpness)


def _thumbnail(grey):
    rows, columns = (np.linspace(0, size, _THUMB + 1).astype(int)[:-1] for size in grey.shape)
    if min(grey.shape) < _THUMB:
        return grey[np.ix_(rows, columns)]
    sums = np.add.reduceat(np.add.reduceat(grey, rows, axis=0), columns, axis=1)
    areas = np.outer(np.diff(np.append(rows, grey.shape[0])), np.diff(np.append(columns, grey.shape[1])))
    return sums / areas


def _unreadable(index, message):
    """Returns the Finding of a reader's message: file: what was found, wanted ...; what to do."""
    found, _, rest = message.partition(", wanted ")
    if not rest:
        found, _, rest = message.partition("; wanted ")
    wanted, _, change = rest.partition("; ")
    kind = "size" if " x " in wanted or "that size" in wanted else "file"
    return Finding("ruins", kind, found, wanted or "a whole image", change or "copy the file again", (index,))
