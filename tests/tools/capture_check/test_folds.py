"""Folded reconstructions are found; single wrong poses, and images in another order, are not taken for them."""

from pathlib import Path

import numpy as np
import pytest

from jaxnerf.core import poses as core_poses
from jaxnerf.core.types import Camera
from jaxnerf.data.geometry.poses import neighbours
from jaxnerf.data.readers import base
from jaxnerf.tools.capture_check import folds, report, tracks

COUNT, FOCAL = 12, 400.0
HALF_TURN = np.diag([-1.0, -1.0, 1.0])  # of the world, about its vertical axis


def orbit(names=None):
    """Returns a capture of cameras on an arc, and Evidence of what they show, in the order of the names."""
    rng = np.random.default_rng(0)
    points, descriptors = rng.uniform(-1, 1, (150, 3)), rng.normal(size=(150, 128))
    descriptors /= np.linalg.norm(descriptors, axis=1, keepdims=True)
    poses, keypoints = [], []
    for angle in np.linspace(-0.8, 0.8, COUNT):
        eye = np.float32([4 * np.sin(angle), -4 * np.cos(angle), 0.5 * np.sin(5 * angle)])
        pose = np.float64(core_poses.look_at(eye, np.zeros(3, np.float32), np.float32([0, 0, 1])))
        local = (points - pose[:, 3]) @ pose[:, :3]
        places = local[:, :2] * [1, -1] / -local[:, 2:] + rng.normal(size=(len(points), 2)) * 0.3 / FOCAL
        poses.append(pose)
        keypoints.append(tracks.Keypoints(places, descriptors))
    names = [f"{index:03d}" for index in range(COUNT)] if names is None else names
    camera = Camera(to_world=poses[0], focal=np.full(2, FOCAL), center=np.full(2, 200.0), height=400, width=400)
    frames = tuple(base.Frame(name, Path(f"{name}.png"), camera) for name in names)
    return base.Capture("colmap", Path("sparse/0"), frames), evidence(keypoints, np.array(poses))


def evidence(keypoints, poses):
    near = neighbours(poses)
    return tracks.Evidence(keypoints, near, tracks.follow(keypoints, near), poses, np.full(len(poses), FOCAL), 1.0)


def turned(found, views):
    """Returns the Evidence with other poses of some views."""
    poses = found.poses.copy()
    poses[views] = HALF_TURN @ poses[views]
    return evidence(found.keypoints, poses)


def test_a_fold_is_a_warning_that_names_its_ends():
    capture, found = orbit()
    assert folds.judge_folds(capture, found, ()) == []
    (finding,) = folds.judge_folds(capture, turned(found, slice(6, None)), ())
    assert (finding.severity, finding.kind, finding.frames) == ("warning", "fold", ())
    line = finding.line()
    assert (
        "between consecutive images (005 and 006): " in line
        and "005 and 006 show a rotation of 8 degrees, their cameras one of" in line
    )
    assert "jaxnerf-cameras" in line
    (finding,) = folds.judge_folds(capture, turned(found, slice(4, 8)), ())
    assert "(003 and 004, 007 and 008)" in finding.found


def test_an_image_with_a_finding_of_its_own_is_skipped():
    capture, found = orbit()
    wrong = turned(found, [*range(6, COUNT), 3])
    assert folds.judge_folds(capture, wrong, ()) == [], "three images are no group"
    assert "005 and 006" in folds.judge_folds(capture, wrong, {3})[0].found


@pytest.mark.parametrize("view", range(COUNT))
def test_single_wrong_poses_are_no_fold(view):
    capture, found = orbit()
    assert folds.judge_folds(capture, turned(found, [view]), ()) == []
    for other in {(view + 1) % COUNT, (view + 5) % COUNT}:
        assert folds.judge_folds(capture, turned(found, [view, other]), ()) == []


def test_images_in_another_order_are_no_fold():
    """Their cameras move as the images do, and images that have little in common say nothing."""
    names = [f"{index:03d}" for index in np.random.default_rng(1).permutation(COUNT)]
    assert folds.judge_folds(*orbit(names), ()) == []


@pytest.mark.parametrize(
    "name, fold",
    [
        pytest.param(name, fold, marks=[pytest.mark.scenes(name), mark], id=name)
        for name, fold, mark in (
            ("can", "0013 and 0014, 0034 and 0035", pytest.mark.slow),
            ("fern", None, pytest.mark.extra),
            ("fox", None, pytest.mark.extra),
            ("lego", None, pytest.mark.extra),
        )
    ],
)
def test_real_scenes_have_no_errors_and_only_can_is_folded(scenes_dir, name, fold):
    inspected = report.inspect(scenes_dir / name)
    assert not inspected.num_errors, inspected.text()
    found = [finding.found for finding in inspected.findings if finding.kind == "fold"]
    assert len(found) == (fold is not None) and all(fold in line for line in found)
