"""Tracks: corners that several images show, and their reprojection errors.

Images are matched without their cameras, which only select the pairs to compare. The same tracks therefore
judge the cameras as stored and every alternative reading of them.
"""

import itertools
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Bool, Float, Int

from jaxnerf.core.cameras import undistort
from jaxnerf.data import image_agreement
from jaxnerf.data.readers.base import Capture
from jaxnerf.runtime import stages
from jaxnerf.tools.capture_check.images import ImageSummary

INLIER = 2.0  # px of the reduced images: the largest error of a track that fits the cameras
_MAX_ERROR = 4.0  # px: errors are clipped here, so that one wrong match does not decide
_RATIO = 0.85  # of the distances to the nearest and second nearest descriptor (Lowe 2004, section 7.1)


class Keypoints(NamedTuple):
    """The corners of one image.

    Attributes:
        points: [N, 2] on the plane at distance 1 along the axis, without distortion: x right, y down.
        descriptors: [N, D] of length 1.
        colors: [N, 3] around the corners, in [0, 1]; None: not known.
    """

    points: Float[np.ndarray, "N 2"]
    descriptors: Float[np.ndarray, "N D"]
    colors: Float[np.ndarray, "N 3"] | None = None


class Tracks(NamedTuple):
    """Corners of an image and their matches in up to K - 1 other images; column 0 is the image itself.

    Attributes:
        views: [T, K] indices of frames.
        points: [T, K, 2] as in Keypoints, 0 where not shown.
        shown: [T, K], whether the image shows the corner.
    """

    views: Int[np.ndarray, "T K"]
    points: Float[np.ndarray, "T K 2"]
    shown: Bool[np.ndarray, "T K"]


class Evidence(NamedTuple):
    """The matches between images, and the cameras as corrected so far.

    Attributes:
        keypoints: of each view.
        near: [V, K] neighbours of each view.
        tracks: of all keypoints through the neighbours.
        poses: [V, 3, 4].
        scale: [V] px of the reduced image per unit on the plane at distance 1.
        fraction: of the tracks that fit.
    """

    keypoints: list[Keypoints]
    near: Int[np.ndarray, "V K"]
    tracks: Tracks
    poses: Float[np.ndarray, "V 3 4"]
    scale: Float[np.ndarray, " V"]
    fraction: float


def keypoints_of(capture: Capture, images: Sequence[ImageSummary | None]) -> list[Keypoints]:
    """Returns the Keypoints of every image, without corners for which `undistort` does not converge."""
    result = []
    for frame, image in zip(capture.frames, images, strict=True):
        camera = frame.camera
        if image is None:
            result.append(Keypoints(np.zeros((0, 2)), np.zeros((0, 128), np.float32), np.zeros((0, 3))))
        elif camera.lens == "pinhole" or camera.distortion is None:
            result.append(Keypoints((image.corners - camera.center) / camera.focal, image.descriptors, image.colors))
        else:
            count = len(image.corners)
            padded = np.tile(np.float32(camera.center), (max(1024, count), 1))  # one shape to compile
            padded[:count] = image.corners
            points, valid = (np.asarray(value)[:count] for value in jax.jit(undistort)(camera, padded))
            result.append(Keypoints(np.float64(points[valid]), image.descriptors[valid], image.colors[valid]))
    return result


def match(first: Keypoints, second: Keypoints) -> Int[np.ndarray, " N"]:
    """Returns for each corner of an image the index of its match in another image, or -1.

    Matches are mutual nearest neighbours that pass Lowe's ratio test.
    """
    return image_agreement.match(first.descriptors, second.descriptors, _RATIO)


def follow(
    keypoints: Sequence[Keypoints],
    near: Int[np.ndarray, "V K"] | Sequence[Sequence[int]],
    *,
    first: Sequence[int] | None = None,
) -> Tracks:
    """Returns the Tracks of the corners of views through their neighbours.

    Args:
        keypoints: of all views.
        near: the neighbours of each of the views that tracks begin in.
        first: these views; None: all.
    """
    parts = []
    with stages.stage("matching images") as stage:
        for view, others in zip(range(len(near)) if first is None else first, near, strict=True):
            stage.update(len(parts), len(near))
            matches = [match(keypoints[view], keypoints[other]) for other in others]
            indices = np.stack([np.arange(len(keypoints[view].points)), *matches], axis=1)
            parts.append(_tracks(keypoints, (view, *others), indices[(indices >= 0).sum(axis=1) > 1]))
    return joined(parts)


def count_fits(
    keypoints: Sequence[Keypoints],
    near: Int[np.ndarray, "V K"] | Mapping[int, Sequence[int]],
    poses: Float[np.ndarray, "V 3 4"],
    scale: Float[np.ndarray, " V"],
    *,
    image: int,
    view: int,
) -> tuple[int, int]:
    """Returns (matches that fit, matches) of an image with the neighbours of a view, as if taken from that view."""
    moved = list(keypoints)
    moved[view] = keypoints[image]
    parts = []
    for other in near[view]:
        if other not in (image, view):
            parts.append(pair_tracks(moved, view, int(other)))
    if not parts:
        return 0, 0
    off = errors(joined(parts), poses, scale)
    return int((off < 0.75 * INLIER).sum()), len(off)


def pair_tracks(keypoints: Sequence[Keypoints], view: int, other: int) -> Tracks:
    """Returns the Tracks [T, 2] of the matches of two views."""
    matches = match(keypoints[view], keypoints[other])
    first = np.flatnonzero(matches >= 0)
    return _tracks(keypoints, (view, other), np.stack([first, matches[first]], axis=1))


def fitting_matches(evidence: Evidence, view: int, other: int) -> tuple[Int[np.ndarray, " M"], Int[np.ndarray, " M"]]:
    """Returns the corners of two views that are matched and fit the cameras."""
    matches = match(evidence.keypoints[view], evidence.keypoints[other])
    first = np.flatnonzero(matches >= 0)
    first = first[errors(pair_tracks(evidence.keypoints, view, other), evidence.poses, evidence.scale) < INLIER]
    return first, matches[first]


def circles(keypoints: Sequence[Keypoints], view: int, others: Int[np.ndarray, " N"]) -> Tracks | None:
    """Returns the Tracks of three views in which each corner matches the next one and the last the first.

    Such matches are correct almost certainly, whatever the cameras are. None if there are fewer than three views.
    """
    parts = []
    matches = {other: match(keypoints[view], keypoints[other]) for other in others}
    for first, second in itertools.combinations(others, 2):
        between = match(keypoints[first], keypoints[second])
        corners = np.flatnonzero((matches[first] >= 0) & (matches[second] >= 0))
        indices = np.stack([corners, matches[first][corners], matches[second][corners]], axis=1)
        closed = between[indices[:, 1]] == indices[:, 2]
        parts.append(_tracks(keypoints, (view, first, second), indices[closed]))
    return joined(parts) if parts else None


def triangulate(
    tracks: Tracks, poses: Float[np.ndarray, "V 3 4"]
) -> tuple[Float[np.ndarray, "T 3"], Float[np.ndarray, "T K"]]:
    """Computes the point nearest to the rays of each track, and its error in each view.

    Returns:
        Points [T, 3], the least-squares solution; errors [T, K] on the plane at distance 1 (multiply by the
        focal length for px), inf behind a camera and 0 where not shown.
    """
    turn, eyes = poses[tracks.views][..., :3], poses[tracks.views][..., 3]
    local = np.concatenate([tracks.points * [1, -1], -np.ones((*tracks.shown.shape, 1))], axis=-1)
    rays = np.einsum("tkij,tkj->tki", turn, local)
    rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
    across = (np.eye(3) - rays[..., None] * rays[..., None, :]) * tracks.shown[..., None, None]
    matrix = across.sum(1) + 1e-9 * np.eye(3)  # parallel rays leave one direction open
    points = np.linalg.solve(matrix, np.einsum("tkij,tkj->ti", across, eyes)[..., None])[..., 0]
    seen = np.einsum("tkji,tkj->tki", turn, points[:, None] - eyes)
    depth = -seen[..., 2]
    in_front = depth > 0
    plane = seen[..., :2] * [1, -1] / np.where(in_front, depth, 1)[..., None]
    off = np.where(in_front, np.linalg.norm(plane - tracks.points, axis=-1), np.inf)
    return points, np.where(tracks.shown, off, 0)


def errors(
    tracks: Tracks, poses: Float[np.ndarray, "V 3 4"], scale: Float[np.ndarray, " V"]
) -> Float[np.ndarray, " T"]:
    """Computes the reprojection error of each track in px of the reduced images, at most 4.

    The error is the root of the mean square over the degrees of freedom: two coordinates in each view, less
    the three of the point.

    Args:
        scale: [V] px of the reduced image per unit on the plane at distance 1.
    """
    _, off = triangulate(tracks, poses)
    squares = ((np.minimum(off, 1e6) * scale[tracks.views]) ** 2).sum(axis=1)
    freedom = np.maximum(2 * tracks.shown.sum(axis=1) - 3, 1)
    return np.minimum(np.sqrt(2 * squares / freedom), _MAX_ERROR)


def subset(tracks: Tracks, count: int) -> Tracks:
    """Returns at most count of the tracks, the same ones on every call."""
    if len(tracks.shown) <= count:
        return tracks
    chosen = np.random.default_rng(0).permutation(len(tracks.shown))[:count]
    return Tracks(*(part[chosen] for part in tracks))


def _tracks(keypoints, columns, indices):
    """Returns the Tracks of the given views whose rows are indices [T, K] of keypoints, -1 for none."""
    shown = indices >= 0
    points = np.zeros((*indices.shape, 2))
    for column, view in enumerate(columns):
        rows = shown[:, column]
        points[rows, column] = keypoints[view].points[indices[rows, column]]
    return Tracks(np.tile(columns, (len(indices), 1)), points, shown)


def joined(parts: Sequence[Tracks]) -> Tracks:
    """Returns one or more Tracks of the same number of views as one."""
    return Tracks(*(np.concatenate(part) for part in zip(*parts, strict=True)))
