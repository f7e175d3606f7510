"""Downscaled copies of images: their assignment, their scale, and the factors that they allow."""

import dataclasses

import numpy as np
import pytest

import captures
from jaxnerf import Camera
from jaxnerf.data.images import downscaled_copies, load_images
from jaxnerf.data.images.image_files import read_image
from jaxnerf.data.readers.base import Capture, Frame


def image(seed, height=8, width=16):
    return np.random.default_rng(seed).integers(0, 256, (height, width, 3), np.uint8)


def put(folder, names, height=8, width=16, kind="png", seed=0):
    folder.mkdir(parents=True, exist_ok=True)
    for index, name in enumerate(names):
        captures.write_image(folder / f"{name}.{kind}", image(seed + index, height, width))


def a_capture(folder, names, kind="png", size=(8, 16), format="transforms"):
    camera = Camera(
        to_world=np.eye(3, 4),
        focal=np.array([10.0, 10.0]),
        center=np.array([8.0, 4.0]),
        height=size and size[0],
        width=size and size[1],
    )
    frames = [Frame(name, folder / f"{name}.{kind}", camera, bounds=(1.0, 2.0)) for name in names]
    return Capture(format, folder, tuple(frames))


NAMES = ("a", "b", "c")


def test_a_camera_without_a_size_is_scaled_for_the_copy(tmp_path):
    put(tmp_path / "images", NAMES)
    put(tmp_path / "images_2", NAMES, 4, 8, seed=50)
    views = load_images.load_capture(a_capture(tmp_path / "images", NAMES, size=None), factor=2, hold=9)
    np.testing.assert_array_equal(views.pixels[:32], image(51, 4, 8).reshape(-1, 3))
    np.testing.assert_allclose(views.cameras.focal, [[5, 5]] * 2)
    np.testing.assert_allclose(views.cameras.center, [[4, 2]] * 2)


def test_the_scale_of_a_folder_is_measured_on_its_images(tmp_path):
    """Frames in images_2 are not shrunk if their cameras have that size; a camera may be of a larger image."""
    put(tmp_path / "images_2", NAMES, 4, 8)
    own = a_capture(tmp_path / "images_2", NAMES, size=(4, 8))
    assert load_images.load_capture(own, hold=9).size.tolist() == [[4, 8]] * 2
    assert load_images.load_capture(own, factor=2, hold=9).size.tolist() == [[2, 4]] * 2
    larger = a_capture(tmp_path / "images_2", NAMES, size=(8, 16))
    views = load_images.load_capture(larger, factor=2, hold=9)
    assert views.size.tolist() == [[4, 8]] * 2
    np.testing.assert_allclose(views.cameras.focal, [[5, 5]] * 2)
    assert downscaled_copies.factor_for(larger, 8) == (2, 16)
    with pytest.raises(ValueError, match="2 times smaller than their cameras, data.factor is 1"):
        load_images.load_capture(larger, hold=9)


def test_copies_are_assigned_by_name_or_else_by_order(tmp_path):
    put(tmp_path / "images", NAMES)
    put(tmp_path / "images_2", ("z", *NAMES), 4, 8, kind="jpg", seed=50)
    found, rest = downscaled_copies.choose_copies(a_capture(tmp_path / "images", NAMES).frames, 2)
    assert [frame.image.name for frame in found] == ["a.jpg", "b.jpg", "c.jpg"] and rest == 1
    put(tmp_path / "images_4", ("0", "1", "2"), 2, 4)
    found, rest = downscaled_copies.choose_copies(a_capture(tmp_path / "images", NAMES).frames, 4)
    assert [frame.image.name for frame in found] == ["0.png", "1.png", "2.png"] and rest == 1


def test_a_folder_of_other_images_is_no_copy(tmp_path):
    """Names are shifted by one, so assignment by order gives each view its neighbour's image."""
    put(tmp_path / "images", NAMES)
    put(tmp_path / "images_2", ("b", "c", "d"), 4, 8)
    found, rest = downscaled_copies.choose_copies(a_capture(tmp_path / "images", NAMES).frames, 2)
    assert [frame.image.parent.name for frame in found] == ["images"] * 3 and rest == 2


def test_folders_with_other_names_and_images_of_other_formats(tmp_path):
    put(tmp_path / "images_undistorted", NAMES)
    views = load_images.load_capture(a_capture(tmp_path / "images_undistorted", NAMES), hold=9)
    assert views.size.tolist() == [[8, 16]] * 2
    put(tmp_path / "images", NAMES, kind="bmp")
    put(tmp_path / "images_2", ("x", "y", "w"), 4, 8)
    views = load_images.load_capture(a_capture(tmp_path / "images", NAMES, kind="bmp"), factor=2, hold=9)
    assert views.size.tolist() == [[4, 8]] * 2


def test_a_mask_of_the_original_is_shrunk_for_the_copy(tmp_path):
    put(tmp_path / "images", NAMES)
    put(tmp_path / "images_2", NAMES, 4, 8)
    mask = np.ones((8, 16), bool)
    mask[3, 5] = False
    captures.write_image(tmp_path / "mask.png", np.repeat(np.uint8(255 * mask)[..., None], 3, -1))
    capture = a_capture(tmp_path / "images", NAMES)
    capture = capture._replace(frames=tuple(frame._replace(mask=tmp_path / "mask.png") for frame in capture.frames))
    views = load_images.load_capture(capture, factor=2, hold=9)
    expected = np.ones((4, 8), bool)
    expected[1, 2] = False
    np.testing.assert_array_equal(views.mask[:32].reshape(4, 8), expected)


@pytest.mark.parametrize("turn", [3, 6])
def test_exif_orientation_is_ignored_if_cameras_refer_to_stored_pixels(tmp_path, turn):
    from PIL import Image

    exif = Image.Exif()
    exif[0x0112] = turn
    (tmp_path / "images").mkdir()
    Image.fromarray(image(0)).save(tmp_path / "images" / "a.png", exif=exif)
    capture = a_capture(tmp_path / "images", ("a",))
    frame = capture.frames[0]._replace(follow_exif=False)
    stored = load_images.load_capture(capture._replace(frames=(frame,), splits={"train": (0,)}))
    np.testing.assert_array_equal(stored.pixels, image(0).reshape(-1, 3))
    assert read_image(frame.image).shape == ((8, 16, 3) if turn == 3 else (16, 8, 3))


@pytest.mark.parametrize(
    "rendered, size, width, expected",
    [
        (True, (512, 512), 200, 2),
        (True, (800, 800), 200, 4),
        (False, (1920, 1080), 200, 5),
        (False, (100, 150), 800, 1),
    ],
)
def test_the_factor_for_a_width_is_valid(tmp_path, rendered, size, width, expected):
    capture = a_capture(tmp_path, NAMES, size=size)._replace(rendered=rendered)
    small = Frame("a", tmp_path / "a.png", dataclasses.replace(capture.frames[0].camera))
    put(tmp_path, ("a",), *size)
    assert downscaled_copies.factor_for(capture._replace(frames=(small,)), width) == (expected, size[1])


def test_the_factor_is_a_multiple_of_the_scale_of_existing_copies(tmp_path):
    put(tmp_path / "images_4", NAMES, 10, 20)
    put(tmp_path / "images_8", NAMES, 5, 10)
    capture = a_capture(tmp_path / "images_4", NAMES, size=(40, 80))
    assert downscaled_copies.factor_for(capture, 17) == (4, 80) and downscaled_copies.factor_for(capture, 7) == (12, 80)
