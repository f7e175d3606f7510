"""Whether photographs agree with their cameras, and with which other meaning of the cameras they would.

A track of matched corners fits cameras when one point in space explains it to a pixel or two. Random matches
hardly do: about one in twenty. All axes, and the focal length, are judged by the same tracks.
"""

import itertools
from typing import NamedTuple

import numpy as np

from jaxnerf.capture_check import features
from jaxnerf.capture_check.tracks import Tracks, triangulate

NEAR = 2.0  # px of the shrunk images: a track fits
_WORST = 4.0  # px: beyond, a wrong match is no worse than another
_FEW, _MANY = 400, 3000  # tracks that tell apart axes, and focal lengths
_FACTORS = np.geomspace(0.55, 1.8, 21)  # of the focal length


class Axes(NamedTuple):
    """What a file's cameras may have been meant as."""

    turn: np.ndarray  # [3, 3] from the meant camera's axes to the stated one's: a signed permutation
    inverted: bool  # the file states world -> camera
    share: float  # of tracks that fit


def errors(tracks, poses, scale):
    """Returns [T], how far tracks are off poses [V, 3, 4], in px of the shrunk images, at most 4.

    Args:
        scale: [V] px of the shrunk images that 1 on the plane at distance 1 takes.
    """
    _, off = triangulate(tracks, poses)
    squares = ((np.minimum(off, 1e6) * scale[tracks.views]) ** 2).sum(axis=1)
    freedom = np.maximum(2 * tracks.shown.sum(axis=1) - 3, 1)  # two numbers a view, less the point's three
    return np.minimum(np.sqrt(2 * squares / freedom), _WORST)


def some(tracks, count):
    """Returns count of the tracks, or all where there are no more: the same ones on every run."""
    if len(tracks.shown) <= count:
        return tracks
    chosen = np.random.default_rng(0).permutation(len(tracks.shown))[:count]
    return Tracks(*(part[chosen] for part in tracks))


def as_meant(poses, axes):
    """Returns the poses [V, 3, 4] that are meant where poses state them in other axes; maybe mirrored."""
    turn, eyes = poses[:, :, :3], poses[:, :, 3:]
    if axes.inverted:
        turn = np.swapaxes(turn, 1, 2)
        eyes = -turn @ eyes
    return np.concatenate([turn @ axes.turn, eyes], axis=-1)


def rank_axes(tracks, poses, scale):
    """Returns (the Axes as they are, the best of the 95 others)."""
    few, many = some(tracks, _FEW), some(tracks, _MANY)

    def share(part, axes):
        return float((errors(part, as_meant(poses, axes), scale) < NEAR).mean())

    every = []
    for inverted, order in itertools.product((False, True), itertools.permutations(range(3))):
        for signs in itertools.product((1, -1), repeat=3):
            axes = Axes(np.eye(3)[:, order] * signs, inverted, 0.0)
            every.append(axes._replace(share=share(few, axes)))
    stated, *others = every
    others = sorted(others, key=lambda axes: -axes.share)[:3]
    stated, *others = (axes._replace(share=share(many, axes)) for axes in (stated, *others))
    return stated, max(others, key=lambda axes: axes.share)


def focal_factor(tracks, poses, scale):
    """Returns what the focal length is to be multiplied with, and how sure that it is another than 1.

    Depth makes up for much of a wrong focal length, but not for all of it: the mean error has its least value
    where the length is right.

    Returns:
        factor; gain in px, how much smaller the mean error is there than at 1; and its standard error over
        the views, inf where the least is at an end of what was tried.
    """
    tracks = some(tracks, _MANY)

    def cost(factor):
        return errors(tracks._replace(points=tracks.points / factor), poses, scale * factor)

    means = np.array([cost(factor).mean() for factor in _FACTORS])
    best = int(means.argmin())
    if best in (0, len(_FACTORS) - 1):
        return float(_FACTORS[best]), 0.0, np.inf
    before, here, after = means[best - 1 : best + 2]
    shift = 0.5 * (before - after) / max(before + after - 2 * here, 1e-12)
    factor = float(_FACTORS[best] * (_FACTORS[1] / _FACTORS[0]) ** np.clip(shift, -0.5, 0.5))
    gain = cost(1.0) - cost(factor)
    groups = np.bincount(tracks.views[:, 0], gain, len(poses))
    count = np.bincount(tracks.views[:, 0], minlength=len(poses))
    deviation = np.sqrt(((groups - count * gain.mean()) ** 2).sum()) / len(gain)
    return factor, float(gain.mean()), float(deviation)


def pairs(found, points, content, place, others):
    """Returns Tracks of two views: the corners of one photograph, seen from the place of the same or another.

    Args:
        found, points: of all views, see tracks.follow.
        content, place: indices of a photograph, and of the camera that it is taken to be from.
        others: indices of views to match with.
    """
    rows = []
    for other in others:
        matched = features.match(found[content], found[other])
        good = points[content][1][matched[:, 0]] & points[other][1][matched[:, 1]]
        first, second = matched[good].T
        where = np.stack([points[content][0][first], points[other][0][second]], axis=1)
        views = np.tile([place, other], (len(where), 1))
        rows.append(Tracks(views, where, matched[good], np.ones((len(where), 2), bool)))
    return Tracks(*(np.concatenate(part) for part in zip(*rows, strict=True)))


def fits(found, points, near, poses, scale, *, content, place):
    """Returns (matches that fit, matches) of a photograph with the neighbours of a place."""
    others = [other for other in near[place] if other not in (content, place)]
    if not others:
        return 0, 0
    tracks = pairs(found, points, content, place, others)
    if not len(tracks.shown):
        return 0, 0
    return int((errors(tracks, poses, scale) < 0.75 * NEAR).sum()), len(tracks.shown)


def circles(found, points, view, others):
    """Returns the Tracks of three views where each corner leads to the next and back, None without any.

    Chance closes no circle: whatever the cameras are, these are true matches.
    """
    rows = []
    leads = {other: _leads(found, points, view, other) for other in others}
    for first, second in itertools.combinations(others, 2):
        corners = np.flatnonzero((leads[first] >= 0) & (leads[second] >= 0))
        between = _leads(found, points, first, second)
        corners = corners[between[leads[first][corners]] == leads[second][corners]]
        three = np.stack([corners, leads[first][corners], leads[second][corners]], axis=1)
        views = np.tile([view, first, second], (len(corners), 1))
        where = [points[which][0][column] for which, column in zip(views[:1].ravel(), three.T, strict=False)]
        if len(corners):
            rows.append(Tracks(views, np.stack(where, axis=1), three, np.ones(three.shape, bool)))
    return Tracks(*(np.concatenate(part) for part in zip(*rows, strict=True))) if rows else None


def _leads(found, points, first, second):
    """Returns for each corner of a view its match in another, or -1."""
    result = np.full(len(found[first].pixels), -1)
    matched = features.match(found[first], found[second])
    good = points[first][1][matched[:, 0]] & points[second][1][matched[:, 1]]
    result[matched[good, 0]] = matched[good, 1]
    return result
