"""The LLFF reader: cameras, splits, sizes, and errors of a folder."""

import imageio.v3 as iio
import numpy as np
import pytest

from jaxnerf.data.geometry import world
from jaxnerf.data.images import load_images
from jaxnerf.data.readers import llff

HEIGHT, WIDTH, FOCAL = 8, 12, 10.0


def poses(count):
    """Returns poses [N, 3, 4] (x right, y up, looking along -z) that look roughly along -z."""
    rng = np.random.default_rng(0)
    result = np.zeros((count, 3, 4))
    for pose in result:
        x, y = rng.uniform(-0.2, 0.2, 2)
        about_x = np.array([[1, 0, 0], [0, np.cos(x), -np.sin(x)], [0, np.sin(x), np.cos(x)]])
        about_y = np.array([[np.cos(y), 0, np.sin(y)], [0, 1, 0], [-np.sin(y), 0, np.cos(y)]])
        pose[:, :3], pose[:, 3] = about_x @ about_y, rng.normal(size=3)
    return result


def rows(count=9):
    """Returns poses_bounds [N, 17] with axes down, right, backwards."""
    right, up, back, place = np.moveaxis(poses(count), -1, 0)
    shape = np.tile([HEIGHT, WIDTH, FOCAL], (count, 1))
    matrices = np.stack([-up, right, back, place, shape], axis=-1)
    bounds = np.stack([2.0 + np.arange(count), 20.0 + np.arange(count)], axis=-1)
    return np.concatenate([matrices.reshape(count, 15), bounds], axis=-1)


def load_llff(folder, **options):
    capture, _ = world.recenter(llff.read_capture(folder))
    return load_images.load_capture(capture, **options)


def pixels(index, height=HEIGHT, width=WIDTH):
    return np.random.default_rng(index).integers(0, 256, (height, width, 3), np.uint8)


@pytest.fixture
def folder(tmp_path):
    """A dataset of nine views."""
    (tmp_path / "images").mkdir()
    for index in range(9):
        iio.imwrite(tmp_path / "images" / f"view{index}.png", pixels(index))
    np.save(tmp_path / "poses_bounds.npy", rows())
    return tmp_path


def test_every_eighth_view_is_held_out_and_pixels_are_those_of_the_files(folder):
    train, test = (load_llff(folder, split=split) for split in ("train", "test"))
    assert test.names == ("view0", "view8")
    assert train.names == tuple(f"view{index}" for index in range(1, 8))
    np.testing.assert_array_equal(test.pixels, np.concatenate([pixels(0), pixels(8)]).reshape(-1, 3))
    np.testing.assert_array_equal(test.offset, [0, HEIGHT * WIDTH])
    np.testing.assert_array_equal(test.size, [[HEIGHT, WIDTH]] * 2)
    assert test.background is None
    np.testing.assert_array_equal(load_llff(folder, split="val").pixels, test.pixels)


def test_cameras_are_the_files_up_to_a_similarity(folder):
    """The nearest bound becomes 1 / 0.75; relative rotations and relative distances do not change."""
    train, test = (load_llff(folder, split=split) for split in ("train", "test"))
    order = [1, 2, 3, 4, 5, 6, 7, 0, 8]
    found = np.concatenate([train.cameras.to_world, test.cameras.to_world]).astype(np.float64)
    given, scale = poses(9)[order], 1 / (2.0 * 0.75)
    motion = found[:, :, :3] @ given[:, :, :3].transpose(0, 2, 1)
    np.testing.assert_allclose(motion, np.broadcast_to(motion[0], motion.shape), atol=1e-6)
    assert np.linalg.det(motion[0]) == pytest.approx(1, abs=1e-5)
    moved = given[:, :, 3] @ motion[0].T * scale
    shift = found[:, :, 3] - moved
    np.testing.assert_allclose(shift, np.broadcast_to(shift[0], shift.shape), atol=1e-6)
    np.testing.assert_allclose(found[:, :, 3].mean(0), 0, atol=1e-6)
    back = found[:, :, 2].mean(0)
    np.testing.assert_allclose(back / np.linalg.norm(back), [0, 0, 1], atol=1e-6)
    assert abs(found[:, 0, 1].sum()) < 1e-5  # the mean up is normal to x
    np.testing.assert_allclose(test.near, [1 / 0.75, 10 * scale], rtol=1e-6)
    np.testing.assert_allclose(test.far, [20 * scale, 28 * scale], rtol=1e-6)
    np.testing.assert_allclose(train.cameras.focal, np.full((7, 2), FOCAL))
    np.testing.assert_allclose(train.cameras.center, np.tile([WIDTH / 2, HEIGHT / 2], (7, 1)))


def test_a_factor_averages_or_selects_the_downscaled_folder(folder):
    half = load_llff(folder, split="test", factor=2)
    mean = pixels(8).reshape(4, 2, 6, 2, 3).mean((1, 3)) / 255
    np.testing.assert_allclose(half.pixels[24:] / 65535, mean.reshape(-1, 3), atol=1e-5)
    np.testing.assert_allclose(half.cameras.focal, FOCAL / 2)
    assert (half.cameras.height, half.cameras.width) == (4, 6)
    (folder / "images_2").mkdir()
    for index in range(9):
        iio.imwrite(folder / "images_2" / f"view{index}.png", pixels(50 + index, 4, 6))
    there = load_llff(folder, split="test", factor=2)
    np.testing.assert_array_equal(there.pixels[:24], pixels(50, 4, 6).reshape(-1, 3))
    np.testing.assert_allclose(there.cameras.focal, FOCAL / 2)


def changed(array, row, column, value):
    array = array.copy()
    array[row, column] = value
    return array


@pytest.mark.parametrize(
    "content, message",
    [
        (rows()[:, :16], r"expected floats \[N, 17\]"),
        (rows()[:, :14], "NeX.s form: append h, w and f of its hwf_cxcy.npy"),
        (rows()[0], r"expected floats \[N, 17\]"),
        (rows()[:0], r"expected floats \[N, 17\]"),
        (np.array([{"poses": 1}], dtype=object), "unreadable"),
        (rows(8), "has 9 images, poses_bounds.npy has 8"),
        (changed(rows(), 3, 16, 1.0), "expected 0 < near < far"),
        (changed(rows(), 3, 15, -1.0), "expected 0 < near < far"),
        (changed(rows(), 4, 2, np.nan), "row 4 is not finite"),
        (changed(rows(), 5, 0, 3.0), "row 5.*rotation"),
    ],
)
def test_errors_of_the_poses(folder, content, message):
    np.save(folder / "poses_bounds.npy", content, allow_pickle=True)
    with pytest.raises(ValueError, match=message) as caught:
        load_llff(folder)
    assert str(folder) in str(caught.value) and "\n" not in str(caught.value)


def test_a_factor_larger_than_an_image_is_an_error(folder):
    with pytest.raises(ValueError, match="12 x 8, too small for factor 9"):
        load_llff(folder, factor=9)


def test_errors_of_the_files(folder):
    with pytest.raises(ValueError, match="split is 'all'"):
        load_llff(folder, split="all")
    iio.imwrite(folder / "images" / "view3.png", pixels(3, 8, 10))
    with pytest.raises(ValueError, match="view3.png: is 10 x 8, its camera is for 12 x 8"):
        load_llff(folder)
    (folder / "images" / "view3.png").write_bytes(b"no image")
    with pytest.raises(ValueError, match="view3.png: unreadable"):
        load_llff(folder)
    with pytest.raises(ValueError, match="split 'train' of 9 images is empty"):
        load_llff(folder, hold=1)
    (folder / "poses_bounds.npy").write_bytes(b"\x93NUMPY")
    with pytest.raises(ValueError, match="poses_bounds.npy: unreadable"):
        load_llff(folder)
    (folder / "poses_bounds.npy").unlink()
    with pytest.raises(ValueError, match="poses_bounds.npy: no such file"):
        load_llff(folder)


@pytest.mark.scenes("fern")
def test_the_real_fern(scenes_dir):
    train, test = (load_llff(scenes_dir / "fern", split=split, factor=8) for split in ("train", "test"))
    assert (len(train.names), len(test.names)) == (17, 3)
    assert (train.cameras.height, train.cameras.width) == (378, 504)
    assert train.pixels.shape == (17 * 378 * 504, 3)
    near = np.concatenate([train.near, test.near])
    assert near.min() == pytest.approx(1 / 0.75, rel=1e-6)
    assert np.abs(np.concatenate([train.cameras.to_world, test.cameras.to_world])[:, :, 3].mean(0)).max() < 1e-5
    assert (train.cameras.to_world[:, 2, 2] > 0.9).all()  # all look along -z
