"""How well images of the embedded scene fit right and wrong cameras, and each other's colours."""

import dataclasses

import numpy as np
import pytest

import captures
from jaxnerf.core.poses import se3_exponential
from jaxnerf.data import image_agreement
from jaxnerf.data.synthetic import load_synthetic


@pytest.fixture(scope="module")
def views():
    return load_synthetic(size=200)


@pytest.fixture(scope="module")
def right(views):
    return image_agreement.agreement(views)


def test_images_fit_right_cameras_and_each_other(right):
    """Many corners are outlines of smooth bodies, which differ between views."""
    assert right.count > 1000 and 0 < right.off < 2
    assert right.brightness < 0.05 and right.tint < 0.05


def test_wrong_cameras_and_changed_colours_show(views, right):
    poses = np.array(views.cameras.to_world)
    rng = np.random.default_rng(0)
    turns = np.asarray(
        se3_exponential(np.float32(np.radians(1) * rng.normal(size=(len(poses), 6)) * [1, 1, 1, 0, 0, 0]))
    )
    poses[:, :, :3] = turns[:, :, :3] @ poses[:, :, :3]
    pixels = views.pixels.copy()
    gains = np.exp(rng.uniform(*np.log([0.4, 1.0]), len(poses)))[:, None] * [1, 1, 0.9]
    pixels[:, :3] = pixels[:, :3] * np.repeat(gains, 200 * 200, axis=0)
    changed = dataclasses.replace(
        views, pixels=pixels, cameras=dataclasses.replace(views.cameras, to_world=np.float32(poses))
    )
    found = image_agreement.agreement(changed)
    assert found.off > 3 * right.off
    assert found.brightness > 3 * right.brightness and found.tint > right.tint


def test_images_without_corners_say_nothing(views):
    grey = dataclasses.replace(views, pixels=np.full_like(views.pixels, 1000))
    assert image_agreement.agreement(grey) == (0, 0, 0, 0)
    hidden = dataclasses.replace(views, mask=np.zeros(len(views.pixels), bool))
    assert image_agreement.agreement(hidden) == (0, 0, 0, 0)


@pytest.mark.parametrize(("count", "height", "width"), [(1, 20, 30), (3, 1, 50), (3, 900, 3)])
def test_single_and_narrow_images_say_nothing(count, height, width):
    black = captures.black_views(captures.orbit(count, height=height, width=width))
    assert image_agreement.agreement(black) == (0, 0, 0, 0)
