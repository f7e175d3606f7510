"""Masks that are found in a folder beside the images, for every format of captures."""

import json
import os

import imageio.v3 as iio
import numpy as np
import pytest

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
