"""Judges ranges along rays: near and far, the box of the scene, and the points of the dataset's own model."""

import jax
import numpy as np
from jaxtyping import Float

from jaxnerf.core.cameras import project
from jaxnerf.data.geometry.bounds import depths, with_bounds
from jaxnerf.data.readers.base import Capture
from jaxnerf.tools.capture_check.findings import Finding, named, percent
from jaxnerf.tools.capture_check.tracks import Tracks

_MIN_POINTS = 30  # to judge ranges
_INSIDE = 0.5  # fraction of the points between near and far, below which training fails
_CUT = 0.9  # the same, below which a part of the scene is cut off
_LOOSE = 20.0  # times the farthest depth, or the nearest divided by it: samples are spread thin
_FIELDS = "config.data.near, config.data.far"
_MODEL_ERROR = 0.01  # of the longer side; a good model has a tenth of that
_BEHIND = 0.02  # fraction of a model's points


def ranges(capture: Capture, near: float | None, far: float | None) -> tuple[Float[np.ndarray, "V 2"], str | None]:
    """Returns (near, far) of each view, world units along the axis, and where they are stated.

    The second value is None if near and far are computed from the poses and points.
    """
    stated = None
    if all(frame.bounds is not None for frame in capture.frames):
        stated = capture.files.bounds.format(source=capture.source)
    elif capture.bounds and not capture.bounds_reason:
        stated = _FIELDS
    bounds = np.array([frame.bounds for frame in with_bounds(capture).frames])
    for column, value in enumerate((near, far)):
        if value is not None:
            bounds[:, column], stated = value, _FIELDS
    return bounds, stated


def view_depths(
    poses: Float[np.ndarray, "V 3 4"], points: Float[np.ndarray, "N 3"], tracks: Tracks
) -> Float[np.ndarray, " N"]:
    """Returns the depth of each point along the axis of the first view of its track."""
    pose = poses[tracks.views[:, 0]]
    return np.einsum("ni,ni->n", pose[:, :, 3] - points, pose[:, :, 2])


def judge_bounds(depth: Float[np.ndarray, " N"], bounds: Float[np.ndarray, "N 2"], stated: str | None) -> list[Finding]:
    """Returns Findings about the bounds of the view in which each depth was measured; see `ranges`."""
    if len(depth) < _MIN_POINTS:
        return []
    near, far = bounds.T
    inside = float(((depth >= near) & (depth <= far)).mean())
    low, high = np.percentile(depth, [2, 98])
    loose = np.median(far) > _LOOSE * high or np.median(near) < low / _LOOSE
    if inside >= _CUT and not (loose and stated):
        return []
    found = (
        f"near {np.median(near):.4g} and far {np.median(far):.4g} contain {percent(inside)} of the points that "
        f"the images show, at depths of {low:.4g} to {high:.4g}"
    )
    ratio = np.median(depth) / np.sqrt(np.median(near) * np.median(far))
    change = f"{stated or _FIELDS}: to about {0.8 * low:.3g} and {1.25 * high:.3g}"
    if inside < _INSIDE and not 0.1 < ratio < 10:
        change += f" (they are in other units: times {ratio:.2g})"
    severity = "error" if inside < _INSIDE else "warning"
    return [Finding(severity, "bounds", found, "nearly all, without much space around", change)]


def judge_box(capture: Capture, points: Float[np.ndarray, "N 3"]) -> list[Finding]:
    """Returns Findings about the box outside which the format states that there is no matter."""
    if capture.box is None or len(points) < _MIN_POINTS:
        return []
    lower, upper = capture.box
    inside = float(((points >= lower) & (points <= upper)).all(axis=1).mean())
    if inside >= _INSIDE:
        return []
    found = f"{capture.source}: its box contains {percent(inside)} of the points that the images show"
    change = "aabb_scale: a larger power of two; or the unit of the poses"
    return [Finding("error", "bounds", found, "most of them", change)]


def judge_model_points(capture: Capture) -> list[Finding]:
    """Returns Findings about the points of the dataset's own model, projected into its cameras."""
    if capture.points is None or all(frame.seen is None or not len(frame.seen) for frame in capture.frames):
        return []
    behind, off = np.array([_projected(frame, capture.points) for frame in capture.frames]).T
    findings = []
    if np.nanmean(behind) > _BEHIND:
        found = f"{capture.source}: {percent(np.nanmean(behind))} of its points lie behind cameras that show them"
        change = "the poses: export the model again, poses and points together"
        findings.append(Finding("error", "points", found, "none", change))
    bad = np.flatnonzero(off > _MODEL_ERROR).tolist()
    if bad:
        error = percent(np.median(off[bad]), 1)
        found = f"{capture.source}: its points project {error} of the image size off in {named(capture, bad)}"
        change = "poses and lens: copy cameras, images and points of one model, or run COLMAP again"
        expected = f"less than {percent(_MODEL_ERROR)}"
        findings.append(Finding("error", "points", found, expected, change, tuple(bad)))
    return findings


def _projected(frame, points):
    """Returns the fraction of a frame's points behind it, and their median error as a fraction of its size."""
    if frame.seen is None or not len(frame.seen):
        return np.nan, np.nan
    seen = points[frame.seen]
    behind = float((depths(frame.camera, seen) <= 0).mean())
    padded = np.repeat(seen[:1], 1 << (len(seen) - 1).bit_length(), axis=0)  # few shapes to compile
    padded[: len(seen)] = seen
    at = np.asarray(jax.jit(project)(frame.camera, padded)[0])[: len(seen)]
    off = np.linalg.norm(at - frame.seen_at, axis=1)
    return behind, float(np.median(off)) / max(frame.camera.height or 1, frame.camera.width or 1)
