"""The sheet that evaluation writes shows whatever a rendering holds."""

import imageio.v3 as iio
import numpy as np
import pytest

from jaxnerf import Rendering
from jaxnerf.evaluation.pictures import sheet_row, write_sheet


@pytest.mark.parametrize("far", [6.0, np.inf])
def test_sheet_shows_near_bright_and_no_end_black(tmp_path, far):
    depth = np.array([[2.0, 4.0], [5.0, far]], np.float32)
    image = Rendering(
        rgb=np.zeros((2, 2, 3)),
        opacity=np.ones((2, 2)),
        depth=depth,
        disparity=np.full((2, 2), np.inf),  # as where a sample lies at t = 0
        weights=None,
        num_dropped=np.zeros((2, 2), np.int32),
    )
    with np.errstate(all="raise"):
        write_sheet(tmp_path / "sheet.png", [sheet_row(np.ones((2, 2, 3)), image)])
    sheet = iio.imread(tmp_path / "sheet.png")
    assert sheet.shape == (2, 10, 3)
    shades = sheet[:, 8:, 0].ravel()
    assert shades[0] == 255 and shades[3] == 0 and shades[0] > shades[1] > shades[2]


def test_sheet_of_nothing_but_infinity_is_black(tmp_path):
    flat = np.zeros((2, 2))
    image = Rendering(
        rgb=np.zeros((2, 2, 3)),
        opacity=flat,
        depth=flat + np.inf,
        disparity=flat,
        weights=None,
        num_dropped=flat,
    )
    write_sheet(tmp_path / "sheet.png", [sheet_row(np.ones((2, 2, 3)), image)])
    assert iio.imread(tmp_path / "sheet.png")[:, 8:].max() == 0
