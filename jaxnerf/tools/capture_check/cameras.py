"""Judges the cameras of a dataset by its images: axes, focal length, and the pose of each image.

A track of matched corners fits the cameras if one point in space explains it to within two pixels. About one
in twenty random matches does.
"""

import dataclasses
import itertools
import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from jaxnerf.core.cameras import project
from jaxnerf.data.geometry.poses import neighbours
from jaxnerf.data.geometry.world import poses_of
from jaxnerf.data.readers.base import Capture
from jaxnerf.runtime import stages
from jaxnerf.tools.capture_check.findings import Finding, axes_change, axes_name, focal_change, percent
from jaxnerf.tools.capture_check.images import ImageSummary
from jaxnerf.tools.capture_check.tracks import (
    INLIER,
    Evidence,
    Tracks,
    circles,
    count_fits,
    errors,
    follow,
    keypoints_of,
    match,
    subset,
    triangulate,
)
from jaxnerf.tools.capture_check.view_evidence import find_alternative, support

_MIN_TRACKS = 60  # to judge axes and the focal length
_SCREENING, _RANKING = 400, 3000  # tracks that screen all axes, and that rank the best and focal lengths
_CLEARLY = 0.1  # fraction of tracks by which other axes must fit better, beside a third more
_FACTORS = np.geomspace(0.55, 1.8, 21)  # of the focal length
_MIN_ERROR = 0.07  # of the focal length, to be reported; lens and noise reach 0.02
_MIN_VIEWS = 3  # with tracks, for a standard error over views
_MIN_GAIN = 0.02  # px
_SURE = 5.0  # standard errors
_UNUSUAL = 0.35  # of the median fraction of matches that fit, below which an image is examined
_RARE = 0.2  # median fraction of matches that fit, below which views share too little or all poses are wrong
_MIN_CIRCLES = 15  # matches that close a circle
_CLOSED = 0.5  # fraction of these that fits if poses are right; mostly above 0.8
# Matches that close a circle, and px of their median error: 0.5 to 1.6 in lego, mic, fern, fox and can as they are, 4
# where cameras are off by 0.3 degrees.
_MIN_ACCURATE, _ACCURATE = 300, 2.0
_NONE = 0.1  # the same if all poses are wrong; an object with two equal sides closes circles that fit to 0.2
_MIN_SUPPORT, _MIN_CAMERAS = 30, 3  # guided matches, beyond those by chance, and cameras that confirm another pose
_OWN_FRACTION = 0.6  # of these, below which an image's own pose is wrong
_OWN_FRACTION_IN_MODEL = 0.4  # the same where the dataset's own reconstruction confirms the pose
_MIN_CONFIDENCE = 0.999
_MIN_OBSERVATIONS = 30  # of the reconstruction in one image, to confirm it
_GUIDED = 0.6  # guided matches per match, above which most poses are right; mostly 0.75, at random poses 0.4 or less
_SAMPLE = 12  # views that tell whether all poses are wrong
_PARALLAX = np.deg2rad(1.5)  # between the rays of a point whose depth counts


class Axes(NamedTuple):
    """An alternative reading of the poses in a file.

    Attributes:
        turn: [3, 3] from the intended camera's axes to the stored one's, a signed permutation.
        inverted: whether the file stores world to camera.
        fraction: of the tracks that fit this reading.
    """

    turn: Float[np.ndarray, "3 3"]
    inverted: bool
    fraction: float


def gather(capture: Capture, images: Sequence[ImageSummary | None], near: Int[np.ndarray, "V K"]) -> Evidence:
    """Matches the images and returns the Evidence; an unreadable image (None) has no corners."""
    keypoints = keypoints_of(capture, images)
    scale = np.ones(len(images))
    for view, (image, frame) in enumerate(zip(images, capture.frames, strict=True)):
        if image is not None:
            height = frame.camera.height or image.size[0]
            scale[view] = np.mean(frame.camera.focal) * image.reduced[0] / height
    tracks, poses = follow(keypoints, near), poses_of(capture)
    return Evidence(keypoints, near, tracks, poses, scale, _fitting(tracks, poses, scale))


def judge_positions(capture: Capture) -> list[Finding]:
    """Returns a Finding if all cameras have the same position."""
    eyes = poses_of(capture)[:, :, 3]
    if len(eyes) < 2 or np.ptp(eyes, axis=0).max() > 1e-6 * (1 + np.abs(eyes).max()):
        return []
    found = f"{capture.source}: all {len(eyes)} cameras are at the same position"
    expected = "different positions, without which depth is undetermined"
    return [Finding("error", "pose", found, expected, "move the camera between images, or compute the poses again")]


def judge_axes(capture: Capture, evidence: Evidence) -> tuple[list[Finding], Evidence]:
    """Returns Findings about the axes convention, and the Evidence with the poses as intended."""
    count = len(evidence.tracks.shown)
    if count < _MIN_TRACKS:
        found = f"{capture.source}: only {count} corners are recognised in several images"
        change = "nothing, or take images with more texture and overlap"
        return [Finding("warning", "overlap", found, f"{_MIN_TRACKS} to judge the cameras", change)], evidence
    stored, other = rank_axes(evidence.tracks, evidence.poses, evidence.scale)
    if other.fraction <= max(stored.fraction + _CLEARLY, 4 / 3 * stored.fraction):
        return [], evidence
    found = (
        f"{capture.source}: the poses are in {axes_name(other.turn, other.inverted)}; {percent(other.fraction)} of the "
        f"matches fit these, {percent(stored.fraction)} fit the poses as stored"
    )
    expected = "camera-to-world with x right, y up, looking along -z (or as the format defines)"
    change = axes_change(capture.files, other.turn, other.inverted)
    finding = Finding("error", "axes", found, expected, change)
    return [finding], evidence._replace(poses=as_intended(evidence.poses, other), fraction=other.fraction)


def judge_focal(capture: Capture, evidence: Evidence) -> tuple[list[Finding], Evidence]:
    """Returns Findings about the focal length, and the Evidence with the one that fits."""
    if len(evidence.tracks.shown) < _MIN_TRACKS or len(np.unique(evidence.tracks.views)) < _MIN_VIEWS:
        return [], evidence
    factor, gain, error = focal_factor(evidence.tracks, evidence.poses, evidence.scale)
    if abs(np.log(factor)) < np.log1p(_MIN_ERROR) or gain <= _MIN_GAIN or gain < _SURE * error:
        return [], evidence
    focal = np.mean(capture.frames[0].camera.focal)
    found = (
        f"{capture.source}: the focal length is {focal:.5g} px; the images fit {factor:.3g} times that better, by "
        f"{gain:.2f} +- {error:.2f} px"
    )
    finding = Finding("error", "focal", found, f"about {focal * factor:.5g}", focal_change(capture, factor))
    keypoints = [part._replace(points=part.points / factor) for part in evidence.keypoints]
    tracks = evidence.tracks._replace(points=evidence.tracks.points / factor)
    scale = evidence.scale * factor
    fraction = _fitting(tracks, evidence.poses, scale)
    return [finding], evidence._replace(keypoints=keypoints, tracks=tracks, scale=scale, fraction=fraction)


def judge_views(capture: Capture, evidence: Evidence) -> list[Finding]:
    """Returns Findings about images that do not belong to their cameras: swapped, or with a wrong pose.

    An image is flagged only if another pose explains several times as many guided matches, see `view_evidence`.
    """
    views = range(len(capture.frames))
    with stages.stage("comparing the poses with the images"):
        fit, matches = np.array([_fits(evidence, view, view) for view in views]).T
    fraction = fit / np.maximum(matches, 1)
    usual = np.median(fraction)
    if usual < _RARE:
        return _judge_all(capture, evidence)
    odd = [view for view in views if fraction[view] < _UNUSUAL * usual and len(evidence.keypoints[view].points)]
    with stages.stage("searching other poses for images that do not fit"):
        found = {view: find_alternative(evidence, view, without=odd) for view in odd}
    flagged = {view: other for view, other in found.items() if other and _is_certain(capture, evidence, view, other)}
    findings, left = [], set(flagged)
    for first, second in itertools.combinations(flagged, 2):
        if {first, second} <= left and _are_swapped(evidence.poses, first, second, flagged):
            findings.append(_swap(capture, first, second, flagged))
            left -= {first, second}
    findings += [_wrong_pose(capture, evidence, view, flagged[view]) for view in sorted(left)]
    return findings + [_unknown(capture, view) for view in odd if matches[view] < _MIN_CIRCLES]


def circle_error(evidence: Evidence) -> tuple[int, float]:
    """Returns how many matches of some views a third image confirms, and the median of their errors, px; at most 4."""
    views = range(0, len(evidence.poses), -(-len(evidence.poses) // _SAMPLE))
    off = _circle_errors(evidence, [(view, evidence.near[view]) for view in views])
    return len(off), float(np.median(off)) if len(off) else 0.0


def judge_accuracy(capture: Capture, evidence: Evidence) -> list[Finding]:
    """Returns a Finding if most confirmed matches are a little off, so that refined poses gain."""
    count, off = circle_error(evidence)
    if count < _MIN_ACCURATE or off < _ACCURATE:
        return []
    found = f"{capture.source}: {count} corners that three images agree on are {off:.1f} px off their cameras (median)"
    change = "--config.cameras.refine=True in training, which corrects poses that are a little wrong, if auto does not"
    return [Finding("warning", "accuracy", found, f"less than {_ACCURATE:g}", change)]


def points_of(evidence: Evidence) -> tuple[Float[np.ndarray, "N 3"], Tracks]:
    """Returns the points in space on which the images agree with sufficient parallax, and their tracks."""
    tracks = evidence.tracks
    points, _ = triangulate(tracks, evidence.poses)
    rays = points[:, None] - evidence.poses[tracks.views][..., 3]
    rays /= np.maximum(np.linalg.norm(rays, axis=-1, keepdims=True), 1e-12)
    cosine = np.where(tracks.shown, (rays * rays[:, :1]).sum(-1), 1).min(axis=1)
    good = errors(tracks, evidence.poses, evidence.scale) < 0.5 * INLIER
    good &= cosine < np.cos(_PARALLAX)
    return points[good], Tracks(*(part[good] for part in tracks))


def as_intended(poses: Float[np.ndarray, "V 3 4"], axes: Axes) -> Float[np.ndarray, "V 3 4"]:
    """Returns the intended poses of a file that stores them in other axes; they may be mirrored."""
    turn, eyes = poses[:, :, :3], poses[:, :, 3:]
    if axes.inverted:
        turn = np.swapaxes(turn, 1, 2)
        eyes = -turn @ eyes
    return np.concatenate([turn @ axes.turn, eyes], axis=-1)


def with_poses(evidence: Evidence, poses: Float[np.ndarray, "V 3 4"]) -> Evidence:
    """Returns the Evidence with other poses, which choose other neighbours."""
    near = neighbours(poses)
    tracks = follow(evidence.keypoints, near)
    fraction = _fitting(tracks, poses, evidence.scale)
    return evidence._replace(near=near, tracks=tracks, poses=poses, fraction=fraction)


def rank_axes(tracks: Tracks, poses: Float[np.ndarray, "V 3 4"], scale: Float[np.ndarray, " V"]) -> tuple[Axes, Axes]:
    """Returns the Axes as stored, and the best of the 95 alternatives."""

    def measured(part, axes):
        return axes._replace(fraction=_fitting(part, as_intended(poses, axes), scale))

    every = [
        Axes(np.eye(3)[:, order] * signs, inverted, 0.0)
        for inverted in (False, True)
        for order in itertools.permutations(range(3))
        for signs in itertools.product((1, -1), repeat=3)
    ]
    screening, ranking = subset(tracks, _SCREENING), subset(tracks, _RANKING)
    stored, *others = (measured(screening, axes) for axes in every)
    best = sorted(others, key=lambda axes: -axes.fraction)[:3]
    others = [measured(ranking, axes) for axes in best]
    return measured(ranking, stored), max(others, key=lambda axes: axes.fraction)


def focal_factor(
    tracks: Tracks, poses: Float[np.ndarray, "V 3 4"], scale: Float[np.ndarray, " V"]
) -> tuple[float, float, float]:
    """Returns the factor of the focal length with the least mean error, and how certain it is.

    Depth compensates much of a wrong focal length, but not all of it.

    Returns:
        The factor; the gain in px, the mean error at factor 1 minus that at the factor; and the gain's
        standard error over views, inf if the least error is at an end of the range.
    """
    tracks = subset(tracks, _RANKING)

    def cost(factor):
        return errors(tracks._replace(points=tracks.points / factor), poses, scale * factor)

    means = np.array([cost(factor).mean() for factor in _FACTORS])
    best = int(means.argmin())
    if best in (0, len(_FACTORS) - 1):
        return float(_FACTORS[best]), 0.0, np.inf
    before, here, after = means[best - 1 : best + 2]
    shift = 0.5 * (before - after) / max(before + after - 2 * here, 1e-12)  # vertex of the parabola
    factor = float(_FACTORS[best] * (_FACTORS[1] / _FACTORS[0]) ** np.clip(shift, -0.5, 0.5))
    gain = cost(1.0) - cost(factor)
    sums = np.bincount(tracks.views[:, 0], gain, len(poses))
    count = np.bincount(tracks.views[:, 0], minlength=len(poses))
    deviation = np.sqrt(((sums - count * gain.mean()) ** 2).sum()) / len(gain)
    return factor, float(gain.mean()), float(deviation)


def _fits(evidence, image, view):
    return count_fits(evidence.keypoints, evidence.near, evidence.poses, evidence.scale, image=image, view=view)


def _fitting(tracks, poses, scale):
    """Returns the fraction of tracks that fit; 0 if there are none."""
    return float((errors(tracks, poses, scale) < INLIER).mean()) if len(tracks.shown) else 0.0


def _is_certain(capture, evidence, view, other):
    """Returns whether an Alternative is enough to flag an image."""
    limit = _OWN_FRACTION
    if len(_track_errors(capture, evidence, view)) >= _MIN_OBSERVATIONS:
        limit = _OWN_FRACTION_IN_MODEL if np.median(_track_errors(capture, evidence, view)) < INLIER else limit
    enough = other.other.matches >= _MIN_SUPPORT and other.other.cameras >= _MIN_CAMERAS
    enough &= _confidence(other) > _MIN_CONFIDENCE
    return enough and other.own.matches < limit * other.other.matches


def _track_errors(capture, evidence, view):
    """Returns the reprojection errors of the points that the dataset's own model has in a view, px; none without."""
    frame = capture.frames[view]
    if frame.seen is None or capture.points is None or not len(frame.seen):
        return np.zeros(0)
    camera = dataclasses.replace(frame.camera, to_world=evidence.poses[view])
    shown, depth = project(camera, capture.points[frame.seen])
    off = np.linalg.norm(np.asarray(shown) - frame.seen_at, axis=1)
    scale = evidence.scale[view] / np.mean(camera.focal)
    return np.where(np.asarray(depth) > 0, np.nan_to_num(off, nan=np.inf) * scale, np.inf)


def _are_swapped(poses, first, second, flagged):
    """Returns whether each of two images was taken from about the place of the other's camera."""
    eyes = poses[:, :, 3]
    apart = np.linalg.norm(eyes[first] - eyes[second])
    off = [
        np.linalg.norm(flagged[image].pose[:, 3] - eyes[camera]) for image, camera in ((first, second), (second, first))
    ]
    return max(off) < 0.3 * apart


def _numbers(other):
    return (
        f"{other.other.matches:.0f} matches with {other.other.cameras} cameras, beyond those by chance, fit another "
        f"place, {max(other.own.matches, 0):.0f} fit its own (confidence {percent(_confidence(other), 1)})"
    )


def _confidence(other):
    """Returns the probability that the other pose is better: the counts are sums of many rare events."""
    spread = np.sqrt(other.other.matches + max(other.own.matches, 0) + 1)
    return 0.5 + 0.5 * math.erf((other.other.matches - other.own.matches) / spread / math.sqrt(2))


def _swap(capture, first, second, flagged):
    one, two = capture.frames[first].image, capture.frames[second].image
    found = f"{one} and {two} each show the view of the other's camera: of the first, {_numbers(flagged[first])}"
    expected, change = "each image at its own camera", "rename the two files to each other"
    return Finding("error", "swap", found, expected, change, (first, second))


def _wrong_pose(capture, evidence, view, other):
    frame, pose = capture.frames[view], evidence.poses[view]
    cosine = (np.trace(pose[:, :3].T @ other.pose[:, :3]) - 1) / 2
    angle, away = np.degrees(np.arccos(np.clip(cosine, -1, 1))), np.linalg.norm(pose[:, 3] - other.pose[:, 3])
    found = f"{frame.image} does not show the view of its camera: {_numbers(other)}"
    found += f"; the other place is {away:.3g} world units away and turned by {angle:.0f} degrees"
    change = f"{frame.name} in {capture.source}: correct its pose or its file, or remove it"
    return Finding("error", "pose", found, "its own place", change, (view,))


def _unknown(capture, view):
    found = f"{capture.frames[view].image} cannot be judged, as it has hardly a corner that its neighbours show"
    return Finding("warning", "overlap", found, "overlap", "nothing, or look at that image", (view,))


def _judge_all(capture, evidence):
    """Returns Findings if hardly any match fits, because all poses are wrong or views are too far apart."""
    views = range(0, len(evidence.poses), -(-len(evidence.poses) // _SAMPLE))
    guided = sum(support(evidence, view, evidence.poses[view], evidence.near[view]).matches for view in views)
    free = sum(
        (match(evidence.keypoints[view], evidence.keypoints[k]) >= 0).sum()
        for view in views
        for k in evidence.near[view]
    )
    if guided > _GUIDED * free:
        return []  # the texture repeats itself: matches that know nothing of the cameras are wrong
    off = _circle_errors(evidence, list(enumerate(evidence.near)))
    confirmed = len(off)
    if confirmed < _MIN_CIRCLES:
        found = f"{capture.source}: the images have too little in common to judge the poses"
        change = "nothing, or take more images between these"
        return [Finding("warning", "overlap", found, "overlap", change)]
    fraction = float((off < INLIER).mean())
    if fraction > _CLOSED:
        return []
    severity = "error" if fraction < _NONE else "warning"
    found = f"{capture.source}: {percent(fraction)} of {confirmed} matches confirmed by a third image fit the poses"
    change = "the poses or the lens: compute them again, as other axes do not correct them"
    return [Finding(severity, "pose", found, "nearly all", change)]


def _circle_errors(evidence, groups):
    """Returns the errors of the matches among the (view, others) of each group that close a circle."""
    parts = [circles(evidence.keypoints, *group) for group in groups]
    off = [errors(part, evidence.poses, evidence.scale) for part in parts if part is not None]
    return np.concatenate([*off, np.zeros(0)])
