"""Views held out of the training set: none of them is lost, and none is in both."""

import dataclasses

import jax
import numpy as np
import pytest
from jaxnerf.data.subset import held_out, select_views

from jaxnerf import Camera, Views
from jaxnerf.data.dataset import load_views
from runs import smoke_config

SIZES = [(2, 3), (1, 4), (3, 3), (2, 2)]


@pytest.fixture
def views():
    """Four small views of different sizes, in which every number tells its view."""
    counts = [height * width for height, width in SIZES]
    view = np.repeat(np.arange(4), counts)
    return Views(
        pixels=np.stack([view, np.arange(view.size)], -1).astype(np.uint16).repeat(2, axis=-1),
        offset=np.cumsum([0, *counts[:-1]]).astype(np.int32),
        size=np.int32(SIZES),
        cameras=Camera(
            to_world=np.arange(4 * 12, dtype=np.float32).reshape(4, 3, 4),
            focal=np.arange(8, dtype=np.float32).reshape(4, 2),
            center=-np.arange(8, dtype=np.float32).reshape(4, 2),
            distortion=np.arange(16, dtype=np.float32).reshape(4, 4),
            lens="fisheye",
        ),
        near=np.arange(4, dtype=np.float32),
        far=np.arange(4, 8).astype(np.float32),
        mask=np.arange(view.size) % 2 == 0,
        names=tuple("abcd"),
        background=(1.0, 0.0, 1.0),
    )


@pytest.mark.parametrize("indices", [[2], [3, 0], [1, 2, 3], np.arange(4)])
def test_a_view_keeps_all_that_is_its_own(views, indices):
    got = select_views(views, indices)
    assert got.names == tuple("abcd"[index] for index in indices)
    assert (got.cameras.lens, got.background) == ("fisheye", (1.0, 0.0, 1.0))
    ends = np.append(got.offset, len(got.pixels))
    for place, index in enumerate(indices):
        height, width = SIZES[index]
        own = slice(ends[place], ends[place + 1])
        first = views.offset[index]
        np.testing.assert_array_equal(got.pixels[own], views.pixels[first : first + height * width])
        np.testing.assert_array_equal(got.mask[own], views.mask[first : first + height * width])
        for name in ("size", "near", "far"):
            np.testing.assert_array_equal(getattr(got, name)[place], getattr(views, name)[index])
        for name in ("to_world", "focal", "center", "distortion"):
            np.testing.assert_array_equal(getattr(got.cameras, name)[place], getattr(views.cameras, name)[index])
    kinds = [[leaf.dtype for leaf in jax.tree.leaves(one)] for one in (got, views)]
    assert kinds[0] == kinds[1]


def test_all_views_in_order_are_the_views(views):
    for given in (views, dataclasses.replace(views, mask=None, names=())):
        got = select_views(given, range(4))
        assert jax.tree.structure(got) == jax.tree.structure(given)
        jax.tree.map(np.testing.assert_array_equal, got, given)


def test_pixels_are_copied(views):
    got = select_views(views, [0, 1])
    got.pixels[:] = 0
    assert views.pixels[1, 2] > 0


@pytest.mark.parametrize("count", [2, 3, 7, 60, 100])
def test_one_view_in_so_many_is_held_out(count):
    for every in range(2, count + 1):
        indices = held_out(count, every)
        assert (np.diff(indices) == every).all() and indices[0] < every and indices[-1] < count
        assert abs(indices.size - count / every) < 1
        assert indices[0] == 3 or every < 4


def test_training_and_held_out_views_are_all_and_none_is_in_both():
    data = smoke_config().data
    every = load_views(data, "train")
    data.hold_out = 7
    train, held = load_views(data, "train"), load_views(data, "held_out")
    assert len(held.offset) == 9 and len(train.offset) == 51
    assert held.names[:2] == ("train_003", "train_010")
    assert set(train.names).isdisjoint(held.names) and {*train.names, *held.names} == set(every.names)
    for part in (train, held):
        wanted = select_views(every, [every.names.index(name) for name in part.names])
        jax.tree.map(np.testing.assert_array_equal, part, wanted)
    assert load_views(data, "test").names[0] == "test_000"  # as it was


@pytest.mark.parametrize("hold_out", [1, -2, 61])
def test_what_leaves_no_view_on_one_side_is_named(hold_out):
    data = smoke_config().data
    data.hold_out = hold_out
    for split in ("train", "held_out"):
        with pytest.raises(ValueError, match=f"data.hold_out is {hold_out} of 60 views, wanted 2 to 60"):
            load_views(data, split)


def test_nothing_is_held_out_unasked():
    data = smoke_config().data
    assert len(load_views(data, "train").offset) == 60
    with pytest.raises(ValueError, match="held_out"):
        load_views(data, "held_out")
