"""Rays inside a pixel, rows at equal seconds, and flicker."""

import numpy as np
import pytest

from jaxnerf.core.cameras import pixel_grid
from studies import study

multiscale = study("multiscale/multiscale")
zoom = study("multiscale/zoom")


@pytest.mark.parametrize("side", [1, 2, 4])
def test_subpixels_cover_each_pixel_evenly(side):
    places = np.asarray(multiscale.subpixels(3, 5, side)).reshape(3, side, 5, side, 2)
    np.testing.assert_allclose(places.mean((1, 3)), pixel_grid(3, 5), atol=1e-6)
    steps = np.diff(places[0, 0].reshape(-1, 2)[:, 0])
    np.testing.assert_allclose(steps, 1 / side, atol=1e-6)


def test_rows_at_equal_seconds_are_interpolated_between_checkpoints():
    def run(*seconds, **more):
        return {
            "seconds": seconds[-1],
            "scores": {"1x1": {"psnr": 0.0, "seconds": 0.5}},
            "moments": [{"seconds": at, "1x1": 10 + at, "8x1": 20 + at, **more} for at in seconds],
        }

    rows = multiscale.at_equal_seconds("lego", {"full size": run(2, 4, 6, **{"8x4": 30.0}), "other": run(3, 6, 9)})
    assert rows == [
        ["lego", "full size, 1", "12.00 / 22.00 (2 s)", "14.00 / 24.00 (4 s)", "16.00 / 26.00 (6 s)", "0.500"],
        ["lego", "full size, 16", "12.00 / 30.00", "14.00 / 30.00", "16.00 / 30.00", "0.500"],
        ["lego", "other, 1", "-", "14.00 / 24.00", "16.00 / 26.00", "0.500"],
    ]


def test_flicker_is_what_changes_and_should_not():
    exact = np.random.default_rng(0).uniform(0, 0.5, (4, 5, 6, 3))
    assert zoom.flicker(exact + 0.1, exact) == pytest.approx(0)
    flashing = exact + np.array([0, 0.1, 0, 0.1])[:, None, None, None]
    assert zoom.flicker(flashing, exact) == pytest.approx(0.1)


def test_the_middle_of_an_image():
    pixels = np.asarray(pixel_grid(8, 12))
    np.testing.assert_array_equal(zoom.middle(pixels, 0.5), pixels[2:6, 3:9])
    np.testing.assert_array_equal(zoom.middle(pixels, 1.0), pixels)
