"""Files whose names differ a little from those that a dataset states, and files that are no images."""

import json
import os
import unicodedata

import numpy as np
import pytest

import captures
from jaxnerf.data.readers import base, blender, transforms
from jaxnerf.data.readers.image_paths import ImageFinder

STUB = bytes.fromhex("00051607000200004d6163204f532058") + bytes(80)  # of macOS, beside each file on a foreign disk


@pytest.fixture(scope="module")
def shots():
    """Returns eight Shots with random pixels."""
    return captures.noise(captures.orbit(8))


def renamed(folder, shots, change, stated=str):
    """Writes transforms.json with names that `stated` changes, and files with names that `change` does."""
    content = captures.write_transforms(folder, shots, kind="jpg")
    for frame in content["frames"]:
        name = frame["file_path"].removeprefix("images/")
        os.rename(folder / "images" / name, folder / "images" / change(name))
        frame["file_path"] = stated(frame["file_path"])
    (folder / "transforms.json").write_text(json.dumps(content))
    return folder


def upper(name):
    return name.replace(".jpg", ".JPG")


def with_umlaut(form, name):
    return unicodedata.normalize(form, name.replace("0", "ü", 1))


@pytest.mark.parametrize(
    ("change", "stated"),
    [
        (upper, str),
        (upper, lambda path: path[:-4]),
        (str, upper),
        (str, lambda path: path.replace("images", "Images")),
        (lambda name: with_umlaut("NFD", name), lambda path: with_umlaut("NFC", path)),
        (lambda name: with_umlaut("NFC", name), lambda path: with_umlaut("NFD", path)),
    ],
)
def test_names_that_differ_in_case_or_unicode_form_are_read_with_a_note(tmp_path, shots, change, stated):
    plain = captures.write_transforms(tmp_path / "plain", shots, kind="jpg")
    capture = transforms.read_capture(renamed(tmp_path / "other", shots, change, stated))
    assert len(capture.frames) == len(plain["frames"]) and not capture.frames[3].name.lower().endswith("jpg")
    for frame, shot in zip(capture.frames, shots, strict=True):
        np.testing.assert_array_equal(frame.camera.to_world, shot.camera.to_world)
        assert frame.image.name == change(f"{shot.name}.jpg")
    assert len(capture.notes) == 1 and "8 paths differ from the files in case or Unicode form" in capture.notes[0]


def test_of_two_files_that_fit_none_is_chosen(tmp_path):
    for name in ("a.JPG", "A.jpg"):
        (tmp_path / name).touch()
    finder = ImageFinder(tmp_path)
    assert finder.find("a.jpg") is None and finder.find("a.JPG") == tmp_path / "a.JPG"


@pytest.mark.parametrize(
    ("stated", "near"),
    [
        (lambda path: path[:-4] + ".png", "images/000.jpg"),
        (lambda path: path + ".png", "images/000.jpg"),
        (lambda path: "images/" + path, "images/000.jpg"),
        (lambda path: path.removeprefix("images/"), "images/000.jpg"),
        (lambda path: "data\\scene\\" + path, "images/000.jpg"),
        (lambda path: "../elsewhere/" + path, "images/000.jpg"),
        (lambda path: "/home/other/" + path[:-4] + ".png", "images/000.jpg"),
    ],
)
def test_the_file_that_nearly_fits_is_named(tmp_path, shots, stated, near):
    with pytest.raises(ValueError, match=f"/{near} nearly fits .*: rename it, or correct the path") as caught:
        transforms.read_capture(renamed(tmp_path, shots, str, stated))
    assert "copy" not in str(caught.value).split(near)[1] and "\n" not in str(caught.value)


def test_the_blender_reader_names_it_too(tmp_path, shots):
    captures.write_blender(tmp_path, shots)
    for index in range(8):
        os.rename(tmp_path / f"train/{index:03d}.png", tmp_path / f"train/{index:03d}.PNG")
    assert [frame.image.suffix for frame in blender.read_capture(tmp_path).frames] == [".PNG"] * 8
    assert "in case or Unicode form" in blender.read_capture(tmp_path).notes[0]
    os.rename(tmp_path / "train/002.PNG", tmp_path / "002.png")
    with pytest.raises(ValueError, match=r"002.png does not exist.*; .*/002.png nearly fits"):
        blender.read_capture(tmp_path)


def test_a_path_out_of_the_folder_and_back_by_its_name_stays_inside(tmp_path, shots):
    folder = renamed(tmp_path / "my scene", shots, str, lambda path: ".\\..\\my scene\\" + path.replace("/", "\\"))
    assert [frame.name for frame in transforms.read_capture(folder).frames] == [shot.name for shot in shots]
    content = json.loads((folder / "transforms.json").read_text())
    for path in ("../my scene/../../etc/passwd", "../../my scene/images/000.jpg", "../my scene"):
        content["frames"][0]["file_path"] = path
        (folder / "transforms.json").write_text(json.dumps(content))
        with pytest.raises(ValueError, match="leaves the folder"):
            transforms.read_capture(folder)


def put_hidden(folder):
    """Writes the files that macOS, Windows and a file server leave beside images."""
    for path in list(folder.iterdir()):
        (folder / f"._{path.name}").write_bytes(STUB)
    for name in (".DS_Store", "Thumbs.db", ".hidden.png"):
        (folder / name).write_bytes(STUB)
    (folder / "folder.png").mkdir()


@pytest.mark.parametrize("format", ["llff", "transforms", "colmap"])
def test_hidden_files_are_no_images_and_no_masks(tmp_path, format):
    shots = captures.shoot(captures.front(8))
    if format == "transforms":
        content = captures.write_transforms(tmp_path, shots, masks=True)
        for frame in content["frames"]:
            del frame["mask_path"]
        (tmp_path / "transforms.json").write_text(json.dumps(content))
    else:
        {"llff": captures.write_llff, "colmap": captures.write_colmap}[format](tmp_path, shots, masks=True)
    plain = base.read_capture(tmp_path)
    for name in ("images", "masks"):
        put_hidden(tmp_path / name)
    capture = base.read_capture(tmp_path)
    assert [(f.name, f.image, f.mask) for f in capture.frames] == [(f.name, f.image, f.mask) for f in plain.frames]
    assert len(capture.frames) == 8 and capture.notes == () and capture.frames[0].mask is not None


@pytest.mark.parametrize("write", [captures.write_transforms, captures.write_blender, captures.write_llff])
def test_poses_of_three_decimals_are_made_rotations_again(tmp_path, write):
    shots = (captures.shoot if write is captures.write_llff else captures.noise)(captures.orbit(20))
    write(tmp_path, shots)
    exact = [frame.camera.to_world for frame in base.read_capture(tmp_path).frames]
    if write is captures.write_llff:
        rows = np.load(tmp_path / "poses_bounds.npy")
        np.save(tmp_path / "poses_bounds.npy", np.concatenate([rows[:, :15].round(3), rows[:, 15:]], axis=1))
    for path in tmp_path.glob("transforms*.json"):
        content = json.loads(path.read_text())
        for frame in content["frames"]:
            frame["transform_matrix"] = np.round(frame["transform_matrix"], 3).tolist()
        path.write_text(json.dumps(content))
    capture = base.read_capture(tmp_path)
    poses = [frame.camera.to_world for frame in capture.frames]
    assert len(capture.notes) == 1 and "of 20 poses are no exact rotations, as if rounded" in capture.notes[0]
    off = [np.abs(pose[:, :3].T @ pose[:, :3] - np.eye(3)).max() for pose in poses]
    assert max(off) <= 1e-3 and np.abs(np.subtract(poses, exact)).max() < 2e-3
    assert any(value < 1e-12 for value in off)
