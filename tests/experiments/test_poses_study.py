"""The perturbed cameras of the study of refined poses, and their errors."""

import numpy as np

from jaxnerf.data.synthetic import load_synthetic
from studies import study

poses = study("benchmark/poses")
changed_views = study("benchmark/changed_views")
pose_errors = study("pose_estimation/pose_errors")
TRUTH = np.float64(load_synthetic(size=200).cameras.to_world)


def test_errors_do_not_depend_on_the_world():
    turn = np.linalg.qr(np.random.default_rng(0).normal(size=(3, 3)))[0]
    turn *= np.linalg.det(turn)
    to_other = pose_errors.Similarity(1.7, turn, np.array([0.3, -2.0, 5.0]))
    found = pose_errors.similarity(TRUTH[:, :, 3], to_other(TRUTH)[:, :, 3])
    np.testing.assert_allclose(found.scale, 1.7)
    np.testing.assert_allclose(found.turn, turn, atol=1e-9)
    np.testing.assert_allclose(found.move, to_other.move, atol=1e-9)
    np.testing.assert_allclose(pose_errors.errors(to_other(TRUTH), TRUTH), 0, atol=1e-4)


def test_cameras_that_are_turned_about_themselves_have_the_errors_that_are_asked_for():
    degrees, moves = pose_errors.errors(poses.turned(TRUTH, 1.0, 0), TRUTH)
    expected = np.sqrt(8 / np.pi)  # the mean length of a normal vector of three components
    np.testing.assert_allclose(degrees, expected, rtol=0.1)
    np.testing.assert_allclose(moves, expected * np.radians(4), rtol=0.1)
    np.testing.assert_allclose(pose_errors.errors(poses.turned(TRUTH, 0.0, 0), TRUTH), 0, atol=1e-4)


def test_a_motion_of_the_world_is_seen_by_the_cameras_that_barf_perturbs():
    moved = poses.perturbed(TRUTH, 0.15, 1)
    twists = np.random.default_rng(1).normal(size=(len(TRUTH), 6)) * 0.15
    motions = np.asarray(changed_views.se3_exponential(np.float32(twists)))
    x = np.array([0.2, -0.4, 0.6])
    after = motions[:, :, :3] @ x + motions[:, :, 3]
    seen = np.einsum("vji,vj->vi", moved[:, :, :3], x - moved[:, :, 3])
    expected = np.einsum("vji,vj->vi", TRUTH[:, :, :3], after - TRUTH[:, :, 3])
    np.testing.assert_allclose(seen, expected, atol=1e-5)


def test_a_row_has_a_cell_for_each_head():
    found = {"turn_before": 13.5, "turn": 0.2, "move_before": 0.7, "move": 0.02, "focal": 1.0, "psnr": 30.0}
    assert {len(poses.HEADS)} == {
        len(cells) for cells in (poses.row("lego", found, "twist", 0.15, 0, 3000), *poses.PUBLISHED)
    }
    assert poses.row("lego", found, "twist", 0.15, 0, 3000, align=True)[-2:] == ("30.00", "-")
