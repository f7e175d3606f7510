"""The world that a capture is trained in: moved, turned and scaled from the file's, and how to get back."""

import dataclasses

import numpy as np

from jaxnerf.data.geometry.poses import gaze_center, up_of


def poses_of(capture):
    """Returns the poses [V, 3, 4] of a capture's frames."""
    return np.stack([frame.camera.to_world for frame in capture.frames])


def looks_forward(capture, *, cosine=0.85):
    """Returns whether all cameras of a capture look one way, so that NDC holds what they see.

    cosine: of the widest angle between an axis and their mean. LLFF's grids stay within 20 degrees.
    """
    backs = poses_of(capture)[:, :, 2]
    mean = backs.mean(axis=0)
    return len(backs) > 1 and bool((backs @ mean > cosine * np.linalg.norm(mean)).all())


def recenter(capture, *, bound_share=0.75):
    """Returns the capture as the released codes move forward-facing ones, and [4, 4] back to the file.

    The mean camera becomes the identity, so that all look roughly along -z, and the nearest bound
    lies at 1 / bound_share: what normalised device coordinates with a near plane of 1 want.
    """
    poses = poses_of(capture)
    nearest = min(frame.bounds[0] for frame in capture.frames)
    if not nearest > 0:
        raise ValueError(f"{capture.source}: the nearest bound is {nearest}, wanted more than 0; set data.near")
    scale = 1 / (nearest * bound_share)
    back = _unit(poses[:, :, 2].sum(0))
    right = _unit(np.cross(poses[:, :, 1].sum(0), back))
    turn = np.stack([right, np.cross(back, right), back])
    return _moved(capture, scale, turn, poses[:, :, 3].mean(0))


def center(capture):
    """Returns the capture with what its cameras look at in the middle, and [4, 4] back to the file.

    The point nearest to all axes becomes the origin, what is up becomes z, and the cameras' median distance
    becomes 1. A world that is upright already is not turned.
    """
    poses = poses_of(capture)
    middle = gaze_center(poses)
    distance = np.median(np.linalg.norm(poses[:, :, 3] - middle, axis=-1))
    if not distance > 0:
        raise ValueError(
            f"{capture.source}: all {len(poses)} cameras stand where they look at ({middle.round(3).tolist()}"
            "), wanted different places; correct the poses"
        )
    return _moved(capture, 1 / distance, _turn_upright(up_of(poses)), middle)


def _turn_upright(up):
    """Returns the rotation [3, 3] by the smallest angle that takes a direction to z."""
    z = np.array([0.0, 0.0, 1.0])
    if up[2] < -1 + 1e-9:
        return np.diag([1.0, -1.0, -1.0])
    # Rodrigues' formula with the axis up x z, whose length is the sine of the angle.
    x, y, _ = axis = np.cross(up, z)
    across = np.array([[0, -axis[2], y], [axis[2], 0, -x], [-y, x, 0]])
    return np.eye(3) + across + across @ across / (1 + up[2])


def _moved(capture, scale, turn, origin):
    """Returns the capture with x -> scale turn (x - origin), and the inverse of that as [4, 4]."""
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
