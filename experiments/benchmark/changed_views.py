"""Views whose cameras or exposures are wrong by a known amount."""

import dataclasses

import numpy as np
from jaxtyping import Float

from jaxnerf.core.poses import se3_exponential
from jaxnerf.core.views import Views

FACTORS, TINTS = (0.6, 1.6), (0.9, 1.1)


def perturbed(poses: Float[np.ndarray, "V 3 4"], amount: float, seed: int) -> Float[np.ndarray, "V 3 4"]:
    """Returns cameras that see the world after random motions of it, which is how BARF perturbs."""
    twists = np.random.default_rng(seed).normal(size=(len(poses), 6)) * amount
    motions = np.asarray(se3_exponential(np.float32(twists)), np.float64)
    back = np.swapaxes(motions[:, :, :3], 1, 2)
    eyes = back @ (poses[:, :, 3] - motions[:, :, 3])[:, :, None]
    return np.concatenate([back @ poses[:, :, :3], eyes], axis=2)


def turned(
    poses: Float[np.ndarray, "V 3 4"], degrees: float, seed: int, center: Float[np.ndarray, "3"] | None = None
) -> Float[np.ndarray, "V 3 4"]:
    """Returns cameras that are turned about themselves, and moved by the same fraction of their distance.

    Args:
        poses: camera to world.
        degrees: the standard deviation of the angles about each axis.
        seed: of the angles.
        center: from which the mean distance is taken; None: the origin.
    """
    size = np.radians(degrees) * np.random.default_rng(seed).normal(size=(len(poses), 6))
    turns = se3_exponential(np.float32(np.concatenate([size[:, :3], 0 * size[:, 3:]], axis=1)))
    distance = np.linalg.norm(poses[:, :, 3] - (0 if center is None else center), axis=1).mean()
    eyes = poses[:, :, 3] + distance * size[:, 3:]
    return np.concatenate([np.asarray(turns)[:, :, :3] @ poses[:, :, :3], eyes[:, :, None]], axis=2)


def with_poses(views: Views, poses: Float[np.ndarray, "V 3 4"]) -> Views:
    """Returns Views whose cameras have other poses."""
    return dataclasses.replace(views, cameras=dataclasses.replace(views.cameras, to_world=np.float32(poses)))


def factors(count: int, seed: int) -> Float[np.ndarray, "V 3"]:
    """Returns the factors of the images' channels."""
    rng = np.random.default_rng(seed)
    tints = rng.uniform(*TINTS, (count, 3))
    return np.exp(rng.uniform(*np.log(FACTORS), (count, 1))) * tints


def changed(views: Views, gains: Float[np.ndarray, "V 3"]) -> Views:
    """Returns Views whose colours are multiplied by factors, clipped, and rounded as they were."""
    largest = np.iinfo(views.pixels.dtype).max
    pixels, counts = np.array(views.pixels), np.prod(views.size, axis=1)
    colors = pixels[:, :3] * np.repeat(gains, counts, axis=0)
    pixels[:, :3] = np.rint(np.minimum(colors, largest))
    return dataclasses.replace(views, pixels=pixels)
