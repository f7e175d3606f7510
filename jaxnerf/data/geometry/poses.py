"""Checks of camera poses, and the point and the direction that a set of poses defines. numpy on the host."""

import math
from typing import Any

import numpy as np
from jax import Array
from jaxtyping import Bool, Float, Int

AXES = ("+x", "-x", "+y", "-y", "+z", "-z")
_ROUNDED = 2e-3  # a matrix of three decimals is off by at most 2 sqrt(3) 0.0005; one scaled by 1.001 by 0.002


def check_pose(matrix: Any, *, source: Any, shape: tuple[int, int] = (4, 4)) -> Float[np.ndarray, "3 4"]:
    """Returns a camera's rotation and position, float64, after checking that they are a rigid motion.

    Args:
        matrix: camera -> world, lists or an array, in the axes of `Camera`: x right, y up, looking along -z.
            Readers of formats with other axes convert them first.
        source: file and frame, for the message.
        shape: (4, 4), or (3, 4) if the format has no last row.

    Raises:
        ValueError: if it is not a matrix of finite numbers of that shape, if its rotation scales, shears or
            mirrors by more than three decimals explain, or if its fourth row is not 0 0 0 1. Where it is off by
            more than 1e-3, but not by more than that, the nearest rotation is returned.
    """
    try:
        pose = np.asarray(matrix)
    except (ValueError, OverflowError):
        raise _wrong(source, "rows of unequal length", f"{shape} numbers; export it again") from None
    if pose.shape != shape:
        raise _wrong(source, f"shape {pose.shape}", f"{shape}; export it again")
    if pose.dtype.kind not in "iuf":
        raise _wrong(source, "entries that are not numbers", f"{shape} numbers; export it again")
    pose = pose.astype(np.float64)
    finite = np.abs(pose) < 3.4e38  # in float32, which Views hold
    if not finite.all():
        bad = np.argwhere(~finite)[0].tolist()
        raise _wrong(source, f"{pose[tuple(bad)]} at {bad}", "finite numbers; export it again or remove it")
    if shape == (4, 4) and np.abs(pose[3] - [0, 0, 0, 1]).max() > 1e-3:
        raise _wrong(source, f"last row {pose[3].tolist()}", "0 0 0 1; transpose it if it is column-major")
    return np.column_stack([_checked_rotation(pose[:3, :3], source), pose[:3, 3]])


def _checked_rotation(rotation, source, tolerance=1e-3):
    # Most files have about seven digits, so rounding errors are near 1e-7, far below the tolerance.
    with np.errstate(over="ignore", invalid="ignore"):
        off = np.abs(rotation.T @ rotation - np.eye(3)).max()
        lengths = ", ".join(f"{length:.4g}" for length in np.linalg.norm(rotation, axis=0))
    if not off < _ROUNDED:  # also True if the product overflowed to NaN
        found = f"no rotation in its first three columns (lengths {lengths}, off by {off:.2g})"
        change = "divide out its scale or shear, or export more digits"
        raise _wrong(source, found, f"unit columns at right angles; {change}")
    if np.linalg.det(rotation) < 0:
        raise _wrong(source, "determinant -1, so it mirrors", "a rotation, determinant 1; negate one axis")
    if off <= tolerance:
        return rotation
    left, _, right = np.linalg.svd(rotation)
    return left @ right


def _wrong(source, found, expected):
    return ValueError(f"{source}: the camera-to-world matrix has {found}, expected {expected}")


def gaze_center(to_world: Float[Array | np.ndarray, "V 3 4"]) -> Float[np.ndarray, "3"]:
    """Returns the point with the least mean squared distance from the cameras' axes, float64."""
    poses = np.asarray(to_world, np.float64)
    eyes, axes = poses[:, :, 3], poses[:, :, 2]
    across = np.eye(3) - axes[:, :, None] * axes[:, None, :]  # projections onto the planes normal to the axes
    return np.linalg.lstsq(across.sum(0), (across @ eyes[..., None]).sum(0)[:, 0], rcond=None)[0]


def axis_of(name: str) -> Float[np.ndarray, "3"]:
    """Returns the unit vector of one of the AXES, which a user gives as up.

    Raises:
        ValueError: if it is none of them.
    """
    if name not in AXES:
        raise ValueError(f"up is {name!r}, expected one of {', '.join(AXES)}; correct --up")
    return (1 if name[0] == "+" else -1) * np.eye(3)["xyz".index(name[1])]


def up_of(poses: Float[np.ndarray, "V 3 4"]) -> Float[np.ndarray, "3"]:
    """Returns the unit vector that is up for a set of cameras.

    Cameras around a scene usually have a level horizon, so up is normal to their x axes, or to the y axes of images
    that are stored sideways. If all look in one direction, these axes span no plane; then up is the mean of their y
    axes, which tilts with their pitch.
    """
    mean = poses[:, :, 1].mean(axis=0)
    length = np.linalg.norm(mean)
    mean = mean / length if length > 1e-6 else np.array([0.0, 0.0, 1.0])
    across, flatness = _normal(poses[:, :, 0])
    turned = sideways(poses)
    if turned.any():
        up = _normal(_level_axes(poses, turned))[0]
        return up * _sense(poses, turned, up)
    if flatness >= 0.25:
        return mean
    return across if across @ mean > 0 else -across


def sideways(poses: Float[np.ndarray, "V 3 4"]) -> Bool[np.ndarray, " V"]:
    """Returns which cameras' images are stored sideways: with y axes that are level in place of x axes.

    The plane of the level axes is searched from the main directions of all x axes and of all y axes: in turn, each
    camera's axis that is closer to it is level, and the plane is that of these axes. Without a plane, or if the x axes
    are in one, no camera is sideways.
    """
    upright = _normal(poses[:, :, 0])[1]
    best, turned = np.inf, np.zeros(len(poses), bool)
    if upright < 0.01:
        return turned
    for normal in np.concatenate([np.linalg.eigh(np.cov(poses[:, :, axis].T))[1].T for axis in (0, 1)]):
        for _ in range(8):
            chosen = np.abs(poses[:, :, 1] @ normal) < np.abs(poses[:, :, 0] @ normal)
            normal, flatness = _normal(_level_axes(poses, chosen))
        # The axes of all cameras that look one way are in the plane of the image, too.
        upright_axes = np.abs(_level_axes(poses, ~chosen) @ normal)
        if flatness < best and np.median(upright_axes) > 0.3:
            best, turned = flatness, chosen
    return turned if best < min(0.25, 0.3 * upright) else np.zeros(len(poses), bool)


def _level_axes(poses, turned):
    return np.where(turned[:, None], poses[:, :, 1], poses[:, :, 0])


def _normal(axes):
    """Returns the normal of the plane of axes, and how flat they are: 0 in a plane, inf if they span none."""
    spread, normals = np.linalg.eigh(np.einsum("ni,nj->ij", axes, axes) / len(axes))
    # The spreads sum to 1; cameras on an arc of +-25 degrees have a second spread of 0.05.
    return normals[:, 0], spread[0] / spread[1] if spread[1] > 0.05 else np.inf


def _sense(poses, turned, up):
    """Returns 1 or -1: by the upright images, or else as cameras look down on a scene, or as telephones turn images."""
    upright = (poses[~turned, :, 1] @ up).sum()
    if turned.mean() < 0.8 and abs(upright) > 0.1 * len(poses):
        return np.sign(upright)
    pitch = (poses[:, :, 2] @ up).mean()  # the back of a camera that looks down points up
    if abs(pitch) > 0.1:
        return np.sign(pitch)
    return -np.sign((poses[turned, :, 0] @ up).sum()) or 1.0


def look_one_way(poses: Float[np.ndarray, "V 3 4"], *, cosine: float = 0.85) -> bool:
    """Returns whether all cameras, two or more, look in one direction, so that NDC contain what they see.

    Args:
        poses: of the cameras.
        cosine: of the largest angle between an axis and the mean axis. In LLFF's datasets it is 20 degrees.
    """
    backs = poses[:, :, 2]
    mean = backs.mean(axis=0)
    return len(backs) > 1 and bool((backs @ mean > cosine * np.linalg.norm(mean)).all())


def travel(poses: Float[np.ndarray, "V 3 4"]) -> bool:
    """Returns whether cameras travel, as on a walk: fewer than half look at the point that is nearest to their axes.

    A camera looks at it if it is within 45 degrees of the axis, as in most images, or stands there. All do in a capture
    of an object, or of a room around one.
    """
    towards = gaze_center(poses) - poses[:, :, 3]
    ahead = -(towards * poses[:, :, 2]).sum(axis=1)
    return bool((ahead >= math.sqrt(0.5) * np.linalg.norm(towards, axis=1)).mean() < 0.5)


def neighbours(
    poses: Float[np.ndarray, "V 3 4"], *, count: int = 5, of: Int[np.ndarray, " N"] | None = None
) -> Int[np.ndarray, "N K"]:
    """Returns the indices of the views most similar to each view, or to each of the views `of`, nearest first.

    The measure is the angle of the rotation between two views plus half their distance, in units of the
    median distance from the median position. Neither changes if axes are swapped or negated in all poses.
    """
    turn, eyes = poses[:, :, :3], poses[:, :, 3]
    rows = np.arange(len(poses)) if of is None else of
    cosine = (np.einsum("aij,bij->ab", turn[rows], turn) - 1) / 2
    distance = np.linalg.norm(eyes[rows, None] - eyes, axis=-1)
    spread = np.median(np.linalg.norm(eyes - np.median(eyes, axis=0), axis=-1))
    cost = np.arccos(np.clip(cosine, -1, 1)) + 0.5 * distance / max(spread, 1e-12)
    cost[np.arange(len(rows)), rows] = np.inf
    return np.argsort(cost, axis=1, kind="stable")[:, : min(count, len(poses) - 1)]
