"""Camera paths from where a capture's cameras stand and look.

turntable, spiral and ellipse take the poses [V, 3, 4] of Views, these and N, and return poses [N, 3, 4].
"""

import re

import jax
import numpy as np

from jaxnerf.core import poses as poses_module
from jaxnerf.data.geometry.poses import gaze_center, up_of

_interpolate = jax.jit(poses_module.interpolate, static_argnames=("num_frames", "closed"))


def turntable(poses, views, num_frames):
    """Around the point nearest to all lines of sight, at the cameras' mean distance and elevation."""
    center, up = gaze_center(poses), up_of(poses)
    offsets = poses[:, :, 3] - center
    distances = np.linalg.norm(offsets, axis=-1)
    elevation = np.arcsin(np.clip(offsets @ up / np.maximum(distances, 1e-30), -1, 1)).mean()
    return poses_module.turntable(num_frames, center=center, radius=distances.mean(), elevation=elevation, up=up)


def spiral(poses, views, num_frames):
    """As the LLFF code: sways as far as 90 % of the cameras, and looks at 3/4 of the way in disparity."""
    pose = np.float64(poses_module.mean_pose(poses))
    radii = np.percentile(np.abs((poses[:, :, 3] - pose[:, 3]) @ pose[:, :3]), 90, axis=0)
    far = 5 * np.max(views.far)
    near = max(0.9 * np.min(views.near), far / 1000)  # a near of 0 would have it look at its own eye
    return poses_module.spiral(num_frames, pose=pose, radii=radii, focus=1 / (0.25 / near + 0.75 / far))


def ellipse(poses, views, num_frames):
    """Through the spread of the cameras across what is up, at their mean height, looking as the turntable."""
    eyes, up = poses[:, :, 3], up_of(poses)
    middle = eyes.mean(axis=0)
    across = (eyes - middle) @ (np.eye(3) - np.outer(up, up))
    _, spread, axes = np.linalg.svd(across, full_matrices=False)
    # Points all around an ellipse have a variance of half its squared half axis.
    axes = axes[:2] * (spread[:2] * np.sqrt(2 / len(eyes)))[:, None]
    axes = np.concatenate([axes, np.zeros((2 - len(axes), 3))])  # of a single view
    return poses_module.ellipse(num_frames, middle=middle, axes=axes, target=gaze_center(poses), up=up)


def through_views(views, num_frames, closed):
    """Returns poses [N, 3, 4] and focal [N, 2] through the views in the order of their names."""

    def natural(index):  # r_2 before r_10
        return [int(part) if part.isdecimal() else part for part in re.split(r"(\d+)", views.names[index])]

    order = sorted(range(len(views.size)), key=natural) if views.names else np.arange(len(views.size))
    count = len(order)
    num_frames = num_frames or (6 * count if closed else 6 * (count - 1) + 1)
    poses = _interpolate(num_frames, poses=np.asarray(views.cameras.to_world)[order], closed=closed)
    height = np.float64(views.size)[order, :1]
    focal = np.float64(views.cameras.focal)[order] * (views.size[0, 0] / height)  # as if all were of one size
    times = np.asarray(poses_module.path_times(num_frames, count, closed=closed))
    focal = [np.interp(times, np.arange(count), side, period=count if closed else None) for side in focal.T]
    return np.asarray(poses), np.stack(focal, axis=-1)


KINDS = {"turntable": (turntable, 48), "spiral": (spiral, 120), "ellipse": (ellipse, 120)}  # and their N
