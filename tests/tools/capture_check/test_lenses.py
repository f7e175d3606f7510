"""Tests what jaxnerf-check says about lenses: fields of view in closed form, and cameras that could be one."""

import pathlib

import numpy as np
import pytest

from jaxnerf.core.types import Camera
from jaxnerf.data.readers.base import Capture, Frame
from jaxnerf.tools.capture_check import lenses


def camera(focal, lens="pinhole", distortion=None, size=(64, 64)):
    center = np.array(size) / 2
    return Camera(
        to_world=np.eye(4)[:3],
        focal=np.array([focal, focal]),
        center=center,
        distortion=distortion,
        lens=lens,
        height=size[1],
        width=size[0],
    )


@pytest.mark.parametrize("degrees", [90, 150, 220])
@pytest.mark.parametrize("terms", [(0.0, 0.0, 0.0, 0.0), (0.05, 0.0, 0.0, 0.0), (0.02, 0.01, 0.002, 0.001)])
def test_the_field_of_view_of_a_fisheye_is_that_of_its_lens(degrees, terms):
    half = np.radians(degrees / 2)
    focal = 32 / (half * np.polyval([*terms[::-1], 1.0], half**2))
    found, exceeds = lenses.field_of_view(camera(focal, "fisheye", np.array(terms)))
    np.testing.assert_allclose(found[:2], degrees, atol=0.05)
    assert found[2] > found[0] and not exceeds


def test_the_field_of_view_of_other_lenses():
    found, _ = lenses.field_of_view(camera(60.0, size=(80, 60)))
    np.testing.assert_allclose(found, 2 * np.degrees(np.arctan(np.array([40, 30, 50]) / 60)))
    bent = camera(60.0, "opencv", np.array([0.1, 0.0, 0.0, 0.0]))
    edge = 32 / 60  # r (1 + 0.1 r^2)
    radius = next(r.real for r in np.roots([0.1, 0, 1, -edge]) if abs(r.imag) < 1e-9)
    np.testing.assert_allclose(lenses.field_of_view(bent)[0][:2], 2 * np.degrees(np.arctan(radius)), atol=1e-3)
    folding = camera(10.0, "fisheye", np.array([-0.1, 0.0, 0.0, 0.0]))  # no light beyond an angle of sqrt(10 / 3)
    found, exceeds = lenses.field_of_view(folding)
    np.testing.assert_allclose(found, 2 * np.degrees(np.sqrt(10 / 3)), atol=0.05)
    assert exceeds


@pytest.mark.parametrize(
    "focals, said",
    [
        (np.linspace(529, 632, 12), True),
        ([580.0] * 12, False),
        ([500.0, 580.0] * 6, False),
        (np.linspace(300, 900, 12), False),
    ],
)
def test_cameras_that_could_be_one_are_reported(focals, said):
    frames = tuple(Frame(f"{k:03d}", pathlib.Path("x.png"), camera(focal)) for k, focal in enumerate(focals))
    found = lenses.judge_lenses(Capture("transforms", pathlib.Path("transforms.json"), frames))
    assert [("529 to 632 px" in each.found, "--single_camera" in each.change) for each in found] == [
        (True, True)
    ] * said
