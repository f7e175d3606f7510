"""The same images at several sizes, and rays inside a pixel."""

import numpy as np
import pytest

from jaxnerf.core.cameras import pixel_grid
from jaxnerf.data import dataset, ray_batches, synthetic
from studies import study

multiscale = study("multiscale/multiscale")


def at_size(size):
    return dataset.select_views(synthetic.load_synthetic(split="train", size=size), range(3))


def test_rays_of_joined_views_are_those_of_each_size():
    parts = [at_size(8), at_size(4)]
    views = multiscale.joined(parts)
    assert [tuple(size) for size in views.size] == [(8, 8)] * 3 + [(4, 4)] * 12
    assert len(views.pixels) == 2 * len(parts[0].pixels) == views.offset[-1] + 16
    assert len(set(views.names)) == len(views.names) == 15
    for index in (0, 2, 4, 14):
        part, place = (parts[0], index) if index < 3 else (parts[1], index % 3)
        side = int(part.size[0][0])
        np.testing.assert_array_equal(views.image(index), part.image(place))
        rays, expected = (
            ray_batches.view_rays(each, at, pixel_grid(side, side), needs=("radius",))
            for each, at in ((views, index), (part, place))
        )
        np.testing.assert_array_equal(rays.directions, expected.directions)
        np.testing.assert_array_equal(rays.radius, expected.radius)


def test_one_size_stays_as_it_is():
    views = at_size(8)
    assert multiscale.joined([views]) is views


@pytest.mark.parametrize("side", [1, 2, 4])
def test_subpixels_cover_each_pixel_evenly(side):
    places = np.asarray(multiscale.subpixels(3, 5, side)).reshape(3, side, 5, side, 2)
    np.testing.assert_allclose(places.mean((1, 3)), pixel_grid(3, 5), atol=1e-6)
    steps = np.diff(places[0, 0].reshape(-1, 2)[:, 0])
    np.testing.assert_allclose(steps, 1 / side, atol=1e-6)
