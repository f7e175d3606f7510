"""What is wrong with photographs beside the others of their capture."""

from collections import Counter

import numpy as np

from jaxnerf.capture_check.findings import Finding, named
from jaxnerf.data.geometry.world import poses_of

_SAME = 0.0015  # mean difference of thumbnails, in [0, 1], below which two show one picture
_PLAIN = 1e-6  # sharpness of what has no texture at all
_BLURRED = 0.25  # of the sharpness of the views beside


def compare(capture, photos, near):
    """Returns Findings about sizes, alpha, masks, duplicates and blur; near [V, K] are views beside each."""
    there = [index for index, photo in enumerate(photos) if photo is not None]
    findings = _odd_sizes(capture, photos, there) + _odd_alpha(capture, photos, there) + _odd_masks(capture)
    return findings + _duplicates(capture, photos, there) + _blurred(capture, photos, near)


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
                f"{named(capture, few)} has {has}, unlike the other {len(there) - len(few)}",
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
    found = f"{named(capture, without)} has no mask, {len(capture.frames) - len(without)} others have"
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
        share = photos[index].sharpness / max(np.median(beside), _PLAIN)
        if np.median(beside) > _PLAIN and share < _BLURRED:
            found = f"{capture.frames[index].image} has {100 * share:.0f} % of the detail of the views beside"
            findings.append(Finding("note", "blur", found, "sharp images", "leave that image out", (index,)))
    return findings
