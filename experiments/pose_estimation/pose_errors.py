"""How far cameras are from others, whatever the position, orientation and scale of their world."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float


class Similarity(NamedTuple):
    """x -> scale * turn @ x + move."""

    scale: float
    turn: Float[np.ndarray, "3 3"]
    move: Float[np.ndarray, "3"]

    def __call__(self, poses: Float[np.ndarray, "V 3 4"]) -> Float[np.ndarray, "V 3 4"]:
        """Returns the cameras in the other world."""
        eyes = self.scale * poses[:, :, 3] @ self.turn.T + self.move
        return np.concatenate([self.turn @ poses[:, :, :3], eyes[:, :, None]], axis=2)


def similarity(start: Float[np.ndarray, "V 3"], end: Float[np.ndarray, "V 3"]) -> Similarity:
    """Returns the similarity that maps points onto others with the least squared distance (Umeyama 1991).

    Points that coincide are only moved.
    """
    centers = start.mean(axis=0), end.mean(axis=0)
    left, sizes, right = np.linalg.svd((end - centers[1]).T @ (start - centers[0]) / len(start))
    signs = np.array([1, 1, np.sign(np.linalg.det(left @ right))])
    turn = (left * signs) @ right
    spread = ((start - centers[0]) ** 2).sum(axis=1).mean()
    scale = float((sizes * signs).sum() / spread) if spread else 1.0
    return Similarity(scale, turn, centers[1] - scale * turn @ centers[0])


def errors(poses: Float[np.ndarray, "V 3 4"], truth: Float[np.ndarray, "V 3 4"]) -> tuple[float, float]:
    """Returns the mean error of rotations, degrees, and of positions, world units, after the best similarity."""
    aligned = similarity(poses[:, :, 3], truth[:, :, 3])(poses)
    apart = np.linalg.norm(aligned[:, :, :3] - truth[:, :, :3], axis=(1, 2)) / np.sqrt(8)
    angles = np.degrees(2 * np.arcsin(np.minimum(apart, 1)))
    return float(angles.mean()), float(np.linalg.norm(aligned[:, :, 3] - truth[:, :, 3], axis=1).mean())
