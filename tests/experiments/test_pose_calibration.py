"""The covariance of estimated poses: the true pose lies in the stated regions as often as stated."""

import pytest

from studies import study

calibration = study("pose_estimation/calibration")


@pytest.mark.extra
def test_the_covariance_is_calibrated():
    probabilities = [probability for probability, _ in calibration.trials(100)]
    assert 85 <= sum(probability <= 0.9 for probability in probabilities) <= 95
