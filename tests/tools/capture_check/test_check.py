"""Tests jaxnerf-check: the defects it finds in datasets, and the changes it proposes."""

import dataclasses
import functools
import json
import pathlib
import subprocess
import sys

import jax
import numpy as np
import pytest
from PIL import Image, ImageCms, ImageColor, ImageFilter

import captures
from jaxnerf.core import cameras, types
from jaxnerf.core import poses as poses_module
from jaxnerf.data.geometry import path_poses, world
from jaxnerf.data.images import load_images
from jaxnerf.data.images.image_files import read_image
from jaxnerf.tools.capture_check import camera_plot, findings, images, tracks
from jaxnerf.tools.capture_check.report import inspect

ROOT = pathlib.Path(__file__).resolve().parents[3]
sys.path.insert(0, str(ROOT / "experiments" / "capture_check"))
import check_planted  # noqa: E402
import planting  # noqa: E402

SIZE = 160


def indoor_scene(origins, directions):
    """Returns the colours [..., 3] that rays see on three textured walls, x = -2, y = 2 and z = -1."""
    walls = np.array([-2.0, 2.0, -1.0])
    with np.errstate(divide="ignore"):
        t = (walls - origins) / directions
    t = np.where(t > 1e-6, t, np.inf)
    wall = t.argmin(axis=-1)
    points = origins + t.min(axis=-1, keepdims=True) * directions
    rng = np.random.default_rng(0)
    waves = rng.normal(size=(3, 40, 3)) * 7, rng.uniform(0, 6, (3, 40)), rng.normal(size=(40, 3))
    phase = np.einsum("...i,...ki->...k", points, waves[0][wall]) + waves[1][wall]
    return 1 / (1 + np.exp(-0.7 * np.sin(phase) @ waves[2]))


def shots(count=12, lens="pinhole"):
    """Returns the Shots of cameras on two short arcs, which look into the corner of the room."""
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
        rgb = indoor_scene(*(np.float64(value) for value in (rays.origins, rays.directions)))
        pixels = np.concatenate([rgb, np.ones((SIZE, SIZE, 1))], axis=-1)
        result.append(captures.Shot(f"{index:03d}", camera, np.uint16(np.rint(65535 * pixels))))
    return result


@pytest.fixture(scope="module")
def folders(tmp_path_factory):
    """A folder with a dataset without defects in each format."""
    base = tmp_path_factory.mktemp("clean")
    straight = shots()
    grid = np.meshgrid(np.linspace(-1.9, 1, 12), np.linspace(-1, 1.9, 12))
    xyz = np.stack([*grid, np.full_like(grid[0], -1.0)], axis=-1).reshape(-1, 3)
    project = jax.jit(cameras.project)
    at, depth = zip(*(project(shot.camera, np.float32(xyz)) for shot in straight), strict=True)
    at, depth = np.float64(at), np.float64(depth)
    seen = (depth > 0) & (at > 0).all(axis=-1) & (at < SIZE).all(axis=-1)
    points = captures.Points(xyz, np.full((len(xyz), 3), 128, np.uint8), seen, at, depth)
    captures.write_transforms(base / "transforms", shots(lens="opencv"))
    captures.write_colmap(base / "colmap", straight, points=points)
    captures.write_llff(base / "llff", straight, points=points)
    return base


@functools.cache
def clean(folder):
    """Returns the Report of a dataset without defects."""
    return inspect(folder)


def planted(folders, tmp_path, format, plant):
    """Plants a defect in a copy of a dataset and returns the Report."""
    folder = planting.copy(folders / format, tmp_path / format)
    plant(folder)
    return inspect(folder)


def kinds(report):
    return {finding.kind for finding in report.findings if finding.severity == "error"}


def test_cameras_that_hardly_fit_any_image_are_reported(folders, tmp_path):
    """No single camera is at fault, and no common change of all of them helps."""

    def plant(folder):
        content = json.loads((folder / "transforms.json").read_text())
        for index, frame in enumerate(content["frames"]):
            factor = 1.16 if index % 2 else 1.0
            frame |= {"fl_x": factor * content["fl_x"], "fl_y": factor * content["fl_y"]}
        (folder / "transforms.json").write_text(json.dumps(content))

    report = planted(folders, tmp_path, "transforms", plant)
    (found,) = (finding for finding in report.findings if finding.kind == "pose")
    assert "of the matched corners fit the cameras; expected a third or more" in found.line()


def test_a_fault_of_all_images_is_stated_for_the_first_ones(folders, tmp_path):
    def plant(folder):
        content = json.loads((folder / "transforms.json").read_text())
        for level in [content, *content["frames"]]:
            if "w" in level:
                level["w"], level["h"] = level["h"] // 2, level["w"]
        (folder / "transforms.json").write_text(json.dumps(content))

    text = planted(folders, tmp_path, "transforms", plant).text()
    assert text.count("its camera is for") == 3 and "and 9 more images like these" in text and "12 errors" in text


@pytest.mark.parametrize("format", ["transforms", "colmap", "llff"])
def test_a_dataset_without_defects_has_no_errors(folders, format):
    report = clean(folders / format)
    assert not report.num_errors, report.text()
    assert f"format     {format}" in report.text() and "12: 10 train, 2 test" in report.text()
    assert len(report.points) > 200
    off_walls = np.abs(report.points - [-2.0, 2.0, -1.0]).min(axis=1)
    assert np.median(off_walls) < 0.02
    assert not {"exposure", "lens", "training"} & {finding.kind for finding in report.findings}


def change_frames(change):
    """Returns a function that calls change(index, frame, image file) for each frame of a transforms.json."""

    def plant(folder):
        content = json.loads((folder / "transforms.json").read_text())
        for index, frame in enumerate(content["frames"]):
            change(index, frame, folder / frame["file_path"])
        (folder / "transforms.json").write_text(json.dumps(content))

    return plant


def rewrite(file, change):
    pixels = read_image(file)[..., :3]
    pixels = change(np.uint8(pixels >> 8 if pixels.dtype == np.uint16 else pixels))
    file.unlink()  # it is a link to the file of the dataset without defects
    Image.fromarray(pixels).save(file)


def test_what_training_refuses_is_an_error(folders, tmp_path):
    lens = {"camera_model": "OPENCV_FISHEYE", **dict.fromkeys(("k1", "k2", "k3", "k4", "p1", "p2"), 0.0)}
    report = planted(
        folders, tmp_path, "transforms", change_frames(lambda k, frame, _: frame.update(lens if k % 4 == 1 else {}))
    )
    (found,) = (finding for finding in report.findings if finding.kind == "training")
    assert found.severity == "error" and "training refuses this: the images mix lenses" in found.line()


def test_images_of_the_size_of_their_own_cameras_are_not_odd(folders, tmp_path):
    def crop(index, frame, file):
        if index % 3 == 2:
            frame |= {"w": 120, "h": SIZE}
            rewrite(file, lambda pixels: pixels[:, :120])

    report = planted(folders, tmp_path, "transforms", change_frames(crop))
    assert not any(finding.kind == "size" for finding in report.findings), report.text()


@pytest.mark.parametrize("size, accepted", [(SIZE, True), (SIZE // 2, True), (100, False)])
def test_masks_of_the_full_size_are_read_beside_smaller_images_as_in_training(folders, tmp_path, size, accepted):
    def shrink(index, frame, file):
        rewrite(file, lambda pixels: pixels[::2, ::2])
        frame["mask_path"] = f"masks/{index:03d}.png"
        mask = file.parents[1] / frame["mask_path"]
        mask.parent.mkdir(exist_ok=True)
        Image.new("L", (size, size), 255).save(mask)

    report = planted(folders, tmp_path, "transforms", change_frames(shrink))
    assert any("export the mask again" in finding.change for finding in report.findings) != accepted


@pytest.mark.parametrize("gains", [[1, 1, 1, 0.6], [(1, 1, 1), (1, 0.9, 0.75)]])
def test_images_of_other_exposures_or_white_balances_are_found(folders, tmp_path, gains):
    def expose(index, frame, file):
        rewrite(file, lambda pixels: np.uint8(pixels * np.array(gains[index % len(gains)])))

    report = planted(folders, tmp_path, "transforms", change_frames(expose))
    (found,) = (finding for finding in report.findings if finding.kind == "exposure")
    assert "times" in found.found and "--config.cameras.exposure=True" in found.change


_OPENCV, _ROLLED = np.diag([1.0, -1.0, -1.0, 1.0]), np.diag([-1.0, -1.0, 1.0, 1.0])
_Y_UP = np.array([[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]])


@pytest.mark.parametrize(
    "chosen, read, says",
    [
        (lambda k: 5 <= k < 10, lambda pose: pose @ _OPENCV, "5 of 12 images, 005 to 009, are in OpenCV's axes"),
        (lambda k: k in (0, 2, 4, 6, 8), lambda pose: pose @ _OPENCV, "000, 002, 004, 006, 008, are in OpenCV's axes"),
        (lambda k: k < 7, lambda pose: pose @ _OPENCV, "7 of 12 images, 000 to 006, are in OpenCV's axes"),
        (lambda k: k in (3, 8), lambda pose: pose @ _ROLLED, "2 of 12 images, 003, 008, are in axes turned"),
        (lambda k: 6 < k < 10, np.linalg.inv, "3 of 12 images, 007 to 009, are in world-to-camera matrices"),
        (lambda k: 6 < k < 10, lambda pose: _Y_UP @ pose, "3 of 12 images, 007 to 009, are in a world turned by right"),
    ],
)
def test_images_whose_poses_are_in_other_axes_than_the_rest_are_named(folders, tmp_path, chosen, read, says):
    """The last two of the images share too little with the others to be judged."""

    def turn(index, frame, file):
        if chosen(index):
            frame["transform_matrix"] = read(np.array(frame["transform_matrix"])).tolist()

    report = planted(folders, tmp_path, "transforms", change_frames(turn))
    assert kinds(report) == {"axes"}, report.text()
    (found,) = (finding for finding in report.findings if finding.kind == "axes")
    assert says in found.found and found.change.startswith("of these images only, "), found
    np.testing.assert_allclose(report.poses[:10], clean(folders / "transforms").poses[:10], atol=1e-6)


def test_what_was_noted_when_the_cameras_were_found_is_repeated(folders, tmp_path):
    def note(folder):
        place = next(path.parent for path in folder.rglob("images.*") if path.is_file())
        (place / findings.NOTES).write_text("the cameras may be wrong, as they contradict a and b\n")

    report = planted(folders, tmp_path, "colmap", note)
    assert any(finding.kind == "fold" and "as they contradict a and b" in finding.found for finding in report.findings)


def test_plots_of_folders_of_one_name_do_not_collide_and_show_up_as_up(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    one, other = tmp_path / "one" / "scene", tmp_path / "other" / "scene"
    options = {"is_run": False, "overwrite": False}
    first = camera_plot.new_path(None, one, **options)
    camera_plot.save(camera_plot.Figure(), first, one)
    names = [str(camera_plot.new_path(None, folder, **options)) for folder in (one, other)]
    names.append(str(camera_plot.new_path(None, one, is_run=True, overwrite=False)))
    assert names == ["check-scene.png", "check-other-scene.png", "next-images-scene.png"]
    up = np.array([0.0, 0.57, 0.82]) / np.hypot(0.57, 0.82)
    axes = camera_plot._axes(up)
    np.testing.assert_allclose(axes @ axes.T, np.eye(3), atol=1e-12)
    np.testing.assert_allclose(axes[2], up)
    assert np.linalg.det(axes) > 0
    np.testing.assert_array_equal(camera_plot._axes(np.array([0.0, 0.02, -1.0]))[2], [0, 0, -1])


@pytest.mark.slow
@pytest.mark.parametrize("format", ["transforms", "llff"])
@pytest.mark.parametrize("signs", [(1, -1, -1), (-1, -1, 1), (-1, 1, -1)])
def test_turned_axes_are_found_and_the_change_corrects_them(folders, tmp_path, format, signs):
    report = planted(folders, tmp_path, format, lambda f: planting.edit_poses(f, planting.flip(*signs)))
    assert kinds(report) == {"axes"}
    (finding,) = (finding for finding in report.findings if finding.kind == "axes")
    order = {"transforms": (1, 2, 3), "llff": (2, 1, 3)}[format]  # LLFF's columns: down, right, backwards
    negated = sorted(column for column, sign in zip(order, signs, strict=True) if sign < 0)
    assert finding.change.endswith(f"negate columns {negated[0]} and {negated[1]}")
    np.testing.assert_allclose(report.poses, clean(folders / format).poses, atol=1e-6)


def test_inverted_and_swapped_axes_are_found(folders, tmp_path):
    def invert(poses):
        turn = np.swapaxes(poses[:, :, :3], 1, 2)
        return np.concatenate([turn, -turn @ poses[:, :, 3:]], axis=-1)

    report = planted(folders, tmp_path, "transforms", lambda f: planting.edit_poses(f, invert))
    assert kinds(report) == {"axes"} and "invert it" in report.findings[0].change
    swapped = np.array([[0.0, 1, 0], [-1, 0, 0], [0, 0, 1]])
    change = findings.axes_change(report.capture.files, swapped.T, False)
    assert change.endswith("replace its columns by +2, -1, +3 of the old ones")


def test_a_mirrored_world_is_found_and_the_change_corrects_it(folders, tmp_path):
    report = planted(folders, tmp_path, "transforms", lambda f: planting.edit_poses(f, planting.mirror))
    assert kinds(report) == {"axes"}
    assert "negate columns 1, then also negate row 1" in report.findings[0].change
    with pytest.raises(ValueError, match="determinant -1.*negate one axis"):
        planted(folders, tmp_path / "x", "llff", lambda f: planting.edit_poses(f, planting.flip(-1, 1, 1)))


@pytest.mark.parametrize("factor", [0.8, 1.25])
def test_a_wrong_focal_length_is_found_and_estimated(folders, tmp_path, factor):
    report = planted(folders, tmp_path, "llff", lambda folder: planting.scale_focal(folder, factor))
    assert kinds(report) == {"focal"}
    (finding,) = (finding for finding in report.findings if finding.kind == "focal")
    assert float(finding.expected.removeprefix("about ")) == pytest.approx(1.2 * SIZE, rel=0.03)


def test_the_focal_length_is_that_of_the_files(folders, tmp_path):
    """Files of half the size that their cameras state have half the focal length."""

    def shrink(folder):
        for path in (folder / "images").iterdir():
            with Image.open(path) as image:
                half = image.resize((SIZE // 2, SIZE // 2))
            path.unlink()  # a link
            half.save(path)

    lens = dict(planted(folders, tmp_path, "colmap", shrink).facts)["lens"]
    assert lens.startswith(f"focal length {0.6 * SIZE:.5g}, {0.6 * SIZE:.5g} px (of the cameras' 160 x 160 px: 2 times")
    whole = dict(clean(folders / "colmap").facts)["lens"]
    assert whole.startswith(f"focal length {1.2 * SIZE:.5g}, {1.2 * SIZE:.5g} px; field of view")
    assert lens.split("; ")[1] == whole.split("; ")[1]


def test_two_swapped_images_are_named(folders, tmp_path):
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


def test_permuted_poses_are_found(folders, tmp_path):
    order = np.random.default_rng(0).permutation(12)
    report = planted(folders, tmp_path, "llff", lambda f: planting.edit_poses(f, lambda poses: poses[order]))
    assert kinds(report) == {"pose"} and "confirmed by a third image" in report.text()


def test_cameras_that_do_not_fit_the_models_points_are_found(folders, tmp_path):
    def move(folder):
        path = folder / "sparse" / "0" / "cameras.txt"
        path.write_text(path.read_text().replace("192.", "230.").replace("80.0", "90.0"))

    assert "points" in kinds(planted(folders, tmp_path, "colmap", move))


def test_bounds_in_other_units_are_found(folders, tmp_path):
    report = planted(folders, tmp_path, "llff", lambda folder: planting.scale_bounds(folder, 100))
    assert kinds(report) == {"bounds"} and "times 0.0" in report.findings[0].change
    assert "bounds" in kinds(inspect(folders / "transforms", near=200.0, far=600.0))


def test_truncated_files_odd_sizes_and_missing_masks_or_alpha_are_named(folders, tmp_path):
    def spoil(folder):
        planting.cut(folder / "images" / "002.png")
        planting.resize(folder / "images" / "004.png", 0.8)
        planting.resize(folder / "images" / "006.png", 0.5)

    report = planted(folders, tmp_path, "transforms", spoil)
    found = {(finding.severity, finding.kind, finding.frames) for finding in report.findings}
    assert {("error", "file", (2,)), ("error", "size", (4,)), ("warning", "size", (6,))} <= found
    assert {finding[2] for finding in found if finding[0] == "error"} == {(2,), (4,)}
    with pytest.raises(ValueError, match="mask"):
        planted(folders, tmp_path / "m", "transforms", lambda f: planting.add_masks(f, without=["007"]))
    report = planted(folders, tmp_path / "a", "llff", lambda folder: planting.remove_alpha(folder, 3))
    assert kinds(report) == {"mask"} and report.findings[0].frames == (3,)


def test_duplicate_and_blurred_images_are_warnings(folders, tmp_path):
    def spoil(folder):
        files = planting.images(folder)
        planting._write(files[1], files[0].read_bytes())
        soft = Image.open(files[9]).convert("RGB").filter(ImageFilter.GaussianBlur(3))
        files[9].unlink()
        soft.save(files[9])

    report = planted(folders, tmp_path, "transforms", spoil)
    warnings = {(finding.kind, finding.frames) for finding in report.findings if finding.severity == "warning"}
    assert {("duplicate", (0, 1)), ("blur", (9,))} <= warnings


def test_few_plain_or_damaged_images_get_a_report(tmp_path):
    captures.write_transforms(tmp_path / "one", shots(1))
    with pytest.raises(ValueError, match="add images"):
        inspect(tmp_path / "one")
    folder = tmp_path / "few"
    captures.write_transforms(folder, shots(2))
    camera_plot.save(camera_plot.plot_cameras(inspect(folder)), tmp_path / "plot.png", folder)
    for path in planting.images(folder):
        Image.new("RGB", (SIZE, SIZE)).save(path)
    assert "overlap" in {finding.kind for finding in inspect(folder).findings}
    for path in planting.images(folder):
        path.write_bytes(b"no image")
    assert kinds(inspect(folder)) == {"file"}


def test_the_report_is_reproducible(folders):
    one, two = clean(folders / "transforms"), inspect(folders / "transforms")
    assert one.text() == two.text() and np.array_equal(one.points, two.points)


def test_corners_are_matched_across_a_shift():
    pixels = np.random.default_rng(0).integers(0, 255, (60, 70, 3), np.uint8)
    pixels = np.asarray(Image.fromarray(pixels).resize((1400, 1200), Image.Resampling.BICUBIC))
    grey = images.reduce(pixels, 466)
    assert grey.shape == (399, 466)
    first, second = (tracks.Keypoints(*images.find_corners(part)) for part in (grey[:, :-20], grey[:, 20:]))
    pairs = tracks.match(first, second)
    shift = first.points[pairs >= 0] - second.points[pairs[pairs >= 0]]
    assert len(shift) > 100
    assert np.median(np.abs(shift - [20, 0])) < 0.1
    nothing = tracks.Keypoints(*images.find_corners(np.zeros((100, 100), np.float32)))
    assert nothing.points.shape == (0, 2)
    assert tracks.match(nothing, first).shape == (0,) and (tracks.match(first, nothing) == -1).all()


def test_alpha_is_composited_over_white():
    pixels = np.zeros((4, 4, 4), np.uint16)
    pixels[:2] = [65535, 0, 0, 32768]
    grey = images.reduce(pixels, 4)
    np.testing.assert_allclose(grey[2:], 1)
    np.testing.assert_allclose(grey[:2], 0.5 + 0.5 * 0.299, atol=1e-4)


def test_triangulation_finds_the_point_of_a_track():
    poses = np.stack([np.asarray(shot.camera.to_world, np.float64) for shot in shots(4)])
    point = np.array([-1.0, 0.5, -0.3])
    local = np.einsum("vji,vj->vi", poses[:, :, :3], point - poses[:, :, 3])
    seen = local[:, :2] * [1, -1] / -local[:, 2:]
    track = tracks.Tracks(np.arange(4)[None], seen[None], np.ones((1, 4), bool))
    points, off = tracks.triangulate(track, poses)
    np.testing.assert_allclose(points[0], point, atol=1e-6)
    assert off.max() < 1e-6
    behind = np.concatenate([poses[:, :, :3] @ np.diag([-1.0, -1, -1]), poses[:, :, 3:]], axis=-1)
    assert np.isinf(tracks.triangulate(track, behind)[1]).all()


def test_the_plot_shows_cameras_with_findings_in_red_and_the_path_that_render_selects(folders, tmp_path):
    report = clean(folders / "llff")
    poses = world.poses_of(report.capture)[load_images.split_indices(report.capture, "train")]
    kind, reason = path_poses.default_kind(poses)
    assert dict(report.facts)["path"] == f"jaxnerf-render selects {kind}, as {reason}"
    np.testing.assert_array_equal(report.path, path_poses.make_poses(kind, poses))
    wrong = findings.Finding("error", "pose", "", "", "", (2,))
    camera_plot.save(camera_plot.plot_cameras(report._replace(findings=(wrong,))), tmp_path / "plot.png", folders)
    pixels = np.int32(Image.open(tmp_path / "plot.png").convert("RGB"))
    for color in (camera_plot.FLAGGED, camera_plot.CAMERA, camera_plot.PATH):
        assert (np.abs(pixels - ImageColor.getrgb(color)).max(axis=-1) < 40).sum() > 20
    assert camera_plot.is_plot_of(tmp_path / "plot.png", folders)
    assert not camera_plot.is_plot_of(tmp_path / "plot.png", tmp_path)


def run(*arguments, cwd, without=()):
    """Runs the program as a user does, as if the modules in `without` were not installed."""
    code = (
        f"import sys; sys.modules.update(dict.fromkeys({list(without)})); "
        "from jaxnerf.tools.capture_check import program; program.run()"
    )
    return subprocess.run(
        [sys.executable, "-c", code, *map(str, arguments)],
        cwd=cwd,
        env={"PYTHONPATH": str(ROOT), "JAX_PLATFORMS": "cpu", "PATH": "/usr/bin:/bin"},
        capture_output=True,
        text=True,
    )


@pytest.mark.slow
def test_the_program_reports_and_does_not_touch_the_dataset(folders, tmp_path):
    before = sorted(folders.rglob("*"))
    done = run(f"--data_dir={folders / 'llff'}", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert "no errors" in done.stdout and done.stdout.endswith("plot: check-llff.png\n")
    assert [path.name for path in tmp_path.iterdir()] == ["check-llff.png"]
    assert sorted(folders.rglob("*")) == before
    bad = run(f"--data_dir={folders / 'llff'}", "--near=200", "--far=600", cwd=tmp_path)  # over its own plot
    assert bad.returncode == 1 and "ERROR   near 200" in bad.stdout
    assert all(line.startswith("working") for line in bad.stderr.splitlines()), bad.stderr  # on a busy machine
    inside = run(f"--data_dir={folders / 'llff'}", f"--out={folders / 'llff' / 'x.png'}", cwd=tmp_path)
    assert inside.returncode == 1 and "choose another path with --out" in inside.stderr


@pytest.mark.slow
def test_the_program_replaces_no_other_file_than_its_own_plot(folders, tmp_path):
    plot = tmp_path / "plot.png"
    other = camera_plot.plot_cameras(clean(folders / "llff"))
    camera_plot.save(other, tmp_path / "another_dataset.png", folders / "colmap")
    Image.new("RGB", (2, 2)).save(tmp_path / "image.png")
    for content in ((tmp_path / "another_dataset.png").read_bytes(), (tmp_path / "image.png").read_bytes(), b"text"):
        plot.write_bytes(content)
        refused = run(f"--data_dir={folders / 'llff'}", f"--out={plot}", cwd=tmp_path)
        assert refused.returncode == 1 and refused.stderr.count("\n") == 1 and "--overwrite" in refused.stderr
        assert plot.read_bytes() == content and not refused.stdout
    (tmp_path / "plot.png.0123.tmp").touch()  # of a process that was killed
    done = run(f"--data_dir={folders / 'llff'}", f"--out={plot}", "--overwrite", cwd=tmp_path)
    assert done.returncode == 0 and not list(tmp_path.glob("*.tmp")) and camera_plot.is_plot_of(plot, folders / "llff")


def test_the_program_names_packages_that_are_missing(folders, tmp_path):
    done = run(f"--data_dir={folders / 'llff'}", cwd=tmp_path, without=["matplotlib"])
    assert done.returncode == 0 and "no errors" in done.stdout, done.stderr
    assert "pip install matplotlib" in done.stdout and not list(tmp_path.iterdir())
    done = run(f"--data_dir={folders / 'llff'}", cwd=tmp_path, without=["cv2"])
    assert done.returncode == 1 and done.stderr.count("\n") == 1
    assert "pip install opencv-python-headless" in done.stderr


@pytest.mark.scenes("can")
def test_images_too_far_apart_to_judge_are_no_error(scenes_dir, tmp_path):
    folder = planting.copy(scenes_dir / "can", tmp_path / "can", without=("sparse",))
    for index, path in enumerate(planting.images(folder)):
        if index % 8:
            path.unlink()
    rows = np.load(folder / "poses_bounds.npy")
    np.save(folder / "poses_bounds.npy", rows[::8])
    report = inspect(folder)  # both sides of the can have the same label
    assert not report.num_errors, report.text()


@pytest.mark.slow
@pytest.mark.scenes("fern")
def test_defects_planted_in_a_real_scene_are_found(scenes_dir, tmp_path, monkeypatch):
    """A part of those in check_planted.py; test_folds.py checks that the scenes themselves have no errors."""
    monkeypatch.setattr(images, "_summarize", check_planted.read_once())
    for name in ("y and z flipped", "bounds in cm"):
        expected, plant, flags = check_planted.defects("fern")[name]
        folder = planting.copy(scenes_dir / "fern", tmp_path / name.replace(" ", "-") / "fern")
        plant(folder)
        verdict, lines = check_planted.check(folder, expected, flags)
        # The points of a model stay where they were and do not fit the wrong poses either.
        assert verdict.removesuffix(", also points") in ("found (error)", "found by the reader"), (name, verdict, lines)


def test_cameras_at_one_position_are_found_and_their_axes_are_not_judged(tmp_path):
    stack = captures.orbit(6)
    poses = np.array(stack.to_world)
    poses[:, :, 3] = poses[0, :, 3]
    captures.write_transforms(tmp_path, captures.noise(dataclasses.replace(stack, to_world=poses)))
    report = inspect(tmp_path)
    assert [finding.kind for finding in report.findings if finding.severity == "error"] == ["pose"]
    assert "all 6 cameras are at the same position" in report.text()


def test_test_views_among_the_training_views_and_unused_facts_are_reported(folders, tmp_path):
    def plant(folder):
        path = folder / "transforms.json"
        content = json.loads(path.read_text())
        names = [frame["file_path"] for frame in content["frames"]]
        content |= {"train_filenames": names, "test_filenames": names[::4], "camera_angle_x": 1.5}
        path.write_text(json.dumps(content))

    report = planted(folders, tmp_path, "transforms", plant)
    assert not report.num_errors
    (leak,) = (finding for finding in report.findings if finding.kind == "leak")
    assert leak.line().startswith(
        "WARNING 3 of 3 views of the split 'test' are training views, too (000 is the same file)"
    )
    (unused,) = (finding for finding in report.findings if finding.kind == "skipped")
    assert "camera_angle_x 1.5 is a focal length of 85.874 of 160 px, 192 px is stated, too, and used" in unused.found


def test_what_files_state_and_training_does_not_follow_is_reported(folders, tmp_path):
    """EXIF orientations, colour profiles, a principal point outside, a lens that folds, times."""

    def plant(folder):
        path, exif = folder / "transforms.json", Image.Exif()
        content = json.loads(path.read_text())
        exif[0x0112] = 3
        profile = bytearray(ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes())
        profile = profile.replace(b"s\0R\0G\0B", b"p\0R\0G\0B").replace(b"sRGB", b"pRGB")
        for index, frame in enumerate(content["frames"]):
            image = Image.open(folder / frame["file_path"])
            image.save(folder / frame["file_path"], exif=exif, icc_profile=bytes(profile) if index < 5 else None)
            frame["time"] = 0.0
        content["frames"][0] |= {"cx": -900.0}
        content["k1"] = -3.0
        path.write_text(json.dumps(content))

    text = planted(folders, tmp_path, "transforms", plant).text()
    assert "WARNING EXIF orientation of 12 of 12 images (3 in 000.png) is not followed" in text
    assert "WARNING colour profiles differ, and images are read as they are: 5 pRGB" in text and "7 sRGB" in text
    assert "WARNING the principal point of 000 is -900, 80 px in an image of 160, 160 px, so outside" in text
    assert "% of the pixels have no ray: " in text and "expected a ray for each" in text
    assert "time       training images at 1 time from 0 to 0, " in text and "images each, as of a rig" in text


def test_split_files_with_full_intrinsics_are_checked_as_one_file_is(folders, tmp_path):
    def plant(folder):
        content = json.loads((folder / "transforms.json").read_text())
        for split, frames in (("train", content["frames"][2:]), ("test", content["frames"][:2])):
            (folder / f"transforms_{split}.json").write_text(json.dumps({**content, "frames": frames}))
        (folder / "transforms.json").unlink()

    report = planted(folders, tmp_path, "transforms", plant)
    assert not report.num_errors, report.text()
    facts = dict(report.facts)
    assert facts["format"].startswith("transforms (") and "12: 10 train, 2 test" in facts["views"]
    assert "transforms_train.json states fl_x" in facts["read"] and "from the cameras" in facts["near, far"]
