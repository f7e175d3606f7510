"""What a page offers before the first state of a training is there."""

from types import SimpleNamespace

import numpy as np
import pytest

from jaxnerf.training.config import RunConfig
from jaxnerf.viewer.page import Page


@pytest.mark.parametrize("contracted, expected", [(False, 1.3), (True, 8.0)])
def test_the_crop_limits_are_those_of_the_grid_that_will_be_trained(contracted, expected):
    """Contracted space has no limits; there they are twice the distance of the cameras."""
    schedule = SimpleNamespace(lower=(-1.3,) * 3, upper=(1.3,) * 3, contracted=contracted)
    experiment = SimpleNamespace(config=RunConfig(), model=SimpleNamespace(grid_schedule=schedule))
    viewer = SimpleNamespace(state=None, run=SimpleNamespace(experiment=experiment))
    page = SimpleNamespace(_viewer=viewer, _size=4.0, _target=np.zeros(3))
    lower, upper = Page._crop_range(page)
    np.testing.assert_allclose([lower, upper], [[-expected] * 3, [expected] * 3], rtol=1e-6)
