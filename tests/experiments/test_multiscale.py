"""Rays inside a pixel."""

import numpy as np
import pytest

from jaxnerf.core.cameras import pixel_grid
from studies import study

multiscale = study("multiscale/multiscale")


@pytest.mark.parametrize("side", [1, 2, 4])
def test_subpixels_cover_each_pixel_evenly(side):
    places = np.asarray(multiscale.subpixels(3, 5, side)).reshape(3, side, 5, side, 2)
    np.testing.assert_allclose(places.mean((1, 3)), pixel_grid(3, 5), atol=1e-6)
    steps = np.diff(places[0, 0].reshape(-1, 2)[:, 0])
    np.testing.assert_allclose(steps, 1 / side, atol=1e-6)
