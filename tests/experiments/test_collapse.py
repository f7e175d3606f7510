"""Captures with painted backgrounds train: the study of dead networks repeats what a saturated colour did."""

import pytest

from studies import study


@pytest.mark.extra
def test_captures_with_painted_backgrounds_train():
    """With a plain sigmoid, both seeds in front of black and one of two in front of white collapse."""
    collapse = study("stability/collapse")
    trained = collapse.PaintedStudy(480, "color_activation")
    for background in collapse.BACKGROUNDS:
        for seed in range(2):
            row = trained.run(seed, background)
            assert row["psnr"] > row["psnr_alone"] + 2, row
