"""The images of the study of exposures."""

import numpy as np

import captures
from studies import study

exposures = study("benchmark/exposures")
changed_views = study("benchmark/changed_views")


def test_factors_are_in_their_ranges_and_belong_to_images():
    gains = exposures.factors(2000, 0)
    low, high = changed_views.FACTORS
    assert 0.9 * low < gains.min() < 0.95 * low and 1.05 * high < gains.max() < 1.1 * high
    np.testing.assert_allclose(np.log(gains).mean(), np.log(low * high) / 2, atol=0.02)
    views = captures.black_views(captures.orbit(3, height=4, width=5))
    views.pixels[:] = 100
    found = exposures.changed(views, np.float64([[1, 1, 1], [0.6, 0.7, 0.8], [3, 1, 1]]))
    np.testing.assert_array_equal(found.pixels.reshape(3, 20, 3)[:, 7], [[100] * 3, [60, 70, 80], [255, 100, 100]])
    assert (views.pixels == 100).all()


def test_a_row_has_a_cell_for_each_head():
    found = {"psnr": 20.0, "psnr_exposure_aligned": 25.0, "psnr_exposure_half": 24.0}
    assert len(exposures.row("fox", found, True, 100)) == len(exposures.HEADS)
