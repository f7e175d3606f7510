"""Finds views of a test split that are training views, too, so that their scores are not those of held-out views."""

import os
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np

from jaxnerf.data.images.load_images import scored_splits, split_indices
from jaxnerf.data.readers.base import Capture
from jaxnerf.runtime.fingerprint import file_sha256


class SharedView(NamedTuple):
    """A test view that is a training view, too.

    Attributes:
        name: of the test view.
        training_name: of the training view.
        reason: "the same file" or "the same bytes".
    """

    name: str
    training_name: str
    reason: str


def shared_views(capture: Capture, split: str, train: Sequence[int] | np.ndarray | None = None) -> list[SharedView]:
    """Returns the views of a split that are training views, too.

    Only files are compared: `jaxnerf-check` finds equal images of different files, too. Most datasets end
    without a file being read, since no two have one size.

    Args:
        capture: any.
        split: "test" or "val".
        train: indices of the training views; None: those of the split "train".

    Raises:
        ValueError: if a split is empty.
    """
    train = split_indices(capture, "train") if train is None else train
    rest, found, images = list(split_indices(capture, split)), {}, [frame.image for frame in capture.frames]
    sizes = {index: os.path.getsize(images[index]) for index in (*train, *rest)}
    for reason, key in {"the same file": _identity, "the same bytes": file_sha256}.items():
        common = {sizes[index] for index in train} & {sizes[index] for index in rest}
        known = {key(images[index]): index for index in reversed(train) if sizes[index] in common}
        pairs = {index: known.get(key(images[index])) for index in rest if sizes[index] in common}
        found |= {index: (other, reason) for index, other in pairs.items() if other is not None}
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


def _identity(path):
    state = os.stat(path)
    return state.st_dev, state.st_ino
