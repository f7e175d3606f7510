"""Rays inside a pixel, scores after equal seconds, and flicker."""

import numpy as np
import pytest

from jaxnerf.core.cameras import pixel_grid
from studies import study

multiscale = study("multiscale/multiscale")
zoom = study("multiscale/zoom")
equal_seconds = study("multiscale/equal_seconds")


@pytest.mark.parametrize("side", [1, 2, 4])
def test_subpixels_cover_each_pixel_evenly(side):
    places = np.asarray(multiscale.subpixels(3, 5, side)).reshape(3, side, 5, side, 2)
    np.testing.assert_allclose(places.mean((1, 3)), pixel_grid(3, 5), atol=1e-6)
    steps = np.diff(places[0, 0].reshape(-1, 2)[:, 0])
    np.testing.assert_allclose(steps, 1 / side, atol=1e-6)


def test_scores_after_equal_seconds_are_interpolated_between_checkpoints():
    scores = [{"1x1": 10.0 + at, "8x4": 20.0 + at} for at in (2, 4, 6)]
    found = equal_seconds.psnr_at([2.0, 5.0, 9.0], [2.0, 4.0, 6.0], scores, "8x4")
    assert found == ["12.00 / 22.00", "15.00 / 25.00", "16.00 / 26.00"]
    assert equal_seconds.psnr_at([1.5], [2.0, 4.0, 6.0], scores, "8x4") == ["-"]


def test_flicker_is_what_changes_and_should_not():
    exact = np.random.default_rng(0).uniform(0, 0.5, (4, 5, 6, 3))
    assert zoom.flicker(exact + 0.1, exact) == pytest.approx(0)
    flashing = exact + np.array([0, 0.1, 0, 0.1])[:, None, None, None]
    assert zoom.flicker(flashing, exact) == pytest.approx(0.1)


def test_the_middle_of_an_image():
    pixels = np.asarray(pixel_grid(8, 12))
    np.testing.assert_array_equal(zoom.middle(pixels, 0.5), pixels[2:6, 3:9])
    np.testing.assert_array_equal(zoom.middle(pixels, 1.0), pixels)
