"""Finds views of a test split that are training views, too, so that their scores are not those of held-out views."""

import filecmp
import os
from collections import defaultdict
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
from PIL import Image

from jaxnerf.data.geometry.world import poses_of
from jaxnerf.data.images.image_files import read_image
from jaxnerf.data.images.load_images import scored_splits, split_indices
from jaxnerf.data.readers.base import Capture

_SAMPLES, _SAMPLE = 3, 4096  # bytes of files of one size that are compared before the whole files are
_SAME_POSE = 1e-5  # of the cameras' spread, and of an axis: files may have five digits
_MAX_DECODED = 64  # test images that are compared with a training image of the same pose
_THUMBNAIL = 16  # px
_MEAN, _LARGEST = 0.005, 0.03  # differences of grey thumbnails, in [0, 1], that compression explains


class SharedView(NamedTuple):
    """A test view that is a training view, too.

    Attributes:
        name: of the test view.
        training_name: of the training view.
        reason: "the same file", "the same bytes" or "the same pose and image".
    """

    name: str
    training_name: str
    reason: str


def shared_views(capture: Capture, split: str, train: Sequence[int] | np.ndarray | None = None) -> list[SharedView]:
    """Returns the views of a split that are training views, too.

    Paths are compared first, then bytes of files of one size, then images of one pose; most datasets end after the
    first two without reading a file.

    Args:
        capture: any.
        split: "test" or "val".
        train: indices of the training views; None: those of the split "train".

    Raises:
        ValueError: if a split is empty.
    """
    train = split_indices(capture, "train") if train is None else train
    rest, found = list(split_indices(capture, split)), {}
    searches = {"the same file": _same_file, "the same bytes": _same_bytes, "the same pose and image": _same_pose}
    for reason, search in searches.items():
        pairs = search(capture, rest, train)
        found |= {index: (other, reason) for index, other in pairs.items()}
        rest = [index for index in rest if index not in found]
    names = [frame.name for frame in capture.frames]
    return [SharedView(names[index], names[other], reason) for index, (other, reason) in sorted(found.items())]


def found_by_split(capture: Capture, select: Callable[[int], np.ndarray] | None) -> dict[str, dict[str, Any]]:
    """Returns {split: {"count", "names", "note"}} of the splits "test" and "val" with views that are trained on.

    Args:
        capture: any.
        select: the training views that are used, see `selection`; None: all.

    Raises:
        ValueError: if a split is empty.
    """
    train = split_indices(capture, "train")
    train = train if select is None else train[select(len(train))]
    found = {split: _summary(capture, split, train) for split in scored_splits(capture)}
    if len(found) == 1:  # the one that is defined stands for the other
        found |= dict.fromkeys(("test", "val"), *found.values())
    return {split: summary for split, summary in found.items() if summary}


def _summary(capture, split, train):
    """Returns what `found_by_split` does of a split; None without shared views."""
    shared = shared_views(capture, split, train)
    if not shared:
        return None
    first = shared[0]
    example = f"{first.name} is {first.training_name}, {first.reason}"
    if first.name == first.training_name:
        example = f"{first.name} is {first.reason}"
    note = (
        f"{len(shared)} of {len(split_indices(capture, split))} views of the split {split!r} are training views, too "
        f"({example}): their scores are not those of held-out views"
    )
    return {"count": len(shared), "names": [view.name for view in shared], "note": note}


def _same_file(capture, rest, train):
    frames = capture.frames
    files = {_identity(frames[index].image): index for index in reversed(train)}
    pairs = {index: files.get(_identity(frames[index].image)) for index in rest}
    return {index: other for index, other in pairs.items() if other is not None}


def _identity(path):
    state = os.stat(path)
    return state.st_dev, state.st_ino


def _same_bytes(capture, rest, train):
    frames, sizes = capture.frames, defaultdict(list)
    for index in train:
        sizes[os.path.getsize(frames[index].image)].append(index)
    pairs = {}
    for index in rest:
        image = frames[index].image
        for other in sizes.get(size := os.path.getsize(image), ()):
            candidate = frames[other].image
            if _sample(image, size) == _sample(candidate, size) and filecmp.cmp(image, candidate, shallow=False):
                pairs[index] = other
                break
    return pairs


def _sample(path, size):
    with open(path, "rb") as file:
        parts = []
        for place in np.linspace(0, max(size - _SAMPLE, 0), _SAMPLES).astype(int):
            file.seek(place)
            parts.append(file.read(_SAMPLE))
    return b"".join(parts)


def _same_pose(capture, rest, train):
    poses, frames = poses_of(capture), capture.frames
    spread = np.linalg.norm(np.ptp(poses[:, :, 3], axis=0)) or 1.0
    poses = np.concatenate([poses[:, :, :3].reshape(-1, 9), (poses[:, :, 3] - poses[0, :, 3]) / spread], axis=1)
    pairs, decoded = {}, 0
    for index in rest:
        near = np.flatnonzero(np.abs(poses[train] - poses[index]).max(axis=1) < _SAME_POSE)
        others = [train[place] for place in near if frames[train[place]].time == frames[index].time]
        if others and decoded < _MAX_DECODED:
            decoded += 1
            if _same_image(frames[index].image, frames[others[0]].image):
                pairs[index] = others[0]
    return pairs


def _same_image(*paths):
    """Returns whether two image files show the same, perhaps at another size or quality; False if one is unreadable."""
    try:
        first, second = (_thumbnail(path) for path in paths)
    except ValueError:
        return False
    off = np.abs(first - second)
    return bool(off.mean() < _MEAN and off.max() < _LARGEST)


def _thumbnail(path):
    pixels = read_image(path, follow_exif=False)
    values = np.float32(pixels) / np.iinfo(pixels.dtype).max
    color = values[..., :3] * values[..., 3:] + 1 - values[..., 3:] if values.shape[-1] == 4 else values
    grey = Image.fromarray(color @ np.float32([0.299, 0.587, 0.114]))  # compression changes colours more
    return np.asarray(grey.resize((_THUMBNAIL, _THUMBNAIL), Image.BOX))
