"""Paths stay where cameras are: which kind is selected, how near its frames are to cameras, and clear errors."""

import re

import numpy as np
import pytest

from helpers import compiled
from jaxnerf.core import poses as core_poses
from jaxnerf.data.geometry import path_poses
from jaxnerf.data.geometry.poses import gaze_center, up_of

look_at = compiled(core_poses.look_at)
UP = np.array([0.0, 0.0, 1.0])


def around(azimuths, elevations=(20.0,), distance=4.0, wobble=0.0, seed=0):
    """Returns poses that look at the origin from rows of azimuths (degrees) at elevations; wobble: a hand's."""
    rng = np.random.default_rng(seed)
    azimuth, elevation = (np.radians(each.ravel()) for each in np.meshgrid(azimuths, elevations))
    azimuth, elevation, far = (
        value + wobble * rng.normal(size=value.shape) for value in (azimuth, elevation, 0 * azimuth + distance)
    )
    level = np.stack([np.cos(azimuth), np.sin(azimuth), 0 * azimuth], axis=-1)
    eyes = far[:, None] * (np.cos(elevation)[:, None] * level + np.sin(elevation)[:, None] * UP)
    return np.stack([look_at(np.float32(eye), np.zeros(3, np.float32), np.float32(UP)) for eye in eyes])


def turned(poses, seed=1):
    """Returns poses after a similarity of the world, and its rotation."""
    rotation, _ = np.linalg.qr(np.random.default_rng(seed).normal(size=(3, 3)))
    rotation *= np.sign(np.linalg.det(rotation))
    eyes = 3 * poses[:, :, 3] @ rotation.T + [5, -7, 9]
    return np.concatenate([rotation @ poses[:, :, :3], eyes[:, :, None]], axis=-1), rotation


def outside_hull(eyes, positions):
    """Returns how far points [N, 3] are outside the convex hull of positions, 0 inside."""
    directions = np.random.default_rng(0).normal(size=(4000, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    return np.maximum((eyes @ directions.T - (positions @ directions.T).max(axis=0)).max(axis=1), 0)


ARC = around(np.linspace(30, 138, 16), (5.0, 25.0, 45.0), wobble=0.05)  # 108 degrees
FORWARD = np.stack(
    [np.column_stack([np.eye(3), [0.2 * column, 0.2 * row, 0.0]]) for row in range(4) for column in range(5)]
)


@pytest.mark.parametrize(
    "poses, expected, reason",
    [
        (around(np.arange(0, 360, 30)), "turntable", "surround .* at most 30 degrees"),
        (around(np.arange(0, 360, 60)), "turntable", "at most 60 degrees"),
        (around(np.arange(0, 360, 90)), "interpolate", "largest gap is 90 degrees"),
        (around(np.arange(0, 280, 20)), "arc", "only 260 of 360 degrees"),
        (ARC, "arc", "only 1[01][0-9] of 360 degrees"),
        (np.concatenate([ARC, around([0, 90, 180, 270], (85.0,))]), "arc", "only 1[01][0-9] of 360"),
        (np.concatenate([around(np.arange(0, 80, 10)), around([180, 190, 200])]), "arc", "only 70 of 360 degrees"),
        (around(np.arange(60, 115, 5)), "spiral", "all 11 cameras look one way"),
        (FORWARD, "spiral", "all 20 cameras look one way"),
        (around(np.arange(0, 360, 30)) * [1, -1, -1, 1], "interpolate", "only 0% of the 12 cameras look at"),
        (around(np.arange(0, 360, 30)) * [1, 1, 1, 0], "interpolate", "all 12 cameras are at one position"),
    ],
)
def test_a_turntable_is_selected_only_where_cameras_surround_what_they_look_at(poses, expected, reason):
    for each in (poses, turned(poses)[0]):
        kind, found = path_poses.default_kind(each)
        assert kind == expected, found
        assert re.search(reason, found), found


def test_an_arc_swings_within_the_covered_azimuth_at_the_cameras_elevations_and_distances():
    poses = np.concatenate([around([30], (50.0,), 3.0), around(np.linspace(40, 130, 12), (10.0, 40.0), 4.0)])
    found, rotation = turned(poses)
    path = path_poses.make_poses("arc", found)
    assert path.shape == (96, 3, 4)
    offset = ((path[:, :, 3] - gaze_center(found)) @ rotation) / 3
    azimuth = np.degrees(np.arctan2(offset[:, 1], offset[:, 0]))
    assert 30 < azimuth.min() < 40 and 120 < azimuth.max() < 130
    distance = np.linalg.norm(offset, axis=1)
    elevation = np.degrees(np.arcsin(offset @ UP / distance))
    assert (elevation > 10).all() and (elevation < 50).all() and np.ptp(elevation) > 10
    assert (distance > 3.2).all() and (distance < 4.001).all()
    assert distance[azimuth.argmin()] < distance[azimuth.argmax()] - 0.02, "nearer where the near camera is"
    jumps = np.linalg.norm(np.diff(path[:, :, 3], axis=0, append=path[:1, :, 3]), axis=1)
    assert jumps.max() < 0.22 * 3, "closed, without a leap"


@pytest.mark.parametrize("kind, poses", [("arc", ARC), ("turntable", around(np.arange(0, 360, 20), (5.0, 40.0)))])
def test_frames_are_as_near_to_cameras_as_cameras_are_to_each_other(kind, poses):
    """A turntable of these 108 degrees passes cameras at 3 times that distance."""
    positions = poses[:, :, 3]

    def ratio(path):
        apart = np.linalg.norm(path[:, None, :, 3] - positions, axis=-1)
        nearby = positions[np.argsort(apart, axis=1)[:, :6]]
        spacing = np.linalg.norm(nearby[:, :, None] - nearby[:, None], axis=-1).max(axis=(1, 2))
        return (apart.min(axis=1) / spacing).max()

    path = path_poses.make_poses(kind, poses)
    assert ratio(path) < 0.7
    assert outside_hull(path[:, :, 3], positions).max() < 0.08 * 4.0
    if kind == "arc":
        assert ratio(path_poses.make_poses("turntable", poses)) > 2


@pytest.mark.parametrize("kind", ["turntable", "arc", "spiral", "ellipse"])
def test_the_horizon_is_level_although_hands_roll(kind):
    rng = np.random.default_rng(0)
    poses = around(np.linspace(0, 110 if kind != "turntable" else 350, 30), (10.0, 30.0))
    roll = 0.15 * rng.normal(size=len(poses))
    rolled = np.stack([np.cos(roll), np.sin(roll), -np.sin(roll), np.cos(roll)], axis=-1).reshape(-1, 2, 2)
    poses = np.concatenate([poses[:, :, :2] @ rolled, poses[:, :, 2:]], axis=-1)
    path = path_poses.make_poses(kind, poses)
    up = up_of(poses)
    assert up @ UP > 0.995
    if kind != "spiral":  # which turns around the mean camera
        np.testing.assert_allclose(path[:, :, 0] @ up, 0, atol=1e-5)
    assert (path[:, :, 1] @ up > 0.5).all()
    assert np.isfinite(path).all()


def test_spirals_and_ellipses_are_scaled_into_the_hull_of_the_cameras():
    """The cameras form a cross, whose hull is smaller than the ellipsoid of their percentiles."""
    offsets = np.array([[x, 0, 0] for x in np.linspace(-1, 1, 41)] + [[0, y, 0] for y in np.linspace(-1, 1, 41)])
    poses = np.stack([look_at(np.float32(each), np.float32([0, 0.1, -3]), np.float32([0, 1, 0])) for each in offsets])
    for kind in ("spiral", "ellipse"):
        eyes = path_poses.make_poses(kind, poses)[:, :, 3]
        assert outside_hull(eyes, offsets).max() <= 0.03  # 0.025 and rounding
        assert np.abs(eyes[:, 0]).max() > 0.4, "not smaller than need be"
    assert outside_hull(np.array([[0.8, 0.8, 0.0]]), offsets)[0] == pytest.approx(0.6 / 2**0.5, abs=0.02)


def test_a_spiral_turns_no_more_than_the_cameras():
    poses = around(np.linspace(80, 100, 9), (-5.0, 5.0))
    path = path_poses.make_poses("spiral", poses)
    turns = np.degrees(np.arccos(np.clip(path[:, 1, 2], -1, 1)))  # from +y, the mean axis
    assert 4 < turns.max() < 12
    parallel = path_poses.make_poses("spiral", FORWARD)
    np.testing.assert_allclose(parallel[:, :, 2], np.tile([0, 0, 1], (120, 1)), atol=2e-3)


def test_cameras_that_define_no_path_are_errors():
    one, line = ARC[:1], np.stack([look_at(np.float32([x, 4, 0]), np.zeros(3), UP) for x in np.linspace(-6, 6, 9)])
    for kind in ("auto", "arc", "interpolate"):
        with pytest.raises(ValueError, match="there is one camera, expected two or more; give .* --path=FILE.json"):
            path_poses.check_kind(kind, one)
    with pytest.raises(ValueError, match="path 'auto' through 3 views: all cameras have the same pose"):
        path_poses.default_kind(np.tile(one, (3, 1, 1)))
    tripod = ARC * [1, 1, 1, 0]
    for kind in ("turntable", "arc", "spiral", "ellipse"):
        with pytest.raises(ValueError, match="at one position, expected different .* --path=interpolate"):
            path_poses.make_poses(kind, tripod)
    for kind in ("turntable", "arc", "ellipse"):
        with pytest.raises(ValueError, match="axes are parallel, expected axes that meet; select --path=spiral"):
            path_poses.make_poses(kind, FORWARD)
    with pytest.raises(ValueError, match="path 'turntable' through 9 views: all cameras are on a line"):
        path_poses.make_poses("turntable", line)
    assert np.isfinite(path_poses.make_poses("arc", line)).all()
    above = around([0, 120, 240], (80.0,))
    with pytest.raises(ValueError, match="the cameras cover 0 degrees of azimuth, expected at least 1"):
        path_poses.make_poses("arc", above)


def test_names_are_sorted_by_the_value_of_their_numbers():
    names = ("b/img_1", "img_10", "img_2", "a 3", "a 03b", "12", "9")
    assert [names[index] for index in path_poses.natural_order(names)] == [
        *("9", "12", "a 3", "a 03b", "b/img_1", "img_2", "img_10"),
    ]


def test_any_names_have_a_natural_order():
    names = ["b", "a b", "²", "a10b", "a2b", "a", "10", "2", ""]
    found = [names[index] for index in path_poses.natural_order(names)]
    assert found == ["", "2", "10", "a", "a2b", "a10b", "a b", "b", "²"]
