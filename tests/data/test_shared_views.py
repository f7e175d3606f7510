"""Test views among the training views: they are found in every format, reported, and recorded."""

import json
import os
import shutil

import pytest

import captures
from jaxnerf.data import dataset, shared_views
from jaxnerf.data.dataset import DataOptions
from jaxnerf.data.readers import base
from jaxnerf.evaluation import protocol
from jaxnerf.evaluation.evaluate import summary


@pytest.fixture(scope="module")
def shots():
    """Returns eight Shots of the scene, which compress as real images do."""
    return captures.shoot(captures.orbit(8, height=96, width=128))


def found(folder, split="test"):
    return shared_views.shared_views(base.read_capture(folder), split)


def options(folder, **changes):
    return DataOptions(**{"format": "auto", "dir": str(folder), "background": "auto", "ndc": "auto"} | changes)


def test_a_list_of_names_within_the_training_views(tmp_path, shots):
    captures.write_transforms(tmp_path, shots, splits={"train": range(8), "test": [0, 4]})
    assert found(tmp_path) == [("000", "000", "the same file"), ("004", "004", "the same file")]
    data, lines, _ = dataset.resolve(options(tmp_path))
    expected = (
        "2 of 2 views of the split 'test' are training views, too (000 is the same file): their scores are not those "
        "of held-out views"
    )
    assert [line for line in lines if "training views" in line] == [f"note          {expected}"]
    recorded = dataset.conventions(data)["shared_with_training"]
    assert recorded["test"] == recorded["val"] == {"count": 2, "names": ["000", "004"], "note": expected}


def test_a_test_file_that_equals_the_training_file(tmp_path, shots):
    captures.write_blender(tmp_path, shots)
    for split, count in (("test", 8), ("val", 3)):
        content = json.loads((tmp_path / "transforms_train.json").read_text())
        content["frames"] = content["frames"][:count]
        (tmp_path / f"transforms_{split}.json").write_text(json.dumps(content))
    # All that would be inferred is set, so that the images' sizes are not needed.
    data, lines, _ = dataset.resolve(options(tmp_path, format="blender", background="white"))
    notes = [line for line in lines if "are training views, too" in line]
    assert [note.split()[1:4] for note in notes] == [["8", "of", "8"], ["3", "of", "3"]]
    recorded = dataset.conventions(data)["shared_with_training"]
    assert recorded["test"]["count"] == 8 and recorded["val"]["count"] == 3
    assert "(test/000 is train/000, the same file)" in notes[0]


def split_in_two(folder, shots):
    """Writes a Blender dataset whose test images, in test/, are copies of the first three training images."""
    captures.write_blender(folder, shots)
    captures.write_blender(folder, shots[:3], split="test")


@pytest.mark.parametrize("copy", [os.link, shutil.copy, lambda a, b: os.symlink(a.resolve(), b)])
def test_copies_and_links_of_files(tmp_path, shots, copy):
    split_in_two(tmp_path, shots)
    content = json.loads((tmp_path / "transforms_test.json").read_text())
    for index, frame in enumerate(content["frames"]):
        (tmp_path / "test" / f"{index:03d}.png").unlink()
        copy(tmp_path / "train" / f"{index:03d}.png", tmp_path / "test" / f"other_{index}.png")
        frame["file_path"] = f"test/other_{index}"
        frame["transform_matrix"][0][3] += 1.0  # another pose does not hide it
    (tmp_path / "transforms_test.json").write_text(json.dumps(content))
    reason = "the same bytes" if copy is shutil.copy else "the same file"
    assert found(tmp_path) == [(f"test/other_{k}", f"train/{k:03d}", reason) for k in range(3)]


def test_datasets_without_shared_views(tmp_path, shots):
    captures.write_transforms(tmp_path / "a", shots)
    captures.write_blender(tmp_path / "b", shots[:6])
    captures.write_blender(tmp_path / "b", shots[6:], split="test")
    for folder in (tmp_path / "a", tmp_path / "b"):
        data, lines, _ = dataset.resolve(options(folder))
        assert found(folder) == [] and not any("training views" in line for line in lines)
        assert "shared_with_training" not in dataset.conventions(data)


def test_a_copy_under_another_name_in_a_capture_without_splits(tmp_path, shots):
    captures.write_transforms(tmp_path, shots)
    shutil.copy(tmp_path / "images" / "003.png", tmp_path / "images" / "000.png")
    assert found(tmp_path) == [("000", "003", "the same bytes")]


def test_training_views_that_are_not_used_do_not_count(tmp_path, shots):
    captures.write_transforms(tmp_path, shots, splits={"train": range(8), "test": [0, 4]})
    data, *_ = dataset.resolve(options(tmp_path, num_views=2))  # 000 and 004
    assert dataset.views_shared_with_training(data)["test"]["names"] == ["000", "004"]
    data, *_ = dataset.resolve(options(tmp_path, num_views=1))
    assert dataset.views_shared_with_training(data)["test"]["names"] == ["000"]


def test_test_images_alone_can_be_read(tmp_path, shots):
    """As on a computer that only evaluates."""
    split_in_two(tmp_path, shots)
    data, *_ = dataset.resolve(options(tmp_path))
    shutil.rmtree(tmp_path / "train")
    assert len(dataset.load_split(data, "test").names) == 3
    assert dataset.conventions(data)["format"] == "blender"


def test_results_record_the_views_of_their_split_only(tmp_path, shots):
    captures.write_transforms(tmp_path, shots, splits={"train": range(6), "test": [0, 4], "val": [7]})
    data, *_ = dataset.resolve(options(tmp_path))
    conventions = dataset.conventions(data)
    for split, count in (("test", 2), ("val", 0), ("train", 0)):
        views = dataset.load_split(data, split)
        recorded = protocol.of_views(conventions, views, split=split)
        shared = recorded["conventions"].get("shared_with_training", {"count": 0})
        assert shared["count"] == count
        why = f"{count} of the views were trained on, there none"
        different = [why in row["why"] for row in recorded["comparable_with"]]
        assert all(different) == any(different) == (count > 0)
        results = {"psnr": 30.0, "ssim": 0.9, "views": 2, **recorded}
        assert ("are training views, too" in summary(results)) == (count > 0) and "\n" not in summary(results)
