"""Masks that are found in a folder beside the images, for every format of captures."""

import json
import os
import shutil

import imageio.v3 as iio
import numpy as np
import pytest
from PIL import Image

import captures
from jaxnerf.data import dataset
from jaxnerf.data.dataset import DataOptions
from jaxnerf.data.readers import base

NAMES = [f"{index:03d}" for index in range(8)]


@pytest.fixture(scope="module")
def shots():
    """Returns eight Shots with random pixels."""
    return captures.noise(captures.orbit(8))


def write(folder, shots, format):
    """Writes a dataset with masks/ that its format does not state, and returns its folder."""
    if format == "colmap":
        captures.write_colmap(folder, shots, masks=True)
        return folder
    content = captures.write_transforms(folder, shots, masks=True)
    for frame in content["frames"]:
        del frame["mask_path"]
    (folder / "transforms.json").write_text(json.dumps(content))
    if format == "llff":
        (folder / "transforms.json").unlink()
        rows = np.tile([0, 1, 0, 0, 24, -1, 0, 0, 0, 32, 0, 0, 1, 0, 40, 1, 9], (8, 1)).astype(float)
        np.save(folder / "poses_bounds.npy", rows)
    return folder


@pytest.mark.parametrize("place", ["images_mask", "images_masks", "masks"])
@pytest.mark.parametrize("format", ["transforms", "colmap", "llff"])
def test_masks_are_found_and_reported(tmp_path, shots, format, place):
    folder = write(tmp_path, shots, format)
    (folder / "masks").rename(folder / place)
    resolved, lines, _ = dataset.resolve(DataOptions(format="auto", background="auto", ndc="auto", dir=str(folder)))
    assert resolved.format == format
    said = f"8 of 8 images have one, such as {folder / place / '000.png'}: dark pixels are ignored"
    assert [line for line in lines if line.startswith("masks ")] == [f"masks         {said} in training and metrics"]
    assert [frame.mask for frame in base.read_capture(folder).frames] == [folder / place / f"{n}.png" for n in NAMES]
    views = dataset.load_split(resolved, "train")
    np.testing.assert_array_equal(views.mask[: 24 * 32].reshape(24, 32), captures.hidden(24, 32))


def test_a_mask_may_have_the_whole_name_of_its_image(tmp_path, shots):
    folder = write(tmp_path, shots, "colmap")
    for name in NAMES:
        os.rename(folder / "masks" / f"{name}.png", folder / "masks" / f"{name}.png.png")
    assert base.read_capture(folder).frames[3].mask == folder / "masks" / "003.png.png"


def test_a_missing_mask_is_an_error_that_names_it(tmp_path, shots):
    folder = write(tmp_path, shots, "colmap")
    for name in ("002", "005"):
        (folder / "masks" / f"{name}.png").unlink()
    with pytest.raises(ValueError, match=r"masks: has no 002.png, but masks of 6 of 8 images, expected one for each"):
        base.read_capture(folder)


def test_a_folder_without_masks_of_the_images_is_noted(tmp_path, shots):
    folder = write(tmp_path, shots, "colmap")
    for name in NAMES:
        (folder / "masks" / f"{name}.png").unlink()
    iio.imwrite(folder / "masks" / "object.png", np.zeros((4, 4), np.uint8))
    found = base.read_capture(folder)
    assert found.frames[0].mask is None
    assert found.notes == (f"{folder / 'masks'}: has no 000.png and no other image's mask, so its files are not used",)


def test_masks_that_the_format_states_are_kept(tmp_path, shots):
    captures.write_transforms(tmp_path, shots, masks=True)
    (tmp_path / "images_mask").mkdir()
    found = base.read_capture(tmp_path)
    assert found.frames[0].mask == tmp_path / "masks" / "000.png" and not found.notes


def test_masks_are_part_of_the_fingerprint(tmp_path, shots):
    folder = write(tmp_path, shots, "colmap")
    with_masks = base.fingerprint(base.read_capture(folder))
    (folder / "masks").rename(folder / "no_masks")
    assert base.fingerprint(base.read_capture(folder)) != with_masks


@pytest.mark.parametrize("names", ["{}.PNG", "{}.jpg.png", "{}.JPG.png"])
def test_masks_may_differ_in_case_from_their_images(tmp_path, shots, names):
    content = captures.write_transforms(tmp_path, shots, kind="jpg", masks=True)
    for frame in content["frames"]:
        del frame["mask_path"]
        name = frame["file_path"][-7:-4]
        os.rename(tmp_path / "images" / f"{name}.jpg", tmp_path / "images" / f"{name}.JPG")
        os.rename(tmp_path / "masks" / f"{name}.png", tmp_path / "masks" / names.format(name))
    (tmp_path / "transforms.json").write_text(json.dumps(content))
    frames = base.read_capture(tmp_path).frames
    assert [frame.mask for frame in frames] == [tmp_path / "masks" / names.format(name) for name in NAMES]


def painted(value, mode):
    """Returns an image of 32 x 24 px that is black but for 8 rows of a value."""
    pixels = np.zeros((24, 32), np.uint8)
    pixels[8:16] = value
    image = Image.fromarray(pixels)
    if mode == "P":
        palette = image.convert("P")
        palette.putpalette([0, 0, 0] * value + [9, 0, 0] * (256 - value))
        return palette
    return image.point(bool, "1") if mode == "1" else image.convert(mode)


@pytest.mark.parametrize("value, mode", [(255, "L"), (1, "L"), (7, "RGBA"), (255, "LA"), (3, "P"), (1, "1")])
@pytest.mark.parametrize("format", ["transforms", "colmap", "llff", "blender"])
def test_pixels_that_instant_ngps_masks_show_are_ignored(tmp_path, shots, value, mode, format):
    """dynamic_mask_NAME.png beside an image: every pixel that is not black, whatever its alpha; no view is a mask."""
    if format == "blender":
        captures.write_blender(tmp_path, shots)
    elif format == "colmap":
        captures.write_colmap(tmp_path, shots)
    else:
        write(tmp_path, shots, format)
        shutil.rmtree(tmp_path / "masks")
    if format == "transforms":
        for frame in base.read_capture(tmp_path).frames:
            frame.image.rename(frame.image.with_suffix(".jpg"))
        text = (tmp_path / "transforms.json").read_text()
        (tmp_path / "transforms.json").write_text(text.replace(".png", ".jpg"))
    before = base.read_capture(tmp_path)
    for frame in before.frames[1:]:  # one has none
        painted(value, mode).save(frame.image.with_name(f"dynamic_mask_{frame.image.stem}.png"))
    capture = base.read_capture(tmp_path)
    assert [frame.image for frame in capture.frames] == [frame.image for frame in before.frames]
    assert "dynamic_mask_" in capture.choices[-1] and "7 of 8 images have such a mask" in capture.choices[-1]
    assert base.fingerprint(capture) != base.fingerprint(before)
    views = dataset.load_dataset(tmp_path, split="train", background="none")
    mask = views.mask[-24 * 32 :].reshape(24, 32)
    assert not mask[8:16].any() and mask[:8].all() and mask[16:].all()
    halved = dataset.load_dataset(tmp_path, split="train", background="none", factor=2).mask[-12 * 16 :].reshape(12, 16)
    assert not halved[4:8].any() and halved[:4].all() and halved[8:].all()


def test_masks_that_a_file_states_win_over_instant_ngps(tmp_path, shots):
    captures.write_transforms(tmp_path, shots, masks=True)
    for frame in base.read_capture(tmp_path).frames:
        painted(255, "L").save(frame.image.with_name(f"dynamic_mask_{frame.image.stem}.png"))
    views = dataset.load_dataset(tmp_path, split="train")
    np.testing.assert_array_equal(views.mask[: 24 * 32].reshape(24, 32), captures.hidden(24, 32))


@pytest.mark.parametrize("factor", [1, 2])
def test_pixels_beyond_the_crop_radius_are_ignored(tmp_path, shots, factor):
    """The radius is in px of the stated size, which may be twice that of the images."""
    content = captures.write_transforms(tmp_path, shots, extra={"fisheye_crop_radius": 20.0})
    for key in ("fl_x", "fl_y", "cx", "cy", "w", "h"):
        content[key] *= 2
    (tmp_path / "transforms.json").write_text(json.dumps(content))
    views = dataset.load_dataset(tmp_path, split="train", factor=2 * factor)
    height, width = 24 // factor, 32 // factor
    mask = views.mask[: height * width].reshape(height, width)
    y, x = np.mgrid[:height, :width] + 0.5
    radius = np.hypot(x - width / 2, y - height / 2) * factor
    assert not mask[radius > 10 + factor].any() and mask[radius < 10 - factor].all()
    assert "pixels beyond fisheye_crop_radius, 20 px, are ignored" in base.read_capture(tmp_path).choices[-1]
    (tmp_path / "transforms.json").write_text(json.dumps(content | {"fisheye_crop_radius": 41}))
    assert dataset.load_dataset(tmp_path, split="train", factor=2).mask is None
    for wrong in (0, -3, "20", float("nan")):
        (tmp_path / "transforms.json").write_text(json.dumps(content | {"fisheye_crop_radius": wrong}))
        with pytest.raises(ValueError, match="fisheye_crop_radius is .*, expected px above 0"):
            base.read_capture(tmp_path)
