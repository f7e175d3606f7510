"""Some of the views: a part of the training views held out, to choose by without a look at the test views."""

import dataclasses

import jax
import numpy as np

_PHASE = 3  # captures often begin with views that differ from the rest, so not the first


def held_out(count, every):
    """Returns the indices of the held-out views among count, one in each `every`; ascending, int."""
    return np.arange(min(_PHASE, every - 1), count, every)


def evenly(name, count, number):
    """Returns the indices of so many views of count, evenly spread from the first; ascending, int.

    Raises:
        ValueError: if there are not so many; names the field.
    """
    if not 1 <= number <= count:
        raise ValueError(f"{name} is {number} of {count} views, wanted 1 to {count}, or 0 for all")
    return np.arange(number) * count // number


def select_views(views, indices):
    """Returns the Views of the given indices [N], in that order; pixels are copied."""
    indices = np.asarray(indices)
    size, first = np.asarray(views.size)[indices], np.asarray(views.offset)[indices]
    counts = size.prod(axis=1)

    def pick(values):
        return np.concatenate(
            [values[start : start + count] for start, count in zip(first, counts, strict=True)]
        )

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
        names=tuple(views.names[index] for index in indices) if views.names else (),
    )
