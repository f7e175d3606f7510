"""Tests that poses of scored views are fitted to the scene."""

import dataclasses

import numpy as np

import captures
from jaxnerf.tools.needs.view_poses import aligned_views


def render(views, index):
    """Returns the colours of a sphere around the scene, [H, W, 3]."""
    rays = views.rays(index)
    origins, viewdirs = (np.asarray(each).reshape(-1, 3) for each in (rays.origins, rays.viewdirs))
    return np.asarray(captures.sky_color(origins, viewdirs)).reshape(*rays.near.shape, 3)


def angles(first, second):
    """Returns the angles between orientations, degrees."""
    turns = np.einsum("vij,vik->vjk", np.asarray(first)[:, :, :3], np.asarray(second)[:, :, :3])
    return np.degrees(np.arccos(np.clip((np.trace(turns, axis1=1, axis2=2) - 1) / 2, -1, 1)))


def test_a_pose_that_is_wrong_by_half_a_degree_is_found():
    exact = captures.black_views(captures.orbit(3, height=24, width=32))
    right = np.asarray(exact.cameras.to_world)
    wrong, turn = np.array(right), np.radians(0.5)
    rotation = np.array([[1, 0, 0], [0, np.cos(turn), -np.sin(turn)], [0, np.sin(turn), np.cos(turn)]])
    wrong[:2, :, :3] = np.float32(rotation @ wrong[:2, :, :3])
    views = dataclasses.replace(exact, cameras=dataclasses.replace(exact.cameras, to_world=wrong))
    fitted = np.asarray(aligned_views(views, [0, 2], render, lambda index: render(exact, index)).cameras.to_world)
    before, after = angles(wrong, right), angles(fitted, right)
    assert 0.4 < before[0] < 0.6 and after[0] < 0.1
    assert after[1] == before[1], "a view that is not chosen stays"
    assert after[2] < 0.05, "a right pose stays right"
