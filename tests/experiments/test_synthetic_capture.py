"""Captures of the embedded room: what the reader finds in the files agrees with the ground truth."""

import hashlib
import os

import jax
import numpy as np
import pytest

from jaxnerf.core.cameras import pixel_grid, rays_from_pixels
from jaxnerf.data.dataset import load_dataset
from jaxnerf.data.readers.transforms import read_capture
from test_scenes import room, synthetic_capture

SIZES = {"num_views": 24, "num_held_out": 2, "num_far": 2, "width": 40, "height": 30, "num_points": 200}


@pytest.fixture(scope="module")
def drifting(tmp_path_factory):
    """A small capture with drifting exposure and noisy poses: its folder and its ground truth."""
    folder = tmp_path_factory.mktemp("room") / "drifting"
    noise = {"exposure": 0.4, "white_balance": 0.1, "pose_noise": 1.0}
    return folder, synthetic_capture.write_capture(folder, **SIZES, **noise)


@pytest.fixture(scope="module")
def plain(tmp_path_factory):
    """The same capture without noise, as a pinhole."""
    folder = tmp_path_factory.mktemp("room") / "plain"
    return folder, synthetic_capture.write_capture(folder, **SIZES, distortion=None)


_rays = jax.jit(rays_from_pixels)


def rendered(views, index, truth):
    """Returns the colours and depths of a view by its file's camera: rays of the reader, in the file's world."""
    camera = jax.tree.map(lambda leaf: leaf[index], views.cameras)
    rays = _rays(camera, pixel_grid(*map(int, views.size[index])), near=0.0, far=1.0)
    origins, directions = np.asarray(rays.origins), np.asarray(rays.directions)
    turn, shift = views.to_file[:3, :3], views.to_file[:3, 3]
    return room.render(origins @ turn.T + shift, directions @ turn.T / np.linalg.norm(turn[0]))


def image(views, index):
    height, width = views.size[index]
    first = views.offset[index]
    return views.pixels[first : first + height * width].reshape(height, width, 3) / 255


def test_held_out_pixels_have_the_color_and_the_depth_of_their_rays(drifting):
    folder, truth = drifting
    for split in ("val", "test"):
        views = load_dataset(folder, split=split)
        assert views.names == tuple(truth.names[truth.split == split]) and views.background is None
        assert views.cameras.lens == "opencv"
        for index, name in enumerate(views.names):
            rgb, depth = rendered(views, index, truth)
            known = list(truth.names).index(name)
            # Rays in float32 may pass an edge on its other side.
            same = np.abs(depth - truth.depth[known]) < 1e-3
            assert same.mean() > 0.99
            assert np.quantile(np.abs(rgb - image(views, index))[same], 0.99) < 1.5 / 255


def test_training_pixels_differ_by_the_gains_and_poses_by_the_noise(drifting, plain):
    _, truth = drifting
    views, clean = load_dataset(drifting[0]), load_dataset(plain[0])
    own = truth.split == "train"
    np.testing.assert_allclose(np.log2(truth.gains[own]).mean(axis=0), 0, atol=1e-12)
    np.testing.assert_allclose(np.log2(truth.gains[own, 1]).std(), 0.4, rtol=1e-6)
    assert (truth.gains[~own] == 1).all() and (plain[1].gains == 1).all()
    np.testing.assert_array_equal(truth.to_world, plain[1].to_world)  # neither lens nor noise moves a camera
    center = slice(10, 20), slice(15, 25)  # where the lens has no effect
    for index, gain in enumerate(truth.gains[own]):
        found, expected = image(views, index)[center], image(clean, index)[center]
        usable = (found < 0.99).all(-1) & (expected > 0.1).all(-1)
        np.testing.assert_allclose(np.median(found[usable] / expected[usable], axis=0), gain, rtol=0.1)
    moved = np.linalg.norm(truth.file_to_world[own, :, 3] - truth.to_world[own, :, 3], axis=-1)
    turned = np.einsum("vij,vij->v", truth.file_to_world[own, :, :3], truth.to_world[own, :, :3])
    degrees = np.degrees(np.arccos(np.clip((turned - 1) / 2, -1, 1)))
    np.testing.assert_allclose([np.sqrt((moved**2).mean() / 3), np.sqrt((degrees**2).mean() / 3)], [0.01, 1], rtol=0.3)
    np.testing.assert_array_equal(truth.file_to_world[~own], truth.to_world[~own])


def test_cameras_are_in_free_space_and_some_are_close_to_matter(plain):
    _, truth = plain
    rng = np.random.default_rng(0)
    around = rng.normal(size=(200, 3))
    around *= 0.1 / np.linalg.norm(around, axis=-1, keepdims=True)
    eyes = truth.to_world[:, :, 3]
    assert not room.is_matter(eyes[:, None] + around).any()
    train, far = (eyes[truth.split == split] for split in ("train", "test"))
    assert np.linalg.norm(far[:, None] - train, axis=-1).min() > 0.5
    nearest = truth.depth[truth.split == "train"].min(axis=(1, 2))
    assert 0.1 < nearest.min() < 0.5 and truth.depth.max() > 5
    azimuth = np.degrees(np.arctan2(train[:, 1], train[:, 0]))
    assert np.ptp(azimuth) == pytest.approx(220, abs=10)


def test_num_seen_counts_the_training_views_that_see_a_surface(drifting):
    _, truth = drifting
    train = truth.to_world[truth.split == "train"]
    lens = synthetic_capture._Lens.make(40, 30, synthetic_capture.PHONE_LENS)
    for index in np.flatnonzero(truth.split != "train")[::2]:
        x = synthetic_capture._surface(lens, truth.to_world[index], truth.depth[index].astype(float))
        eyes = train[:, None, :, 3]
        # A margin, as positions are rounded to float32 and lie on either side of the surface.
        free = room.trace(np.broadcast_to(eyes, (24, *x.shape)), x - eyes).t > 0.99
        depth = ((eyes - x) * train[:, None, :, 2]).sum(axis=-1)
        at = np.einsum("vni,vij->vnj", x - eyes, train[:, :, :3])[..., :2] / depth[..., None] * 0.82 * 40
        inside = free & (depth > 0) & (np.abs(at) < [20, 15]).all(axis=-1)  # but for the lens, which moves 1 px
        found = truth.num_seen[index].reshape(-1)
        # The count compares with depths of the nearest pixel, which here is large.
        assert np.abs(found - inside.sum(axis=0)).mean() < 2.5 and np.corrcoef(found, inside.sum(axis=0))[0, 1] > 0.7
    far = truth.num_seen[truth.split == "test"]
    assert ((far >= 2).mean(axis=(1, 2)) > 0.85).all()


def test_points_lie_on_surfaces_and_are_read(plain):
    folder, truth = plain
    assert len(truth.points) == 200 and (truth.points_seen.sum(axis=0) >= 3).all()
    np.testing.assert_allclose(read_capture(folder).points, truth.points, atol=1e-5)
    view, point = np.argwhere(truth.points_seen)[::40].T
    offset = truth.points[point] - truth.to_world[view, :, 3]
    t = room.trace(truth.to_world[view, :, 3], offset).t
    assert (np.abs(t - 1) < 0.05).mean() > 0.9


def test_captures_are_deterministic_and_seeds_differ(plain, tmp_path):
    small = SIZES | {"num_far": 0, "num_held_out": 1, "num_views": 8, "width": 16, "height": 12}
    written = [tmp_path / name for name in ("first", "second", "other")]
    for folder, seed in zip(written, (3, 3, 4), strict=True):
        synthetic_capture.write_capture(folder, **small, distortion=None, seed=seed, exposure=0.2, image_format="jpg")
    digests = [
        {
            path.relative_to(folder).as_posix(): hashlib.sha256(path.read_bytes()).hexdigest()
            for path in sorted(folder.rglob("*.*"))
        }
        for folder in written
    ]
    assert digests[0] == digests[1] and digests[0].keys() == digests[2].keys()
    assert not set(digests[0].values()) & set(digests[2].values())
    read = synthetic_capture.read_ground_truth(plain[0])
    for name, value in plain[1]._asdict().items():
        np.testing.assert_array_equal(getattr(read, name), value)


def test_wrong_arguments_name_themselves(plain, tmp_path):
    with pytest.raises(ValueError, match="plain: exists and is not an empty folder; remove it"):
        synthetic_capture.write_capture(plain[0])
    with pytest.raises(ValueError, match="'bmp', expected one of png, jpg"):
        synthetic_capture.write_capture(tmp_path, image_format="bmp")
    with pytest.raises(ValueError, match="4 views of 40 x 30 px"):
        synthetic_capture.write_capture(tmp_path, **SIZES | {"num_views": 4})
    with pytest.raises(ValueError, match="folds the image"):
        synthetic_capture.write_capture(tmp_path, **SIZES, distortion=(-2.0, 0.0, 0.0, 0.0))
    with pytest.raises(ValueError, match="ground_truth.npz: no such file"):
        synthetic_capture.read_ground_truth(tmp_path)
    assert not any(tmp_path.iterdir())


def test_nothing_is_written_through_a_link(tmp_path, monkeypatch):
    """The folder is empty when the call begins; rendering takes a while."""
    (tmp_path / "precious").mkdir()
    (tmp_path / "capture").mkdir()
    sparse_points = synthetic_capture._sparse_points

    def link(*arguments):
        os.symlink(tmp_path / "precious", tmp_path / "capture" / "images")
        return sparse_points(*arguments)

    monkeypatch.setattr(synthetic_capture, "_sparse_points", link)
    small = SIZES | {"num_far": 0, "num_held_out": 0, "num_views": 8, "width": 16, "height": 12}
    with pytest.raises(OSError, match="capture/images"):
        synthetic_capture.write_capture(tmp_path / "capture", **small)
    assert not any((tmp_path / "precious").iterdir())
    os.symlink(tmp_path / "missing", tmp_path / "dangling")
    monkeypatch.setattr(synthetic_capture, "_sparse_points", sparse_points)
    with pytest.raises(OSError, match="dangling"):
        synthetic_capture.write_capture(tmp_path / "dangling", **small)
    assert not (tmp_path / "missing").exists()


@pytest.mark.slow
def test_repeated_dots_replace_all_colors(plain, tmp_path):
    truth = synthetic_capture.write_capture(tmp_path / "dots", **SIZES, distortion=None, repetition=0.3)
    np.testing.assert_array_equal(truth.depth, plain[1].depth)
    x = np.random.default_rng(0).uniform(-1, 1, (50, 3))
    np.testing.assert_allclose(synthetic_capture._dots(x, 0.3), synthetic_capture._dots(x + [0.3, -0.6, 0.9], 0.3))
    views = load_dataset(tmp_path / "dots", split="train")
    colors = np.float64(views.pixels[:, :3]) / np.iinfo(views.pixels.dtype).max
    assert colors.std(axis=0).min() > 0.1 and (colors[:, 0] > 0.2).all()
