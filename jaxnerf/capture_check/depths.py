"""Whether rays begin before and end behind what photographs show, and how much of it is seen from where."""

import numpy as np

from jaxnerf.capture_check.findings import Finding
from jaxnerf.data.geometry.bounds import with_bounds
from jaxnerf.data.geometry.poses import gaze_center
from jaxnerf.data.geometry.world import looks_forward, poses_of

_ENOUGH = 30  # places
_INSIDE = 0.5  # share of the places between near and far, below which training has no chance
_CUT = 0.9  # below which something is cut off
_LOOSE = 20.0  # times the farthest place's depth, or the nearest's in near: samples are spread thin
_BLENDER = (2.0, 6.0)  # what data.near and data.far are for Blender where they are 0
_FIELDS = "config.data.near, config.data.far"


def ranges(capture, near, far):
    """Returns where rays of each view begin and end [V, 2], world units along the axis, and who says so."""
    if capture.format == "blender":
        bounds, stated = np.tile(_BLENDER, (len(capture.frames), 1)), _FIELDS
    else:
        stated = None
        if all(frame.bounds is not None for frame in capture.frames):
            stated = f"the last two columns of {capture.source}"
        bounds = np.array([frame.bounds for frame in with_bounds(capture).frames])
    for column, given in enumerate((near, far)):
        if given is not None:
            bounds[:, column], stated = given, _FIELDS
    return bounds, stated


def view_depths(evidence, places, tracks):
    """Returns the depths [N] of places along the axis of the first view of their tracks."""
    poses = evidence.poses[tracks.views[:, 0]]
    return np.einsum("ni,ni->n", poses[:, :, 3] - places, poses[:, :, 2])


def judge_bounds(capture, evidence, places, tracks, bounds, stated):
    """Returns Findings about bounds [V, 2]; stated says where they are, None where they are computed."""
    if len(places) < _ENOUGH:
        return []
    depth = view_depths(evidence, places, tracks)
    near, far = bounds[tracks.views[:, 0]].T
    inside = float(((depth >= near) & (depth <= far)).mean())
    low, high = np.percentile(depth, [2, 98])
    loose = np.median(far) > _LOOSE * high or np.median(near) < low / _LOOSE
    if inside >= _CUT and not (loose and stated):
        return []
    found = (
        f"near {np.median(near):.4g} and far {np.median(far):.4g} hold {100 * inside:.0f} % of what the "
        f"photographs show, which lies {low:.4g} to {high:.4g} from the cameras"
    )
    ratio = np.median(depth) / np.sqrt(np.median(near) * np.median(far))
    change = f"{stated or _FIELDS}: to about {0.8 * low:.3g} and {1.25 * high:.3g}"
    if inside < _INSIDE and not 0.1 < ratio < 10:
        change += f" (they are in other units: times {ratio:.2g})"
    severity = "ruins" if inside < _INSIDE else "note"
    return [Finding(severity, "bounds", found, "nearly all, and not much more room", change)]


def judge_box(capture, places):
    """Returns Findings about the box outside of which the format says there is nothing."""
    if capture.box is None or len(places) < _ENOUGH:
        return []
    lower, upper = capture.box
    inside = float(((places >= lower) & (places <= upper)).all(axis=1).mean())
    if inside >= _INSIDE:
        return []
    found = f"{capture.source}: its box holds {100 * inside:.0f} % of the places that the photographs show"
    change = "aabb_scale: a power of two that is larger, or the unit of the poses"
    return [Finding("ruins", "bounds", found, "most of them", change)]


def view_direction(capture):
    """Returns "inwards", "outwards", "forward" or "along a path": how the cameras of a capture look."""
    poses = poses_of(capture)
    backs, eyes = poses[:, :, 2], poses[:, :, 3]
    if looks_forward(capture):
        return "forward"
    toward = ((eyes - gaze_center(poses)) * backs).sum(axis=1) > 0
    if toward.mean() > 0.9:
        return "inwards"
    return "outwards" if toward.mean() < 0.1 else "along a path"


def up_axis(poses):
    """Returns (the name of the world's axis nearest to the cameras' mean up, degrees between the two)."""
    up = poses[:, :, 1].sum(axis=0)
    up = up / max(np.linalg.norm(up), 1e-12)
    axis = int(np.abs(up).argmax())
    angle = np.degrees(np.arccos(np.clip(abs(up[axis]), 0, 1)))
    return f"{'-' if up[axis] < 0 else '+'}{'xyz'[axis]}", float(angle)


def arcs(poses):
    """Returns degrees (around the mean up, lowest, highest) of the places that cameras stand in.

    Around counts the circle but for its widest gap; low and high are above the plane across up, all as seen
    from the point that the cameras look at.
    """
    up = poses[:, :, 1].sum(axis=0)
    up = up / max(np.linalg.norm(up), 1e-12)
    away = poses[:, :, 3] - gaze_center(poses)
    away /= np.maximum(np.linalg.norm(away, axis=1, keepdims=True), 1e-12)
    height = np.degrees(np.arcsin(np.clip(away @ up, -1, 1)))
    first = np.cross(up, np.eye(3)[np.abs(up).argmin()])
    angle = np.sort(np.degrees(np.arctan2(away @ np.cross(up, first), away @ first)))
    gap = np.diff(np.append(angle, angle[0] + 360)).max()
    return 360 - float(gap), float(height.min()), float(height.max())
