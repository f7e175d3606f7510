"""What cameras of a run have seen, and proposals of further images, on balls whose visible side is known."""

import dataclasses
import os

import numpy as np
import pytest

import ball_runs
from jaxnerf.evaluation.paths.camera_path import make_path
from jaxnerf.evaluation.restore import restore_run
from jaxnerf.tools.next_images import candidate_poses, propose
from jaxnerf.tools.next_images.coverage import ViewCoverage, choose_views
from jaxnerf.tools.next_images.propose import propose_images, save_path
from runs import ROOT, run_forked

pytest_plugins = ["run_fixtures"]


def opened(workdir):
    """Returns the coverage of a run without any camera, and its training views, with alpha."""
    run = restore_run(workdir, settings={"bake_occupancy": True})
    views = run.experiment.load_split("train")
    views = dataclasses.replace(views, pixels=np.zeros((len(views.pixels), 4), np.uint8))
    return ViewCoverage(run, run.variables(20)), views


@pytest.fixture(scope="module")
def ball(unoptimized, tmp_path_factory):
    return ball_runs.make_run(tmp_path_factory.mktemp("next") / "packed", "packed")


@pytest.fixture(scope="module")
def compiled_coverage(ball):
    return opened(ball)


@pytest.fixture
def nothing_seen(compiled_coverage):
    """The coverage of the ball's run without any camera, and its views."""
    coverage, views = compiled_coverage
    coverage.clear()
    return coverage, views


def check_familiar(coverage, views):
    coverage.add(views, 0)
    scores = [coverage.score(views, index).shown for index in range(len(views.size))]
    assert scores[0] > 0.93 and scores[0] > max(scores) - 0.01
    return scores


@pytest.mark.slow
def test_a_view_that_has_been_seen_is_familiar(nothing_seen):
    assert min(check_familiar(*nothing_seen)) < 0.75


@pytest.mark.extra
@pytest.mark.parametrize("kind", ["dense", "contracted", "ndc"])
def test_a_view_that_has_been_seen_is_familiar_in_any_space(unoptimized, tmp_path, kind):
    scores = check_familiar(*opened(ball_runs.make_run(tmp_path / kind, kind)))
    assert kind == "ndc" or min(scores) < 0.75  # cameras that look one way see nearly the same


@pytest.mark.slow
def test_the_cells_that_a_camera_sees_are_on_its_side_of_the_ball(nothing_seen, ball):
    coverage, views = nothing_seen
    assert (coverage.num_directions() <= 0).all()
    coverage.add(views, 0)
    seen = coverage.num_directions() > 0
    run = restore_run(ball)
    grid = run.variables(20)[1]
    lower, upper = np.asarray(grid.lower), np.asarray(grid.upper)
    x = lower + (np.indices(seen.shape).reshape(3, -1).T + 0.5) / seen.shape * (upper - lower) - ball_runs.CENTER
    eye = np.asarray(views.cameras.to_world)[0, :, 3] - ball_runs.CENTER
    on_ball = np.abs(np.linalg.norm(x, axis=1) - 0.7) < 0.1
    facing = x @ eye / np.linalg.norm(eye) / np.linalg.norm(x, axis=1)
    assert seen.reshape(-1)[on_ball & (facing > 0.3)].all()
    assert not seen.reshape(-1)[on_ball & (facing < -0.85)].any()


@pytest.mark.slow
def test_masked_pixels_see_nothing(nothing_seen):
    coverage, views = nothing_seen
    coverage.add(dataclasses.replace(views, mask=np.zeros(len(views.pixels), bool)), 0)
    assert (coverage.num_directions() <= 0).all()


@pytest.mark.slow
def test_the_lazy_search_chooses_as_the_full_one(nothing_seen):
    coverage, views = nothing_seen
    coverage.add(views, 0)
    lazy = choose_views(coverage, views, {index: coverage.score(views, index) for index in (1, 2, 3, 4)}, 3)
    coverage.clear()
    coverage.add(views, 0)
    rest, full = [1, 2, 3, 4], []
    for _ in range(3):
        best = min(rest, key=lambda index: coverage.score(views, index).score)
        full.append((best, coverage.score(views, best)))
        coverage.add(views, best)
        rest.remove(best)
    assert [index for index, _ in lazy] == [index for index, _ in full]
    np.testing.assert_allclose([each.score for _, each in lazy], [each.score for _, each in full], rtol=1e-6)
    coverage.clear()
    coverage.add(views, 0)
    scores = {index: coverage.score(views, index) for index in (1, 2, 3, 4)}
    angle = lazy[0][1].angle
    assert choose_views(coverage, views, scores, 3, least_angle=angle - 0.01)[0] == lazy[0]
    assert all(
        found.angle >= angle + 0.01 for _, found in choose_views(coverage, views, scores, 3, least_angle=angle + 0.01)
    )


@pytest.mark.slow
def test_lines_through_matter_are_not_free(nothing_seen):
    coverage, _ = nothing_seen
    starts = np.float32([[4, 0, 0.2], [4, 0, 0.2], [4, 0, 0.2]])
    ends = np.float32([[-4, 0, 0.2], [4, 1, 0.2], [0.2, 0, 0.2]])
    np.testing.assert_array_equal(coverage.is_free(starts, ends), [False, True, False])


@pytest.mark.slow
def test_proposals_spread_where_all_is_well_seen(ball, monkeypatch):
    monkeypatch.setattr(candidate_poses, "_DIRECTIONS", 40)
    monkeypatch.setattr(propose, "_THIN", 180.0)
    report = propose_images(ball, 3)
    poses = np.asarray(report.views.cameras.to_world)
    expected = candidate_poses.farthest_poses(poses, report.candidates.poses, 3)
    np.testing.assert_allclose(report.path.poses, report.candidates.poses[expected])


@pytest.mark.slow
def test_proposals_are_what_has_not_been_seen_and_are_saved_as_a_path(ball, monkeypatch):
    monkeypatch.setattr(candidate_poses, "_DIRECTIONS", 40)
    report = propose_images(ball, 3)
    assert report.candidates.kind in ("around", "turned") and len(report.proposals) == 3
    assert "Next images" in report.text() and report.counts.sum() == report.counts[0] + report.counts[1:].sum()
    path = make_path(str(save_path(report, ball)), report.views)
    np.testing.assert_allclose(path.poses, [each.pose for each in report.proposals], atol=1e-5)
    assert path.fps == 1.0 and (path.width, path.height) == (32, 32)
    np.testing.assert_allclose(path.focal, report.path.focal, rtol=1e-6)


@pytest.mark.slow
def test_a_scene_that_moves_is_refused(ball, monkeypatch):
    def moving(run, views, *_):
        return dataclasses.replace(views, time=np.zeros(len(views.size), np.float32))

    monkeypatch.setattr(propose, "refined_views", moving)
    with pytest.raises(ValueError, match="the scene moves"):
        propose_images(ball)


@pytest.mark.slow
def test_the_program_reports_and_refuses(unoptimized, tmp_path, monkeypatch):
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(ROOT / "tests"), str(ROOT)]))
    workdir = ball_runs.make_run(tmp_path / "ball", "ndc")
    ball_module = (f"--workdir={workdir}", f"--out={tmp_path / 'cover.png'}", "--plugins=ball_runs")
    code, out, err = run_forked("check", *ball_module, "--next_images=2")
    assert code == 0, err
    assert "above" in out and "  2. from " in out and (tmp_path / "cover.png").is_file()
    assert (workdir / "camera_paths" / "next_images.json").is_file()


@pytest.mark.slow
@pytest.mark.slow
@pytest.mark.parametrize(
    "flags, message",
    [
        (("--workdir=there/is/none",), "there/is/none"),
        (("--step=7", "--data_dir=x"), "--step is given without --workdir"),
        ((), "neither --data_dir nor --workdir"),
    ],
)
def test_wrong_calls_are_refused_in_a_line(flags, message):
    code, out, err = run_forked("check", *flags)
    assert code == 1 and not out and message in err and err.count("\n") == 1
