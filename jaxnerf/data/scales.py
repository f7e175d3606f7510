"""Images at several sizes, so that training sees pixels of several footprints (arXiv:2103.13415, Section 4)."""

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from jaxnerf.core.views import Views
from jaxnerf.data.images.image_files import average_tiles


def with_scales(views: Views, num_scales: int) -> Views:
    """Adds the images shrunk by 2, 4, 8 and so on.

    The losses of a pixel weigh as its side. With its area as the weight (arXiv:2103.13415, Section 4), all sizes count
    alike, but the few rays of large pixels make most of the gradient: full-size images lose more than small ones gain.

    Args:
        views: in numpy, on the host. Their pixels are copied.
        num_scales: sizes, that of the views included.

    Returns:
        Views of all sizes, the largest first, with their loss_weight, and with the sparse points of the largest.

    Raises:
        ValueError: if an image has no pixel at the smallest size, or there are 2^31 pixels or more.
    """
    parts = [views]
    for scale in range(1, num_scales):
        parts.append(shrink_views(views, 2**scale))
    counts = [len(part.pixels) for part in parts]
    if sum(counts) >= 2**31:  # offsets and pixel ids are int32
        raise ValueError(f"data.num_scales is {num_scales}: {sum(counts)} pixels, expected fewer than 2^31; lower it")
    sides = 2.0 ** np.arange(num_scales)
    return _joined(parts, np.float32(sides / (sides @ counts / sum(counts))))


def shrink_views(views: Views, factor: int) -> Views:
    """Shrinks images by a whole number: each pixel is the mean of factor x factor, see `average_tiles`.

    What remains of an image at its right and bottom is cropped. A pixel of which a part is masked is masked. Sparse
    points are dropped.

    Raises:
        ValueError: if an image has no pixel left; names it.
    """
    size = np.asarray(views.size) // factor
    if not size.all():
        index = int(np.argmin(size.min(axis=1)))
        height, width = views.size[index]
        raise ValueError(
            f"view {views.names[index] if views.names else index}: is {width} x {height} px, too small to be shrunk by "
            f"{factor}; lower data.num_scales"
        )
    dtype, cameras = views.pixels.dtype, views.cameras

    def shrunk(image):
        mean = average_tiles(image, factor, background=views.background)
        return mean if dtype == np.uint16 else np.rint(mean / 257).astype(dtype)

    def all_in_tiles(mask):
        height, width = mask.shape
        return mask.reshape(height // factor, factor, width // factor, factor).all((1, 3))

    camera_size = {name: getattr(cameras, name) for name in ("height", "width")}
    return dataclasses.replace(
        views,
        pixels=_of_images(shrunk, views, views.pixels, factor),
        offset=np.append(0, np.cumsum(size.prod(axis=1))[:-1]).astype(np.int32),
        size=size.astype(np.int32),
        mask=None if views.mask is None else _of_images(all_in_tiles, views, views.mask, factor),
        sparse=None,
        cameras=dataclasses.replace(
            cameras,
            focal=cameras.focal / np.float32(factor),
            center=cameras.center / np.float32(factor),
            **{name: side and side // factor for name, side in camera_size.items()},
        ),
    )


def _of_images(function: Callable[[Any], np.ndarray], views: Views, values: np.ndarray, factor: int) -> np.ndarray:
    """Returns the results of a function of the values [H, W, ...] of each image, cropped to multiples of a factor."""
    results = []
    for first, (height, width) in zip(views.offset, np.asarray(views.size), strict=True):
        image = np.asarray(values[first : first + height * width]).reshape(height, width, *values.shape[1:])
        result = function(image[: height - height % factor, : width - width % factor])
        results.append(result.reshape(-1, *values.shape[1:]))
    return np.concatenate(results)


def _joined(parts: Sequence[Views], weights: np.ndarray) -> Views:
    """Returns the Views of all parts, which are the same views at several sizes with these loss_weights."""
    first, count = parts[0], len(parts[0].size)
    starts = np.cumsum([0, *(len(part.pixels) for part in parts[:-1])])

    def repeated(values):
        return None if values is None else np.concatenate([values] * len(parts))

    def joined(name, of=lambda part: part):
        values = [getattr(of(part), name) for part in parts]
        return None if values[0] is None else np.concatenate(values)

    cameras = {name: joined(name, lambda part: part.cameras) for name in ("to_world", "focal", "center", "distortion")}
    same = {name: repeated(getattr(first, name)) for name in ("near", "far", "free_depth", "time")}
    image_index = np.arange(count, dtype=np.int32) if first.image_index is None else first.image_index
    return dataclasses.replace(
        first,
        pixels=joined("pixels"),
        offset=np.concatenate(
            [part.offset + np.int32(start) for part, start in zip(parts, starts, strict=True)], dtype=np.int32
        ),
        size=joined("size"),
        mask=joined("mask"),
        cameras=dataclasses.replace(first.cameras, **cameras, height=None, width=None),
        names=first.names * len(parts),
        image_index=repeated(image_index),
        loss_weight=np.repeat(weights, count),
        **same,
    )
