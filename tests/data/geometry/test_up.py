"""Up is found from the cameras however the images are stored, and can be set."""

import dataclasses

import numpy as np
import pytest

import captures
from jaxnerf import load_dataset
from jaxnerf.data import dataset
from jaxnerf.data.geometry import world
from jaxnerf.data.geometry.poses import sideways, up_of
from jaxnerf.data.readers.base import read_capture
from jaxnerf.data.synthetic import load_synthetic
from jaxnerf.evaluation.paths.camera_path import make_path
from jaxnerf.tools.capture_check import report

UP = np.array([0.2, -0.5, 0.84])
UP /= np.linalg.norm(UP)


def held(seed, *, count=60, arc=2 * np.pi, low=-0.3, high=0.9):
    """Returns poses around the origin with level x axes up to 3 degrees, and the up direction."""
    rng = np.random.default_rng(seed)
    right = np.cross(UP, [1.0, 0.0, 0.0])
    right /= np.linalg.norm(right)
    ahead, poses = np.cross(UP, right), []
    for azimuth, height, roll in zip(
        rng.uniform(0, arc, count), rng.uniform(low, high, count), rng.normal(0, 0.05, count), strict=True
    ):
        back = np.cos(height) * (np.cos(azimuth) * right + np.sin(azimuth) * ahead) + np.sin(height) * UP
        x = np.cross(UP, back)
        x /= np.linalg.norm(x)
        y = np.cross(back, x)
        turned = np.cos(roll) * x + np.sin(roll) * y, np.cos(roll) * y - np.sin(roll) * x
        poses.append(np.stack([*turned, back, 4 * back], axis=-1))
    return np.array(poses)


def stored(poses, turns):
    """Returns the poses of the same cameras whose images are stored after a number of quarter turns each."""
    found = poses.copy()
    for index, turn in enumerate(np.broadcast_to(turns, len(poses))):
        for _ in range(int(turn)):
            x, y = found[index, :, 0].copy(), found[index, :, 1].copy()
            found[index, :, 0], found[index, :, 1] = y, -x
    return found


def angle(poses):
    return np.degrees(np.arccos(np.clip(up_of(poses) @ UP, -1, 1)))


@pytest.mark.parametrize("turn", [0, 1, 3])
@pytest.mark.parametrize("arc", [2 * np.pi, 2.0])
@pytest.mark.parametrize("seed", range(3))
def test_images_stored_sideways_have_the_same_up(seed, arc, turn):
    poses = stored(held(seed, arc=arc), turn)
    assert angle(poses) < 3 and sideways(poses).all() == bool(turn)


@pytest.mark.parametrize("seed", range(3))
def test_mixtures_have_the_same_up(seed):
    poses = held(seed)
    for turns in ([0, 1] * 30, [1, 3] * 30, [0, 1, 3] * 20, [1] * 55 + [0] * 5):
        assert angle(stored(poses, turns)) < 3
        assert (sideways(stored(poses, turns)) == (np.array(turns) % 2 == 1)).all()


def test_level_cameras_that_look_neither_up_nor_down_are_taken_as_telephones_turn_images():
    """EXIF orientation 6: the left edge of what is stored is up."""
    poses = held(1, low=-0.6, high=0.6)
    poses = np.concatenate([poses, poses * [[[1, 1, 1, 1]]]])
    assert angle(stored(poses, 1)) < 3 or angle(stored(poses, 3)) < 3


@pytest.mark.scenes
@pytest.mark.parametrize("name", ["lego", "fox", "fern", "can"])
def test_known_scenes_keep_their_up(scenes_dir, name):
    options = {"factor": 8} if name in ("lego", "fern") else {}
    views = load_dataset(scenes_dir / name, split="train", **options)
    assert not sideways(np.asarray(views.cameras.to_world)).any()


def test_the_check_says_that_images_are_stored_sideways(tmp_path):
    shots = captures.shoot(captures.orbit(8))
    turned = []
    for shot in shots:
        pose = stored(np.asarray(shot.camera.to_world, np.float64)[None], 1)[0]
        turned.append(shot._replace(camera=dataclasses.replace(shot.camera, to_world=pose)))
    captures.write_transforms(tmp_path, turned)
    facts = dict(report.inspect(tmp_path).facts)
    assert "8 of 8 images are stored sideways" in facts["poses"]


def test_mixtures_with_images_upside_down_have_the_same_up():
    for turns in ([0, 2] * 30, [0, 1, 2, 3] * 15, [2] * 25 + [0] * 35):
        assert angle(stored(held(0), turns)) < 3


@pytest.mark.parametrize("turn", [0, 2])
def test_the_check_is_not_sure_of_images_that_may_be_upside_down_and_takes_what_is_given(tmp_path, turn):
    """Nothing in the poses tells a capture stored upside down from one that looks up at a ceiling."""
    shots = []
    for shot in captures.shoot(captures.orbit(8)):
        pose = stored(np.asarray(shot.camera.to_world, np.float64)[None], turn)[0]
        shots.append(shot._replace(camera=dataclasses.replace(shot.camera, to_world=pose)))
    captures.write_transforms(tmp_path, shots)
    found, given = report.inspect(tmp_path), report.inspect(tmp_path, up="+z")
    line = dict(found.facts)["poses"]
    assert line.startswith(f"right-handed; up is {'-' if turn else '+'}z")
    assert ("not sure: the cameras look up" in line and "--up sets it" in line) == bool(turn)
    assert dict(given.facts)["poses"] == "right-handed; up is +z, as --up gives it"
    np.testing.assert_array_equal(given.up, [0, 0, 1])
    assert given.path[:, 2, 1].mean() > 0.5
    low, high = (int(word) for word in dict(given.facts)["arcs"].split("elevations of ")[1].split()[:3:2])
    assert (low, high) == (-11, 30)
    with pytest.raises(ValueError, match="up is 'z', expected one of"):
        report.inspect(tmp_path, up="z")


@pytest.mark.scenes
@pytest.mark.parametrize("name", ["lego", "fox", "fern", "can"])
def test_the_check_is_sure_of_known_scenes(scenes_dir, name):
    poses = world.poses_of(read_capture(scenes_dir / name))
    assert "not sure" not in report._up_axis(poses, None)


@pytest.mark.parametrize("up, row", [("+z", (0, 0, 1)), ("-y", (0, -1, 0))])
def test_the_up_that_is_given_becomes_z_of_the_world_and_up_of_paths(tmp_path, up, row):
    captures.write_transforms(tmp_path, captures.noise(captures.orbit(9)))
    views = dataset.load_dataset(tmp_path, world="around", up=up)
    np.testing.assert_allclose(world.direction_in_run(np.float64(row), views.to_file), (0, 0, 1), atol=1e-6)
    path = make_path("turntable", views, up=up)
    np.testing.assert_allclose(path.poses[:, 2, 0], 0, atol=1e-6)  # all horizons are level


@pytest.mark.parametrize("up, sign", [("+z", 1), ("-z", -1)])
def test_a_path_turns_around_the_up_that_is_given(up, sign):
    views = load_synthetic(size=8)
    path = make_path("turntable", views, up=up)
    assert (sign * path.poses[:, 2, 1] > 0.5).all()
    with pytest.raises(ValueError, match="up is 'z', expected one of .*; correct --up"):
        make_path("turntable", views, up="z")
