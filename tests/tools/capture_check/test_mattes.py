"""Alpha that cuts away what other images show."""

import pathlib

import numpy as np

from helpers import compiled
from jaxnerf.core.cameras import pixel_grid, rays_from_pixels
from jaxnerf.core.poses import look_at
from jaxnerf.core.types import Camera
from jaxnerf.data.readers.base import Capture, Frame
from jaxnerf.tools.capture_check.mattes import judge_mattes

SIDE, HOLE = 64, (slice(8, 24), slice(18, 46))  # px; the hole is a cap of the ball


def capture_of_a_ball(count=16):
    """Returns a Capture of cameras around a ball of radius 1, and its mattes."""
    frames, mattes = [], []
    for angle in 2 * np.pi * np.arange(count) / count:
        eye = np.float32([4 * np.cos(angle), 4 * np.sin(angle), np.sin(3 * angle)])
        pose = np.asarray(look_at(eye, np.zeros(3), np.float32([0, 0, 1])))
        focal, center = np.full(2, 1.2 * SIDE), np.full(2, SIDE / 2)
        camera = Camera(to_world=pose, focal=focal, center=center, height=SIDE, width=SIDE)
        rays = compiled(rays_from_pixels)(camera, pixel_grid(SIDE, SIDE), near=2.0, far=6.0)
        aside = np.linalg.norm(np.cross(rays.origins, rays.viewdirs), axis=-1)
        frames.append(Frame(f"image_{len(frames)}", pathlib.Path("none.png"), camera))
        mattes.append(np.float32(aside < 1))
    return Capture("transforms", pathlib.Path("transforms.json"), tuple(frames)), mattes


def judge(mattes, capture):
    return judge_mattes(capture, mattes, np.tile([2.0, 6.0], (len(mattes), 1)))


def test_a_matte_that_cuts_away_what_others_show_is_named():
    capture, mattes = capture_of_a_ball()
    assert judge(mattes, capture) == []
    for index in (4, 11):
        mattes[index][HOLE] = 0
    (finding,) = judge(mattes, capture)
    assert set(finding.frames) == {4, 11} and "image_4" in finding.found and "image_11" in finding.found
    assert "--config.scene.use_alpha=False" in finding.line()


def test_images_without_alpha_and_empty_mattes_are_not_judged():
    capture, mattes = capture_of_a_ball(6)
    assert judge([None] * 6, capture) == []
    assert judge([np.zeros_like(matte) for matte in mattes], capture) == []
    mattes[2] = None
    assert judge(mattes, capture) == []
