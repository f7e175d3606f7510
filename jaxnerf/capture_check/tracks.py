"""Places that several photographs show, and how well cameras agree about them.

The photographs are matched without their cameras: those only say which are worth comparing. So the same
tracks judge the cameras as they are and every way in which they could have been meant.
"""

from typing import NamedTuple

import jax
import numpy as np

from jaxnerf.capture_check import features
from jaxnerf.core.cameras import undistort

_NEIGHBOURS = 5  # views that each is compared with


class Tracks(NamedTuple):
    """Corners of a view and where up to K - 1 of its neighbours show them; the first is the view itself."""

    views: np.ndarray  # [T, K] indices of frames
    points: np.ndarray  # [T, K, 2] on the plane at distance 1: x right, y down, through the lens
    corners: np.ndarray  # [T, K] indices into the view's features
    shown: np.ndarray  # [T, K] bool; elsewhere the others are 0


def neighbours(poses, *, count=_NEIGHBOURS):
    """Returns [V, K] indices of the views most like each, nearest first.

    Likeness is the angle of the turn between two views and how far they are apart: neither changes where
    axes are swapped or negated in all poses.
    """
    turn = poses[:, :, :3]
    cosine = (np.einsum("aij,bij->ab", turn, turn) - 1) / 2
    angle = np.arccos(np.clip(cosine, -1, 1))
    apart = np.linalg.norm(poses[:, None, :, 3] - poses[None, :, :, 3], axis=-1)
    spread = np.median(np.linalg.norm(poses[:, :, 3] - np.median(poses[:, :, 3], axis=0), axis=-1))
    cost = angle + 0.5 * apart / max(spread, 1e-12)
    np.fill_diagonal(cost, np.inf)
    return np.argsort(cost, axis=1, kind="stable")[:, : min(count, len(poses) - 1)]


def no_features():
    """Returns the Features of a photograph without any."""
    return features.Features(np.zeros((0, 2)), np.zeros((0, 0), np.float32))


def on_plane(capture, found):
    """Returns for each view [N, 2], where its corners cross the plane at distance 1, and which do [N]."""
    result = []
    for frame, corners in zip(capture.frames, found, strict=True):
        camera = frame.camera
        if camera.lens == "pinhole" or camera.distortion is None:
            points = (corners.pixels - camera.center) / camera.focal
            result.append((points, np.ones(len(points), bool)))
            continue
        count = len(corners.pixels)
        padded = np.tile(np.float32(camera.center), (max(1024, count), 1))  # one shape to compile
        padded[:count] = corners.pixels
        points, good = jax.jit(undistort)(camera, padded)
        result.append((np.float64(points)[:count], np.asarray(good)[:count]))
    return result


def follow(found, points, near):
    """Returns the Tracks of all views through their neighbours [V, K]."""
    rows = []
    for view, others in enumerate(near):
        count = len(found[view].pixels)
        corners = np.full((count, 1 + len(others)), -1)
        corners[:, 0] = np.arange(count)
        for place, other in enumerate(others, 1):
            pairs = features.match(found[view], found[other])
            corners[pairs[:, 0], place] = pairs[:, 1]
        views = np.tile(np.append(view, others), (count, 1))
        rows.append((views, corners))
    views, corners = (np.concatenate(part) for part in zip(*rows, strict=True))
    shown, where = corners >= 0, np.zeros((*corners.shape, 2))
    for view, (on, good) in enumerate(points):
        chosen = shown & (views == view)
        where[chosen] = on[corners[chosen]]
        shown[chosen] &= good[corners[chosen]]
    keep = shown[:, 0] & (shown.sum(axis=1) > 1)
    return Tracks(views[keep], where[keep], np.maximum(corners[keep], 0), shown[keep])


def triangulate(tracks, poses):
    """Returns the points [T, 3] nearest to the rays of tracks, and how far off in each view [T, K].

    Off is measured on the plane at distance 1: times the focal length it is px; inf behind a camera.
    """
    turn, eyes = poses[tracks.views][..., :3], poses[tracks.views][..., 3]
    local = np.concatenate([tracks.points * [1, -1], -np.ones((*tracks.shown.shape, 1))], axis=-1)
    rays = np.einsum("tkij,tkj->tki", turn, local)
    rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
    across = (np.eye(3) - rays[..., None] * rays[..., None, :]) * tracks.shown[..., None, None]
    matrix = across.sum(1) + 1e-9 * np.eye(3)
    places = np.linalg.solve(matrix, np.einsum("tkij,tkj->ti", across, eyes)[..., None])[..., 0]
    seen = np.einsum("tkji,tkj->tki", turn, places[:, None] - eyes)
    depth = -seen[..., 2]
    good = depth > 0
    plane = seen[..., :2] * [1, -1] / np.where(good, depth, 1)[..., None]
    off = np.where(good, np.linalg.norm(plane - tracks.points, axis=-1), np.inf)
    return places, np.where(tracks.shown, off, 0)
