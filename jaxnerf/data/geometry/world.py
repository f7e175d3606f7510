"""Normalisation of a dataset's world: a similarity of the file's world, and its inverse. numpy on the host."""

import dataclasses

import numpy as np
from jax import Array
from jaxtyping import Float

from jaxnerf.data.geometry.poses import gaze_center, up_of
from jaxnerf.data.readers.base import Capture


def unit_of(to_file: Float[np.ndarray, "4 4"]) -> float:
    """Returns the length in the file's units of one unit of a normalised world, from the matrix in float32."""
    return float(np.cbrt(np.linalg.det(np.float64(np.float32(to_file))[:3, :3])))


def poses_in_file(
    poses: Float[Array | np.ndarray, "N 3 4"], to_file: Float[Array | np.ndarray, "4 4"] | None
) -> Float[np.ndarray, "N 3 4"]:
    """Transforms poses from a run's world to that of the dataset's files, see `Views.to_file`; float64."""
    poses = np.asarray(poses, np.float64)
    if to_file is None:
        return poses
    linear, offset, rotation = _parts(to_file)
    return np.concatenate([rotation @ poses[:, :, :3], (poses[:, :, 3] @ linear.T + offset)[:, :, None]], axis=-1)


def poses_in_run(
    poses: Float[np.ndarray, "N 3 4"], to_file: Float[Array | np.ndarray, "4 4"] | None
) -> Float[np.ndarray, "N 3 4"]:
    """Computes the inverse of `poses_in_file`."""
    if to_file is None:
        return poses
    rotation, eyes = _parts(to_file)[2], points_in_run(poses[:, :, 3], to_file)
    return np.concatenate([rotation.T @ poses[:, :, :3], eyes[:, :, None]], axis=-1)


def points_in_run(
    points: Float[np.ndarray, "N 3"], to_file: Float[Array | np.ndarray, "4 4"] | None
) -> Float[np.ndarray, "N 3"]:
    """Transforms points from the world of the dataset's files to a run's, see `Views.to_file`."""
    if to_file is None:
        return points
    linear, offset, _ = _parts(to_file)
    return np.linalg.solve(linear, (points - offset).T).T


def direction_in_run(
    direction: Float[np.ndarray, "3"], to_file: Float[Array | np.ndarray, "4 4"] | None
) -> Float[np.ndarray, "3"]:
    """Rotates a direction from the axes of the dataset's files to those of a run's world, see `Views.to_file`."""
    return direction @ poses_in_file(np.eye(3, 4)[None], to_file)[0, :, :3]


def _parts(to_file):
    """Returns the linear part of a similarity, its offset, and its rotation."""
    linear, offset = np.float64(to_file)[:3, :3], np.float64(to_file)[:3, 3]
    return linear, offset, linear / np.cbrt(abs(np.linalg.det(linear)))


def poses_of(capture: Capture) -> Float[np.ndarray, "V 3 4"]:
    """Returns the poses of a dataset's frames."""
    return np.stack([frame.camera.to_world for frame in capture.frames])


def recenter(capture: Capture, *, bound_factor: float = 0.75) -> tuple[Capture, Float[np.ndarray, "4 4"]]:
    """Moves a forward-facing dataset as the released code of LLFF and NeRF does.

    The mean camera becomes the identity, so that all cameras look roughly along -z. The nearest bound becomes
    1 / bound_factor, as normalised device coordinates with a near plane of 1 require.

    Returns:
        The Capture, and the similarity that maps its world back to the file's.

    Raises:
        ValueError: if the nearest bound is not positive.
    """
    poses = poses_of(capture)
    nearest = min(frame.bounds[0] for frame in capture.frames)
    if not nearest > 0:
        raise ValueError(f"{capture.source}: the nearest bound is {nearest}, expected more than 0; set data.near")
    scale = 1 / (nearest * bound_factor)
    back = _unit(poses[:, :, 2].sum(0))
    right = _unit(np.cross(poses[:, :, 1].sum(0), back))
    turn = np.stack([right, np.cross(back, right), back])
    return _moved(capture, scale, turn, poses[:, :, 3].mean(0))


def center(capture: Capture, *, up: Float[np.ndarray, "3"] | None = None) -> tuple[Capture, Float[np.ndarray, "4 4"]]:
    """Moves a dataset so that its cameras look at the origin.

    The point closest to all cameras' axes becomes the origin, up becomes z, and the cameras' median distance
    becomes 1. The rotation is the smallest that takes up to z.

    Args:
        capture: any.
        up: unit vector in the file's axes; None: `up_of` the cameras.

    Returns:
        The Capture, and the similarity that maps its world back to the file's.

    Raises:
        ValueError: if all cameras stand at the point that they look at.
    """
    poses = poses_of(capture)
    middle = gaze_center(poses)
    distance = np.median(np.linalg.norm(poses[:, :, 3] - middle, axis=-1))
    if not distance > 0:
        raise ValueError(
            f"{capture.source}: all {len(poses)} cameras are at the point that they look at "
            f"({middle.round(3).tolist()}), expected different positions; correct the poses"
        )
    return _moved(capture, 1 / distance, _turn_upright(up_of(poses) if up is None else up), middle)


def _turn_upright(up):
    """Returns the rotation [3, 3] by the smallest angle that maps a direction to z."""
    z = np.array([0.0, 0.0, 1.0])
    if up[2] < -1 + 1e-9:
        return np.diag([1.0, -1.0, -1.0])
    # Rodrigues' formula with the axis up x z, whose length is the sine of the angle.
    x, y, _ = axis = np.cross(up, z)
    across = np.array([[0, -axis[2], y], [axis[2], 0, -x], [-y, x, 0]])
    return np.eye(3) + across + across @ across / (1 + up[2])


def _moved(capture, scale, turn, origin):
    """Returns the Capture after x -> scale turn (x - origin), and the inverse of that as [4, 4]."""
    frames = []
    for frame in capture.frames:
        pose = np.asarray(frame.camera.to_world)
        moved = np.column_stack([turn @ pose[:, :3], scale * turn @ (pose[:, 3] - origin)])
        bounds = frame.bounds and tuple(scale * bound for bound in frame.bounds)
        camera = dataclasses.replace(frame.camera, to_world=moved)
        frames.append(frame._replace(camera=camera, bounds=bounds))
    points = None if capture.points is None else scale * (capture.points - origin) @ turn.T
    box = capture.box
    if box is not None:
        corners = np.stack(np.meshgrid(*np.transpose(box), indexing="ij"), axis=-1).reshape(-1, 3)
        corners = scale * (corners - origin) @ turn.T
        box = (corners.min(axis=0), corners.max(axis=0))
    back = np.eye(4)
    back[:3, :3], back[:3, 3] = turn.T / scale, origin
    return capture._replace(frames=tuple(frames), points=points, box=box), back


def _unit(vector):
    return vector / np.linalg.norm(vector)
