"""What a page offers before the first state of a training is there."""

from types import SimpleNamespace

import numpy as np
import pytest

from jaxnerf.tools.viewer.page import Page
from jaxnerf.training.config import RunConfig


@pytest.mark.parametrize("contracted, expected", [(False, 1.3), (True, 8.0)])
def test_the_crop_limits_are_those_of_the_grid_that_will_be_trained(contracted, expected):
    """Contracted space has no limits; there they are twice the distance of the cameras."""
    schedule = SimpleNamespace(lower=(-1.3,) * 3, upper=(1.3,) * 3, contracted=contracted)
    experiment = SimpleNamespace(config=RunConfig(), model=SimpleNamespace(grid_schedule=schedule))
    viewer = SimpleNamespace(state=None, run=SimpleNamespace(experiment=experiment))
    page = SimpleNamespace(_viewer=viewer, _size=4.0, _target=np.zeros(3))
    lower, upper = Page._crop_range(page)
    np.testing.assert_allclose([lower, upper], [[-expected] * 3, [expected] * 3], rtol=1e-6)


def test_uncertainty_is_offered_where_the_run_has_it():
    for state, last in ((None, "normals"), (state_with(None), "normals"), (state_with(abs), "uncertainty")):
        assert Page._modes(SimpleNamespace(_viewer=SimpleNamespace(state=state)))[-1] == last


def state_with(uncertainty_at):
    return SimpleNamespace(uncertainty_at=uncertainty_at)


@pytest.mark.parametrize(
    "mode, uncertain, requests",
    [("uncertainty", False, 1), ("uncertainty", True, 0), ("colour", True, 1), ("depth", True, 0), ("colour", None, 1)],
)
def test_a_frame_is_requested_where_the_last_one_does_not_hold_the_mode(mode, uncertain, requests):
    calls = []
    page = SimpleNamespace(_mode=SimpleNamespace(value=mode), _delivery=None)
    if uncertain is not None:
        page._delivery = SimpleNamespace(frame=SimpleNamespace(uncertain=uncertain))
    page._request, page._redraw = (lambda name=name: calls.append(name) for name in ("request", "redraw"))
    Page._change_mode(page)
    assert calls == ["request"] * requests or (calls == ["redraw"] and not requests)


@pytest.mark.parametrize("outwards, distance", [(False, 3.0), (True, 0.2)])
def test_a_view_turns_about_what_cameras_look_at_or_about_its_own_place_where_they_travel(outwards, distance):
    turns = [np.diag([1.0, 1, 1]), np.diag([-1.0, 1, -1])]  # looking along -z and along z
    eyes = [[0.5, 0, 3], [0, 0, -3]]
    poses = np.stack([np.column_stack([turn, eye]) for turn, eye in zip(turns, eyes[:: 1 - 2 * outwards], strict=True)])
    page = SimpleNamespace(_poses=poses, _size=4.0, _target=np.zeros(3))
    pose = np.column_stack([np.eye(3), [0.5, 0, 3]])
    np.testing.assert_allclose(Page._look_at(page, pose), [0.5, 0, 3 - distance])
