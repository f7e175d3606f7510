"""Checks of camera poses that every reader shares. numpy on the host."""

import numpy as np


def check_pose(matrix, *, source, shape=(4, 4)):
    """Returns a camera's rotation and position after checking that it is a rigid motion.

    Args:
        matrix: numbers in the given shape, lists or an array, camera -> world, in the axes of `Camera`: x
            right, y up, looking along -z. A reader of another convention turns its axes first.
        source: where it comes from, file and frame, for the message.
        shape: (4, 4), or (3, 4) where the format leaves out the last row.

    Returns:
        [3, 4] float64.

    Raises:
        ValueError: if it is not such a matrix of finite numbers, if its rotation part scales, shears or
            mirrors by more than 1e-3, or if a fourth row is not 0 0 0 1.
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
    finite = np.abs(pose) < 3.4e38  # in the float32 that it is going to be
    if not finite.all():
        bad = np.argwhere(~finite)[0].tolist()
        raise _wrong(source, f"{pose[tuple(bad)]} at {bad}", "finite numbers; export again or remove it")
    if shape == (4, 4) and np.abs(pose[3] - [0, 0, 0, 1]).max() > 1e-3:
        raise _wrong(source, f"last row {pose[3].tolist()}", "0 0 0 1; transpose it if it is column-major")
    _check_rotation(pose[:3, :3], source)
    return pose[:3]


def _check_rotation(rotation, source, tolerance=1e-3):
    # Files carry about seven digits, which leaves errors near 1e-7: off by 1e-3 is a mistake, not rounding.
    with np.errstate(over="ignore", invalid="ignore"):
        off = np.abs(rotation.T @ rotation - np.eye(3)).max()
        lengths = ", ".join(f"{length:.4g}" for length in np.linalg.norm(rotation, axis=0))
    if not off <= tolerance:  # also where the product overflowed to NaN
        found = f"no rotation in its first three columns (lengths {lengths}, off by {off:.2g})"
        raise _wrong(source, found, "unit columns at right angles; divide out its scale or shear")
    if np.linalg.det(rotation) < 0:
        raise _wrong(source, "determinant -1, so it mirrors", "a rotation, determinant 1; negate one axis")


def _wrong(source, found, wanted):
    return ValueError(f"{source}: the camera-to-world matrix has {found}, wanted {wanted}")


def gaze_center(to_world):
    """Returns the point [3] nearest to the axes of cameras [V, 3, 4], in the mean of squares; float64."""
    poses = np.asarray(to_world, np.float64)
    eyes, axes = poses[:, :, 3], poses[:, :, 2]
    across = np.eye(3) - axes[:, :, None] * axes[:, None, :]  # projections onto the planes across the axes
    return np.linalg.lstsq(across.sum(0), (across @ eyes[..., None]).sum(0)[:, 0], rcond=None)[0]


def up_of(poses):
    """Returns the unit vector [3] that is up for cameras [V, 3, 4].

    Who walks around a scene holds the horizon level: up is across all the cameras' x axes. Where all look
    one way, so that these span no plane, it is the mean of their y axes, which leans with their pitch.
    """
    mean = poses[:, :, 1].mean(axis=0)
    length = np.linalg.norm(mean)
    mean = mean / length if length > 1e-6 else np.array([0.0, 0.0, 1.0])
    spread, axes = np.linalg.eigh(np.einsum("ni,nj->ij", poses[:, :, 0], poses[:, :, 0]) / len(poses))
    across = axes[:, 0] if axes[:, 0] @ mean > 0 else -axes[:, 0]
    # Of a sum of 1: an arc of 25 degrees either way has a second spread of 0.05.
    return across if spread[1] > 0.05 and spread[0] < 0.25 * spread[1] else mean
