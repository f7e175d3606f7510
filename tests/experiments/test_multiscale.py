"""Images at several sizes, rays inside a pixel, and flicker."""

import numpy as np
import pytest

import captures
import jaxnerf
from jaxnerf import pixel_grid
from jaxnerf.core.cameras import pixel_radius
from jaxnerf.data.facts import footprint_spread
from studies import study

multiscale = study("multiscale/multiscale")
scales = study("multiscale/multiscale_images")
zoom = study("multiscale/zoom")
READ = {"format": "transforms", "world": "file", "near": 2.0, "far": 6.0, "background": "white"}


@pytest.fixture(scope="module")
def folders(tmp_path_factory):
    """Returns the folders of a Blender dataset, and of its images at two sizes."""
    folder = tmp_path_factory.mktemp("scales")
    shots = captures.noise(captures.orbit(5))
    for split, part in (("train", shots[:3]), ("test", shots[3:])):
        captures.write_blender(folder / "whole", part, split=split)
    scales.write_scales(folder / "whole", folder / "scales", factor=1, num_scales=2, repeat=4)
    return folder / "whole", folder / "scales"


@pytest.mark.parametrize("split", ["train", "test"])
def test_images_of_all_sizes_are_means_of_the_original(folders, split):
    whole, views = (
        jaxnerf.load_dataset(folders[0], split=split),
        jaxnerf.load_dataset(folders[1], split=split, **READ),
    )
    times = [1, 4 if split == "train" else 1]
    assert len(views.names) == len(whole.names) * sum(times)
    np.testing.assert_array_equal([views.near, views.far], [[2] * len(views.near), [6] * len(views.far)])
    for index, name in enumerate(views.names):
        stem, scale = name.split("/")[1].split("_d")[0], int(name.split("_d")[1][0])
        of = whole.names.index(stem)
        assert views.size[index].tolist() == [24 // 2**scale, 32 // 2**scale]
        np.testing.assert_array_equal(views.cameras.to_world[index], whole.cameras.to_world[of])
        mean = np.asarray(whole.image(of)).reshape(24 // 2**scale, 2**scale, -1, 2**scale, 3).mean((1, 3))
        np.testing.assert_allclose(views.image(index), mean, atol=1 / 255)


def test_pixels_of_a_small_image_have_larger_cones(folders):
    views = jaxnerf.load_dataset(folders[1], split="test", **READ)
    at = np.float32([2.5, 1.5])
    (large, wide), factor = (views.camera(index) for index in (0, 1)), 2
    rays, parts = (jaxnerf.rays_from_pixels(*each, near=1.0, far=2.0) for each in ((wide, at), (large, factor * at)))
    np.testing.assert_allclose(rays.directions, parts.directions, rtol=1e-6)
    np.testing.assert_allclose(pixel_radius(wide, at), factor * pixel_radius(large, factor * at), rtol=1e-5)
    assert footprint_spread(views) == pytest.approx(2, rel=1e-3)


@pytest.mark.parametrize("side", [1, 2, 4])
def test_subpixels_cover_each_pixel_evenly(side):
    places = np.asarray(multiscale.subpixels(3, 5, side)).reshape(3, side, 5, side, 2)
    np.testing.assert_allclose(places.mean((1, 3)), pixel_grid(3, 5), atol=1e-6)
    steps = np.diff(places[0, 0].reshape(-1, 2)[:, 0])
    np.testing.assert_allclose(steps, 1 / side, atol=1e-6)


def test_flicker_is_what_changes_and_should_not():
    exact = np.random.default_rng(0).uniform(0, 0.5, (4, 5, 6, 3))
    assert zoom.flicker(exact + 0.1, exact) == pytest.approx(0)
    flashing = exact + np.array([0, 0.1, 0, 0.1])[:, None, None, None]
    assert zoom.flicker(flashing, exact) == pytest.approx(0.1)


def test_the_middle_of_an_image():
    pixels = np.asarray(pixel_grid(8, 12))
    np.testing.assert_array_equal(zoom.middle(pixels, 0.5), pixels[2:6, 3:9])
    np.testing.assert_array_equal(zoom.middle(pixels, 1.0), pixels)
