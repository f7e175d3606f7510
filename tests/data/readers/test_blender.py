"""The Blender reader: its results, and errors that name the invalid input."""

import json
import math

import numpy as np
import pytest
from PIL import Image

from captures import load_blender, write_png16
from jaxnerf.data.images.image_files import average_tiles, read_image, to_straight
from jaxnerf.data.images.load_images import load_capture
from jaxnerf.data.readers import base
from jaxnerf.data.readers.blender import read_capture

_POSE = [[1.0, 0, 0, 0.5], [0, 0, -1, -4], [0, 1, 0, 0], [0, 0, 0, 1]]


def _pixels(seed, shape=(12, 8, 4), dtype=np.uint8):
    return np.random.default_rng(seed).integers(0, np.iinfo(dtype).max, shape, dtype, endpoint=True)


@pytest.fixture
def dataset(tmp_path):
    """Returns a function that changes and writes the JSON file of a valid dataset of two RGBA frames."""
    (tmp_path / "train").mkdir()
    for index in range(2):
        Image.fromarray(_pixels(index)).save(tmp_path / "train" / f"r_{index}.png")
    frames = [{"file_path": f"./train/r_{index}", "transform_matrix": _POSE} for index in range(2)]
    content = {"camera_angle_x": 0.8, "frames": frames}

    def write(change=lambda content: None):
        change(content)
        (tmp_path / "transforms_train.json").write_text(json.dumps(content))
        return tmp_path

    return write


def test_factor_1_returns_every_frame_unchanged(dataset):
    views = load_blender(dataset())
    assert views.pixels.dtype == np.uint8 and views.background == (1.0, 1.0, 1.0)
    np.testing.assert_array_equal(views.pixels, np.concatenate([_pixels(k).reshape(-1, 4) for k in range(2)]))
    np.testing.assert_array_equal(views.offset, [0, 96])
    np.testing.assert_array_equal(views.size, [[12, 8]] * 2)
    assert views.names == ("r_0", "r_1")
    assert (views.cameras.height, views.cameras.width) == (12, 8)
    np.testing.assert_allclose(views.cameras.focal, 4 / math.tan(0.4), rtol=1e-6)
    np.testing.assert_array_equal(views.cameras.center, [[4, 6]] * 2)
    np.testing.assert_array_equal(views.cameras.to_world, np.float32([_POSE[:3]] * 2))
    np.testing.assert_array_equal(views.near, [2, 2])
    np.testing.assert_array_equal(views.far, [6, 6])


def test_file_path_may_carry_its_extension_or_no_dot(dataset):
    def change(content):
        content["frames"][0]["file_path"] = "train/r_0.png"
        content.update(w=8, h=12)

    assert load_blender(dataset(change)).names == ("r_0", "r_1")


def test_factor_scales_pixels_and_camera_together(dataset):
    views = load_blender(dataset(), factor=4)
    assert views.pixels.shape == (12, 4) and views.pixels.dtype == np.uint16
    np.testing.assert_allclose(views.cameras.focal, 1 / math.tan(0.4), rtol=1e-6)
    np.testing.assert_array_equal(views.cameras.center, [[1, 1.5]] * 2)


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
@pytest.mark.parametrize("background", [(1.0, 1.0, 1.0), (0.2, 0.0, 0.7)])
def test_shrinking_commutes_with_compositing(dtype, background):
    pixels = _pixels(0, (40, 60, 4), dtype)
    pixels[:20, :30, 3] = 0

    def over(straight):
        values = straight / np.iinfo(straight.dtype).max
        return values[..., :3] * values[..., 3:] + np.array(background) * (1 - values[..., 3:])

    expected = over(pixels).reshape(8, 5, 12, 5, 3).mean((1, 3))
    found = over(average_tiles(pixels, 5, background=background))
    assert np.abs(found - expected).max() < 1e-5


def test_invisible_color_does_not_bleed_over_an_edge():
    pixels = np.zeros((2, 2, 4), np.uint8)
    pixels[:, 0] = 200, 100, 0, 255  # the other column is transparent black
    shrunk = average_tiles(pixels, 2)[0, 0] / 65535
    np.testing.assert_allclose(shrunk, [200 / 255, 100 / 255, 0, 0.5], atol=2e-5)


def test_straight_alpha_is_finite_where_alpha_is_0():
    np.testing.assert_array_equal(to_straight(np.zeros((1, 3)), np.zeros(1), background=(1, 1, 1)), [[0] * 4])


def test_rgb_files_are_read_only_without_a_background(dataset, tmp_path):
    for index in range(2):
        Image.fromarray(_pixels(index)[..., :3]).save(tmp_path / "train" / f"r_{index}.png")
    assert load_blender(dataset(), background=None).pixels.shape == (192, 3)
    with pytest.raises(ValueError, match=r"r_0\.png: has no alpha.*background=None"):
        load_blender(tmp_path)


@pytest.mark.parametrize("channels", [3, 4])
def test_sixteen_bits_survive(tmp_path, channels):
    pixels = _pixels(3, (5, 7, channels), np.uint16)
    write_png16(tmp_path / "deep.png", pixels)
    np.testing.assert_array_equal(read_image(tmp_path / "deep.png"), pixels)


def test_grey_and_palette_become_color(tmp_path):
    grey = Image.fromarray(_pixels(0, (5, 7)))
    grey.save(tmp_path / "grey.png")
    np.testing.assert_array_equal(read_image(tmp_path / "grey.png"), np.asarray(grey)[..., None].repeat(3, -1))
    grey.convert("P").save(tmp_path / "palette.png", transparency=0)
    assert read_image(tmp_path / "palette.png").shape == (5, 7, 4)


def _set(key, value):
    return lambda content: content.__setitem__(key, value)


def _frame(key, value):
    return lambda content: content["frames"][1].__setitem__(key, value)


def _pose(row, column, value):
    changed = [list(line) for line in _POSE]
    changed[row][column] = value
    return _frame("transform_matrix", changed)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (_set("frames", []), r"frames is \[\]"),
        (_set("frames", {}), "frames is {}"),
        (lambda content: content.pop("frames"), "has no frames"),
        (lambda content: content.pop("camera_angle_x"), "has no fl_x or camera_angle_x"),
        (_set("camera_angle_x", math.nan), "camera_angle_x is nan"),
        (_set("camera_angle_x", 39.6), "camera_angle_x is 39.6.*degrees"),
        (_set("camera_angle_x", 0), "camera_angle_x is 0"),
        (_set("camera_angle_x", "wide"), "camera_angle_x is 'wide'"),
        (_set("camera_angle_x", 10**15), "camera_angle_x is 1000"),
        (_set("w", 9), r"r_0\.png: is 8 x 12, expected w = 9"),
        (_set("h", "12"), "h is '12'"),
        (lambda content: content["frames"][1].pop("file_path"), "frame 1: has no file_path"),
        (lambda content: content["frames"][1].pop("transform_matrix"), "frame 1: has no transform_matrix"),
        (_frame("file_path", 7), "frame 1: file_path is 7"),
        (_frame("file_path", "./train/r_9"), r"frame 1: .*r_9\.png does not exist"),
        (_frame("file_path", "train/../../r_1"), "frame 1: file_path .* leaves the folder"),
        (_frame("file_path", "/etc/passwd"), "frame 1: file_path .* leaves the folder"),
        (_frame("file_path", "."), "frame 1: file_path '.' leaves the folder"),  # it would read ../<folder>.png
        (_frame("file_path", "train/a\nb"), "frame 1: file_path is"),
        (_frame("transform_matrix", _POSE[:3]), r"frame 1: .*shape \(3, 4\)"),
        (_frame("transform_matrix", [[1, 2], [3]]), "frame 1: .*unequal length"),
        (_frame("transform_matrix", [["a"] * 4] * 4), "frame 1: .*not numbers"),
        (_pose(0, 3, math.inf), r"frame 1: .*inf at \[0, 3\]"),
        (_pose(0, 0, -1.0), "frame 1: .*mirrors"),
        (_pose(0, 0, 1.01), "frame 1: .*no rotation.*1.01"),
        (_pose(0, 1, 0.01), "frame 1: .*no rotation"),
        (_pose(0, 0, 1e30), "frame 1: .*no rotation"),
        (_pose(3, 3, 2.0), "frame 1: .*last row"),
    ],
)
def test_errors_of_the_json_file(dataset, change, message):
    with pytest.raises(ValueError, match=message) as caught:
        load_blender(dataset(change))
    assert "\n" not in str(caught.value)
    assert "transforms_train.json" in str(caught.value) or ".png" in str(caught.value)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"split": "val"}, r"transforms_val\.json: no such file \(the folder has transforms_train\.json\)"),
        ({"factor": 3}, r"r_0\.png: factor 3 does not divide 8 x 12.*one of 1, 2, 4$"),
        ({"near": 6.0}, "r_0 has near 6 and far 6, expected near < far"),
        ({"near": -1.0}, "r_0 has near -1"),
        ({"far": math.inf}, "r_0 has near 2 and far inf"),
        ({"far": math.nan}, "r_0 has near 2 and far nan"),
    ],
)
def test_errors_of_the_arguments(dataset, arguments, message):
    with pytest.raises(ValueError, match=message):
        load_blender(dataset(), **arguments)


def test_errors_of_the_files(dataset, tmp_path):
    dataset()
    second = tmp_path / "train" / "r_1.png"
    whole = second.read_bytes()
    for body in (whole[: len(whole) // 2], whole[:30], b"", b"no image"):
        second.write_bytes(body)
        with pytest.raises(ValueError, match=r"r_1\.png: unreadable") as caught:
            load_blender(tmp_path)
        assert "\n" not in str(caught.value)
    Image.fromarray(_pixels(1, (12, 12, 4))).save(second)
    with pytest.raises(ValueError, match=r"r_1\.png: is 12 x 12 uint8.*expected 8 x 12 uint8 as r_0\.png"):
        load_blender(tmp_path)
    write_png16(second, _pixels(1, dtype=np.uint16))
    with pytest.raises(ValueError, match=r"r_1\.png: is 8 x 12 uint16"):
        load_blender(tmp_path)
    for text in ("{", "[1]", "\xff"):
        (tmp_path / "transforms_train.json").write_bytes(text.encode("latin-1"))
        with pytest.raises(ValueError, match=r"transforms_train\.json: (malformed|holds)"):
            load_blender(tmp_path)
    with pytest.raises(ValueError, match="the folder does not exist"):
        load_blender(tmp_path / "nowhere")


@pytest.mark.scenes("lego")
def test_the_real_lego(scenes_dir):
    test = load_blender(scenes_dir / "lego", split="test")
    assert test.pixels.shape == (25 * 800 * 800, 4) and test.pixels.dtype == np.uint8
    np.testing.assert_allclose(test.cameras.focal, 1111.111, rtol=1e-6)
    train = load_blender(scenes_dir / "lego", factor=8)
    assert train.pixels.shape == (100 * 100 * 100, 4) and len(train.names) == 100
    np.testing.assert_allclose(train.cameras.focal, 138.8889, rtol=1e-6)
    alpha = train.pixels[:, 3]
    assert 0.3 < (alpha == 0).mean() < 0.9 and 0.1 < (alpha == 65535).mean()
    np.testing.assert_allclose(np.linalg.norm(train.cameras.to_world[:, :, 3], axis=-1), 4.0311, rtol=1e-3)
    with pytest.raises(ValueError, match=r"transforms_test\.json, transforms_train\.json"):
        load_blender(scenes_dir / "lego", split="val")


def _timed(*times):
    """Returns a change that gives the first frames these times."""

    def change(content):
        for frame, time in zip(content["frames"], times, strict=False):
            frame["time"] = time

    return change


def test_times_are_those_of_the_frames(dataset):
    """As in the format of D-NeRF."""
    views = load_blender(dataset(_timed(0.0, 0.75)))
    np.testing.assert_array_equal(views.time, np.float32([0, 0.75]))
    np.testing.assert_array_equal(load_blender(dataset(), select=lambda count: [1]).time, np.float32([0.75]))
    capture = read_capture(dataset())
    assert [frame.time for frame in capture.frames] == [0.0, 0.75]
    assert load_capture(capture._replace(frames=bounded(capture.frames))).time.tolist() == [0, 0.75]


def test_numbers_of_frames_are_scaled_over_all_splits(dataset):
    folder = dataset(_timed(10, 40))
    content = json.loads((folder / "transforms_train.json").read_text())
    content["frames"] = [content["frames"][0] | {"time": 70}]
    (folder / "transforms_test.json").write_text(json.dumps(content))
    for split, expected in (("train", [0, 0.5]), ("test", [1])):
        capture = base.read_capture(folder, "blender", split=split)
        assert [frame.time for frame in capture.frames] == expected
        assert capture.choices == ("times from 10 to 70, those of all splits, are scaled to [0, 1]",)
    assert [frame.time for frame in base.read_capture(folder).frames] == [0, 0.5, 1]
    (folder / "transforms_test.json").unlink()
    assert [frame.time for frame in base.read_capture(dataset(_timed(3, 3))).frames] == [0, 0]
    assert base.read_capture(dataset(_timed(0, 1))).choices == ()


def bounded(frames):
    return tuple(frame._replace(bounds=(1.0, 2.0)) for frame in frames)


def test_without_times_views_have_none(dataset):
    assert load_blender(dataset()).time is None
    assert [frame.time for frame in read_capture(dataset()).frames] == [None, None]


@pytest.mark.parametrize(
    "times, message",
    [
        ((0.5,), "frame 1: has no time, other frames have; expected all or none"),
        ((0.5, "late"), "frame 1: time is 'late', expected a number; correct it, or remove all times"),
        ((0.5, True), "frame 1: time is True"),
        ((0.5, float("nan")), "NaN|nan"),
        ((0.5, None), "frame 1: time is None"),
    ],
)
def test_wrong_times_are_named(dataset, times, message):
    folder = dataset(_timed(*times))
    for read in (load_blender, read_capture):
        with pytest.raises(ValueError, match=message):
            read(folder)


def test_bounds_that_cannot_be_the_cameras_are_said(dataset):
    """Cameras that look outwards, all within a hundredth of near, say nothing of how far away the scene is."""

    def shrunk(scale):
        def change(content):
            for index, frame in enumerate(content["frames"]):
                frame["transform_matrix"] = [[1, 0, 0, scale * index], *_POSE[1:]]

        return change

    assert read_capture(dataset(shrunk(0.004))).bounds_reason == "although all cameras are within 0.004: see data.near"
    assert not read_capture(dataset(shrunk(1.0))).bounds_reason
