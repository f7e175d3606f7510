"""Views of a Capture: splits, sizes, bits, alpha, masks, orientation, lenses, downscaled copies."""

import dataclasses

import imageio.v3 as iio
import jax
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from PIL import Image, ImageOps

from captures import write_image
from jaxnerf import Camera
from jaxnerf.data.images import load_images
from jaxnerf.data.images.image_files import image_form, image_size, read_image, read_mask
from jaxnerf.data.readers.base import Capture, Frame

HEIGHT, WIDTH = 6, 8


def a_camera(height=HEIGHT, width=WIDTH, **options):
    pose = np.eye(3, 4)
    center = np.array([4.5, 3.25])
    return Camera(to_world=pose, focal=np.array([10.0, 11.0]), center=center, height=height, width=width, **options)


def pixels(seed, height=HEIGHT, width=WIDTH, channels=3, dtype=np.uint8):
    high = np.iinfo(dtype).max
    return np.random.default_rng(seed).integers(0, high, (height, width, channels), dtype, endpoint=True)


def a_capture(folder, images, cameras=None, masks=None, splits=None, **options):
    """Writes images and returns their Capture."""
    (folder / "images").mkdir(parents=True, exist_ok=True)
    frames = []
    for index, image in enumerate(images):
        path = folder / "images" / f"view{index}.png"
        iio.imwrite(path, image)
        camera = cameras[index] if cameras else a_camera(*image.shape[:2])
        mask = None
        if masks and masks[index] is not None:
            mask = folder / f"mask{index}.png"
            iio.imwrite(mask, np.uint8(255 * masks[index]))
        frames.append(Frame(path.stem, path, camera, mask=mask, bounds=(1.0, 5.0 + index)))
    return Capture("test", folder, tuple(frames), splits=splits, **options)


def test_pixels_bounds_and_cameras_are_those_of_the_files(tmp_path):
    images = [pixels(index) for index in range(9)]
    capture = a_capture(tmp_path, images)
    test, train = (load_images.load_capture(capture, split=split) for split in ("test", "train"))
    assert test.names == ("view0", "view8") and len(train.names) == 7
    np.testing.assert_array_equal(test.pixels, np.concatenate([images[0], images[8]]).reshape(-1, 3))
    np.testing.assert_array_equal(test.size, [[HEIGHT, WIDTH]] * 2)
    np.testing.assert_array_equal(test.offset, [0, HEIGHT * WIDTH])
    np.testing.assert_allclose([test.near, test.far], [[1, 1], [5, 13]])
    cameras = test.cameras
    assert (cameras.height, cameras.width, cameras.lens, cameras.distortion) == (
        HEIGHT,
        WIDTH,
        "pinhole",
        None,
    )
    np.testing.assert_allclose(cameras.focal, [[10, 11]] * 2)
    assert test.pixels.dtype == np.uint8 and test.mask is None and test.background is None
    np.testing.assert_array_equal(load_images.load_capture(capture, split="val").pixels, test.pixels)


@pytest.mark.parametrize(
    "splits, split, expected",
    [
        ({"train": (0, 2), "test": (1,)}, "train", [0, 2]),
        ({"train": (0, 2), "test": (1,)}, "val", [1]),
        ({"train": (0,), "val": (2,)}, "test", [2]),
        ({"train": (0,), "val": (2,), "test": (1,)}, "val", [2]),
        (None, "train", [1, 2]),
        (None, "test", [0]),
    ],
)
def test_split_indices(tmp_path, splits, split, expected):
    capture = a_capture(tmp_path, [pixels(index) for index in range(3)], splits=splits)
    assert load_images.split_indices(capture, split).tolist() == expected


def test_an_unknown_or_empty_split_is_an_error(tmp_path):
    capture = a_capture(tmp_path, [pixels(0)], splits={"train": (0,)})
    with pytest.raises(ValueError, match="split is 'all'"):
        load_images.split_indices(capture, "all")
    with pytest.raises(ValueError, match="split 'test' of 1 images is empty"):
        load_images.split_indices(capture, "test")


def test_sizes_and_cameras_may_differ(tmp_path):
    images = [pixels(0), pixels(1, 4, 10), pixels(2, 5, 5)]
    views = load_images.load_capture(a_capture(tmp_path, images), hold=9)
    np.testing.assert_array_equal(views.size, [[4, 10], [5, 5]])
    np.testing.assert_array_equal(views.offset, [0, 40])
    assert views.cameras.height is None and views.cameras.width is None
    np.testing.assert_array_equal(views.pixels[40:], images[2].reshape(-1, 3))


def test_a_factor_averages_squares_and_crops_the_rest(tmp_path):
    image = pixels(0, 7, 10)
    views = load_images.load_capture(a_capture(tmp_path, [image] * 2), factor=3, hold=9)
    mean = image[:6, :9].reshape(2, 3, 3, 3, 3).mean((1, 3)) / 255
    np.testing.assert_allclose(views.pixels / 65535, mean.reshape(-1, 3), atol=1e-5)
    np.testing.assert_allclose(views.cameras.focal, [[10 / 3, 11 / 3]])
    np.testing.assert_allclose(views.cameras.center, [[1.5, 3.25 / 3]])
    with pytest.raises(ValueError, match="too small for factor 20"):
        load_images.load_capture(a_capture(tmp_path, [image] * 2), factor=20)


def test_the_smallest_copies_that_a_factor_allows_are_used(tmp_path):
    images = [pixels(index, 8, 16) for index in range(2)]
    capture = a_capture(tmp_path, images)
    for number, seed in ((2, 50), (3, 60)):
        (tmp_path / f"images_{number}").mkdir()
        for index in range(2):
            name = f"renamed{index}.png"
            iio.imwrite(tmp_path / f"images_{number}" / name, pixels(seed + index, 8 // number, 16 // number))
    half = load_images.load_capture(capture, factor=2, hold=9)
    np.testing.assert_array_equal(half.pixels, pixels(51, 4, 8).reshape(-1, 3))
    np.testing.assert_allclose(half.cameras.focal, [[5, 5.5]])
    quarter = load_images.load_capture(capture, factor=4, hold=9)
    mean = pixels(51, 4, 8).reshape(2, 2, 4, 2, 3).mean((1, 3)) / 255
    np.testing.assert_allclose(quarter.pixels / 65535, mean.reshape(-1, 3), atol=1e-5)
    whole = load_images.load_capture(capture, hold=9)
    np.testing.assert_array_equal(whole.pixels, images[1].reshape(-1, 3))
    (tmp_path / "images").rename(tmp_path / "images_8")
    frames = tuple(f._replace(image=tmp_path / "images_8" / f.image.name) for f in capture.frames)
    assert load_images.load_capture(capture._replace(frames=frames), hold=9).size.tolist() == [[8, 16]]


def test_an_image_whose_size_is_not_its_cameras_is_an_error(tmp_path):
    capture = a_capture(tmp_path, [pixels(0), pixels(1, 6, 7)], cameras=[a_camera()] * 2)
    with pytest.raises(ValueError, match=r"view1.png: is 7 x 6, its camera is for 8 x 6"):
        load_images.load_capture(capture)


def test_the_camera_of_a_larger_image_is_scaled(tmp_path):
    camera = a_camera(4 * HEIGHT + 1, 4 * WIDTH - 1)
    capture = a_capture(tmp_path, [pixels(0)] * 2, cameras=[camera] * 2)
    views = load_images.load_capture(capture, factor=4, hold=9)
    np.testing.assert_allclose(views.cameras.focal, [[10 * 8 / 31, 11 * 6 / 25]], rtol=1e-6)


def test_masks_are_shrunk_with_the_pixels(tmp_path):
    mask = np.ones((HEIGHT, WIDTH), bool)
    mask[2, 3] = False
    capture = a_capture(tmp_path, [pixels(0), pixels(1), pixels(2)], masks=[None, mask, None])
    views = load_images.load_capture(capture, hold=9)
    np.testing.assert_array_equal(views.mask, np.concatenate([mask.ravel(), np.ones(HEIGHT * WIDTH, bool)]))
    small = load_images.load_capture(capture, hold=9, factor=2)
    expected = np.ones((3, 4), bool)
    expected[1, 1] = False
    np.testing.assert_array_equal(small.mask[:12], expected.ravel())
    iio.imwrite(tmp_path / "mask1.png", np.zeros((3, 3), np.uint8))
    with pytest.raises(ValueError, match="mask1.png: is 3 x 3, expected 8 x 6 as view1.png"):
        load_images.load_capture(capture, hold=9)


def test_images_without_alpha_become_opaque_beside_others_with_alpha(tmp_path):
    images = [pixels(0), pixels(1, channels=4), pixels(2)]
    capture = a_capture(tmp_path, images)
    views = load_images.load_capture(capture, hold=9, background=(1.0, 1.0, 1.0))
    assert views.pixels.shape[-1] == 4 and views.background == (1.0, 1.0, 1.0)
    np.testing.assert_array_equal(views.pixels[: HEIGHT * WIDTH], images[1].reshape(-1, 4))
    assert (views.pixels[HEIGHT * WIDTH :, 3] == 255).all()
    plain = load_images.load_capture(capture, hold=9)
    assert plain.pixels.shape[-1] == 3 and plain.background is None


@pytest.mark.parametrize("place", ["before", "behind", "none"])
def test_the_form_of_a_png_is_read_without_its_pixels(tmp_path, place):
    """EXIF data may be before the pixels or, as ImageMagick writes it, behind them."""
    exif = Image.Exif()
    exif[0x0112] = 6
    path = tmp_path / "turned.png"
    Image.fromarray(pixels(0, 40, 70)).save(path, exif=exif)
    content = path.read_bytes()
    start = content.index(b"eXIf") - 4
    end = start + 12 + int.from_bytes(content[start : start + 4], "big")
    chunk, rest = content[start:end], content[:start] + content[end:]
    if place != "before":
        path.write_bytes(rest[:-12] + chunk + rest[-12:] if place == "behind" else rest)
    turned = place != "none"
    assert image_size(path) == ((40, 70) if turned else (70, 40))
    assert image_form(path)[0] == read_image(path).shape == ((70, 40, 3) if turned else (40, 70, 3))
    if place != "behind":
        path.write_bytes(path.read_bytes()[:-200])  # the pixels are incomplete
        assert image_form(path)[0][0] == (70 if turned else 40)


@pytest.mark.parametrize("turn", range(1, 9))
def test_exif_orientation_is_followed_if_only_the_upright_size_fits_the_camera(tmp_path, turn):
    stored, exif = pixels(0, 4, 7), Image.Exif()
    exif[0x0112] = turn
    path = tmp_path / "turned.png"
    Image.fromarray(stored).save(path, exif=exif)
    upright = np.asarray(ImageOps.exif_transpose(Image.open(path)))
    np.testing.assert_array_equal(read_image(path), upright)
    assert image_size(path) == upright.shape[1::-1]
    for size, expected in (((8, 14), stored), ((14, 8), upright if turn >= 5 else stored), ((7, 7), stored)):
        np.testing.assert_array_equal(read_image(path, camera_size=size), expected)
    assert image_size(path, center=np.array([2.0, 3.6])) == (upright.shape[1::-1] if turn >= 5 else (7, 4))
    assert image_size(path, center=np.array([3.4, 2.0])) == (7, 4)


@pytest.mark.parametrize("kind", ["png", "jpg", "webp"])
def test_where_both_sizes_fit_pixels_are_those_that_are_stored(tmp_path, kind):
    """Programs that find poses ignore EXIF orientation."""
    capture = a_capture(tmp_path, [pixels(index, 8, 8) for index in range(2)])
    exif, frames = Image.Exif(), []
    exif[0x0112] = 3
    for frame in capture.frames:
        image = Image.open(frame.image)
        path = frame.image.with_suffix(f".{kind}")
        image.save(path, exif=exif)
        frames.append(frame._replace(image=path))
    capture = capture._replace(frames=tuple(frames))
    views = load_images.load_capture(capture, hold=9)
    stored = np.asarray(Image.open(frames[1].image))
    np.testing.assert_array_equal(views.pixels[:64, :3].reshape(8, 8, 3), stored[..., :3])


def test_a_mask_is_true_where_the_image_is_bright(tmp_path):
    iio.imwrite(tmp_path / "mask.png", np.uint8([[0, 127, 128, 255]]))
    assert read_mask(tmp_path / "mask.png").tolist() == [[False, False, True, True]]


def test_cameras_of_several_lenses_are_stacked():
    opencv = a_camera(distortion=np.array([0.1, 0.2, 0.3, 0.4]), lens="opencv")
    five = a_camera(distortion=np.arange(5.0), lens="opencv")
    fisheye = a_camera(distortion=np.arange(4.0), lens="fisheye")
    stack = load_images.stack_cameras([a_camera(), opencv, five], "abc")
    assert stack.lens == "opencv"
    np.testing.assert_allclose(stack.distortion, [[0] * 5, [0.1, 0.2, 0.3, 0.4, 0], [0, 1, 2, 3, 4]], rtol=1e-6)
    assert load_images.stack_cameras([fisheye, fisheye], "ab").distortion.shape == (2, 4)
    with pytest.raises(ValueError, match="mix lenses.*fisheye"):
        load_images.stack_cameras([a_camera(), fisheye], "ab")
    assert dataclasses.replace(stack).height == HEIGHT


@settings(deadline=None, max_examples=120, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data(), kind=st.sampled_from(["png", "jpg", "webp", "png16"]))
def test_a_damaged_image_is_read_or_a_one_line_error(tmp_path, data, kind):
    path = tmp_path / f"view.{kind[:4].removesuffix('16')}"
    write_image(path, pixels(0, 20, 30, dtype=np.uint16 if kind == "png16" else np.uint8))
    content = bytearray(path.read_bytes())
    if data.draw(st.booleans()):
        content = content[: data.draw(st.integers(0, len(content) - 1))]
    else:
        for _ in range(data.draw(st.integers(1, 6))):
            content[data.draw(st.integers(0, min(len(content), 400) - 1))] ^= 1 << data.draw(st.integers(0, 7))
    path.write_bytes(content)
    for read in (read_image, image_size, read_mask):
        try:
            assert np.size(read(path)) <= 2**28
        except ValueError as error:
            assert str(path) in str(error) and "\n" not in str(error)


def test_observations_of_sparse_points_follow_the_images(tmp_path):
    """Those of the chosen frames are in pixels of the shrunk images; those in cropped rows and columns are dropped."""
    capture = a_capture(tmp_path, [pixels(index, 7, 9) for index in range(3)], points=np.arange(12.0).reshape(4, 3))
    at = [np.array([[1.0, 2.0], [8.5, 1.0]]), np.array([[2.0, 5.0]]), np.array([[7.9, 5.9], [1.0, 6.5], [0.0, 0.0]])]
    frames = [
        frame._replace(seen=np.arange(len(where)), seen_at=where)
        for frame, where in zip(capture.frames, at, strict=True)
    ]
    frames[1] = frames[1]._replace(seen=None, seen_at=None)
    capture = capture._replace(frames=tuple(frames), splits={"train": (0, 1, 2)})
    sparse = load_images.load_capture(capture).sparse
    np.testing.assert_array_equal(sparse.positions, capture.points)
    np.testing.assert_array_equal(sparse.view, [0, 0, 2, 2, 2])
    np.testing.assert_array_equal(sparse.point, [0, 1, 0, 1, 2])
    np.testing.assert_allclose(sparse.pixel, np.concatenate([at[0], at[2]]), rtol=1e-6)
    halved = load_images.load_capture(capture, factor=2, select=lambda count: [2, 0]).sparse
    np.testing.assert_array_equal(halved.view, [0, 0, 1])
    np.testing.assert_array_equal(halved.point, [0, 2, 0])
    np.testing.assert_allclose(halved.pixel, np.array([[7.9, 5.9], [0, 0], [1, 2]]) / 2, rtol=1e-6)
    assert [leaf.dtype.name for leaf in jax.tree.leaves(halved)] == ["float32", "int32", "int32", "float32"]
    without_observations = capture._replace(frames=tuple(frame._replace(seen=None, seen_at=None) for frame in frames))
    sparse = load_images.load_capture(without_observations).sparse
    assert sparse.positions.shape == (4, 3) and sparse.pixel.shape == (0, 2) and sparse.view.dtype == np.int32
    assert load_images.load_capture(capture._replace(points=None, frames=without_observations.frames)).sparse is None
