"""Finds images whose poses are stored in other axes than the rest, as where two captures were joined in one file.

The images fall into groups: within a group, matches fit the poses. A group that many matches with other groups
contradict is tried in each reading of its poses that keeps rotations rotations: with the cameras' axes swapped or
negated, as world to camera, and with the world's axes swapped or negated. The reading by which most matches fit counts.
"""

import itertools
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxnerf.data.geometry.path_poses import natural_order
from jaxnerf.data.geometry.world import poses_of
from jaxnerf.data.readers.base import Capture
from jaxnerf.tools.capture_check.cameras import Axes, as_intended, with_poses
from jaxnerf.tools.capture_check.findings import Finding, axes_change, axes_name
from jaxnerf.tools.capture_check.tracks import INLIER, Evidence, Tracks, errors, joined, pair_tracks, subset

_MIN_MATCHES = 15  # of two images that are compared
_AGREE, _CONTRADICT = 0.25, 0.1  # fractions of these that fit: of poses that are right, and by chance at most
_GAIN, _TIMES = 15, 1.3  # matches with other groups that have to fit more than now, and how many times as many
_MIN_IMAGES = 2  # in other axes; a single one has a wrong pose, see `cameras.judge_views`
_BESIDE, _NEAR, _SIMILAR = 3, 4, 3  # images compared: next by name, by position, and by position and direction
_LARGE = 0.25  # of all images, from which a group may be the one that is right
_WORLD = 0.9  # times as many matches as fit a reading of the cameras' axes
_SCREENING = 600  # matches that choose a reading
_PASSES = 6
_MOST_RUNS = 12  # of consecutive images that are named

_TURNS = [
    np.eye(3)[:, order] * signs
    for order in itertools.permutations(range(3))
    for signs in itertools.product((1, -1), repeat=3)
    if np.linalg.det(np.eye(3)[:, order] * signs) > 0
]


class Reading(NamedTuple):
    """A reading of poses in a file: the Axes of its cameras, and those of its world.

    Attributes:
        axes: see `cameras.Axes`.
        world: [3, 3] from the file's world to the others'.
    """

    axes: Axes
    world: Float[np.ndarray, "3 3"]

    @property
    def is_stored(self) -> bool:
        """Whether it is that of a file without faults."""
        return not self.axes.inverted and np.array_equal([self.axes.turn, self.world], [np.eye(3)] * 2)

    def poses(self, stored: Float[np.ndarray, "V 3 4"]) -> Float[np.ndarray, "V 3 4"]:
        """Returns the intended poses."""
        return self.world @ as_intended(stored, self.axes)


_READINGS = [Reading(Axes(turn, inverted, 0.0), np.eye(3)) for inverted in (False, True) for turn in _TURNS]
_NUM_AXES = len(_READINGS)
_READINGS += [Reading(Axes(np.eye(3), False, 0.0), turn) for turn in _TURNS[1:]]


def judge_mixed(capture: Capture, evidence: Evidence) -> tuple[list[Finding], Evidence]:
    """Returns a Finding for each reading other than the file's, if the images have several readings.

    Args:
        capture: with the poses as stored.
        evidence: with the poses of most images as intended, see `cameras.judge_axes`.

    Returns:
        Findings, none if all images have one reading; and the Evidence with all poses as intended.
    """
    stored, order = poses_of(capture), natural_order([frame.name for frame in capture.frames])
    labels, poses = find_mixed(evidence, stored, order)
    counts = np.bincount(labels, minlength=len(_READINGS) + 1)
    kinds = [label for label in range(len(_READINGS)) if counts[label] >= _MIN_IMAGES]
    if len(kinds) < 2:
        return [], evidence
    findings = []
    for reading, label in ((_READINGS[label], label) for label in kinds):
        if not reading.is_stored:
            findings.append(_finding(capture, reading, np.flatnonzero(labels == label)))
    return findings, with_poses(evidence, poses)


def find_mixed(
    evidence: Evidence, stored: Float[np.ndarray, "V 3 4"], order: Int[np.ndarray, " V"]
) -> tuple[Int[np.ndarray, " V"], Float[np.ndarray, "V 3 4"]]:
    """Finds the reading of each view's pose.

    Args:
        evidence: with the poses in the reading of most views.
        stored: [V, 3, 4] the poses as they are in the file.
        order: indices of the views, of which consecutive ones are similar.

    Returns:
        Indices [V] of readings, their number for a view that agrees with no other; and the poses [V, 3, 4] in these.
    """
    tracks = _compared(evidence, stored, order)
    start = [label for label, each in enumerate(_READINGS) if np.allclose(each.poses(stored), evidence.poses)]
    labels, poses = np.full(len(stored), start[0] if start else len(_READINGS)), evidence.poses.copy()
    for _ in range(_PASSES if len(tracks.shown) else 0):
        numbers, large = _groups(tracks, poses, evidence.scale), []
        groups = [np.flatnonzero(numbers == number) for number in np.unique(numbers)]
        moved = False
        for group in sorted(groups, key=len) if len(groups) > 1 else []:
            found = _better(tracks, poses, stored, evidence.scale, group)
            if found is not None and len(group) >= _LARGE * len(stored):  # either of two may be wrong
                large.append((*found, group))
            elif found is not None:
                labels[group], poses[group] = found[1], _READINGS[found[1]].poses(stored[group])
                moved = True
        if large and not moved:
            _, label, group = max(large, key=lambda each: each[0])
            labels[group], poses[group] = label, _READINGS[label].poses(stored[group])
        elif not moved:
            break
    numbers = _groups(tracks, poses, evidence.scale)
    labels[np.bincount(numbers, minlength=len(numbers))[numbers] == 1] = len(_READINGS)
    return labels, poses


def _compared(evidence, stored, order):
    """Returns the Tracks of pairs of views that may show the same, whatever the axes are."""
    eyes = stored[:, :, 3]
    by_position = np.argsort(np.linalg.norm(eyes[:, None] - eyes, axis=-1), axis=1, kind="stable")[:, 1 : 1 + _NEAR]
    pairs = {(view, int(other)) for view in range(len(eyes)) for other in by_position[view]}
    pairs |= {(view, int(other)) for view in range(len(eyes)) for other in evidence.near[view, :_SIMILAR]}
    for step in range(1, _BESIDE + 1):
        pairs |= {(int(one), int(other)) for one, other in zip(order, np.roll(order, -step), strict=True)}
    found = [pair_tracks(evidence.keypoints, *pair) for pair in sorted({tuple(sorted(pair)) for pair in pairs})]
    none = pair_tracks(evidence.keypoints, 0, 0)
    return joined([Tracks(*(part[:0] for part in none)), *(each for each in found if len(each.shown) >= _MIN_MATCHES)])


def _fitting(tracks, poses, scale) -> Bool[np.ndarray, " T"]:
    return errors(tracks, poses, scale) < 0.75 * INLIER


def _groups(tracks, poses, scale):
    """Returns the number [V] of each view's group, that of its first view: the views that agreeing pairs connect."""
    groups = np.arange(len(poses))
    for (one, other), fraction in _fractions(tracks, _fitting(tracks, poses, scale)):
        if fraction >= _AGREE:
            low, high = sorted((groups[one], groups[other]))
            groups[groups == high] = low
    return groups


def _fractions(tracks, fitting):
    """Returns ((view, view), fraction that fits) of each pair."""
    pairs, inverse = np.unique(tracks.views, axis=0, return_inverse=True)
    inverse = inverse.reshape(-1)
    return list(zip(pairs.tolist(), np.bincount(inverse, fitting) / np.bincount(inverse), strict=True))


def _better(tracks, poses, stored, scale, group):
    """Returns (matches gained, reading) of a group that many more matches fit than its present one, or None."""
    inside = np.isin(tracks.views, group)
    concerned, across = inside.any(axis=1), inside.any(axis=1) & ~inside.all(axis=1)
    tracks, across = (Tracks(*(part[chosen] for part in tracks)) for chosen in (concerned, across))
    present, present_across = (_fitting(part, poses, scale) for part in (tracks, across))
    if not any(fraction < _CONTRADICT for _, fraction in _fractions(across, present_across)):
        return None

    def count(part, label):
        moved = poses.copy()
        moved[group] = _READINGS[label].poses(stored[group])
        return int(_fitting(part, moved, scale).sum())

    screening = subset(tracks, _SCREENING)
    best = sorted(range(len(_READINGS)), key=lambda label: -count(screening, label))[:4]
    # Two readings may fit alike where cameras are in a plane. Cameras are turned more often than worlds.
    gain, best = max((count(tracks, label) * (_WORLD if label >= _NUM_AXES else 1), label) for label in best)
    before, after = int(present_across.sum()), count(across, best)
    enough = after >= max(_TIMES * before, before + _GAIN) and gain >= present.sum()
    return (gain - int(present.sum()), best) if enough else None


def _finding(capture, reading, members):
    counts = f"{len(members)} of {len(capture.frames)} images, {_runs(capture, members)}"
    if np.array_equal(reading.world, np.eye(3)):
        name = axes_name(reading.axes.turn, reading.axes.inverted)
        change = axes_change(capture.files, reading.axes.turn, reading.axes.inverted)
    else:
        rows = "; ".join(" ".join(f"{int(value)}" for value in row) for row in reading.world)
        name, change = (
            "a world turned by right angles",
            f"multiply every camera-to-world matrix from the left by [{rows}]",
        )
    found = f"{capture.source}: the poses of {counts}, are in {name}, unlike those of the others"
    change = f"of these images only, {change}"
    return Finding("error", "axes", found, "one convention for all images", change, tuple(map(int, members)))


def _runs(capture, members):
    """Returns the names of images, of consecutive ones the first and the last."""
    breaks = np.flatnonzero(np.diff(members) > 1) + 1
    names = [frame.name for frame in capture.frames]
    runs = [(names[run[0]], names[run[-1]]) for run in np.split(members, breaks)]
    parts = [first if first == last else f"{first} to {last}" for first, last in runs[:_MOST_RUNS]]
    return ", ".join(parts) + (f" and {len(runs) - _MOST_RUNS} more" if runs[_MOST_RUNS:] else "")
