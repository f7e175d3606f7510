"""Folded reconstructions: consecutive images that show nearly the same view, but whose cameras are far apart.

Where a scene repeats itself, as a can with the same label on its front and back, structure from motion may lay one side
onto the other. Within each group of consecutive images the cameras are then right, and no single image is to blame.
"""

import itertools
from collections.abc import Collection

import cv2
import numpy as np
from jaxtyping import Float

from jaxnerf.data.geometry.path_poses import natural_order
from jaxnerf.data.readers.base import Capture
from jaxnerf.runtime.atomic_files import read_bytes
from jaxnerf.tools.capture_check.findings import NOTES, Finding
from jaxnerf.tools.capture_check.tracks import INLIER, Evidence, count_fits, match

_MIN_MATCHES = 40  # of two images between which the cameras may jump
_NONE, _MANY = 0.1, 0.3  # fractions of matches that fit the cameras: by chance at most, and of cameras that are right
_MIN_AGREEING = 3  # pairs of consecutive images in a group whose cameras are right
_MIN_FRACTION = 0.6  # of the matches of two images, which agree on one motion
_MAX_TURN = np.radians(45.0)  # of this motion; without parallax its estimate is ambiguous, but then half a turn
_MIN_OFF = np.radians(60.0)  # of the cameras' rotation from it
_MOST_NOTES = 2000  # bytes that are repeated
_FLIP = np.diag([1.0, -1.0, -1.0])  # from OpenCV's camera axes


def judge_folds(capture: Capture, evidence: Evidence, doubtful: Collection[int]) -> list[Finding]:
    """Returns a Finding if the cameras jump between consecutive images whose own motion is small.

    A jump counts only if the cameras of the groups before and after it agree with their images, so that a single wrong
    pose is none.

    Args:
        capture: whose images are consecutive in the order of their names.
        evidence: see `cameras.gather`.
        doubtful: images with findings of their own, which are skipped.
    """
    names = [frame.name for frame in capture.frames]
    order = [int(view) for view in natural_order(names) if view not in set(doubtful)]
    pairs = list(itertools.pairwise(order))
    fits = [_fits(evidence, *pair) for pair in pairs]
    jumps = [
        pair for pair, (fit, count) in zip(pairs, fits, strict=True) if count >= _MIN_MATCHES and fit < _NONE * count
    ]
    starts = [0, *(order.index(second) for _, second in jumps), len(order)]
    groups = [order[start:end] for start, end in itertools.pairwise(starts)]
    beside = zip(jumps, itertools.pairwise(groups), strict=True)
    jumps = [pair for pair, (one, other) in beside if _belongs(evidence, one[::-1]) and _belongs(evidence, other)]
    found = ((*pair, _two_view_turn(evidence, *pair)) for pair in jumps)
    sure = [
        each
        for each in found
        if each[2] is not None and _angle(each[2]) < _MAX_TURN and _off(evidence, *each) > _MIN_OFF
    ]
    if not sure:
        return []
    first, second, turn = sure[0]
    listed = ", ".join(f"{names[one]} and {names[other]}" for one, other in jumps[:5])
    listed += f" and {len(jumps) - 5} more" if len(jumps) > 5 else ""
    shown, stored = (np.degrees(_angle(each)) for each in (turn, _model_turn(evidence.poses, first, second)))
    found = (
        f"{capture.source}: the cameras jump between consecutive images ({listed}): {names[first]} and {names[second]} "
        f"show a rotation of {shown:.0f} degrees, their cameras one of {stored:.0f}; the reconstruction may be folded, "
        "as where a scene repeats itself"
    )
    change = "find the cameras again: jaxnerf-cameras --images=DIR --out=NEW"
    return [Finding("warning", "fold", found, "cameras that move as the images do", change)]


def noted(capture: Capture) -> list[Finding]:
    """Returns a Finding for each contradiction that jaxnerf-cameras noted when it found the cameras."""
    place = capture.source if capture.source.is_dir() else capture.source.parent
    content = read_bytes(place / NOTES)[:_MOST_NOTES] if (place / NOTES).is_file() else b""
    lines = content.decode(errors="replace").split("\n")
    change = "compare the images that it names with the plot, or take more images between them"
    return [Finding("warning", "fold", f"{place / NOTES}: {line}", "none", change) for line in lines if line.strip()]


def _belongs(evidence, group):
    """Returns whether the first image of a group fits the camera of one of the next two, and others fit, too."""
    first_agrees = any(_agree(evidence, group[0], other) for other in group[1:3])
    return first_agrees and sum(_agree(evidence, *pair) for pair in itertools.pairwise(group)) >= _MIN_AGREEING


def _agree(evidence, first, second):
    """Returns whether the matches of two images fit their cameras."""
    fit, count = _fits(evidence, first, second)
    return count >= 0.5 * _MIN_MATCHES and fit > _MANY * count


def _fits(evidence, first, second):
    """Returns how many matches of two images fit their cameras, and how many there are."""
    near = {first: [second]}
    return count_fits(evidence.keypoints, near, evidence.poses, evidence.scale, image=first, view=first)


def _off(evidence, first, second, turn):
    """Returns the angle between the rotation that two images show and that of their cameras."""
    return _angle(turn.T @ _model_turn(evidence.poses, first, second))


def _two_view_turn(evidence, first, second) -> Float[np.ndarray, "3 3"] | None:
    """Returns the rotation from the axes of one camera to the other's that their matches show; None without enough."""
    one, other = evidence.keypoints[first], evidence.keypoints[second]
    matches = match(one, other)
    corners = np.flatnonzero(matches >= 0)
    if len(corners) < _MIN_MATCHES:
        return None
    places = np.ascontiguousarray(one.points[corners]), np.ascontiguousarray(other.points[matches[corners]])
    tolerance = INLIER / np.mean([evidence.scale[first], evidence.scale[second]])
    cv2.setRNGSeed(0)
    essential, inliers = cv2.findEssentialMat(*places, np.eye(3), method=cv2.RANSAC, prob=0.9999, threshold=tolerance)
    if essential is None or essential.shape != (3, 3) or inliers.sum() < _MIN_FRACTION * len(corners):
        return None
    _, turn, _, _ = cv2.recoverPose(essential, *places, np.eye(3), mask=inliers)
    return _FLIP @ turn @ _FLIP


def _model_turn(poses, first, second):
    return poses[second, :, :3].T @ poses[first, :, :3]


def _angle(turn):
    return float(np.arccos(np.clip((np.trace(turn) - 1) / 2, -1, 1)))
