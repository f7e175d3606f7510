"""The embedded house: exact depths and free space, and a walk whose cameras look at no common point."""

import numpy as np
import pytest

from jaxnerf.data.geometry.poses import travel
from test_scenes import house, room, synthetic_capture


def test_the_depth_is_that_of_marching_through_free_space_in_all_rooms_and_outside():
    rng = np.random.default_rng(0)
    progress = np.linspace(0, 1, 60)
    origins = np.column_stack([house.along_path(progress), np.full(60, house.FLOOR + 1.5)])
    assert not room.is_matter(origins, house.HOUSE).any()
    directions = rng.normal(size=origins.shape) * [1, 1, 0.3]
    hits = room.trace(origins, directions, house.HOUSE)
    fractions = np.linspace(0, 1, 1500)[:-1]
    x = origins[:, None] + (hits.t[:, None] * fractions)[..., None] * directions[:, None]
    assert not room.is_matter(x, house.HOUSE).any()
    beyond = origins + (hits.t * (1 + 1e-9))[:, None] * directions
    assert room.is_matter(beyond, house.HOUSE).all()
    far = hits.t * np.linalg.norm(directions, axis=1)
    assert (far[progress < 0.5] < 9).mean() > 0.8 and far.max() > 30


@pytest.mark.parametrize(("place", "travels"), [("room", False), ("house", True)])
def test_only_the_cameras_of_the_walk_look_at_no_common_point(place, travels):
    poses = synthetic_capture._path_poses(synthetic_capture.PLACES[place], 60, 0, 0)
    assert travel(poses) == travels
