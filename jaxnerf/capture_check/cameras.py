"""What is wrong with the cameras of a capture, judged by what its photographs show."""

from typing import NamedTuple

import numpy as np

from jaxnerf.capture_check import consistency, features, tracks
from jaxnerf.capture_check.findings import Finding, axes_change, axes_name, focal_change, percent
from jaxnerf.data.geometry.world import poses_of

_ENOUGH = 60  # tracks, to judge anything
_CLEARLY = 0.1  # share of tracks by which other axes must fit better, and a third more
_OFF = 0.07  # of the focal length, from where it is reported: lens and noise reach 0.02
_WITNESSES = 3  # views, from where the spread among them tells anything
_LEAST_GAIN = 0.02  # px: less is nothing, however sure
_SURE = 5.0  # standard errors
_STRANGE = 0.35  # of the usual share of matches that fit: below, a photograph is not from its camera
_RARE = 0.2  # share of matches that fit, where views share too little, or nothing is right
_CIRCLES = 15  # matches that close a circle, to be sure
_CLOSED = 0.5  # of these, where the poses are right: mostly above 0.8
_NONE = 0.1  # of these, where all poses are wrong; a can with one label twice closes circles that fit to 0.2
_TRUSTED = 0.33  # usual share of matches that fit, for one photograph alone to be called wrong
_PARALLAX = np.deg2rad(1.5)  # between rays, for a place to have a depth


class Evidence(NamedTuple):
    """What the photographs say about the cameras."""

    found: list  # Features of each view
    points: list  # where their corners lie on the plane at distance 1, see tracks.on_plane
    near: np.ndarray  # [V, K] views beside each
    tracks: tracks.Tracks
    poses: np.ndarray  # [V, 3, 4], as they are meant where that is clear
    scale: np.ndarray  # [V] px of the shrunk image that 1 on the plane takes
    share: float  # of tracks that fit


def gather(capture, photos, near):
    """Returns the Evidence in the photographs' corners; a photograph that is None shows nothing."""
    empty = tracks.no_features()
    found = [empty if photo is None else photo.features for photo in photos]
    points = tracks.on_plane(capture, found)
    scale = []
    for photo, frame in zip(photos, capture.frames, strict=True):
        height, factor = (1, 1) if photo is None else (photo.size[0], photo.factor)
        stated = frame.camera.height or height
        scale.append(np.mean(frame.camera.focal) * height / stated / factor)
    poses, scale = poses_of(capture), np.array(scale)
    followed = tracks.follow(found, points, near)
    share = 0.0
    if len(followed.shown):
        share = float((consistency.errors(followed, poses, scale) < consistency.NEAR).mean())
    return Evidence(found, points, near, followed, poses, scale, share)


def judge_axes(capture, evidence):
    """Returns Findings about the meaning of the poses, and the Evidence with poses as they are meant."""
    if len(evidence.tracks.shown) < _ENOUGH:
        found = f"only {len(evidence.tracks.shown)} places are recognised in several photographs"
        change = "nothing, or take photographs with more texture and overlap"
        return [Finding("note", "overlap", found, f"{_ENOUGH} to judge the cameras by", change)], evidence
    stated, other = consistency.rank_axes(evidence.tracks, evidence.poses, evidence.scale)
    if other.share > max(stated.share + _CLEARLY, 4 / 3 * stated.share):
        mended = evidence._replace(poses=consistency.as_meant(evidence.poses, other), share=other.share)
        found = (
            f"{capture.source}: the poses are in {axes_name(other)}: {percent(other.share)} of what the "
            f"photographs share fits then, {percent(stated.share)} as they are"
        )
        wanted = "camera-to-world with x right, y up, looking along -z (as the format has it)"
        return [Finding("ruins", "axes", found, wanted, axes_change(capture.format, other))], mended
    return [], evidence


def judge_places(capture):
    """Returns Findings about cameras that all stand in one place."""
    eyes = poses_of(capture)[:, :, 3]
    if len(eyes) < 2 or np.ptp(eyes, axis=0).max() > 1e-6 * (1 + np.abs(eyes).max()):
        return []
    found = f"{capture.source}: all {len(eyes)} cameras stand in one place"
    wanted = "places apart: only these tell how far off anything is"
    return [Finding("ruins", "pose", found, wanted, "photograph while walking, or compute the poses anew")]


def judge_focal(capture, evidence):
    """Returns Findings about the focal length, and the Evidence with the one that fits."""
    if len(evidence.tracks.shown) < _ENOUGH:
        return [], evidence
    factor, gain, error = consistency.focal_factor(evidence.tracks, evidence.poses, evidence.scale)
    told = len(np.unique(evidence.tracks.views)) >= _WITNESSES and gain > _LEAST_GAIN
    if abs(np.log(factor)) < np.log1p(_OFF) or gain < _SURE * error or not told:
        return [], evidence
    focal = np.mean(capture.frames[0].camera.focal)
    found = (
        f"{capture.source}: the focal length is {focal:.5g} px and the photographs fit best at {factor:.2f} "
        f"times that (by {gain:.2f} +- {error:.2f} px)"
    )
    wanted = f"about {focal * factor:.5g}"
    finding = Finding("ruins", "focal", found, wanted, focal_change(capture, factor))
    points = [(place / factor, good) for place, good in evidence.points]
    followed = evidence.tracks._replace(points=evidence.tracks.points / factor)
    scale = evidence.scale * factor
    share = float((consistency.errors(followed, evidence.poses, scale) < consistency.NEAR).mean())
    return [finding], evidence._replace(points=points, tracks=followed, scale=scale, share=share)


def judge_views(capture, evidence):
    """Returns Findings about photographs that are not from their cameras: swapped, or with a wrong pose."""

    def fits(content, place):
        return consistency.fits(*evidence[:3], *evidence[4:6], content=content, place=place)

    views = range(len(capture.frames))
    fit, matches = np.array([fits(view, view) for view in views]).T
    share = fit / np.maximum(matches, 1)
    usual = np.median(share)
    if usual < _RARE:
        return _judge_all(capture, evidence)
    strange = [view for view in views if share[view] < _STRANGE * usual and len(evidence.found[view].pixels)]
    findings, left = [], list(strange)
    for first in strange:
        for second in strange:
            if not (first < second and first in left and second in left):
                continue
            mended = fits(first, second), fits(second, first)
            if all(good >= 8 and good > 0.6 * usual * every for good, every in mended):
                findings.append(_swapped(capture, first, second))
                left = [view for view in left if view not in (first, second)]
    return findings + [finding for view in left for finding in _stranger(capture, evidence, view, usual)]


def places(evidence):
    """Returns where in space the photographs agree that something is: [N, 3], and their tracks."""
    followed = evidence.tracks
    if not len(followed.shown):
        return np.zeros((0, 3)), followed
    found, _ = tracks.triangulate(followed, evidence.poses)
    rays = found[:, None] - evidence.poses[followed.views][..., 3]
    rays /= np.maximum(np.linalg.norm(rays, axis=-1, keepdims=True), 1e-12)
    cosine = np.where(followed.shown, (rays * rays[:, :1]).sum(-1), 1).min(axis=1)
    good = consistency.errors(followed, evidence.poses, evidence.scale) < 0.5 * consistency.NEAR
    good &= cosine < np.cos(_PARALLAX)
    return found[good], tracks.Tracks(*(part[good] for part in followed))


def _swapped(capture, first, second):
    one, two = capture.frames[first], capture.frames[second]
    found = f"{one.image} and {two.image} show what the other's camera sees"
    wanted = "each photograph at its own camera"
    return Finding("ruins", "swap", found, wanted, "rename the two files to each other", (first, second))


def _stranger(capture, evidence, view, usual):
    """Returns the Findings about a photograph that does not fit those beside it."""
    counts = [
        0 if other == view else len(features.match(evidence.found[view], evidence.found[other]))
        for other in range(len(capture.frames))
    ]
    others = np.argsort(counts, kind="stable")[::-1][: evidence.near.shape[1]]  # by what they show alone
    sure, share = _of_circles(evidence, [(view, others)])
    if sure >= _CIRCLES and share > _CLOSED:
        return []  # it fits elsewhere: what is beside it is too far off, or looks another way
    frame = capture.frames[view]
    change = f"{frame.name} in {capture.source}: correct its pose or its file, or remove it"
    if sure >= _CIRCLES:
        found = f"{frame.image} does not show what its camera sees ({percent(share)} of {sure} sure matches fit)"
        severity = "ruins" if usual > _TRUSTED else "note"
        return [Finding(severity, "pose", found, "nearly all", change, (view,))]
    found = f"{frame.image} shows nothing that is recognised in the views beside it"
    return [Finding("note", "pose", found, "overlap", change, (view,))]


def _judge_all(capture, evidence):
    """Returns Findings where hardly any match fits: because poses are wrong, or views too far apart?"""
    sure, share = _of_circles(evidence, list(enumerate(evidence.near)))
    if sure < _CIRCLES:
        found = f"{capture.source}: the photographs have too little in common to judge the poses by"
        change = "nothing, or take more photographs between these"
        return [Finding("note", "overlap", found, "overlap", change)]
    if share > _CLOSED:
        return []
    severity = "ruins" if share < _NONE else "note"
    found = f"{capture.source}: {percent(share)} of {sure} sure matches between photographs fit the poses"
    change = "the poses or the lens: wrong in a way that no turn of axes mends, so compute them anew"
    return [Finding(severity, "pose", found, "nearly all", change)]


def _of_circles(evidence, groups):
    """Returns how many matches are sure among (view, others) of each group, and the share that fits."""
    closed = [consistency.circles(evidence.found, evidence.points, *group) for group in groups]
    off = [consistency.errors(part, evidence.poses, evidence.scale) for part in closed if part is not None]
    off = np.concatenate([*off, np.zeros(0)])
    return len(off), float((off < consistency.NEAR).mean()) if len(off) else 0.0
