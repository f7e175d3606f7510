"""Views of a split: selection, held-out views, and `load_dataset` for every format, registered ones included."""

import dataclasses

import jax
import numpy as np
import pytest

import captures
from jaxnerf import Camera, SparsePoints, Views, load_dataset, register_reader
from jaxnerf.configs import capture
from jaxnerf.data import dataset
from jaxnerf.data.dataset import DataOptions, load_split
from jaxnerf.data.readers import blender, transforms
from jaxnerf.data.view_selection import held_out, select_views
from jaxnerf.extend import CameraFiles
from jaxnerf.options import replaced
from jaxnerf.registry import READERS, Reader
from jaxnerf.tools.capture_check import findings
from jaxnerf.training.config import read_config

SIZES = [(2, 3), (1, 4), (3, 3), (2, 2)]


@pytest.fixture
def views():
    """Returns four small views of different sizes, whose numbers are all different."""
    counts = [height * width for height, width in SIZES]
    view = np.repeat(np.arange(4), counts)
    return Views(
        pixels=np.stack([view, np.arange(view.size)], -1).astype(np.uint16).repeat(2, axis=-1),
        offset=np.cumsum([0, *counts[:-1]]).astype(np.int32),
        size=np.int32(SIZES),
        cameras=Camera(
            to_world=np.arange(4 * 12, dtype=np.float32).reshape(4, 3, 4),
            focal=np.arange(8, dtype=np.float32).reshape(4, 2),
            center=-np.arange(8, dtype=np.float32).reshape(4, 2),
            distortion=np.arange(16, dtype=np.float32).reshape(4, 4),
            lens="fisheye",
        ),
        near=np.arange(4, dtype=np.float32),
        far=np.arange(4, 8).astype(np.float32),
        mask=np.arange(view.size) % 2 == 0,
        names=tuple("abcd"),
        background=(1.0, 0.0, 1.0),
        sparse=SparsePoints(
            positions=np.arange(15, dtype=np.float32).reshape(5, 3),
            view=np.int32([0, 0, 2, 3, 3, 3]),
            point=np.int32([4, 1, 0, 1, 2, 3]),
            pixel=np.arange(12, dtype=np.float32).reshape(6, 2) / 6,
        ),
    )


@pytest.mark.parametrize(
    "split, number, names",
    [("train", 3, ["train_000", "train_020", "train_040"]), ("test", 99, None), ("held_out", 2, None)],
)
def test_at_most_some_views_are_read(split, number, names):
    data = DataOptions(size=24, hold_out=10 if split == "held_out" else 0)
    whole, some = load_split(data, split), load_split(data, split, max_views=number)
    count = min(number, len(whole.names))
    places = np.arange(count) * len(whole.names) // count
    assert list(some.names) == [whole.names[place] for place in places] and (names is None or list(some.names) == names)


def capture_data(**changes):
    """Returns the options of the dataset in configs/capture.py, with some changes."""
    return replaced(read_config(capture.get_config()).data, **changes)


def test_a_relative_folder_is_saved_as_an_absolute_one(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    captures.write_transforms(tmp_path / "scene", captures.noise(captures.orbit(8)))
    data = capture_data(dir="scene")
    assert dataset.resolve(data)[0].dir == str(tmp_path / "scene")
    (tmp_path / "below").mkdir()
    monkeypatch.chdir(tmp_path / "below")
    monkeypatch.setenv("JAXNERF_SCENES", str(tmp_path))
    assert dataset.resolve(data)[0].dir == "scene"


@pytest.mark.parametrize("indices", [[2], [3, 0], [1, 2, 3], np.arange(4)])
def test_a_selected_view_keeps_its_arrays(views, indices):
    got = select_views(views, indices)
    assert got.names == tuple("abcd"[index] for index in indices)
    assert (got.cameras.lens, got.background) == ("fisheye", (1.0, 0.0, 1.0))
    ends = np.append(got.offset, len(got.pixels))
    for place, index in enumerate(indices):
        height, width = SIZES[index]
        own = slice(ends[place], ends[place + 1])
        first = views.offset[index]
        np.testing.assert_array_equal(got.pixels[own], views.pixels[first : first + height * width])
        np.testing.assert_array_equal(got.mask[own], views.mask[first : first + height * width])
        for name in ("size", "near", "far"):
            np.testing.assert_array_equal(getattr(got, name)[place], getattr(views, name)[index])
        for name in ("to_world", "focal", "center", "distortion"):
            np.testing.assert_array_equal(getattr(got.cameras, name)[place], getattr(views.cameras, name)[index])
        mine, theirs = got.sparse.view == place, views.sparse.view == index
        np.testing.assert_array_equal(got.sparse.point[mine], views.sparse.point[theirs])
        np.testing.assert_array_equal(got.sparse.pixel[mine], views.sparse.pixel[theirs])
    assert len(got.sparse.view) == np.isin(views.sparse.view, indices).sum() and (np.diff(got.sparse.view) >= 0).all()
    np.testing.assert_array_equal(got.sparse.positions, views.sparse.positions)
    kinds = [[leaf.dtype for leaf in jax.tree.leaves(one)] for one in (got, views)]
    assert kinds[0] == kinds[1]


def test_selecting_all_views_changes_nothing(views):
    for given in (views, dataclasses.replace(views, mask=None, names=(), sparse=None)):
        got = select_views(given, range(4))
        assert jax.tree.structure(got) == jax.tree.structure(given)
        jax.tree.map(np.testing.assert_array_equal, got, given)


def test_selected_views_keep_their_times_and_indices(views):
    moving = dataclasses.replace(views, time=np.float32([0, 0.25, 0.5, 1]), image_index=np.arange(4, dtype=np.int32))
    got = select_views(moving, [3, 1])
    assert got.time.tolist() == [1, 0.25] and got.image_index.tolist() == [3, 1]


def test_selecting_copies_pixels(views):
    got = select_views(views, [0, 1])
    got.pixels[:] = 0
    assert views.pixels[1, 2] > 0


@pytest.mark.parametrize("count", [2, 3, 7, 60, 100])
def test_held_out_indices_are_equally_spaced(count):
    for every in range(2, count + 1):
        indices = held_out(count, every)
        assert (np.diff(indices) == every).all() and indices[0] < every and indices[-1] < count
        assert abs(indices.size - count / every) < 1
        assert indices[0] == 3 or every < 4


def test_training_and_held_out_views_partition_the_split():
    every, data = load_split(DataOptions(size=24), "train"), DataOptions(size=24, hold_out=7)
    train, held = load_split(data, "train"), load_split(data, "held_out")
    assert len(held.offset) == 9 and len(train.offset) == 51
    assert held.names[:2] == ("train_003", "train_010")
    assert set(train.names).isdisjoint(held.names) and {*train.names, *held.names} == set(every.names)
    for part in (train, held):
        expected = select_views(every, [every.names.index(name) for name in part.names])
        jax.tree.map(np.testing.assert_array_equal, part, expected)
    assert load_split(data, "test").names[0] == "test_000"  # not affected


@pytest.mark.parametrize("hold_out", [1, -2, 61])
def test_a_hold_out_that_leaves_no_view_is_an_error(hold_out):
    data = DataOptions(size=24, hold_out=hold_out)
    for split in ("train", "held_out"):
        with pytest.raises(ValueError, match=f"data.hold_out is {hold_out} of 60 views, expected 2 to 60"):
            load_split(data, split)


def test_nothing_is_held_out_by_default():
    data = DataOptions(size=24)
    assert len(load_split(data, "train").offset) == 60
    with pytest.raises(ValueError, match="held_out"):
        load_split(data, "held_out")


def test_num_views_are_evenly_spread_over_the_views_that_are_not_held_out():
    data = DataOptions(size=24, hold_out=7)
    train, some = (load_split(each, "train") for each in (data, replaced(data, num_views=17)))
    assert some.names == train.names[::3]
    jax.tree.map(np.testing.assert_array_equal, some, select_views(train, np.arange(17) * 3))
    assert len(load_split(data, "held_out").offset) == 9
    with pytest.raises(ValueError, match="data.num_views is 52 of 51 views, expected 1 to 51"):
        load_split(replaced(data, num_views=52), "train")


def test_view_indices_name_the_training_views():
    data = DataOptions(size=24, view_indices=(26, 2, 55))
    every, some = (load_split(each, "train") for each in (DataOptions(size=24), data))
    assert some.names == tuple(every.names[index] for index in (26, 2, 55))
    np.testing.assert_array_equal(some.image(1), every.image(2))
    assert load_split(data, "test").names == load_split(DataOptions(size=24), "test").names
    for changes, problem in (
        ({"view_indices": (3, 60)}, "data.view_indices has 60, expected indices of training views"),
        ({"hold_out": 7, "view_indices": (0, int(held_out(60, 7)[1]))}, "that are not held out"),
        ({"num_views": 2}, "data.num_views is 2 and data.view_indices .*, expected only one"),
    ):
        with pytest.raises(ValueError, match=problem):
            load_split(replaced(data, **changes), "train")


@pytest.mark.parametrize("wrong", [(1, 1), (-1,), (True,), (1.5,)])
def test_wrong_view_indices_are_named(wrong):
    config = capture.get_config()
    config.data.view_indices = wrong
    with pytest.raises(ValueError, match="data.view_indices is .*, expected different whole numbers"):
        read_config(config)


def test_num_views_of_files_reads_only_those_views(tmp_path):
    captures.write_transforms(tmp_path, captures.noise(captures.orbit(8)))
    data = capture_data(dir=str(tmp_path), num_views=3, hold_out=3)
    assert load_split(data, "held_out").names == ("003", "006")
    train = load_split(data, "train")  # of 001, 002, 004, 005, 007
    assert train.names == ("001", "002", "005") and len(train.pixels) == 3 * 24 * 32


FORMATS = {
    "blender": (captures.write_blender, captures.orbit),
    "transforms": (captures.write_transforms, captures.orbit),
    "colmap": (captures.write_colmap, captures.orbit),
    "llff": (captures.write_llff, captures.front),
}


@pytest.mark.parametrize("name", FORMATS)
def test_load_dataset_infers_everything_from_the_folder(tmp_path, name):
    write, stack = FORMATS[name]
    shots = captures.shoot(stack(8)) if name in ("colmap", "llff") else captures.noise(stack(8))
    write(tmp_path, shots)
    views = load_dataset(tmp_path)
    data = capture_data(dir=str(tmp_path), factor=1)
    resolved, *_ = dataset.resolve(data)
    rule = "all that the dataset's own lists name" if name == "blender" else "every 8th by name, from the first"
    assert dataset.conventions(resolved)["test_split"] == rule
    assert resolved.format == name and resolved.world == dict(blender="file", llff="forward").get(name, "around")
    assert (len(views.offset), views.size.tolist()[0]) == (8 if name == "blender" else 7, [24, 32])
    assert (views.pixels.shape[-1] == 4) == (name == "blender") == (views.background is not None)
    jax.tree.map(np.testing.assert_array_equal, views, load_split(resolved, "train"))
    if name != "blender":
        assert load_dataset(str(tmp_path), split="test").names == ("000",)
    else:
        np.testing.assert_array_equal([views.near, views.far], [[2] * 8, [6] * 8])


def test_load_dataset_takes_the_fields_of_the_data_section(tmp_path):
    captures.write_transforms(tmp_path, captures.noise(captures.orbit(8)), rgba=True)
    views = load_dataset(tmp_path, factor=2, background="black", world="file", near=2.5, far=6.5)
    assert views.size.tolist() == [[12, 16]] * 7 and views.background == (0, 0, 0)
    np.testing.assert_array_equal(views.to_file, np.eye(4))
    np.testing.assert_allclose([views.near[0], views.far[0]], [2.5, 6.5])
    with pytest.raises(ValueError, match="scale is no option, expected one of format, dir"):
        load_dataset(tmp_path, scale=2)
    for name, value in {"factor": 0, "background": "pink", "width": 2.5, "near": float("nan")}.items():
        with pytest.raises(ValueError, match=f"load_dataset: {name} is .*, expected .*; correct it"):
            load_dataset(tmp_path, **{name: value})
    assert load_dataset(tmp_path, factor=np.int64(2), view_indices=range(2)).names == load_dataset(tmp_path).names[:2]
    with pytest.raises(ValueError, match="split is 'all'"):
        load_dataset(tmp_path, split="all")
    with pytest.raises(ValueError, match="data.dir is .*nowhere': no such folder, searched .*nowhere"):
        load_dataset(tmp_path / "nowhere")


def test_a_registered_format_is_detected_resolved_and_split(tmp_path, monkeypatch):
    captures.write_transforms(tmp_path, captures.noise(captures.orbit(8)))
    (tmp_path / "transforms.json").rename(tmp_path / "renamed.json")

    def read(folder):
        (folder / "renamed.json").rename(folder / "transforms.json")
        try:
            return transforms.read_capture(folder)._replace(format="renamed")
        finally:
            (folder / "transforms.json").rename(folder / "renamed.json")

    reader = Reader(read, detect=lambda folder: (folder / "renamed.json").is_file())
    monkeypatch.setattr(READERS, "_parts", dict(READERS._parts))
    READERS.add("renamed", reader)
    data = capture_data(dir=str(tmp_path), hold_out=3)
    resolved, lines, capture = dataset.resolve(data)
    assert resolved.format == "renamed" and dataset.fingerprint(resolved, capture).startswith("8 images, ")
    assert "format        renamed" in lines
    splits = {split: load_split(resolved, split).names for split in ("train", "held_out", "test")}
    assert splits == {"train": ("001", "002", "004", "005", "007"), "held_out": ("003", "006"), "test": ("000",)}
    assert load_dataset(tmp_path, split="test").names == ("000",)


def test_what_a_registered_reader_states_of_its_format_is_followed(tmp_path, monkeypatch):
    for split in ("train", "test"):
        captures.write_blender(tmp_path, captures.noise(captures.orbit(3)), split=split)

    def read(folder, *, split=None):
        stated = {"format": "renders", "normalised": True, "rendered": True, "bounds": (1.5, 7.0)}
        files = CameraFiles(focal="scene.json: focal to about {x:.4g}")
        return blender.read_capture(folder, split=split)._replace(**stated, files=files)

    monkeypatch.setattr(READERS, "_parts", dict(READERS._parts))
    register_reader("renders", read)
    resolved, _, capture = dataset.resolve(capture_data(dir=str(tmp_path), format="renders", factor="auto", width=10))
    assert (resolved.world, resolved.factor) == ("file", 4)  # 3 is nearer, and would crop images of 32 x 24 px
    assert dataset.fingerprint(resolved, capture) == ""
    (tmp_path / "transforms_train.json").rename(tmp_path / "elsewhere.json")
    with pytest.raises(ValueError, match=r"transforms_train\.json: no such file"):
        load_split(resolved, "train")
    (tmp_path / "elsewhere.json").rename(tmp_path / "transforms_train.json")
    views = load_split(resolved, "test")
    assert (views.names[0], views.near[0], views.far[0]) == ("000", 1.5, 7) and views.to_file is None
    with pytest.raises(ValueError, match=r"factor 3 does not divide 32 x 24"):
        load_split(replaced(resolved, factor=3), "test")
    with pytest.raises(ValueError, match="data.world is 'around', expected one of file or auto"):
        load_split(replaced(resolved, world="around"), "test")
    x = np.asarray(capture.frames[0].camera.focal)[0]
    assert findings.focal_change(capture, 2.0) == f"scene.json: focal to about {2 * x:.4g}"
