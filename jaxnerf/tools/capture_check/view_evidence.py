"""The evidence that an image was taken from another place than its camera's: two poses, compared fairly.

Matches that ignore the cameras are often wrong where a texture repeats itself, and may even agree with each other.
Guided matches are therefore counted instead: among the corners near the epipolar line that a pose defines, the
nearest descriptor must be unambiguous. As many are found by chance where the descriptors of an image are exchanged
among its corners; that number is subtracted. An image is flagged only if another pose, estimated from points that
other cameras agree on, explains several times as many of them as its own does.
"""

from collections.abc import Collection, Sequence
from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Float, Int

from jaxnerf.tools.capture_check.tracks import INLIER, Evidence, errors, follow, match, triangulate

_CAMERAS = 6  # nearest ones of a pose, whose guided matches count
_WITNESSES = 8  # images that are most similar by content, whose points another pose is estimated from
_SHUFFLES = 3
_MIN_POINTS = 20  # of the estimate of a pose
_RATIO = 0.85  # see tracks.match
_PARALLAX = np.cos(np.deg2rad(1.0))


class Support(NamedTuple):
    """How many guided matches confirm a pose, beyond those by chance.

    Attributes:
        matches: the sum over the nearest cameras.
        cameras: how many of these confirm it, with at least 8.
    """

    matches: float
    cameras: int


class Alternative(NamedTuple):
    """Another pose of an image.

    Attributes:
        pose: [3, 4].
        own: the Support of the image's own pose.
        other: the Support of the other pose.
        inliers: points that fit the other pose.
    """

    pose: Float[np.ndarray, "3 4"]
    own: Support
    other: Support
    inliers: int


def find_alternative(evidence: Evidence, view: int, *, without: Sequence[int] = ()) -> Alternative | None:
    """Returns the Alternative to the pose of a view with most points, or None.

    Args:
        evidence: see `cameras.gather`.
        view: of the image.
        without: views that are doubtful, too, and do not count.
    """
    doubtful = {view, *without}
    similar = _similar(evidence.keypoints, view, doubtful)
    points, places, sources = _known_points(evidence, view, similar, doubtful)
    if len(points) < _MIN_POINTS:
        return None
    found = _estimate_pose(points, places, INLIER / evidence.scale[view])
    if found is None:
        return None
    pose, inliers = found
    if len(np.unique(sources[inliers])) < 2 or len(inliers) < _MIN_POINTS:
        return None
    stated = support(evidence, view, evidence.poses[view], nearest(evidence.poses, evidence.poses[view], doubtful))
    other = support(evidence, view, pose, nearest(evidence.poses, pose, doubtful))
    return Alternative(pose, stated, other, len(inliers))


def support(
    evidence: Evidence, view: int, pose: Float[np.ndarray, "3 4"], others: Int[np.ndarray, " K"] | Sequence[int]
) -> Support:
    """Counts the guided matches of an image, as if taken from a pose, with other cameras."""
    rng, keypoints = np.random.default_rng(0), evidence.keypoints[view]
    counts = []
    for other in others:
        there, scale = evidence.keypoints[other], (evidence.scale[view], evidence.scale[other])
        near = _near_lines(keypoints.points, there.points, pose, evidence.poses[other], scale)
        similarity = keypoints.descriptors @ there.descriptors.T
        chance = [_count(similarity[rng.permutation(len(similarity))], near) for _ in range(_SHUFFLES)]
        counts.append(_count(similarity, near) - np.mean(chance))
    counts = np.array(counts or [0.0])
    return Support(float(counts.sum()), int((counts >= 8).sum()))


def _count(similarity, near):
    """Returns the number of mutual nearest neighbours near epipolar lines that pass the ratio test."""
    if min(similarity.shape) < 2:
        return 0
    allowed = np.where(near, similarity, -1.0)
    forward, backward = allowed.argmax(axis=1), allowed.argmax(axis=0)
    rows = np.arange(len(allowed))
    best = allowed[rows, forward]
    allowed[rows, forward] = -1
    unambiguous = 1 - best < _RATIO**2 * (1 - np.maximum(allowed.max(axis=1), 0.0))
    return int(((best > 0) & unambiguous & (backward[forward] == rows)).sum())


def _near_lines(first, second, pose, other, scale):
    """Returns [N, M] whether corners are within INLIER px of each other's epipolar lines."""
    turn = other[:, :3].T @ pose[:, :3]
    shift = other[:, :3].T @ (pose[:, 3] - other[:, 3])
    across = np.array([[0, -shift[2], shift[1]], [shift[2], 0, -shift[0]], [-shift[1], shift[0], 0]])
    a, b = (np.concatenate([points * [1, -1], -np.ones((len(points), 1))], axis=1) for points in (first, second))
    lines = a @ (across @ turn).T  # [N, 3] in the second image
    back = b @ (across @ turn)
    off = np.abs(lines @ b.T)
    size = [np.maximum(np.linalg.norm(part[:, :2], axis=1), 1e-12) for part in (lines, back)]
    return (off / size[0][:, None] * scale[1] < INLIER) & (off / size[1] * scale[0] < INLIER)


def _similar(keypoints, view, doubtful):
    """Returns the views with most matches, whatever the poses are."""
    counts = [
        0 if other in doubtful else int((match(keypoints[view], part) >= 0).sum())
        for other, part in enumerate(keypoints)
    ]
    order = np.argsort(counts, kind="stable")[::-1][:_WITNESSES]
    return [int(other) for other in order if counts[other] >= 8]


def _known_points(evidence, view, similar, doubtful):
    """Returns points in space [N, 3], where an image shows them [N, 2], and the view through which each is known."""
    points, places, sources = [np.zeros((0, 3))], [np.zeros((0, 2))], [np.zeros(0, int)]
    keypoints = evidence.keypoints[view]
    for other_view in similar:
        others = [other for other in evidence.near[other_view] if other not in doubtful]
        if len(others) < 2:
            continue
        tracks = follow(evidence.keypoints, np.array([others]), first=[other_view])
        there, _ = triangulate(tracks, evidence.poses)
        rays = there[:, None] - evidence.poses[tracks.views][..., 3]
        rays /= np.maximum(np.linalg.norm(rays, axis=-1, keepdims=True), 1e-12)
        apart = np.where(tracks.shown, (rays * rays[:, :1]).sum(-1), 1).min(axis=1) < _PARALLAX
        good = apart & (errors(tracks, evidence.poses, evidence.scale) < INLIER)
        known = {tuple(place): point for place, point in zip(tracks.points[good, 0], there[good], strict=True)}
        pairs = match(keypoints, evidence.keypoints[other_view])
        found = [
            (known[place], keypoints.points[index])
            for index, other in enumerate(pairs)
            if other >= 0 and (place := tuple(evidence.keypoints[other_view].points[other])) in known
        ]
        if found:
            points.append(np.array([point for point, _ in found]))
            places.append(np.array([place for _, place in found]))
            sources.append(np.full(len(found), other_view))
    return tuple(np.concatenate(part) for part in (points, places, sources))


def _estimate_pose(points, places, tolerance):
    """Returns (the pose [3, 4] from which most points appear at their places, indices of these), or None."""
    cv2.setRNGSeed(0)
    solved, turn, shift, inliers = cv2.solvePnPRansac(
        points, places, np.eye(3), None, iterationsCount=2000, reprojectionError=1.5 * tolerance, confidence=0.9999
    )
    if not solved or inliers is None:
        return None
    rotation = cv2.Rodrigues(turn)[0].T
    pose = np.concatenate([rotation * [1, -1, -1], -rotation @ shift], axis=1)
    return (pose, inliers[:, 0]) if np.isfinite(pose).all() else None


def nearest(poses: Float[np.ndarray, "V 3 4"], pose: Float[np.ndarray, "3 4"], doubtful: Collection[int]) -> list[int]:
    """Returns the views whose cameras are nearest to a pose, without doubtful ones; see `poses.neighbours`."""
    cosine = (np.einsum("ij,bij->b", pose[:, :3], poses[:, :, :3]) - 1) / 2
    eyes = poses[:, :, 3]
    spread = np.median(np.linalg.norm(eyes - np.median(eyes, axis=0), axis=-1))
    cost = np.arccos(np.clip(cosine, -1, 1)) + 0.5 * np.linalg.norm(eyes - pose[:, 3], axis=1) / max(spread, 1e-12)
    order = [int(view) for view in np.argsort(cost, kind="stable") if view not in doubtful]
    return order[:_CAMERAS]
