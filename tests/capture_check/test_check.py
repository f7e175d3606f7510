"""jaxnerf.check: what it finds planted in captures, what it says to change, and that this mends them."""

import dataclasses
import pathlib
import subprocess
import sys

import jax
import numpy as np
import pytest
from PIL import Image

import captures
from jaxnerf.capture_check import camera_plot, consistency, features, findings, tracks
from jaxnerf.capture_check import report as report_module
from jaxnerf.core import cameras, types
from jaxnerf.core import poses as poses_module

sys.path.insert(0, str(pathlib.Path(__file__).resolve().parents[2] / "experiments"))
import check_planted  # noqa: E402
import planting  # noqa: E402

SIZE = 160


def room(origins, directions):
    """Returns the colours [..., 3] of three textured walls, x = -2, y = 2 and z = -1, that rays meet."""
    walls = np.array([-2.0, 2.0, -1.0])
    with np.errstate(divide="ignore"):
        t = (walls - origins) / directions
    t = np.where(t > 1e-6, t, np.inf)
    wall = t.argmin(axis=-1)
    places = origins + t.min(axis=-1, keepdims=True) * directions
    rng = np.random.default_rng(0)
    waves = rng.normal(size=(3, 40, 3)) * 7, rng.uniform(0, 6, (3, 40)), rng.normal(size=(40, 3))
    phase = np.einsum("...i,...ki->...k", places, waves[0][wall]) + waves[1][wall]
    return 1 / (1 + np.exp(-0.7 * np.sin(phase) @ waves[2]))


def shots(count=12, lens="pinhole"):
    """Returns the Shots of cameras on two short arcs that look into the room's corner."""
    result = []
    for index in range(count):
        angle, height = -0.9 + 0.14 * (index // 2 * 2) + 0.05 * (index % 2), 0.7 * (index % 2)
        eye = np.array([3.4 * np.cos(angle) - 1.2, 3.4 * np.sin(angle) + 1.0, 0.4 + height])
        pose = poses_module.look_at(*np.float32([eye, [-1.2, 1.2, -0.4], [0, 0, 1]]))
        distortion = None if lens == "pinhole" else np.float32([0.08, -0.03, 0.002, -0.001])
        camera = types.Camera(
            to_world=np.asarray(pose),
            focal=np.float32([1.2 * SIZE] * 2),
            center=np.float32([SIZE / 2] * 2),
            distortion=distortion,
            lens=lens,
            height=SIZE,
            width=SIZE,
        )
        rays = jax.jit(cameras.rays_from_pixels)(camera, cameras.pixel_grid(SIZE, SIZE), near=0.0, far=1.0)
        rgb = room(*(np.float64(value) for value in (rays.origins, rays.directions)))
        pixels = np.concatenate([rgb, np.ones((SIZE, SIZE, 1))], axis=-1)
        result.append(captures.Shot(f"{index:03d}", camera, np.uint16(np.rint(65535 * pixels))))
    return result


@pytest.fixture(scope="module")
def folders(tmp_path_factory):
    """A clean capture in each format."""
    base = tmp_path_factory.mktemp("clean")
    straight = shots()
    grid = np.meshgrid(np.linspace(-1.9, 1, 12), np.linspace(-1, 1.9, 12))
    xyz = np.stack([*grid, np.full_like(grid[0], -1.0)], axis=-1).reshape(-1, 3)
    at, depth = zip(*(cameras.project(shot.camera, np.float32(xyz)) for shot in straight), strict=True)
    at, depth = np.float64(at), np.float64(depth)
    seen = (depth > 0) & (at > 0).all(axis=-1) & (at < SIZE).all(axis=-1)
    points = captures.Points(xyz, np.full((len(xyz), 3), 128, np.uint8), seen, at, depth)
    captures.write_transforms(base / "transforms", shots(lens="opencv"))
    captures.write_colmap(base / "colmap", straight, points=points)
    captures.write_llff(base / "llff", straight, points=points)
    return base


def planted(folders, tmp_path, format, plant):
    folder = planting.copy(folders / format, tmp_path / format)
    plant(folder)
    return report_module.inspect(folder)


def kinds(report):
    return {finding.kind for finding in report.findings if finding.severity == "ruins"}


@pytest.mark.parametrize("format", ["transforms", "colmap", "llff"])
def test_a_clean_capture_is_ruined_by_nothing(folders, format):
    report = report_module.inspect(folders / format)
    assert not report.ruined, report.text()
    assert f"format     {format}" in report.text() and "12: 10 train, 2 test" in report.text()
    assert len(report.places) > 200
    on_walls = np.abs(report.places - [-2.0, 2.0, -1.0]).min(axis=1)
    assert np.median(on_walls) < 0.02  # what the photographs agree on is where the room is


@pytest.mark.parametrize("format", ["transforms", "llff"])
@pytest.mark.parametrize("signs", [(1, -1, -1), (-1, -1, 1), (-1, 1, -1)])
def test_turned_axes_are_found_and_the_change_undoes_them(folders, tmp_path, format, signs):
    report = planted(folders, tmp_path, format, lambda f: planting.edit_poses(f, planting.flip(*signs)))
    assert kinds(report) == {"axes"}
    (finding,) = (finding for finding in report.findings if finding.kind == "axes")
    order = {"transforms": (1, 2, 3), "llff": (2, 1, 3)}[format]  # LLFF's columns: down, right, backwards
    negated = sorted(column for column, sign in zip(order, signs, strict=True) if sign < 0)
    assert finding.change.endswith(f"negate columns {negated[0]} and {negated[1]}")
    right = report_module.inspect(folders / format)
    np.testing.assert_allclose(report.poses, right.poses, atol=1e-6)  # as they are meant


def test_axes_that_are_swapped_and_inverted_are_found(folders, tmp_path):
    def invert(poses):
        turn = np.swapaxes(poses[:, :, :3], 1, 2)
        return np.concatenate([turn, -turn @ poses[:, :, 3:]], axis=-1)

    report = planted(folders, tmp_path, "transforms", lambda f: planting.edit_poses(f, invert))
    assert kinds(report) == {"axes"} and "invert it" in report.findings[0].change
    swapped = np.array([[0.0, 1, 0], [-1, 0, 0], [0, 0, 1]])
    axes = consistency.Axes(swapped.T, False, 1.0)
    assert findings.axes_change("transforms", axes).endswith("make its columns +2, -1, +3 of these")


def test_a_mirrored_world_is_found_and_the_change_undoes_it(folders, tmp_path):
    report = planted(folders, tmp_path, "transforms", lambda f: planting.edit_poses(f, planting.mirror))
    assert kinds(report) == {"axes"}
    assert "negate columns 1, then negate row 1" in report.findings[0].change
    with pytest.raises(ValueError, match="determinant -1.*negate one axis"):
        planted(folders, tmp_path / "x", "llff", lambda f: planting.edit_poses(f, planting.flip(-1, 1, 1)))


@pytest.mark.parametrize("factor", [0.8, 1.25])
def test_a_wrong_focal_length_is_found_and_named(folders, tmp_path, factor):
    report = planted(folders, tmp_path, "llff", lambda folder: planting.scale_focal(folder, factor))
    assert kinds(report) == {"focal"}
    (finding,) = (finding for finding in report.findings if finding.kind == "focal")
    assert float(finding.wanted.removeprefix("about ")) == pytest.approx(1.2 * SIZE, rel=0.03)


def test_two_swapped_photographs_are_named(folders, tmp_path):
    def swap(folder):
        planting.swap(folder / "images" / "003.png", folder / "images" / "008.png")

    report = planted(folders, tmp_path, "transforms", swap)
    assert kinds(report) == {"swap"} and report.findings[0].frames == (3, 8)


def test_one_wrong_pose_is_named(folders, tmp_path):
    def move(poses):
        poses = poses.copy()
        poses[4, :, :3] = poses[4, :, :3] @ np.diag([-1.0, -1.0, 1.0])
        return poses

    report = planted(folders, tmp_path, "llff", lambda folder: planting.edit_poses(folder, move))
    assert kinds(report) == {"pose"} and report.findings[0].frames == (4,)


def test_poses_in_another_order_are_found(folders, tmp_path):
    order = np.random.default_rng(0).permutation(12)
    report = planted(folders, tmp_path, "llff", lambda f: planting.edit_poses(f, lambda poses: poses[order]))
    assert kinds(report) == {"pose"} and "sure matches" in report.text()


def test_poses_that_left_their_points_behind_are_found(folders, tmp_path):
    def move(folder):
        path = folder / "sparse" / "0" / "cameras.txt"
        path.write_text(path.read_text().replace("192.", "230.").replace("80.0", "90.0"))

    assert "points" in kinds(planted(folders, tmp_path, "colmap", move))


def test_bounds_in_another_unit_are_found(folders, tmp_path):
    report = planted(folders, tmp_path, "llff", lambda folder: planting.scale_bounds(folder, 100))
    assert kinds(report) == {"bounds"} and "times 0.0" in report.findings[0].change
    assert "bounds" in kinds(report_module.inspect(folders / "transforms", near=200.0, far=600.0))


def test_files_that_are_cut_odd_or_without_mask_are_named(folders, tmp_path):
    def spoil(folder):
        planting.cut(folder / "images" / "002.png")
        planting.resize(folder / "images" / "004.png", 0.8)
        planting.resize(folder / "images" / "006.png", 0.5)

    report = planted(folders, tmp_path, "transforms", spoil)
    found = {(finding.severity, finding.kind, finding.frames) for finding in report.findings}
    assert {("ruins", "file", (2,)), ("ruins", "size", (4,)), ("note", "size", (6,))} <= found
    assert {finding[2] for finding in found if finding[0] == "ruins"} == {(2,), (4,)}
    with pytest.raises(ValueError, match="mask"):
        planted(folders, tmp_path / "m", "transforms", lambda f: planting.add_masks(f, without=["007"]))
    report = planted(folders, tmp_path / "a", "llff", lambda folder: planting.remove_alpha(folder, 3))
    assert kinds(report) == {"mask"} and report.findings[0].frames == (3,)


def test_a_duplicate_and_a_blurred_photograph_are_notes(folders, tmp_path):
    def spoil(folder):
        images = planting.images(folder)
        planting._write(images[1], images[0].read_bytes())
        soft = features.blur(np.float32(Image.open(images[9])).transpose(2, 0, 1), 3.0)
        images[9].unlink()
        Image.fromarray(np.uint8(soft.transpose(1, 2, 0))).save(images[9])

    report = planted(folders, tmp_path, "transforms", spoil)
    notes = {(finding.kind, finding.frames) for finding in report.findings if finding.severity == "note"}
    assert {("duplicate", (0, 1)), ("blur", (9,))} <= notes


def test_too_few_or_empty_photographs_get_a_report(tmp_path):
    captures.write_transforms(tmp_path / "one", shots(1))
    with pytest.raises(ValueError, match="add images"):
        report_module.inspect(tmp_path / "one")
    folder = tmp_path / "few"
    captures.write_transforms(folder, shots(2))
    report = report_module.inspect(folder)
    assert camera_plot.plot_cameras(report.capture, report.poses, report.places).width > 1000
    for path in planting.images(folder):
        Image.new("RGB", (SIZE, SIZE)).save(path)
    assert "overlap" in {finding.kind for finding in report_module.inspect(folder).findings}
    for path in planting.images(folder):
        path.write_bytes(b"no image")
    assert kinds(report_module.inspect(folder)) == {"file"}


def test_the_same_capture_gives_the_same_report(folders):
    one, two = (report_module.inspect(folders / "transforms") for _ in range(2))
    assert one.text() == two.text() and np.array_equal(one.places, two.places)


def test_corners_are_matched_across_a_shift():
    rng = np.random.default_rng(0)
    image = features.blur(rng.uniform(size=(120, 140)).astype(np.float32), 1.5)
    first, second = features.find(image[:, :120], 2), features.find(image[:, 20:], 2)
    pairs = features.match(first, second)
    shift = first.pixels[pairs[:, 0]] - second.pixels[pairs[:, 1]]
    assert len(pairs) > 20
    assert np.median(np.abs(shift - [40, 0])) < 0.1
    nothing = tracks.no_features()
    assert features.match(nothing, first).shape == (0, 2)
    assert features.find(np.zeros((100, 100), np.float32), 1).pixels.shape == (0, 2)


def test_triangulation_finds_the_point_of_a_track():
    poses = np.stack([np.asarray(shot.camera.to_world, np.float64) for shot in shots(4)])
    point = np.array([-1.0, 0.5, -0.3])
    local = np.einsum("vji,vj->vi", poses[:, :, :3], point - poses[:, :, 3])
    seen = local[:, :2] * [1, -1] / -local[:, 2:]
    track = tracks.Tracks(np.arange(4)[None], seen[None], np.zeros((1, 4), int), np.ones((1, 4), bool))
    places, off = tracks.triangulate(track, poses)
    np.testing.assert_allclose(places[0], point, atol=1e-6)
    assert off.max() < 1e-6
    behind = np.concatenate([poses[:, :, :3] @ np.diag([-1.0, -1, -1]), poses[:, :, 3:]], axis=-1)
    assert np.isinf(tracks.triangulate(track, behind)[1]).all()


def test_the_picture_shows_flagged_cameras_red(folders):
    report = report_module.inspect(folders / "llff")
    picture = camera_plot.plot_cameras(report.capture, report.poses, report.places, flagged={2})
    colours = {colour for _, colour in picture.getcolors(1 << 20)}
    assert (224, 32, 32) in colours and (32, 96, 192) in colours and picture.width > 1000


def run(*arguments, cwd):
    root = pathlib.Path(__file__).resolve().parents[2]
    return subprocess.run(
        [sys.executable, "-m", "jaxnerf.check", *map(str, arguments)],
        cwd=cwd,
        env={"PYTHONPATH": str(root), "JAX_PLATFORMS": "cpu", "PATH": "/usr/bin:/bin"},
        capture_output=True,
        text=True,
    )


def test_the_program_says_what_it_found_and_keeps_its_hands_off_the_capture(folders, tmp_path):
    before = sorted(folders.rglob("*"))
    done = run(f"--data_dir={folders / 'llff'}", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert "nothing found that would ruin training" in done.stdout
    assert [path.name for path in tmp_path.iterdir()] == ["check-llff.png"]
    assert sorted(folders.rglob("*")) == before
    again = run(f"--data_dir={folders / 'llff'}", cwd=tmp_path)
    assert again.returncode == 1 and again.stderr.count("\n") == 1 and "--overwrite" in again.stderr
    bad = run(f"--data_dir={folders / 'llff'}", "--near=200", "--far=600", "--overwrite", cwd=tmp_path)
    assert bad.returncode == 1 and "RUINS near 200" in bad.stdout and not bad.stderr
    inside = run(f"--data_dir={folders / 'llff'}", f"--out={folders / 'llff' / 'x.png'}", cwd=tmp_path)
    assert inside.returncode == 1 and "give --out" in inside.stderr


SCENES = {  # a part of what experiments/check_planted.py plants by hand
    "lego": ["clean"],
    "fern": ["clean", "y and z flipped", "bounds in cm"],
    "fox": ["clean"],
    "can": ["clean"],
}


@pytest.mark.scenes("can")
def test_photographs_too_far_apart_to_judge_by_ruin_nothing(scenes_dir, tmp_path):
    folder = planting.copy(scenes_dir / "can", tmp_path / "can", without=("sparse",))
    for index, path in enumerate(planting.images(folder)):
        if index % 8:
            path.unlink()
    rows = np.load(folder / "poses_bounds.npy")
    np.save(folder / "poses_bounds.npy", rows[::8])
    report = report_module.inspect(folder)  # the can has one label on both sides, which look alike
    assert not report.ruined, report.text()


@pytest.mark.scenes("lego", "fern", "fox", "can")
@pytest.mark.parametrize("scene", SCENES)
def test_planted_in_real_scenes(scenes_dir, tmp_path, scene, monkeypatch):
    monkeypatch.setattr(check_planted.inspect_photos, "_read", check_planted.read_once())
    for name in SCENES[scene]:
        wanted, plant, flags = check_planted.defects(scene)[name]
        folder = planting.copy(scenes_dir / scene, tmp_path / name.replace(" ", "-") / scene)
        plant(folder)
        verdict, lines = check_planted.check(folder, wanted, flags)
        # A model's points, which stay where they were, tell of wrong poses, too.
        good = ("nothing ruins",) if wanted is None else ("found (ruins)", "found by the reader")
        assert verdict.removesuffix(", also points") in good, (name, verdict, lines)


def test_cameras_in_one_place_are_said_and_not_called_turned(tmp_path):
    stack = captures.orbit(6)
    poses = np.array(stack.to_world)
    poses[:, :, 3] = poses[0, :, 3]
    captures.write_transforms(tmp_path, captures.noise(dataclasses.replace(stack, to_world=poses)))
    report = report_module.inspect(tmp_path)
    assert [finding.kind for finding in report.findings if finding.severity == "ruins"] == ["pose"]
    assert "all 6 cameras stand in one place" in report.text()
