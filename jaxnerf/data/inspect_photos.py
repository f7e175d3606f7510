"""What is wrong with the photographs of a capture, each by itself and beside the others."""

from collections import Counter
from concurrent.futures import ThreadPoolExecutor
from typing import NamedTuple

import numpy as np

from jaxnerf.data import features
from jaxnerf.data.findings import Finding
from jaxnerf.data.images import read_image, read_mask
from jaxnerf.data.photos import check_size
from jaxnerf.data.world import poses_of

_THUMB = 24  # px, side of what stands for a photograph when looking for others like it
_SAME = 0.0015  # mean difference of such, in [0, 1], below which two are one
_BLURRED = 0.25  # of the sharpness of the views beside


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


def compare(capture, photos, near):
    """Returns Findings about sizes, alpha, masks, duplicates and blur; near [V, K] are views beside each."""
    there = [index for index, photo in enumerate(photos) if photo is not None]
    findings = _odd_sizes(capture, photos, there) + _odd_alpha(capture, photos, there) + _odd_masks(capture)
    return findings + _duplicates(capture, photos, there) + _blurred(capture, photos, near)


def _read(frame):
    camera = frame.camera
    declared = None if None in (camera.height, camera.width) else (camera.height, camera.width)
    pixels = read_image(frame.image, stored=declared)
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
    return Finding(
        "ruins", kind, found, wanted or "a whole image", change or "copy the file again", (index,)
    )


def _odd_sizes(capture, photos, there):
    usual = Counter(photos[index].size for index in there).most_common(1)
    findings = []
    for index in there:
        (height, width), frame = photos[index].size, capture.frames[index]
        if (height, width) == usual[0][0] or usual[0][1] < 0.5 * len(there):
            continue
        severity = "ruins" if capture.format == "blender" else "note"
        wanted = "{1} x {0} as most".format(*usual[0][0])
        found = f"{frame.image} is {width} x {height}"
        change = "that file: copy or render it again at that size"
        findings.append(Finding(severity, "size", found, wanted, change, (index,)))
    return findings


def _odd_alpha(capture, photos, there):
    opaque = [index for index in there if photos[index].channels == 3]
    if not opaque:
        return []
    if len(opaque) < len(there):
        few = opaque if 2 * len(opaque) <= len(there) else sorted(set(there) - set(opaque))
        has = "no alpha" if few is opaque else "alpha"
        return [
            Finding(
                "ruins",
                "mask",
                f"{_named(capture, few)} has {has}, unlike the other {len(there) - len(few)}",
                "alpha in all images or in none",
                "those files: export them again as the others",
                tuple(few),
            )
        ]
    if capture.format != "blender":
        return []
    found = "no image has alpha, and a Blender scene is composited over white by default"
    change = "--config.data.background=none, or render RGBA"
    return [Finding("note", "mask", found, "RGBA, or RGB taken as it is", change)]


def _odd_masks(capture):
    without = [index for index, frame in enumerate(capture.frames) if frame.mask is None]
    if len(without) in (0, len(capture.frames)):
        return []
    found = f"{_named(capture, without)} has no mask, {len(capture.frames) - len(without)} others have"
    change = "add the missing mask files (all white where nothing is to be ignored), or remove all"
    return [Finding("ruins", "mask", found, "a mask for every image or for none", change, tuple(without))]


def _duplicates(capture, photos, there):
    if len(there) < 2:
        return []
    thumbs = np.stack([photos[index].thumbnail.reshape(-1) for index in there])
    poses, findings = poses_of(capture), []
    for place, index in enumerate(there):
        same = np.flatnonzero(np.abs(thumbs[place + 1 :] - thumbs[place]).mean(axis=1) < _SAME) + place + 1
        for other in (there[k] for k in same):
            moved = "other" if np.abs(poses[index] - poses[other]).max() > 1e-6 else "the same"
            found = f"{capture.frames[index].name} and {capture.frames[other].name} show one picture"
            findings.append(
                Finding(
                    "note",
                    "duplicate",
                    f"{found} from {moved} cameras",
                    "different photographs",
                    "remove one of the two, or copy the right file",
                    (index, other),
                )
            )
    return findings[:10]


def _blurred(capture, photos, near):
    findings = []
    for index, others in enumerate(near):
        beside = [photos[other].sharpness for other in others if photos[other] is not None]
        if photos[index] is None or len(beside) < 2:
            continue
        share = photos[index].sharpness / max(np.median(beside), 1e-9)
        if share < _BLURRED:
            found = f"{capture.frames[index].image} has {100 * share:.0f} % of the detail of the views beside"
            findings.append(Finding("note", "blur", found, "sharp images", "leave that image out", (index,)))
    return findings


def _named(capture, indices):
    names = ", ".join(capture.frames[index].name for index in indices[:5])
    return names + (f" and {len(indices) - 5} more" if len(indices) > 5 else "")
