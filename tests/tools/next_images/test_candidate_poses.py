"""Candidates for further images are where cameras could be, and belong to the group of their direction."""

import numpy as np
import pytest

import captures
from helpers import compiled
from jaxnerf.core import poses
from jaxnerf.tools.next_images.candidate_poses import azimuth_to_right, candidate_poses, farthest_poses

UP = np.array([0.0, 0.0, 1.0])
look_at = compiled(poses.look_at)


def ring(count=12, height=30.0, distance=4.0):
    """Returns poses at an angle of height, from -y on, each to the right of the one before."""
    angle, low = 2 * np.pi * np.arange(count) / count - np.pi / 2, np.radians(height)
    away = np.stack([np.cos(low) * np.cos(angle), np.cos(low) * np.sin(angle), 0 * angle + np.sin(low)], axis=-1)
    return np.stack([look_at(np.float32(distance * each), np.zeros(3), UP) for each in away])


def test_candidates_around_an_object_are_on_the_dome_of_its_cameras():
    poses = ring()
    found = candidate_poses(poses, UP)
    eyes = found.poses[:, :, 3]
    assert found.kind == "around" and len(eyes) > 50
    np.testing.assert_allclose(np.linalg.norm(eyes, axis=1), 4, rtol=1e-4)
    np.testing.assert_allclose(found.poses[:, :, 2], eyes / 4, atol=1e-4)  # they look at the middle
    height = np.degrees(np.arcsin(eyes[:, 2] / 4))
    assert 15 <= height.min() < 20 and height.max() > 80
    assert (found.group[:, 0] == np.where(height >= 60, 0, np.where(height >= 30, 1, 2))).all()
    cosines = eyes @ poses[:, :, 3].T / 16
    np.testing.assert_allclose(cosines[np.arange(len(eyes)), found.nearest], cosines.max(axis=1))


def test_no_candidate_is_below_what_an_object_stands_on_unless_a_camera_is():
    assert candidate_poses(ring(height=10.0), UP).poses[:, 2, 3].min() >= 4 * np.sin(np.radians(5)) - 1e-4
    low = candidate_poses(np.concatenate([ring(height=30.0), ring(height=-20.0)]), UP).poses[:, 2, 3]
    assert -4 * np.sin(np.radians(20)) - 1e-4 <= low.min() < -1


def test_farthest_poses_spread():
    """Of candidates on a ring those opposite of the cameras come first, and then what is between."""
    candidates = ring(12)
    assert farthest_poses(candidates[:1], candidates, 2) == [6, 3]
    assert farthest_poses(candidates[[0, 6]], candidates, 4)[:2] == [3, 9]
    assert sorted(farthest_poses(candidates[:2], candidates[:3], 9)) == [0, 1, 2]
    turned = candidates.copy()
    turned[:, :, 3] = 0  # at one place only directions differ
    assert farthest_poses(turned[:1], turned, 1) == [6]


def test_azimuth_grows_to_the_right_of_who_looks_at_the_middle():
    poses = ring()
    found = azimuth_to_right(poses[:, :, 3], poses[0, :, 3], UP)
    np.testing.assert_allclose(np.degrees(found[:4]), [0, 30, 60, 90], atol=1e-3)
    assert poses[0, :, 0] @ (poses[1, :, 3] - poses[0, :, 3]) > 0  # the second camera is to the right of the first
    candidates = candidate_poses(poses, UP)
    quarter = candidates.poses[candidates.group[:, 1] == 2][:, :, 3]  # at 90 degrees, which is +x
    assert (quarter[:, 0] > 0).all() and (np.abs(quarter[:, 1]) <= quarter[:, 0] + 1e-6).all()


def test_candidates_beside_cameras_that_look_one_way_are_in_their_plane():
    poses = np.asarray(captures.front(9).to_world)
    found = candidate_poses(poses)
    assert found.kind == "beside" and len(found.poses) == 81
    np.testing.assert_allclose(found.poses[:, 1, 3], -4, atol=0.1)
    assert np.ptp(found.poses[:, 0, 3]) > 1.2 * np.ptp(poses[:, 0, 3])
    left, above = found.poses[found.group[:, 1] == 0], found.poses[found.group[:, 0] == 0]
    middle = poses[:, :, 3].mean(axis=0)
    assert (left[:, 0, 3] < middle[0]).all() and (above[:, 2, 3] > middle[2]).all()


def test_elsewhere_candidates_are_turned_at_the_places_of_cameras():
    outwards = np.stack(
        [np.asarray(look_at(pose[:, 3], 2 * pose[:, 3], UP)) for pose in np.float32(ring(30, 0.0, 1.0))]
    )
    found = candidate_poses(outwards, UP)
    assert found.kind == "turned" and len(found.poses) == 24 * 8 * 3
    np.testing.assert_allclose(found.poses[:, :, 3], outwards[found.nearest, :, 3], atol=1e-6)
    gaze = -found.poses[:, :, 2]
    np.testing.assert_allclose(gaze[found.group[:, 0] == 1] @ UP, 0, atol=1e-5)
    assert (gaze[found.group[:, 0] == 0] @ UP > 0.49).all()
    same = found.group[:, 1] == 0  # the first camera looks along -y
    assert (gaze[same, 1] < -0.5).all()
    right = found.group[:, 1] == 2  # 90 degrees to the right of that is -x
    assert (gaze[right, 0] < -0.5).all()


@pytest.mark.parametrize("poses", [ring(1), np.repeat(ring(1), 3, axis=0)])
def test_one_camera_is_refused(poses):
    with pytest.raises(ValueError):
        candidate_poses(poses, UP)
