"""The evidence that an image has a wrong pose: found where it is distinctive, and none where textures repeat."""

from pathlib import Path

import jax
import numpy as np
import pytest

import captures
from jaxnerf.core import poses as core_poses
from jaxnerf.data.geometry import path_poses
from jaxnerf.data.geometry.poses import neighbours
from jaxnerf.data.readers import base
from jaxnerf.tools.capture_check import cameras, report, tracks
from jaxnerf.tools.capture_check.view_evidence import Alternative, Support, find_alternative, support

COUNT, FOCAL = 9, 400.0


def evidence(kinds=None, *, seed=0):
    """Returns Evidence of cameras on an arc; descriptors of the points are of some kinds, or all differ."""
    rng = np.random.default_rng(seed)
    points = rng.uniform(-1, 1, (250, 3))
    own = rng.normal(size=(kinds or len(points), 128))
    own = own[np.arange(len(points)) % len(own)]
    poses, keypoints = [], []
    for angle in np.linspace(-0.5, 0.5, COUNT):
        eye = np.float32([4 * np.sin(angle), -4 * np.cos(angle), 0.8 * np.sin(5 * angle)])
        pose = np.float64(core_poses.look_at(eye, np.zeros(3, np.float32), np.float32([0, 0, 1])))
        local = (points - pose[:, 3]) @ pose[:, :3]
        places = local[:, :2] * [1, -1] / -local[:, 2:] + rng.normal(size=(len(points), 2)) * 0.3 / FOCAL
        descriptors = own + 0.3 * rng.normal(size=own.shape)
        poses.append(pose)
        keypoints.append(tracks.Keypoints(places, descriptors / np.linalg.norm(descriptors, axis=1, keepdims=True)))
    return _with_poses(keypoints, np.array(poses))


def _with_poses(keypoints, poses):
    near = neighbours(poses)
    return tracks.Evidence(keypoints, near, tracks.follow(keypoints, near), poses, np.full(len(poses), FOCAL), 1.0)


def capture():
    camera = jax.tree.map(lambda leaf: leaf[0], captures.orbit(1))
    frames = [base.Frame(f"{index}", Path(f"{index}.png"), camera) for index in range(COUNT)]
    return base.Capture("colmap", Path("sparse/0"), tuple(frames))


def moved(found, view):
    """Returns the Evidence with another pose of a view, and the true pose."""
    poses, true = found.poses.copy(), found.poses[view].copy()
    poses[view, :, :3] = poses[view, :, :3] @ np.array([[0, -1, 0], [1, 0, 0], [0, 0, 1.0]])
    poses[view, :, 3] += [0.5, 0.3, 0.0]
    return _with_poses(found.keypoints, poses), true


def test_an_unreadable_image_neither_confirms_nor_denies_a_pose():
    """As a truncated file beside a wrong pose."""
    wrong, true = moved(evidence(), 4)
    (nothing,) = tracks.keypoints_of(capture()._replace(frames=capture().frames[:1]), [None])
    other = find_alternative(_with_poses([*wrong.keypoints[:5], nothing, *wrong.keypoints[6:]], wrong.poses), 4)
    assert np.abs(other.pose - true).max() < 0.01 and other.other.cameras == 5


def test_a_wrong_pose_is_found_and_the_right_one_estimated():
    wrong, true = moved(evidence(), 4)
    other = find_alternative(wrong, 4)
    assert np.abs(other.pose - true).max() < 0.01
    assert other.other.matches > 500 and other.other.cameras == 6 and abs(other.own.matches) < 50
    (finding,) = cameras.judge_views(capture(), wrong)
    assert finding.frames == (4,) and finding.severity == "error" and "confidence 100.0 %" in finding.found


def test_swapped_images_are_named():
    found = evidence()
    keypoints = list(found.keypoints)
    keypoints[1], keypoints[6] = keypoints[6], keypoints[1]
    findings = cameras.judge_views(capture(), _with_poses(keypoints, found.poses))
    assert [finding.frames for finding in findings] == [(1, 6)] and findings[0].kind == "swap"


@pytest.mark.parametrize("kinds", [None, 1, 3, 12])
def test_no_image_with_a_right_pose_is_flagged(kinds):
    found = evidence(kinds)
    assert not cameras.judge_views(capture(), found)
    for view in (0, 4):
        other = find_alternative(found, view)
        own = support(found, view, found.poses[view], found.near[view])
        assert other is None or other.own.matches > 0.5 * other.other.matches
        assert kinds == 1 or own.matches > 0


def test_the_reconstruction_of_the_dataset_raises_the_bar():
    found = cameras._is_certain
    other = Alternative(np.zeros((3, 4)), own=Support(50.0, 3), other=Support(100.0, 5), inliers=50)
    assert found(capture(), evidence(), 0, other)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(cameras, "_track_errors", lambda *_: np.full(50, 0.5))
        assert not found(capture(), evidence(), 0, other)
        patch.setattr(cameras, "_track_errors", lambda *_: np.full(50, 9.0))
        assert found(capture(), evidence(), 0, other)


def test_up_is_that_of_the_paths_that_render_selects():
    found = evidence().poses
    found[:, :, :3] = found[:, :, :3] @ np.array([[1, 0, 0], [0, 0.6, -0.8], [0, 0.8, 0.6]])  # all look far down
    assert report._up_axis(found, None).startswith("up is +z")
    found = np.array([[1, 0, 0], [0, 0.8, 0.6], [0, -0.6, 0.8]]) @ found
    np.testing.assert_allclose(path_poses.coverage(found).up, [0, 0.6, 0.8], atol=1e-6)
    assert report._up_axis(found, None).startswith("up is (0.000, 0.600, 0.800), 37 degrees from +z")
