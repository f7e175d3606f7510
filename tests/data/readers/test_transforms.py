"""The transforms.json reader: cameras, lenses, splits, points, and errors of files."""

import copy
import json
import math
import os

import jax
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from PIL import Image

import captures
import jaxnerf
from jaxnerf.data.images.image_files import read_image
from jaxnerf.data.readers.base import fingerprint
from jaxnerf.data.readers.ply import read_points
from jaxnerf.data.readers.transforms import read_capture
from jaxnerf.tools.embedded_scene import render


@pytest.fixture(scope="session")
def shots():
    """Returns eight Shots of one pinhole camera, with random pixels."""
    return captures.noise(captures.orbit(8))


@pytest.fixture
def dataset(tmp_path, shots):
    """Returns a function that changes and writes the JSON file of a valid dataset."""
    content = captures.write_transforms(tmp_path, shots)

    def write(change=lambda content: None):
        changed = copy.deepcopy(content)
        change(changed)
        (tmp_path / "transforms.json").write_text(json.dumps(changed))
        return tmp_path

    return write


def assert_cameras(capture, shots):
    """Checks that the cameras of a Capture are those of the shots, bit for bit."""
    assert len(capture.frames) == len(shots)
    for frame, shot in zip(capture.frames, shots, strict=True):
        camera = frame.camera
        assert frame.name == shot.name and frame.image.is_file()
        assert (camera.lens, camera.height, camera.width) == (
            shot.camera.lens,
            shot.camera.height,
            shot.camera.width,
        )
        for key in ("to_world", "focal", "center", "distortion"):
            found, expected = getattr(camera, key), getattr(shot.camera, key)
            assert (found is None) == (expected is None)
            if found is not None:
                assert found.dtype == np.float64
                np.testing.assert_array_equal(found, expected)


def test_a_plain_dataset_is_read_back(dataset, shots):
    capture = read_capture(dataset())
    assert capture.format == "transforms" and capture.source.name == "transforms.json"
    assert_cameras(capture, shots)
    assert capture.splits is None and capture.points is None and capture.box is None and capture.notes == ()
    assert all(frame.mask is None and frame.bounds is None for frame in capture.frames)


def test_sizes_and_cameras_may_differ_from_frame_to_frame(tmp_path):
    mixed = captures.noise(
        captures.orbit(3),
        captures.orbit(2, height=30, width=20, lens="opencv", first=3),
        captures.orbit(2, lens="opencv", first=5, distortion=(-0.2, 0.05, 0.0, 0.001, 0.02)),
        captures.orbit(2, lens="fisheye", first=7, distance=2.4),
    )
    content = captures.write_transforms(tmp_path, mixed)
    assert "fl_x" not in content and "fl_x" in content["frames"][0]
    assert_cameras(read_capture(tmp_path), mixed)


@pytest.mark.parametrize("lens", ["opencv", "fisheye"])
def test_the_scene_rendered_with_the_cameras_that_are_read_equals_the_images(tmp_path, lens):
    """Outside the masks they are equal bit for bit, and an image of a pinhole differs."""
    stack = captures.orbit(2, lens=lens, distance=4.0 if lens == "opencv" else 2.4)
    shots = captures.shoot(stack)
    captures.write_transforms(tmp_path, shots, bits=16, rgba=True, masks=True)
    capture = read_capture(tmp_path)
    read = jax.tree.map(lambda *leaves: np.float32(leaves), *(frame.camera for frame in capture.frames))
    seen = render.render_views(read).reshape(2, 24, 32, 4)
    for frame, expected in zip(capture.frames, seen, strict=True):
        mask = np.asarray(Image.open(frame.mask)) > 0
        np.testing.assert_array_equal(mask, captures.hidden(24, 32))
        equal = (read_image(frame.image) == expected).all(axis=-1)
        assert equal[mask].all() and not equal[~mask].any()
    if lens == "opencv":
        straight = captures.shoot(captures.orbit(2, focal=stack.focal[0]))
        off = captures.over(straight[0].pixels) - captures.over(shots[0].pixels)
        assert np.abs(off).max() > 0.3


def test_frames_are_sorted_by_name_and_named_below_their_folder(dataset):
    capture = read_capture(dataset(lambda content: content["frames"].reverse()))
    assert [frame.name for frame in capture.frames] == [f"{index:03d}" for index in range(8)]
    folder = dataset()
    (folder / "images" / "b").mkdir()
    os.rename(folder / "images" / "000.png", folder / "images" / "b" / "0.0.png")

    def nested(content):
        content["frames"][0]["file_path"] = "images/b/0.0.png"

    names = [frame.name for frame in read_capture(dataset(nested)).frames]
    assert names == [f"{index:03d}" for index in range(1, 8)] + ["b/0.0"]


@pytest.mark.parametrize("prefix", ["/home/other/scene/", "C:\\Users\\other\\scene\\", "/"])
def test_absolute_paths_of_another_computer_are_found_in_the_folder(tmp_path, shots, prefix):
    content = captures.write_transforms(tmp_path, shots, masks=True, splits={"train": range(6), "test": [6, 7]})
    own = read_capture(tmp_path)
    for frame in content["frames"]:
        frame.update({key: prefix + frame[key] for key in ("file_path", "mask_path")})
    for key in ("train_filenames", "test_filenames"):
        content[key] = [prefix + name for name in content[key]]
    (tmp_path / "transforms.json").write_text(json.dumps(content))
    found = read_capture(tmp_path)
    assert_cameras(found, shots)
    assert [frame.mask for frame in found.frames] == [frame.mask for frame in own.frames]
    assert found.splits == own.splits
    assert len(found.notes) == 1 and "has 8 absolute file_paths, read from its own folder: " in found.notes[0]
    assert found.notes[0].endswith(" as images/000.png")


@pytest.mark.parametrize(
    "center, right",
    [
        ((16, 12), True),
        ((15.1, 12.7), True),
        ((20, 11), True),  # cropped at the left
        ((13, 10), True),
        ((32, 24), False),  # twice the size: at the corner
        ((64, 48), False),
        ((24, 18), False),
        ((8, 6), False),
        ((40, 12), False),
        ((16, -3), False),
    ],
)
@pytest.mark.parametrize("in_frames", [False, True])
def test_a_principal_point_of_another_size_without_w_and_h_is_an_error(tmp_path, shots, center, right, in_frames):
    content = captures.write_transforms(tmp_path, shots)
    del content["w"], content["h"]
    center = dict(zip(("cx", "cy"), center, strict=True))
    for level in content["frames"] if in_frames else [content]:
        level |= center
    (tmp_path / "transforms.json").write_text(json.dumps(content))
    if right:
        assert read_capture(tmp_path).frames[0].camera.center.tolist() == list(center.values())
        return
    with pytest.raises(ValueError, match="cx, cy are .* without w and h, expected 16, 12 or so.* 32 x 24 px; add w"):
        read_capture(tmp_path)
    content |= {"w": 32, "h": 24}
    (tmp_path / "transforms.json").write_text(json.dumps(content))
    assert read_capture(tmp_path).frames[0].camera.center.tolist() == list(center.values())


def test_images_of_a_folder_of_another_name_are_found_in_images(tmp_path, shots):
    content = captures.write_transforms(tmp_path, shots)
    for frame in content["frames"]:
        frame["file_path"] = "/home/other/photos/" + frame["file_path"].removeprefix("images/")
    (tmp_path / "transforms.json").write_text(json.dumps(content))
    assert_cameras(read_capture(tmp_path), shots)
    os.remove(tmp_path / "images" / "003.png")
    with pytest.raises(ValueError, match=r"leaves the folder, and .* has no 003.png or images/003.png either"):
        read_capture(tmp_path)


@pytest.mark.parametrize("kind", ["png", "jpg", "webp"])
def test_file_paths_may_lack_extension_or_begin_with_a_dot(tmp_path, shots, kind):
    content = captures.write_transforms(tmp_path, shots, kind=kind)
    for frame in content["frames"][:4]:
        frame["file_path"] = "./images\\" + frame["file_path"][7:10]
    (tmp_path / "transforms.json").write_text(json.dumps(content))
    assert_cameras(read_capture(tmp_path), shots)


def test_the_size_is_the_images_if_it_is_needed_and_not_stated(tmp_path, shots):
    """The size is that of the stored image, or of the upright one if the centre fits that."""
    content = captures.write_transforms(tmp_path, shots, kind="jpg", orientation=6)
    with Image.open(tmp_path / "images" / "000.jpg") as image:
        assert image.size == (24, 32)
    for key in ("w", "h", "cx", "cy", "fl_x", "fl_y"):
        del content[key]
    content["camera_angle_x"] = 0.8
    (tmp_path / "transforms.json").write_text(json.dumps(content))
    camera = read_capture(tmp_path).frames[0].camera
    assert (camera.height, camera.width) == (32, 24) and camera.center.tolist() == [12, 16]
    np.testing.assert_allclose(camera.focal, 12 / math.tan(0.4))
    content |= {"fl_x": 50.0, "cx": 15.0, "cy": 11.0}
    (tmp_path / "transforms.json").write_text(json.dumps(content))
    camera = read_capture(tmp_path).frames[0].camera
    assert camera.height is None and camera.width is None and camera.focal.tolist() == [50, 50]
    content |= {"w": 64}  # only the width is stated; the height is the image's
    (tmp_path / "transforms.json").write_text(json.dumps(content))
    camera = read_capture(tmp_path).frames[0].camera
    assert (camera.height, camera.width) == (24, 64)


@pytest.mark.parametrize("bits", [8, 16])
def test_the_generator_writes_the_exif_orientation(tmp_path, shots, bits):
    paths = captures.write_images(tmp_path, shots[:1], bits=bits, rgba=True, orientation=6)
    with Image.open(tmp_path / paths[0]) as image:
        assert image.size == (24, 32) and image.getexif()[0x0112] == 6


ANGLE = 2 * math.atan(16 / 40)  # of a focal of 40 px at a width of 32


@pytest.mark.parametrize(
    ("whole", "own", "focal"),
    [
        ({"fl_x": 40, "fl_y": 41}, {}, [40, 41]),
        ({"fl_x": 40}, {}, [40, 40]),
        ({"fl_x": 40, "camera_angle_x": 1, "camera_angle_y": 1}, {}, [40, 40]),
        ({"camera_angle_x": ANGLE}, {}, [40, 40]),
        ({"camera_angle_x": ANGLE, "camera_angle_y": 2 * math.atan(12 / 50)}, {}, [40, 50]),
        ({"camera_angle_y": 2 * math.atan(12 / 50)}, {}, [50, 50]),
        ({"camera_angle_x": ANGLE, "fl_y": 41}, {}, [40, 41]),
        ({"fl_x": 40, "fl_y": 41}, {"fl_x": 30}, [30, 41]),
        ({"fl_x": 30, "fl_y": 31}, {"camera_angle_x": ANGLE}, [40, 40]),
        ({"camera_angle_x": 1}, {"fl_x": 30}, [30, 30]),
    ],
)
def test_the_focal_length_is_the_frames_then_the_files_then_from_angles(dataset, whole, own, focal):
    def change(content):
        del content["fl_x"], content["fl_y"]
        content |= whole
        content["frames"][1] |= own
        content["frames"][1]["cx"] = 12.5

    camera = read_capture(dataset(change)).frames[1].camera
    np.testing.assert_allclose(camera.focal, focal, rtol=1e-12)
    assert camera.center.tolist() == [12.5, 12]


@pytest.mark.parametrize(
    ("stated", "lens", "distortion"),
    [
        ({"camera_model": "SIMPLE_PINHOLE"}, "pinhole", None),
        ({"camera_model": "PINHOLE", "k1": 0.1}, "opencv", [0.1, 0, 0, 0]),
        ({"camera_model": "SIMPLE_RADIAL", "k1": 0.1}, "opencv", [0.1, 0, 0, 0]),
        ({"camera_model": "RADIAL", "k1": 0.1, "k2": 0.2}, "opencv", [0.1, 0.2, 0, 0]),
        ({"k1": 0.1, "p1": 0.3, "p2": 0.4}, "opencv", [0.1, 0, 0.3, 0.4]),
        ({"camera_model": "OPENCV", "k3": 0.5}, "opencv", [0, 0, 0, 0, 0.5]),
        ({"camera_model": "OPENCV", "k1": 0, "k2": 0.0}, "pinhole", None),
        ({"distortion_params": [1, 2, 0, 0, 4, 5]}, "opencv", [1, 2, 4, 5]),
        ({"distortion_params": [1, 2, 3, 0, 4, 5], "k1": 9}, "opencv", [1, 2, 4, 5, 3]),
        ({"camera_model": "OPENCV_FISHEYE", "k1": 0.1, "k4": 0.4}, "fisheye", [0.1, 0, 0, 0.4]),
        (
            {"camera_model": "OPENCV_FISHEYE", "distortion_params": [1, 2, 3, 4, 0, 0]},
            "fisheye",
            [1, 2, 3, 4],
        ),
        ({"camera_model": "OPENCV_FISHEYE"}, "fisheye", [0, 0, 0, 0]),  # equidistant, which differs from a pinhole
        ({"is_fisheye": True, "k2": 0.2}, "fisheye", [0, 0.2, 0, 0]),
        ({"is_fisheye": False, "k2": 0.2}, "opencv", [0, 0.2, 0, 0]),
    ],
)
@pytest.mark.parametrize("own", [True, False])
def test_lenses(dataset, stated, lens, distortion, own):
    def change(content):
        del content["camera_model"]
        for level in content["frames"] if own else [content]:
            level |= stated
        content |= {"k1": 7.0} if own and "k1" in stated else {}

    camera = read_capture(dataset(change)).frames[2].camera
    assert camera.lens == lens
    assert camera.distortion is None if distortion is None else camera.distortion.tolist() == distortion


def test_frames_without_a_file_are_skipped_with_one_note(dataset):
    folder = dataset()
    for index in (1, 3):
        (folder / "images" / f"{index:03d}.png").unlink()
    capture = read_capture(folder)
    assert [frame.name for frame in capture.frames] == ["000", "002", "004", "005", "006", "007"]
    assert len(capture.notes) == 1 and capture.notes[0].endswith("2 of 8 frames have no file and are skipped: 001, 003")

    def named(content):
        content["test_filenames"] = ["images/004.png", "images/001.png"]

    capture = read_capture(dataset(named))  # its training views are read all the same
    assert [capture.frames[index].name for index in capture.splits["test"]] == ["004"]
    assert capture.notes[1].endswith("1 of 2 names in test_filenames have no file and are skipped")
    for index in (0, 2, 4):
        (folder / "images" / f"{index:03d}.png").unlink()
    with pytest.raises(ValueError, match="5 of 8 frames have no file .*000, 001, 002, 003, 004\\)"):
        read_capture(dataset())


def test_splits_are_those_of_the_file(tmp_path, shots):
    content = captures.write_transforms(tmp_path, shots, splits={"train": [5, 1, 2, 1], "test": [0], "val": []})
    assert read_capture(tmp_path).splits == {"train": (1, 2, 5), "test": (0,)}
    content["frames"].reverse()
    content["val_filenames"] = ["./images/007.png"]
    (tmp_path / "transforms.json").write_text(json.dumps(content))
    capture = read_capture(tmp_path)
    assert capture.splits == {"train": (1, 2, 5), "test": (0,), "val": (7,)}
    # A skipped frame shifts the indices of the others.
    (tmp_path / "images" / "003.png").unlink()
    capture = read_capture(tmp_path)
    assert [capture.frames[index].name for index in capture.splits["train"]] == ["001", "002", "005"]


def test_masks_are_all_or_none(tmp_path, shots):
    content = captures.write_transforms(tmp_path, shots, masks=True)
    capture = read_capture(tmp_path)
    assert [frame.mask.name for frame in capture.frames] == [f"{index:03d}.png" for index in range(8)]
    (tmp_path / "masks" / "005.png").unlink()
    with pytest.raises(ValueError, match=r"frame 5: mask 'masks/005.png' does not exist"):
        read_capture(tmp_path)
    (tmp_path / "images" / "005.png").unlink()  # a skipped frame needs no mask
    assert len(read_capture(tmp_path).frames) == 7
    del content["frames"][3]["mask_path"]
    (tmp_path / "transforms.json").write_text(json.dumps(content))
    with pytest.raises(ValueError, match="frame 3: has no mask_path, other frames have"):
        read_capture(tmp_path)


def test_depth_files_are_ignored_with_a_note(dataset):
    def change(content):
        for frame in content["frames"][:3]:
            frame["depth_file_path"] = "depth/0.png"

    assert read_capture(dataset(change)).notes[0].endswith("depth files of 3 frames are not used")


def test_the_world_is_that_of_the_file(dataset, shots):
    def change(content):
        content["applied_transform"] = [[1, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 5]]
        content["applied_scale"] = 3.0
        content["orientation_override"] = "up"

    assert_cameras(read_capture(dataset(change)), shots)


@pytest.mark.parametrize("order", ["<", ">", None])
def test_points_of_the_ply_file(dataset, order):
    points = np.random.default_rng(0).normal(size=(20, 3))
    folder = dataset(lambda content: content.update(ply_file_path="./cloud.ply"))
    captures.write_ply(folder / "cloud.ply", points, order=order)
    capture = read_capture(folder)
    np.testing.assert_array_equal(capture.points, points)
    assert capture.points.dtype == np.float64 and capture.notes == ()
    whole = (folder / "cloud.ply").read_bytes()
    for body in (whole[:-20], whole.replace(b"vertex 20", b"vertex 99999999"), whole[:40], b"", b"ply\n\n"):
        (folder / "cloud.ply").write_bytes(body)
        capture = read_capture(folder)
        assert capture.points is None and len(capture.notes) == 1
        assert "cloud.ply" in capture.notes[0] and "\n" not in capture.notes[0]
    (folder / "cloud.ply").unlink()
    assert "cloud.ply does not exist" in read_capture(folder).notes[0]


def test_errors_of_a_ply_file(tmp_path):
    path = tmp_path / "cloud.ply"
    head = b"ply\nformat ascii 1.0\ncomment made here\n"
    xyz = b"property float x\nproperty float y\nproperty float z\n"
    for body, message in [
        (head + b"element face 1\nelement vertex 1\n", "has face before its vertices"),
        (head + b"element vertex 1\nproperty list uchar int x\n", "header line 'property list"),
        (head + b"element vertex 1\nproperty float x\nend_header\n1\n", "has vertices of 'x'"),
        (head + b"element vertex 1\n" + xyz + xyz + b"end_header\n1 2 3\n", "has vertices of 'x y z x y z'"),
        (head.replace(b"ascii", b"morse"), "header line 'format morse"),
        (
            head + b"element vertex 2\n" + xyz + b"end_header\n1 2 3\n",
            "holds 1 vertices of 3 numbers|holds 6 bytes",
        ),
        (head + b"element vertex 1\n" + xyz + b"end_header\n1 2 three\n", "a line that is no vertex"),
        (head + b"element vertex 1\n" + xyz + b"end_header\n1 2 nan\n", r"vertex 0 is \[1.0, 2.0, nan\]"),
        (head + b"comment \xff" * 1200, "header line|without end_header"),
    ]:
        path.write_bytes(body)
        with pytest.raises(ValueError, match=message) as caught:
            read_points(path)
        assert "\n" not in str(caught.value) and "cloud.ply" in str(caught.value)
    path.write_bytes(head + b"element vertex 0\n" + xyz + b"element face 0\nend_header\n")
    assert read_points(path).shape == (0, 3)


def test_the_box_is_the_cube_of_instant_ngp(dataset):
    def change(content):
        content |= {"aabb_scale": 2, "scale": 0.5, "offset": [0.5, 0.25, 1.0]}

    lower, upper = read_capture(dataset(change)).box
    for x, edge in ((lower, -0.5), (upper, 1.5)):  # of side 2 around 0.5
        np.testing.assert_allclose((x * 0.5 + [0.5, 0.25, 1.0])[[1, 2, 0]], edge)
    lower, upper = read_capture(dataset(lambda content: content.update(aabb_scale=4))).box
    np.testing.assert_allclose(upper, 2 / 0.33)
    np.testing.assert_allclose(lower, -2 / 0.33)
    assert read_capture(dataset(lambda content: content.update(scale=0.5))).box is None
    capture = read_capture(dataset(lambda content: content.update(aabb_scale=1, aabb=[[0] * 3, [1] * 3])))
    assert capture.box is None and "aabb_scale is not used" in capture.notes[0]


def _set(key, value):
    return lambda content: content.__setitem__(key, value)


def _frame(key, value):
    return lambda content: content["frames"][1].__setitem__(key, value)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (_set("frames", []), r"frames is \[\]"),
        (_set("frames", [1]), r"frames is \[1\]"),
        (lambda content: content.pop("frames"), "has no frames"),
        (
            lambda content: content.pop("fl_x") and content.pop("fl_y"),
            "frame 0: has no fl_x or camera_angle_x",
        ),
        (_set("fl_x", 0), r"transforms.json: fl_x is 0, expected px"),
        (_set("fl_x", -30.0), "fl_x is -30.0"),
        (_set("fl_x", math.nan), "fl_x is nan"),
        (_set("fl_x", "40"), "fl_x is '40'"),
        (_set("fl_x", 10**15), "fl_x is 1000"),
        (_frame("fl_y", []), r"frame 1: fl_y is \[\]"),
        (_frame("cx", math.inf), "frame 1: cx is inf"),
        (_frame("camera_angle_x", 39.6), "frame 1: camera_angle_x is 39.6, expected radians"),
        (_set("w", 32.5), "w is 32.5, expected whole pixels"),
        (_set("h", 0), "h is 0"),
        (_set("h", True), "h is True"),
        (_set("w", 1e9), "w is 1000000000.0"),
        (_set("k1", None), "k1 is None"),
        (_set("k4", 0.1), "k4 is 0.1, expected 0, as a perspective lens"),
        (_set("distortion_params", [0.1]), r"distortion_params is \[0.1\]"),
        (_set("distortion_params", [0, 0, 0, 0, 0, "x"]), "p2 is 'x'"),
        (
            _set("camera_model", "EQUIRECTANGULAR"),
            "camera_model is 'EQUIRECTANGULAR', .*PINHOLE.*panorama_sfm.py",
        ),
        (_set("camera_model", "VR180_L"), "camera_model is 'VR180_L', .*panorama_sfm.py"),
        (_set("camera_model", "ORTHOPHOTO"), "camera_model is 'ORTHOPHOTO'.*; undistort the images"),
        (_set("camera_model", ["OPENCV"]), r"camera_model is \['OPENCV'\]"),
        (_set("is_fisheye", True), "is_fisheye is True, expected the value that camera_model PINHOLE implies"),
        (_set("is_fisheye", 1), "is_fisheye is 1"),
        (_set("equirectangular", True), "has equirectangular, expected SIMPLE_PINHOLE"),
        (lambda c: c.update(camera_model="OPENCV_FISHEYE", p1=0.1), "p1 is 0.1, expected 0, as a fisheye"),
        (lambda content: content["frames"][1].pop("file_path"), "frame 1: has no file_path"),
        (_frame("file_path", 7), "frame 1: file_path is 7"),
        (_frame("file_path", ""), "frame 1: file_path is ''"),
        (_frame("file_path", "."), "frame 1: file_path '.' leaves the folder"),
        (_frame("file_path", "images/../../001.png"), "frame 1: file_path .* leaves the folder"),
        (_frame("file_path", "images\\..\\..\\001.png"), "frame 1: file_path .* leaves the folder"),
        (_frame("file_path", "/etc/passwd"), "frame 1: file_path .* leaves the folder"),
        (_frame("file_path", "images/a\nb"), r"frame 1: file_path is 'images/a\\nb'"),
        (_frame("file_path", "\ud800"), r"frame 1: file_path is '\\ud800'"),
        (_frame("file_path", "images/000.png"), "'images/000.png' and 'images/000.png' have one name"),
        (_frame("mask_path", "../mask.png"), "frame 0: has no mask_path"),
        (lambda content: content["frames"][1].pop("transform_matrix"), "frame 1: has no transform_matrix"),
        (_frame("transform_matrix", [[1, 2], [3]]), "frame 1: .*unequal length"),
        (_frame("transform_matrix", (-np.eye(4)).tolist()), "frame 1: .*last row"),
        (_frame("transform_matrix", np.diag([-1, 1, 1, 1]).tolist()), "frame 1: .*mirrors"),
        (_frame("transform_matrix", np.diag([2, 2, 2, 1]).tolist()), "frame 1: .*no rotation"),
        (_set("test_filenames", "images/000.png"), "test_filenames is 'images/000.png'"),
        (_set("test_filenames", [3]), "test_filenames is 3"),
        (_set("test_filenames", ["images/99.png"]), "test_filenames has 'images/99.png', which is not among"),
        (_set("train_filenames", ["../000.png"]), "train_filenames '../000.png' leaves the folder"),
        (_set("applied_transform", [[1, 0, 0], [0, 1, 0]]), "applied_transform is"),
        (_set("applied_transform", [[1, 0, 0, math.nan]] * 3), "applied_transform is"),
        (_set("applied_scale", -1), "applied_scale is -1"),
        (_set("ply_file_path", "/etc/passwd"), "ply_file_path '/etc/passwd' leaves the folder"),
        (_set("aabb_scale", "big"), "aabb_scale is 'big'"),
        (_set("aabb_scale", 0), "aabb_scale is 0"),
        (lambda content: content.update(aabb_scale=1, scale=0), "scale is 0"),
        (lambda content: content.update(aabb_scale=1, offset=[0, 0]), r"offset is \[0, 0\]"),
    ],
)
def test_errors_of_the_json_file(dataset, change, message):
    with pytest.raises(ValueError, match=message) as caught:
        read_capture(dataset(change))
    assert "\n" not in str(caught.value) and "transforms.json" in str(caught.value)


def test_errors_of_the_files(dataset):
    folder = dataset(lambda content: content.pop("cx"))
    read_capture(folder)  # the size is stated, so no image is read
    folder = dataset(lambda content: content.pop("cx") and content.pop("w"))
    (folder / "images" / "002.png").write_bytes(b"no image")
    with pytest.raises(ValueError, match="002.png: unreadable"):
        read_capture(folder)
    for text in ("{", "[1]", ""):
        (folder / "transforms.json").write_text(text)
        with pytest.raises(ValueError, match=r"transforms\.json: (malformed|holds)"):
            read_capture(folder)
    (folder / "transforms.json").unlink()
    with pytest.raises(ValueError, match=r"transforms\.json: No such file"):
        read_capture(folder)


LEAVES = (
    st.none()
    | st.booleans()
    | st.integers()
    | st.floats()
    | st.sampled_from([10**400, 1e308, -0.0, "", ".", "..", "/", "a\nb", "images/000.png", "OPENCV_FISHEYE"])
    | st.text(max_size=8)
)
VALUES = st.recursive(
    LEAVES,
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=4), inner, max_size=3),
)


def _places(value, path=()):
    """Returns the path of every value in a JSON tree."""
    items = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    return [path, *(place for key, inner in items for place in _places(inner, (*path, key)))]


@settings(deadline=None, max_examples=150, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.data())
def test_random_json_values_are_read_or_a_one_line_error(fuzzed, data):
    folder, content = fuzzed
    changed = copy.deepcopy(content)
    for _ in range(data.draw(st.integers(1, 2))):
        *path, last = data.draw(st.sampled_from(_places(changed)[1:] or [("frames",)]))
        target = changed
        for key in path:
            target = target[key]
        target[last] = data.draw(VALUES)
    (folder / "transforms.json").write_text(json.dumps(changed))
    try:
        capture = read_capture(folder)
    except ValueError as error:
        assert len(str(error).splitlines()) == 1 and str(folder) in str(error)
    else:
        assert all(len(note.splitlines()) == 1 for note in capture.notes)
        assert all(frame.image.resolve().is_relative_to(folder.resolve()) for frame in capture.frames)
        for frame in capture.frames:
            assert np.isfinite(frame.camera.focal).all() and (np.float32(frame.camera.focal) > 0).all()
            assert np.isfinite(np.float32(frame.camera.center)).all()


@pytest.fixture(scope="session")
def fuzzed(tmp_path_factory, shots):
    """Returns the folder and content of a small dataset with an entry of every kind."""
    folder = tmp_path_factory.mktemp("fuzzed")
    extra = {
        **{
            "aabb_scale": 4,
            "scale": 0.33,
            "offset": [0.5, 0.5, 0.5],
            "applied_scale": 1.0,
            "k1": 0.1,
            "k4": 0.0,
        },
        **{"applied_transform": np.eye(4).tolist(), "ply_file_path": "cloud.ply", "is_fisheye": False},
    }
    content = captures.write_transforms(
        folder, shots[:3], masks=True, splits={"train": [0, 1], "test": [2]}, extra=extra
    )
    content["frames"][0] |= {"fl_x": 30.0, "camera_angle_x": 0.5, "distortion_params": [0.1] + [0] * 5}
    captures.write_ply(folder / "cloud.ply", np.ones((3, 3)))
    del content["w"]  # so that images are opened
    return folder, content


@pytest.mark.scenes("fox")
def test_the_real_fox(scenes_dir):
    capture = read_capture(scenes_dir / "fox")
    assert len(capture.frames) == 50 and capture.frames[0].name == "0001" and capture.splits is None
    (note,) = capture.notes
    assert "17 of 67 frames have no file and are skipped: 0005, " in note and note.endswith(" and 12 more")
    camera = capture.frames[0].camera
    assert camera.lens == "opencv" and (camera.height, camera.width) == (1920, 1080)
    assert camera.focal.tolist() == [1375.52, 1374.49] and camera.center.tolist() == [554.558, 965.268]
    assert camera.distortion.tolist() == [0.0578421, -0.0805099, -0.000980296, 0.00015575]
    lower, upper = capture.box
    np.testing.assert_allclose([-lower, upper], 4 / 2 / 0.33)
    eyes = np.stack([frame.camera.to_world[:, 3] for frame in capture.frames])
    assert ((lower < eyes) & (eyes < upper)).all()
    assert all(frame.image.parent.name == "images" for frame in capture.frames)


def test_times_are_all_or_none(dataset):
    """Those of D-NeRF's and nerfstudio's files; they follow their frames through sorting, splits and selection."""
    plain = read_capture(dataset())
    assert {frame.time for frame in plain.frames} == {None}

    def timed(content):
        for index, frame in enumerate(content["frames"]):
            frame["time"] = 5 * index
        content["frames"].reverse()

    folder = dataset(timed)
    capture = read_capture(folder)
    assert [frame.time for frame in capture.frames] == [5.0 * index for index in range(8)]
    assert fingerprint(capture) != fingerprint(plain)
    views = jaxnerf.load_dataset(folder, world="file", num_views=3)
    assert [int(name) / 7 for name in views.names] == pytest.approx(views.time.tolist())

    def incomplete(content):
        timed(content)
        del content["frames"][2]["time"]

    with pytest.raises(ValueError, match="has no time, other frames have; expected all or none"):
        read_capture(dataset(incomplete))
