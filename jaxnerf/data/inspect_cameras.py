"""What is wrong with the cameras of a capture, judged by what its photographs show."""

from typing import NamedTuple

import jax
import numpy as np

from jaxnerf.core.cameras import project
from jaxnerf.data import consistency, tracks
from jaxnerf.data.bounds import depths
from jaxnerf.data.findings import Finding, axes_change, axes_name, focal_change
from jaxnerf.data.world import poses_of

_ENOUGH = 60  # tracks, to judge anything
_CLEARLY = 0.1  # share of tracks by which other axes must fit better, and a third more
_OFF = 0.07  # of the focal length, from where it is reported: lens and noise reach 0.02
_SURE = 5.0  # standard errors
_STRANGE = 0.35  # of the usual share of matches that fit: below, a photograph is not from its camera
_PARALLAX = np.deg2rad(1.5)  # between rays, for a place to have a depth
_OBSERVED = 0.01  # of the longer side: a model's points are off by a tenth of that


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
            f"{capture.source}: the poses are in {axes_name(other)}: {_percent(other.share)} of what the "
            f"photographs share fits then, {_percent(stated.share)} as they are"
        )
        wanted = "camera-to-world with x right, y up, looking along -z (as the format has it)"
        return [Finding("ruins", "axes", found, wanted, axes_change(capture.format, other))], mended
    return [], evidence


def judge_focal(capture, evidence):
    """Returns Findings about the focal length, and the Evidence with the one that fits."""
    if len(evidence.tracks.shown) < _ENOUGH:
        return [], evidence
    factor, gain, error = consistency.focal_factor(evidence.tracks, evidence.poses, evidence.scale)
    if abs(np.log(factor)) < np.log1p(_OFF) or gain < _SURE * error:
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
    if usual < 0.2 or len(evidence.tracks.shown) < _ENOUGH:
        found = f"{capture.source}: only {_percent(usual)} of what neighbouring photographs share fits"
        change = "the poses: they or the lens are wrong in a way that no turn of axes mends; compute them anew"
        return [Finding("ruins", "pose", found, "at least 20 %", change)] if matches.sum() > _ENOUGH else []
    strange = [view for view in views if share[view] < _STRANGE * usual]
    findings, left = [], list(strange)
    for first in strange:
        for second in strange:
            if not (first < second and first in left and second in left):
                continue
            mended = fits(first, second), fits(second, first)
            if all(good >= 8 and good > 0.6 * usual * every for good, every in mended):
                findings.append(_swapped(capture, first, second))
                left = [view for view in left if view not in (first, second)]
    return findings + [_stranger(capture, view, fit[view], matches[view]) for view in left]


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


def judge_points(capture):
    """Returns Findings about how a model's own points lie before its cameras."""
    if capture.points is None or all(frame.seen is None or not len(frame.seen) for frame in capture.frames):
        return []
    behind, off = np.array([_of_points(frame, capture.points) for frame in capture.frames]).T
    findings = []
    if np.nanmean(behind) > 0.02:
        found = f"{capture.source}: {_percent(np.nanmean(behind))} of its points lie behind cameras that see them"
        change = "the poses: export the model again, poses and points together"
        findings.append(Finding("ruins", "points", found, "none", change))
    bad = np.flatnonzero(off > _OBSERVED)
    if len(bad) and np.isfinite(off).any():
        named = ", ".join(capture.frames[index].name for index in bad[:5])
        more = f" and {len(bad) - 5} more" if len(bad) > 5 else ""
        found = f"{capture.source}: its points are {_percent(np.nanmedian(off[bad]), 1)} of the image off in {named}{more}"
        change = "poses and lens: copy cameras, images and points of one model, or run COLMAP again"
        wanted = f"less than {_percent(_OBSERVED)}"
        findings.append(Finding("ruins", "points", found, wanted, change, tuple(bad.tolist())))
    return findings


def _of_points(frame, points):
    """Returns the share of a frame's points behind it, and how far off they are, as a share of its size."""
    if frame.seen is None or not len(frame.seen):
        return np.nan, np.nan
    seen = points[frame.seen]
    behind = float((depths(frame.camera, seen) <= 0).mean())
    padded = np.repeat(seen[:1], 1 << (len(seen) - 1).bit_length(), axis=0)  # few shapes to compile
    padded[: len(seen)] = seen
    at = np.asarray(jax.jit(project)(frame.camera, padded)[0])[: len(seen)]
    off = np.linalg.norm(at - frame.seen_at, axis=1)
    return behind, float(np.median(off)) / max(frame.camera.height or 1, frame.camera.width or 1)


def _swapped(capture, first, second):
    one, two = capture.frames[first], capture.frames[second]
    found = f"{one.image} and {two.image} show what the other's camera sees"
    wanted = "each photograph at its own camera"
    return Finding("ruins", "swap", found, wanted, "rename the two files to each other", (first, second))


def _stranger(capture, view, fit, matches):
    frame = capture.frames[view]
    found = f"{frame.image} does not show what its camera sees ({fit} of {matches} matches fit)"
    change = f"{frame.name} in {capture.source}: correct its pose or its file, or remove it"
    few = matches < 20  # a photograph of something that no other shows, too dark, or blurred
    return Finding("note" if few else "ruins", "pose", found, "matches that fit its pose", change, (view,))


def _percent(share, digits=0):
    return f"{100 * share:.{digits}f} %"
