"""Datasets with a JSON file for each split: Blender's, and those that state all intrinsics in a world of their own."""

import json

import jax
import numpy as np
import pytest

import captures
import jaxnerf
from jaxnerf.data import dataset
from jaxnerf.data.dataset import DataOptions
from jaxnerf.data.readers import base, transforms

LENS = {"lens": "opencv", "center": (13.0, 14.5), "focal": (30.0, 34.0), "distance": 2.2}
PARTS = {"train": range(6), "val": range(6, 7), "test": range(7, 8)}


@pytest.fixture(scope="module")
def shots():
    """Returns eight Shots of a distorted camera off centre, not at the distance of Blender's renders."""
    return captures.noise(captures.orbit(8, **LENS))


def write(folder, shots, *, change=lambda content: None, parts=PARTS, **options):
    """Writes the same dataset with one file in whole/ and with a file for each split in splits/; returns both."""
    both = folder / "whole", folder / "splits"
    contents = [captures.write_transforms(place, shots, **options) for place in both]
    (both[1] / "transforms.json").unlink()
    for split, indices in parts.items():
        content = {**contents[1], "frames": [contents[1]["frames"][index] for index in indices]}
        change(content)
        (both[1] / f"transforms_{split}.json").write_text(json.dumps(content))
    return both


@pytest.mark.parametrize("angle", [None, 0.9])
@pytest.mark.parametrize("options", [{"kind": "jpg"}, {"rgba": True}, {"masks": True}, {"per_frame": True}])
def test_split_files_with_full_intrinsics_are_read_as_one_file_is(tmp_path, shots, angle, options):
    def change(content):
        content |= {} if angle is None else {"camera_angle_x": angle}

    whole, splits = write(tmp_path, shots, change=change, **options)
    assert base.detect_formats(splits) == ["transforms"]
    capture, expected = base.read_capture(splits), base.read_capture(whole)
    assert capture.splits == {split: tuple(indices) for split, indices in PARTS.items()}
    jax.tree.map(np.testing.assert_array_equal, [f.camera for f in capture.frames], [f.camera for f in expected.frames])
    assert [frame.name for frame in capture.frames] == [frame.name for frame in expected.frames]
    assert [frame.mask is None for frame in capture.frames] == [frame.mask is None for frame in expected.frames]
    assert "transforms_train.json states fl_x" in capture.choices[0] and "near and far follow" in capture.choices[0]


def test_near_far_and_world_of_full_split_files_are_not_blenders(tmp_path, shots):
    whole, splits = write(tmp_path, shots)
    train, test = (jaxnerf.load_dataset(splits, split=split) for split in ("train", "test"))
    assert (train.names, test.names) == (tuple(f"{k:03d}" for k in range(6)), ("007",))
    expected = jaxnerf.load_dataset(whole)  # its test views are every eighth: 000
    for name in ("to_world", "focal", "center", "distortion"):
        found, other = getattr(train.cameras, name), getattr(expected.cameras, name)
        np.testing.assert_array_equal(found[1:], other[:5])
    np.testing.assert_array_equal(train.near[1:], expected.near[:5])
    np.testing.assert_array_equal(train.to_file, expected.to_file)
    lines = dataset.resolve(DataOptions(format="auto", dir=str(splits), background="auto", ndc="auto"))[1]
    assert sum(line.startswith("read ") and "--format=blender" in line for line in lines) == 1


def test_the_blender_reader_takes_every_camera_fact_if_it_is_selected(tmp_path, shots):
    _, splits = write(tmp_path, shots)
    views = jaxnerf.load_dataset(splits, format="blender", background="none")
    np.testing.assert_array_equal([views.near, views.far], [[2] * 6, [6] * 6])
    np.testing.assert_array_equal(views.cameras.center, [[13, 14.5]] * 6)
    np.testing.assert_array_equal(views.cameras.focal, [[30, 34]] * 6)
    np.testing.assert_array_equal(views.cameras.distortion[0, :4], np.float32(shots[0].camera.distortion))


@pytest.mark.parametrize(
    ("stated", "fields"),
    [
        ({"fl_x": 30.0}, "fl_x"),
        ({"camera_angle_x": 0.8, "cx": 15.0}, "cx"),
        ({"camera_angle_x": 0.8, "k1": 0.1}, "k1"),
        ({"camera_angle_x": 0.8, "distortion_params": [0.1, 0, 0, 0, 0, 0]}, "distortion_params"),
        ({"camera_angle_x": 0.8, "camera_model": "OPENCV_FISHEYE"}, "camera_model"),
        ({"camera_angle_y": 0.8}, "camera_angle_y"),
        ({"camera_angle_x": 0.8, "camera_angle_y": 0.7}, None),
        ({"camera_angle_x": 0.8, "w": 32, "h": 24}, None),
    ],
)
@pytest.mark.parametrize("own", [True, False])
def test_the_rule_is_what_the_files_state(tmp_path, shots, stated, fields, own):
    keys = ("fl_x", "fl_y", "cx", "cy", "w", "h", "k1", "k2", "p1", "p2", "camera_model")

    def change(content):
        for key in keys:
            content.pop(key, None)
        for level in content["frames"] if own else [content]:
            level |= stated

    _, splits = write(tmp_path, shots, change=change)
    capture = base.read_capture(splits)
    assert capture.format == ("transforms" if fields else "blender")
    assert not fields or capture.choices[0].startswith(f"transforms_train.json states {fields}: world")


def test_plain_files_have_the_cameras_of_blender(tmp_path):
    """The focal length is that of the angle, to the last bit; the angle along y counts if it is stated."""
    captures.write_blender(tmp_path, captures.noise(captures.orbit(3)))
    content = json.loads((tmp_path / "transforms_train.json").read_text())
    angle = content["camera_angle_x"]
    views = captures.load_blender(tmp_path)
    np.testing.assert_array_equal(views.cameras.focal, np.full((3, 2), np.float32(0.5 * 32 / np.tan(0.5 * angle))))
    np.testing.assert_array_equal(views.cameras.center, [[16, 12]] * 3)
    assert views.cameras.lens == "pinhole" and views.cameras.distortion is None
    content["frames"][1] |= {"camera_angle_x": 1.0}
    content["camera_angle_y"] = 0.5
    (tmp_path / "transforms_train.json").write_text(json.dumps(content))
    focal = captures.load_blender(tmp_path).cameras.focal
    np.testing.assert_allclose(focal[0], [16 / np.tan(angle / 2), 12 / np.tan(0.25)], rtol=1e-6)
    np.testing.assert_allclose(focal[1], [16 / np.tan(0.5), 12 / np.tan(0.25)], rtol=1e-6)


def test_one_split_may_state_more_than_the_others(tmp_path, shots):
    _, splits = write(tmp_path, shots)
    content = json.loads((splits / "transforms_train.json").read_text())
    for key in ("fl_x", "fl_y", "cx", "cy", "k1", "k2", "p1", "p2", "camera_model", "w", "h"):
        del content[key]
    (splits / "transforms_train.json").write_text(json.dumps(content | {"camera_angle_x": 0.9}))
    capture = base.read_capture(splits)
    assert capture.format == "transforms" and capture.choices[0].startswith("transforms_val.json states fl_x")
    assert capture.frames[0].camera.lens == "pinhole" and capture.frames[7].camera.lens == "opencv"


def test_split_files_win_over_one_file_beside_them_with_a_note(tmp_path, shots):
    _, splits = write(tmp_path, shots)
    captures.write_transforms(splits, shots)
    capture = base.read_capture(splits)
    assert capture.source.name == "transforms_train.json" and set(capture.splits) == set(PARTS)
    assert capture.notes[0].endswith("transforms.json: not used beside transforms_train.json; rename that to read it")


def test_of_a_training_file_alone_every_8th_view_is_held_out(tmp_path, shots):
    _, splits = write(tmp_path, shots, parts={"train": range(8)})
    capture = base.read_capture(splits)
    assert capture.splits is None and "every 8th view is a test view" in capture.choices[1]
    assert jaxnerf.load_dataset(splits, split="test").names == ("000",)


def test_names_that_repeat_in_other_files_begin_with_the_split(tmp_path, shots):
    _, splits = write(tmp_path, shots, parts={"train": range(6), "test": range(4, 8)})
    names = [frame.name for frame in base.read_capture(splits).frames]
    assert names == [f"train/{k:03d}" for k in range(6)] + [f"test/{k:03d}" for k in range(4, 8)]


def remove(folder, *names):
    for name in names:
        (folder / name).unlink()


def test_a_test_split_without_images_does_not_end_training(tmp_path, shots):
    _, splits = write(tmp_path, shots)
    remove(splits, "images/007.png")
    captures.write_blender(tmp_path / "blender", shots[:3])
    (tmp_path / "blender" / "test").mkdir()
    captures.write_blender(tmp_path / "blender", shots[3:5], split="test")
    remove(tmp_path / "blender", "test/003.png", "test/004.png")
    for folder, count, file in ((splits, 6, "transforms_test.json"), (tmp_path / "blender", 3, "003.png")):
        capture = base.read_capture(folder)
        assert capture.splits["test"] == () and len(capture.notes) == 1
        assert capture.notes[0].startswith("split 'test' is skipped: ") and file in capture.notes[0]
        assert len(jaxnerf.load_dataset(folder).names) == count
    with pytest.raises(ValueError, match="split 'test' of 7 images is empty"):
        jaxnerf.load_dataset(splits, split="test")
    with pytest.raises(ValueError, match=r"003.png does not exist"):
        jaxnerf.load_dataset(tmp_path / "blender", split="test")
    remove(splits, *(f"images/{k:03d}.png" for k in range(4)))
    with pytest.raises(ValueError, match=r"transforms_train.json: 4 of 6 frames have no file"):
        base.read_capture(splits)


@pytest.mark.parametrize(
    ("stated", "note"),
    [
        (
            {"camera_angle_x": 1.0},
            "camera_angle_x 1 is a focal length of 29.288 of 32 px, 40 px is stated, too, and used",
        ),
        ({"camera_angle_y": 1.0}, "camera_angle_y 1 is a focal length of 21.966 of 24 px, 41 px is stated"),
        ({"k5": 0.1}, "k5 is not used, as no lens"),
        ({"rolling_shutter": [0, 0, 0.1, 0]}, "rolling_shutter is not used, as all pixels"),
        ({"near": 0.5}, "near is not used, as it follows from the cameras; data.near sets it"),
        ({"camera_model": "PINHOLE", "k1": 0.1, "p1": 0.2}, "camera_model PINHOLE has no k1, p1, used as stated"),
        ({"up": [0, 1, 0]}, "up is not used: data.up sets"),
        ({"exposure": 0.5}, "exposure is not used"),
        ({"camera_model": "SIMPLE_RADIAL", "k2": 0.1}, "camera_model SIMPLE_RADIAL has no k2, used"),
        ({"k1": 0.2, "distortion_params": [0.1, 0, 0, 0, 0, 0]}, "k1 is 0.2, distortion_params has 0.1, which is used"),
        ({"camera_angle_x": 2 * np.arctan(16 / 40), "rolling_shutter": [0, 0, 0, 0], "k5": 0.0}, None),
        ({"camera_model": "OPENCV", "k1": 0.1}, None),
    ],
)
@pytest.mark.parametrize("own", [True, False])
def test_facts_that_are_stated_and_not_used_are_noted(tmp_path, stated, note, own):
    shots = captures.noise(captures.orbit(4, focal=(40.0, 41.0)))
    content = captures.write_transforms(tmp_path, shots)
    del content["camera_model"]
    for level in content["frames"] if own else [content]:
        level |= {"fl_x": 40.0, "fl_y": 41.0} | stated
    (tmp_path / "transforms.json").write_text(json.dumps(content))
    capture = transforms.read_capture(tmp_path)
    assert len(capture.notes) == (note is not None)
    if note:
        counted = own and "data.up" not in note and "exposure" not in note
        assert note in capture.notes[0] and capture.notes[0].endswith("so in 4 frames") == counted


def test_an_angle_that_a_frame_overrides_is_no_contradiction(tmp_path):
    content = captures.write_transforms(tmp_path, captures.noise(captures.orbit(3)), per_frame=True)
    (tmp_path / "transforms.json").write_text(json.dumps(content | {"camera_angle_x": 1.5}))
    assert transforms.read_capture(tmp_path).notes == ()


def test_frames_in_no_list_of_names_are_noted(tmp_path, shots):
    captures.write_transforms(tmp_path, shots, splits={"train": range(5), "test": [7]})
    assert transforms.read_capture(tmp_path).notes[0].endswith("2 frames are in no list of names, so no split has them")
    captures.write_transforms(tmp_path, shots, splits={"test": [7]})
    assert transforms.read_capture(tmp_path).notes == ()  # the others are trained on


def test_the_world_that_a_file_was_made_from_is_named(tmp_path, shots):
    captures.write_transforms(tmp_path, shots, extra={"applied_transform": np.eye(4)[:3].tolist(), "applied_scale": 2})
    choices = transforms.read_capture(tmp_path).choices
    assert len(choices) == 1 and "applied_transform, applied_scale: positions are those after it" in choices[0]
