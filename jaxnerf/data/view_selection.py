"""Which views of a split are read, and Views of some of the views."""

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any

import jax
import numpy as np
from jaxtyping import Int

from jaxnerf.core.types import SparsePoints
from jaxnerf.core.views import Views

_HELD_OUT_OFFSET = 3  # not 0, as the first views of a dataset often differ from the others


def held_out(count: int, every: int) -> Int[np.ndarray, " N"]:
    """Returns the indices of the held-out views among count, one in each `every`, in ascending order."""
    return np.arange(min(_HELD_OUT_OFFSET, every - 1), count, every)


def select_views(views: Views, indices: Sequence[int] | Int[np.ndarray, " N"]) -> Views:
    """Returns the Views of the given indices, in their order; pixels are copied."""
    indices = np.asarray(indices)
    size, first = np.asarray(views.size)[indices], np.asarray(views.offset)[indices]
    counts = size.prod(axis=1)

    def pick(values):
        return np.concatenate([values[start : start + count] for start, count in zip(first, counts, strict=True)])

    def take(leaf):
        return np.asarray(leaf)[indices]

    return dataclasses.replace(
        views,
        pixels=pick(views.pixels),
        offset=np.append(0, np.cumsum(counts)[:-1]).astype(np.int32),
        size=size,
        cameras=jax.tree.map(take, views.cameras),
        near=take(views.near),
        far=take(views.far),
        mask=None if views.mask is None else pick(views.mask),
        free_depth=None if views.free_depth is None else take(views.free_depth),
        time=None if views.time is None else take(views.time),
        image_index=None if views.image_index is None else take(views.image_index),
        names=tuple(views.names[index] for index in indices) if views.names else (),
        sparse=None if views.sparse is None else _select_observations(views.sparse, indices),
    )


def _select_observations(sparse: SparsePoints, indices: np.ndarray) -> SparsePoints:
    """Returns all points with their observations in the views of the given indices, in their order."""
    first, ends = (np.searchsorted(sparse.view, indices, side=side) for side in ("left", "right"))
    kept = np.concatenate([np.arange(*bounds) for bounds in zip(first, ends, strict=True)]).astype(int)
    return dataclasses.replace(
        sparse,
        view=np.repeat(np.arange(len(indices), dtype=np.int32), ends - first),
        point=np.asarray(sparse.point)[kept],
        pixel=np.asarray(sparse.pixel)[kept],
        confidence=None if sparse.confidence is None else np.asarray(sparse.confidence)[kept],
    )


def selection(data: Any, split: str, max_views: int | None = None) -> Callable[[int], np.ndarray] | None:
    """Returns a function from the number of views to the indices of those that a split has; None: all.

    Args:
        data: DataOptions.
        split: whose views.
        max_views: see `load_split`.
    """
    every = data.hold_out if split in ("train", "held_out") else 0
    number = data.num_views if split == "train" else 0
    named = list(data.view_indices) if split == "train" else []
    if named and number:
        raise ValueError(
            f"data.num_views is {number} and data.view_indices {data.view_indices}, expected only one of them; set "
            "data.num_views to 0 or data.view_indices to ()"
        )
    if not every and not number and not named and max_views is None:
        return None

    def select(count):
        indices = np.arange(count)
        if every:
            if not 2 <= every <= count:
                raise ValueError(
                    f"data.hold_out is {every} of {count} views, expected 2 to {count}, or 0 for none; correct it"
                )
            held = held_out(count, every)
            indices = held if split == "held_out" else np.setdiff1d(indices, held)
            count = len(indices)
        if named:
            missing = sorted(set(named) - set(indices.tolist()))
            if missing:
                raise ValueError(
                    f"data.view_indices has {missing[0]}, expected indices of training views that are not held out "
                    f"(data.hold_out {every}), below {indices[-1] + 1}; correct it"
                )
            indices = np.array(named)
        if number:
            if not 1 <= number <= count:
                raise ValueError(
                    f"data.num_views is {number} of {count} views, expected 1 to {count}, or 0 for all; correct it"
                )
            indices = _spread(indices, number)
        return indices if max_views is None else _spread(indices, max_views)

    return select


def _spread(indices, number):
    """Returns at most so many of some indices, evenly spread."""
    number = min(number, len(indices))
    return indices[np.arange(number) * len(indices) // number]
