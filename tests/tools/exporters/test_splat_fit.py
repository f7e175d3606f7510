"""Gaussians are fitted to images of other Gaussians, and written and read as SPZ."""

import gzip
import struct

import jax
import numpy as np
import pytest

from jaxnerf import Camera, look_at
from jaxnerf.data.readers.ply import read_points
from jaxnerf.tools.exporters import gaussians as files
from jaxnerf.tools.exporters import splat_fit
from jaxnerf.tools.exporters.gaussians import Gaussians, rasterize
from jaxnerf.tools.exporters.splat_fit import fit_gaussians
from jaxnerf.tools.exporters.splats import make_gaussians
from jaxnerf.tools.exporters.surfaces import DepthImage

SIZE, WHITE = 24, np.float32([1, 1, 1])


@pytest.fixture(autouse=True)
def few_pairs(monkeypatch):
    monkeypatch.setattr(splat_fit, "_PADDING", 2**13)


def some(count=40, seed=0):
    rng = np.random.default_rng(seed)
    rotation = rng.standard_normal((count, 4))
    harmonics = 0.15 * rng.standard_normal((count, 9, 3))
    harmonics[:, 0] = rng.uniform(-1.5, 1.5, (count, 3))
    values = (
        rng.uniform(-1, 1, (count, 3)),
        rotation / np.linalg.norm(rotation, axis=1, keepdims=True),
        np.exp(rng.uniform(-3, -1.2, (count, 3))),
        rng.uniform(0.2, 0.95, count),
        harmonics,
    )
    return Gaussians(*map(np.float32, values))


def camera(index):
    eye = np.float32([4 * np.cos(index), 4 * np.sin(index), 1.0])
    pose = look_at(eye, np.zeros(3, np.float32), np.float32([0, 0, 1]))
    focal, middle = np.float32([1.4 * SIZE, 1.3 * SIZE]), np.float32([SIZE / 2, SIZE / 2 + 1])
    return Camera(to_world=np.asarray(pose), focal=focal, center=middle, height=SIZE, width=SIZE)


def images_of(gaussians, count=6):
    planes = np.zeros((SIZE, SIZE), np.float32)
    images = [rasterize(gaussians, camera(index), WHITE) for index in range(count)]
    images = [np.uint8(np.rint(255 * np.clip(image, 0, 1))) for image in images]
    points = np.zeros((SIZE, SIZE, 3), np.float32)
    return [DepthImage(None, camera(index), planes, image, planes, points) for index, image in enumerate(images)]


def error(gaussians, images):
    drawn = [rasterize(gaussians, image.camera, WHITE) - image.rgb / 255.0 for image in images]
    return float(np.mean(np.square(drawn)))


def test_what_is_differentiated_is_what_the_rasterizer_draws(monkeypatch):
    monkeypatch.setattr(splat_fit, "_MIN_TRANSMITTANCE", 0.0)
    given, view = some(), camera(1)
    arrays = [np.float32(each) for each in (view.to_world, view.focal, view.center)]
    draw = jax.jit(lambda *values: splat_fit._draw(*values, (SIZE, SIZE), WHITE))
    drawn = draw(given, arrays, splat_fit._listed(given, view))
    expected = rasterize(given, view, WHITE)
    assert np.ptp(expected) > 0.5
    np.testing.assert_allclose(np.asarray(drawn).reshape(SIZE, SIZE, 3), expected, atol=2e-5)


def test_a_fit_restores_what_was_disturbed():
    truth = some()
    images, rng = images_of(truth), np.random.default_rng(1)
    moved = truth._replace(
        mean=truth.mean + np.float32(0.03 * rng.standard_normal(truth.mean.shape)),
        scale=truth.scale * np.float32(1.3),
        harmonics=truth.harmonics * np.float32(0.7),
    )
    held_out = images_of(truth, 9)[7:]
    fitted = fit_gaussians(moved, images, WHITE, steps=120)
    assert all(leaf.dtype == np.float32 for leaf in jax.tree.leaves(fitted))
    np.testing.assert_allclose(np.linalg.norm(fitted.rotation, axis=1), 1, atol=1e-5)
    assert error(fitted, images) < 0.05 * error(moved, images)
    assert error(fitted, held_out) < 0.3 * error(moved, held_out)


def test_no_steps_change_nothing():
    given = some()
    for found, expected in zip(fit_gaussians(given, images_of(given, 1), None, steps=0), given, strict=True):
        np.testing.assert_allclose(found, expected, rtol=1e-5, atol=1e-6)


def test_pixels_that_show_what_is_outside_the_box_do_not_count():
    given, (image,) = some(), images_of(some(seed=1), 1)
    image = image._replace(depth=np.ones((SIZE, SIZE), np.float32))
    for box, moves in ((np.array([[8.0] * 3, [9.0] * 3]), False), (np.array([[-9.0] * 3, [9.0] * 3]), True)):
        fitted = fit_gaussians(given, [image], WHITE, box=box, steps=1)
        assert (np.abs(fitted.harmonics - given.harmonics).max() > 1e-3) == moves


def test_spz_holds_the_gaussians_with_the_precision_of_the_format(tmp_path):
    given = some(200)
    files.write_spz(tmp_path / "splats.spz", given)
    read = files.read_spz(tmp_path / "splats.spz")
    np.testing.assert_allclose(read.mean, given.mean, atol=2**-22)
    np.testing.assert_allclose(read.opacity, given.opacity, atol=0.51 / 255)
    np.testing.assert_allclose(np.log(read.scale), np.log(given.scale), atol=0.51 / 16)
    np.testing.assert_allclose(read.harmonics[:, 0], given.harmonics[:, 0], atol=0.51 / (255 * 0.15))
    np.testing.assert_allclose(read.harmonics[:, 1:4], given.harmonics[:, 1:4], atol=0.51 * 8 / 128)
    np.testing.assert_allclose(read.harmonics[:, 4:], given.harmonics[:, 4:], atol=0.51 * 16 / 128)
    axes = [files.rotation_matrices(np.float64(each.rotation)) * given.scale[:, None, :] for each in (read, given)]
    found, expected = (np.einsum("nik,njk->nij", each, each) for each in axes)  # covariances
    np.testing.assert_allclose(found, expected, atol=0.01 * np.square(given.scale).max())
    raw = gzip.decompress((tmp_path / "splats.spz").read_bytes())
    assert struct.unpack_from("<4sII", raw) == (b"NGSP", 2, 200) and raw[12] == 2
    assert len(raw) == 16 + 200 * (9 + 1 + 3 + 3 + 3 + 24)


def test_another_file_than_spz_is_refused(tmp_path):
    (tmp_path / "other.spz").write_bytes(gzip.compress(b"ply\n" * 8))
    with pytest.raises(ValueError, match="is no SPZ file of version 2 and degree 2"):
        files.read_spz(tmp_path / "other.spz")


def test_no_gaussians_are_made_written_read_drawn_and_fitted(tmp_path):
    none = make_gaussians(*(np.zeros(shape) for shape in ((0, 3), (0, 3), (0,), (0, 9, 3))))
    files.write_gaussians(tmp_path / "splats.ply", none)
    assert read_points(tmp_path / "splats.ply").shape == (0, 3)
    files.write_spz(tmp_path / "splats.spz", none)
    for found in (files.read_spz(tmp_path / "splats.spz"), fit_gaussians(none, images_of(some(3), 1), WHITE, steps=1)):
        assert [each.shape for each in found] == [each.shape for each in none]
    np.testing.assert_array_equal(rasterize(none, camera(0), WHITE), np.ones((SIZE, SIZE, 3)))


def test_gaussians_that_no_image_shows_stay_as_they_are():
    behind = some(3)._replace(mean=np.float32([[40, 0, 0]] * 3))
    fitted = fit_gaussians(behind, images_of(some(3), 1), WHITE, steps=2)
    np.testing.assert_array_equal(fitted.mean, behind.mean)
