"""Camera paths between the cameras of a dataset, and the choice of one that does not leave them. numpy on the host."""

import re
from collections.abc import Sequence
from typing import NamedTuple

import jax
import numpy as np
from jax import Array
from jaxtyping import Float, Int

from jaxnerf.core import poses as core_poses
from jaxnerf.core.poses import spread_directions
from jaxnerf.data.geometry.poses import gaze_center, look_one_way, up_of

# Six cameras that are placed around an object by hand are nowhere farther apart. Halfway between two cameras, the
# circle through them is then 16 % of its radius outside the line between them, and 33 degrees from each.
MAX_GAP = np.radians(65.0)
_MIN_ARC = np.radians(10.0)
_STEEP = np.radians(75.0)  # cameras above this elevation have no definite azimuth
_BANDWIDTH = np.radians(20.0)  # cameras within about this angle of a frame determine its elevation and distance
_ARC_PART = 0.9  # of the covered azimuth
_LIFT = 0.5  # how far an arc rises and descends, in standard deviations of the cameras' elevation
_DIRECTIONS = 2048  # in which the hull of the cameras is bounded
_FRAMES = {"turntable": 48, "arc": 96, "spiral": 120, "ellipse": 120}
KINDS = (*_FRAMES, "interpolate", "still")

_look_at = jax.jit(jax.vmap(core_poses.look_at, in_axes=(0, 0, None)))
_mean_pose = jax.jit(core_poses.mean_pose)
_llff_spiral = jax.jit(core_poses.spiral, static_argnums=0)
_MOST_FRAMES = 240  # unless more are asked for
_interpolate = jax.jit(core_poses.interpolate, static_argnames=("num_frames", "closed"))


class Coverage(NamedTuple):
    """The positions of cameras around the point that they look at, angles in radians.

    Attributes:
        center: [3] `gaze_center`.
        up: [3] `up_of`, or as given.
        azimuth: [V] around up, from any fixed direction.
        elevation: [V] above the plane through the center that is perpendicular to up.
        distance: [V] from the center, world units.
        aim: [V, 3] the point of each camera's axis that is nearest to the center.
        gap: the largest angle of azimuth without a camera.
        arc: the first and the last azimuth of the most cameras without a gap above MAX_GAP between them; a whole
            turn apart if there is no such gap at all.
    """

    center: Float[np.ndarray, "3"]
    up: Float[np.ndarray, "3"]
    azimuth: Float[np.ndarray, " V"]
    elevation: Float[np.ndarray, " V"]
    distance: Float[np.ndarray, " V"]
    aim: Float[np.ndarray, "V 3"]
    gap: float
    arc: tuple[float, float]


def coverage(poses: Float[Array | np.ndarray, "V 3 4"], up: Float[np.ndarray, "3"] | None = None) -> Coverage:
    """Computes the Coverage of cameras. Those nearly above or below the center close no gap.

    Args:
        poses: of the cameras.
        up: unit vector; None: `up_of`.
    """
    poses = np.asarray(poses, np.float64)
    center, up = gaze_center(poses), up_of(poses) if up is None else up
    right, ahead = level_axes(up)
    offset = poses[:, :, 3] - center
    distance = np.linalg.norm(offset, axis=1)
    elevation = np.arcsin(np.clip(offset @ up / np.maximum(distance, 1e-30), -1, 1))
    azimuth = np.arctan2(offset @ ahead, offset @ right)
    axes = poses[:, :, 2]
    aim = poses[:, :, 3] - (offset * axes).sum(axis=1, keepdims=True) * axes
    turns = np.sort(azimuth[np.abs(elevation) < _STEEP])
    if not len(turns):
        return Coverage(center, up, azimuth, elevation, distance, aim, 2 * np.pi, (0.0, 0.0))
    gaps = np.diff(np.append(turns, turns[0] + 2 * np.pi))
    breaks = np.flatnonzero(gaps > MAX_GAP)
    if not len(breaks):
        arc = turns[0], turns[0] + 2 * np.pi
    else:  # the run of cameras after each break, up to the next one
        first = breaks + 1
        counts = np.diff(np.append(first, first[0] + len(turns)))
        start = first[counts.argmax()]
        around = np.concatenate([turns, turns + 2 * np.pi])
        arc = around[start], around[start + counts.max() - 1]
    return Coverage(center, up, azimuth, elevation, distance, aim, float(gaps.max()), (float(arc[0]), float(arc[1])))


def default_kind(
    poses: Float[Array | np.ndarray, "V 3 4"], up: Float[np.ndarray, "3"] | None = None
) -> tuple[str, str]:
    """Selects the kind of path that stays where cameras are.

    Args:
        poses: of the cameras.
        up: unit vector; None: `up_of`.

    Returns:
        The kind: "turntable" only where the cameras surround what they look at, "arc" where they look at it from
        one side, "spiral" where all look one way, else "interpolate"; and the reason, which continues "as".

    Raises:
        ValueError: if there are fewer than two different cameras.
    """
    poses = np.asarray(poses, np.float64)
    check_kind("auto", poses)
    if _in_one_place(poses):
        return "interpolate", f"all {len(poses)} cameras are at one position"
    if look_one_way(poses):
        return "spiral", f"all {len(poses)} cameras look one way"
    cover = coverage(poses, up)
    inwards = (((poses[:, :, 3] - cover.center) * poses[:, :, 2]).sum(axis=1) > 0).mean()
    if inwards < 0.9:
        return "interpolate", f"only {inwards:.0%} of the {len(poses)} cameras look at a common point"
    gap, arc = np.degrees(cover.gap), np.degrees(cover.arc[1] - cover.arc[0])
    if cover.gap <= MAX_GAP:
        return "turntable", f"the cameras surround what they look at, with gaps of at most {gap:.0f} degrees of azimuth"
    if arc < np.degrees(_MIN_ARC):
        return "interpolate", f"no cameras are in a row around what they look at; the largest gap is {gap:.0f} degrees"
    return "arc", f"the cameras cover only {arc:.0f} of 360 degrees of azimuth without a large gap"


def check_kind(kind: str, poses: Float[np.ndarray, "V 3 4"]) -> None:
    """Checks that cameras define a path of a kind; "auto" needs what any path needs.

    Raises:
        ValueError: says what the cameras lack, and what to select instead.
    """

    def need(condition, found, expected, instead):
        if not condition:
            raise ValueError(f"path {kind!r} through {len(poses)} views: {found}, expected {expected}; {instead}")

    file, through = "give the poses of the path in a file, --path=FILE.json", "select --path=interpolate"
    need(len(poses) > 1, "there is one camera", "two or more", file)
    if kind in ("auto", "interpolate"):
        same = np.ptp(poses, axis=0).max() <= 1e-6 * (1 + np.abs(poses).max())
        need(not same, "all cameras have the same pose", "different poses", file)
        return
    need(not _in_one_place(poses), "all cameras are at one position", "different positions", through)
    if kind == "spiral":
        return
    axes = poses[:, :, 2]
    spread = 1 - np.linalg.eigvalsh(axes.T @ axes / len(axes))[-1]  # mean square of the sine to their common line
    need(spread > 1e-4, "the cameras' axes are parallel", "axes that meet", "select --path=spiral or interpolate")
    if kind == "turntable":
        _, size, _ = np.linalg.svd(poses[:, :, 3] - poses[:, :, 3].mean(axis=0))
        need(size[1] > 1e-3 * size[0], "all cameras are on a line", "cameras around an object", through)
    if kind == "arc":
        first, last = coverage(poses).arc
        found = f"the cameras cover {np.degrees(last - first):.0f} degrees of azimuth"
        need(last - first > np.radians(1), found, "at least 1", through)


def make_poses(
    kind: str,
    poses: Float[Array | np.ndarray, "V 3 4"],
    num_frames: int | None = None,
    up: Float[np.ndarray, "3"] | None = None,
) -> Float[np.ndarray, "N 3 4"]:
    """Makes the poses of a path, with a level horizon.

    "turntable" is one turn around the point that the cameras look at, and "arc" a swing through 90 % of the azimuth
    that they cover. On both, elevation, distance and aim at each azimuth are means over the cameras nearby. "spiral" is
    the path of the LLFF code (Mildenhall et al. 2019) around the mean camera, and "ellipse" follows the spread of
    the cameras in the horizontal plane. Both are scaled down, if need be, until they leave the convex hull of the
    cameras' positions by no more than half the median distance between neighbours.

    Args:
        kind: one of KINDS but "interpolate", see `poses_through`, and "still".
        poses: of the cameras.
        num_frames: N; None: 48 for a turntable, 96 for an arc, 120 for a spiral or ellipse.
        up: unit vector; None: `up_of`. A spiral keeps the mean camera's.

    Raises:
        ValueError: if the cameras define no such path, see `check_kind`.
    """
    poses = np.asarray(poses, np.float64)
    check_kind(kind, poses)
    if kind == "spiral":
        return np.asarray(_spiral(poses, num_frames or _FRAMES[kind]))
    make = {"turntable": _turntable, "arc": _arc, "ellipse": _ellipse}[kind]
    return np.asarray(make(poses, num_frames or _FRAMES[kind], up_of(poses) if up is None else up))


def poses_through(
    poses: Float[Array | np.ndarray, "V 3 4"], num_frames: int | None = None, *, closed: bool = False
) -> tuple[Float[np.ndarray, "N 3 4"], Float[np.ndarray, " N"]]:
    """Interpolates between cameras in their order, see `core.poses.interpolate`.

    Args:
        poses: of the cameras.
        num_frames: N; None: 6 from camera to camera, but at most 240, for which people wait.
        closed: whether the path returns from the last camera to the first.

    Returns:
        Poses, and times: k at camera k, k + 0.5 halfway to the next.

    Raises:
        ValueError: if there are fewer than two different cameras.
    """
    count = len(poses)
    check_kind("interpolate", np.asarray(poses, np.float64))
    num_frames = num_frames or min(6 * count if closed else 6 * (count - 1) + 1, _MOST_FRAMES)
    times = core_poses.path_times(num_frames, count, closed=closed)
    return np.asarray(_interpolate(num_frames, poses=np.asarray(poses), closed=closed)), np.asarray(times)


def natural_order(names: Sequence[str]) -> Int[np.ndarray, " V"]:
    """Returns the indices that sort names with their numbers by value: img_2 before img_10."""
    return np.array(sorted(range(len(names)), key=lambda index: natural_key(names[index])), int)


def natural_key(name: str) -> list[int | str]:
    """Returns the key that sorts names with their numbers by value, see `natural_order`."""
    return [int(part) if part.isdecimal() else part for part in re.split(r"(\d+)", name)]


def _turntable(poses, num_frames, up):
    cover = coverage(poses, up)
    return _look_at(*_eyes_and_aims(cover, 2 * np.pi * np.arange(num_frames) / num_frames), cover.up)


def _arc(poses, num_frames, up):
    cover = coverage(poses, up)
    first, last = cover.arc
    angle = 2 * np.pi * np.arange(num_frames) / num_frames
    azimuth = (first + last) / 2 + _ARC_PART * (last - first) / 2 * np.sin(angle)
    return _look_at(*_eyes_and_aims(cover, azimuth, _LIFT * np.cos(angle)), cover.up)


def _eyes_and_aims(cover, azimuth, lift=0.0):
    """Returns positions [N, 3] at azimuths [N], at the cameras' elevation and distance there, and what they look at.

    Each looks at what the cameras there look at, in the mean, so that it frames the scene as they do.

    The elevation is lift standard deviations above the weighted mean. Weights are those of von Mises.
    """
    closeness = (np.cos(azimuth[:, None] - cover.azimuth) - 1) / _BANDWIDTH**2
    weights = np.exp(closeness - closeness.max(axis=1, keepdims=True)) * np.cos(cover.elevation)
    weights /= weights.sum(axis=1, keepdims=True)
    mean = weights @ cover.elevation
    spread = np.sqrt(np.maximum(weights @ cover.elevation**2 - mean**2, 0))
    elevation = mean + lift * spread
    distance = weights @ cover.distance
    right, ahead = level_axes(cover.up)
    level = np.cos(azimuth)[:, None] * right + np.sin(azimuth)[:, None] * ahead
    away = np.cos(elevation)[:, None] * level + np.sin(elevation)[:, None] * cover.up
    return cover.center + distance[:, None] * away, weights @ cover.aim


def forward_frame(
    poses: Float[np.ndarray, "V 3 4"],
) -> tuple[Float[np.ndarray, "3 4"], Float[np.ndarray, "3"], float]:
    """Returns the mean of cameras that look one way, how far they spread along its axes, and the depth they look at.

    The spread is the 90th percentile of the distances. The depth is that of the point that the cameras look at, or
    larger, so that a camera which looks at it from within the spread turns no more than the cameras.
    """
    pose = np.float64(_mean_pose(poses))
    radii = np.percentile(np.abs((poses[:, :, 3] - pose[:, 3]) @ pose[:, :3]), 90, axis=0)
    turns = np.arccos(np.clip(poses[:, :, 2] @ pose[:, 2], -1, 1))
    largest = max(np.tan(np.percentile(turns, 90)), 1e-3)  # 0 for parallel cameras
    focus = max((pose[:, 3] - gaze_center(poses)) @ pose[:, 2], radii[:2].max() / largest)
    return pose, radii, float(focus)


def _spiral(poses, num_frames):
    pose, radii, focus = forward_frame(poses)
    eyes = np.asarray(_llff_spiral(num_frames, pose=pose, radii=radii, focus=focus))[:, :, 3]
    radii = radii * _scale_into_hull(eyes, pose[:, 3], poses[:, :, 3])
    return _llff_spiral(num_frames, pose=pose, radii=radii, focus=focus)


def _ellipse(poses, num_frames, up):
    positions = poses[:, :, 3]
    middle = positions.mean(axis=0)
    across = (positions - middle) @ (np.eye(3) - np.outer(up, up))
    _, spread, axes = np.linalg.svd(across, full_matrices=False)
    # Points all around an ellipse have a variance of half its squared half axis.
    axes = axes[:2] * (spread[:2] * np.sqrt(2 / len(positions)))[:, None]
    angle = 2 * np.pi * np.arange(num_frames)[:, None] / num_frames
    around = np.cos(angle) * axes[0] + np.sin(angle) * axes[1]
    eyes = middle + _scale_into_hull(middle + around, middle, positions) * around
    return _look_at(eyes, np.broadcast_to(gaze_center(poses), eyes.shape), up)


def _scale_into_hull(eyes, middle, positions):
    """Returns the largest scale <= 1 about a point of the hull at which all eyes are inside, see `make_poses`.

    The hull is bounded in many directions, so that it may be a plane or a line.
    """
    directions = np.array(spread_directions(_DIRECTIONS))
    between = np.linalg.norm(positions[:, None] - positions, axis=-1) + np.diag(np.full(len(positions), np.inf))
    limit = ((positions - middle) @ directions.T).max(axis=0) + np.median(between.min(axis=1)) / 2
    reach = ((eyes - middle) @ directions.T).max(axis=0)
    return min(1.0, np.divide(limit, reach, where=reach > 1e-9 * reach.max(), out=np.ones_like(reach)).min())


def level_axes(up: Float[np.ndarray, "3"]) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3"]]:
    """Returns two unit vectors perpendicular to up and to each other, from which azimuth is counted."""
    right = np.cross(up, [1.0, 0.1, 0.0] if abs(up[0]) < 0.9 else [0.0, 1.0, 0.1])
    right /= np.linalg.norm(right)
    return right, np.cross(up, right)


def _in_one_place(poses):
    positions = poses[:, :, 3]
    return np.ptp(positions, axis=0).max() <= 1e-6 * (1 + np.abs(positions).max())
