"""Fits the poses of scored views to a trained scene, by their images.

Refined cameras move the scene a little, and wrong poses of scored views hide what refinement gains. As in BARF
(arXiv:2104.06405) each scored view's pose is therefore fitted with the scene fixed: by Gauss-Newton steps whose
derivatives are differences of rendered images, so that no other program has to be compiled.
"""

import dataclasses
from collections.abc import Callable, Iterable

import jax.numpy as jnp
import numpy as np

from jaxnerf.core.poses import se3_exponential
from jaxnerf.core.views import Views
from jaxnerf.data.facts import LookAt

_ITERATIONS = 2
_STEP = 0.5  # px, by which differences move what the camera looks at
_DAMPING = 1e-3  # of Levenberg and Marquardt, times the diagonal


def aligned_views(
    views: Views,
    chosen: Iterable[int],
    render: Callable[[Views, int], np.ndarray],
    truth: Callable[[int], np.ndarray],
) -> Views:
    """Returns Views of which some have poses that fit their images better; a pose that gains nothing stays.

    Args:
        views: that are scored.
        chosen: indices of those whose poses are fitted.
        render: (Views, index) -> colours [H, W, 3] of the scene.
        truth: index -> those of the view's image.
    """
    distance = LookAt(views).distance
    poses = np.array(views.cameras.to_world, np.float32)
    for index in map(int, chosen):
        # A turn or a shift of one unit moves what the camera looks at by about half a pixel.
        turn = _STEP / float(np.asarray(views.cameras.focal)[index, 0])
        scale = np.float32([turn] * 3 + [turn * float(distance[index])] * 3)
        target = np.asarray(truth(index))

        def residual(pose, index=index, target=target):
            moved = poses.copy()
            moved[index] = pose
            found = dataclasses.replace(views, cameras=dataclasses.replace(views.cameras, to_world=moved))
            return (np.clip(render(found, index), 0, 1) - target).ravel()

        poses[index] = _fit(poses[index], residual, scale)
    return dataclasses.replace(views, cameras=dataclasses.replace(views.cameras, to_world=poses))


def _fit(pose, residual, scale):
    """Returns the pose after a few Gauss-Newton steps, each taken only if it reduces the error."""
    error = residual(pose)
    for _ in range(_ITERATIONS):
        columns = [residual(_moved(pose, shift)) - error for shift in np.diag(scale)]
        jacobian = np.stack(columns, axis=1).astype(np.float64)
        normal, slope = jacobian.T @ jacobian, jacobian.T @ error
        normal += np.diag(_DAMPING * np.diag(normal) + 1e-12)
        new = _moved(pose, -np.linalg.solve(normal, slope) * scale)
        found = residual(new)
        if not (found**2).sum() < (error**2).sum():
            break
        pose, error = new, found
    return pose


def _moved(pose, twist):
    """Returns a pose [3, 4] turned about its own position and shifted, along the axes of the world."""
    motion = np.asarray(se3_exponential(jnp.asarray(twist, jnp.float32)[None]))[0]
    turned = motion[:, :3] @ pose[:, :3]
    return np.concatenate([turned, pose[:, 3:] + motion[:, 3:]], axis=1).astype(np.float32)
