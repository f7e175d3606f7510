"""Pixels without rays are masked, and all others are read as without a lens."""

import dataclasses

import numpy as np
import pytest

import captures
from helpers import compiled
from jaxnerf import Camera, pixel_grid, rays_from_pixels
from jaxnerf.data.dataset import load_dataset
from jaxnerf.data.images.pixel_rays import fractions_of_pixels, pixels_with_rays, rays_line, sees_sideways
from jaxnerf.data.readers.base import read_capture


def camera(lens, distortion, focal, *, width=150, height=90, center=(70.0, 50.0)):
    arrays = {"focal": np.full(2, focal), "center": np.array(center), "distortion": np.array(distortion)}
    return Camera(to_world=np.eye(3, 4), **arrays, lens=lens, height=height, width=width)


@pytest.mark.parametrize(
    "lens, reach",
    [
        (camera("opencv", [-0.5, 0.0, 0.0, 0.0], 90.0), 90 * np.sqrt(2 / 3) * 2 / 3),  # folds at r^2 = 2 / 3
        (camera("opencv", [-0.01, 0.0, 0.0, 0.0, 0.0], 90.0), np.inf),
        (camera("fisheye", [0.0] * 4, 20.0), 20 * np.pi),
        (camera("fisheye", [0.0] * 4, 40.0), np.inf),
        (camera("fisheye", [-0.1, 0.0, 0.0, 0.0], 60.0), 60 * np.sqrt(10 / 3) * 2 / 3),
        (camera("opencv", [-0.5, 0.0, 0.0, 0.0], 90.0, center=(-30.0, 20.0)), 90 * np.sqrt(2 / 3) * 2 / 3),
    ],
)
def test_pixels_within_the_reach_of_a_lens_have_rays(lens, reach):
    y, x = np.mgrid[:90, :150] + 0.5
    radius = np.hypot(x - lens.center[0], y - lens.center[1])
    (mask,) = pixels_with_rays([lens])
    if np.isinf(reach):
        assert mask is None
    else:
        sure = np.abs(radius - reach) > 0.01
        np.testing.assert_array_equal(mask[sure], (radius < reach)[sure])
    without, beside = fractions_of_pixels([lens, dataclasses.replace(lens, distortion=None, lens="pinhole")])
    assert 2 * without == pytest.approx((radius > reach).mean(), abs=0.02)
    right = np.pi / 2 * (1 + lens.distortion[0] * np.pi**2 / 4) * lens.focal[0] if lens.lens == "fisheye" else np.inf
    sideways = (radius >= right) & (radius < reach)
    assert 2 * beside == pytest.approx(sideways.mean(), abs=0.02)


@pytest.mark.parametrize("lens, k", [("opencv", [-0.9, 0.0, 0.0, 0.0]), ("fisheye", [-0.9, 0.0, 0.0, 0.0])])
@pytest.mark.parametrize("factor", [1, 2])
def test_pixels_without_rays_are_masked_in_views(tmp_path, lens, k, factor):
    stack = captures.orbit(4, lens=lens)
    folded = dataclasses.replace(stack, distortion=np.tile(np.float32(k), (4, 1)))
    captures.write_transforms(tmp_path, captures.noise(folded))
    views = load_dataset(tmp_path, split="train", factor=factor)
    of_pixels = compiled(rays_from_pixels)
    for index, (height, width) in enumerate(views.size.tolist()):
        rays = of_pixels(views.camera(index), pixel_grid(height, width), near=views.near[index], far=views.far[index])
        mask = views.mask[views.offset[index] :][: rays.far.size].reshape(rays.far.shape)
        np.testing.assert_array_equal(mask, rays.far > rays.near)
    assert 0.1 < views.mask.mean() < 0.9
    assert "of the pixels have no ray: " in rays_line([frame.camera for frame in read_capture(tmp_path).frames])
    assert not sees_sideways(views)
    captures.write_transforms(tmp_path, captures.noise(stack))
    views = load_dataset(tmp_path, split="train")
    assert views.mask is None and not rays_line([frame.camera for frame in read_capture(tmp_path).frames])
    wide = dataclasses.replace(views.cameras, focal=views.cameras.focal / 4)
    assert sees_sideways(dataclasses.replace(views, cameras=wide)) == (lens == "fisheye")
