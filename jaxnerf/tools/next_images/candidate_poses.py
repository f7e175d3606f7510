"""Poses from which a further image of a scene could be taken, beside those of its cameras. numpy on the host."""

from typing import NamedTuple

import jax
import numpy as np
from jax import Array
from jaxtyping import Float, Int

from jaxnerf.core import poses as core_poses
from jaxnerf.core.poses import spread_directions
from jaxnerf.data.geometry.path_poses import coverage, default_kind, forward_frame, level_axes
from jaxnerf.data.geometry.poses import up_of

_DIRECTIONS = 512  # around a scene; neighbours are 9 degrees apart
_BANDWIDTH = np.radians(20.0)  # cameras within about this angle of a candidate determine its distance
_MOST_TURN = np.radians(60.0)  # from the nearest camera: what is farther away may not be accessible
_LOWER, _LEAST_HEIGHT = np.radians(15.0), np.radians(5.0)  # below the lowest camera, but not below what things stand on
_REACH, _PER_SIDE = 1.5, 9  # of a plane of candidates: in spreads of the cameras, and how many along each side
_MOST_PLACES, _TURNS, _PITCHES = 24, 8, np.radians([30.0, 0.0, -30.0])
_SECTORS = tuple(str(angle) for angle in range(0, 360, 45))  # of azimuth

_look_at = jax.jit(jax.vmap(core_poses.look_at, in_axes=(0, 0, None)))


class Candidates(NamedTuple):
    """Poses for a further image, in groups: the cells of a table of directions.

    Attributes:
        kind: "around" what the cameras look at, "beside" cameras that look one way, or "turned" at cameras' places.
        reason: for the kind; it continues "as".
        poses: [N, 3, 4] float64.
        nearest: [N] index of the camera that is nearest: by the angle around what the cameras look at, by position, or
            the one at that place.
        group: [N, 2] row and column.
        rows, columns: names of the groups. Azimuth is counted to the right from the first camera, in degrees.
    """

    kind: str
    reason: str
    poses: Float[np.ndarray, "N 3 4"]
    nearest: Int[np.ndarray, " N"]
    group: Int[np.ndarray, "N 2"]
    rows: tuple[str, ...]
    columns: tuple[str, ...]


def candidate_poses(poses: Float[Array | np.ndarray, "V 3 4"], up: Float[np.ndarray, "3"] | None = None) -> Candidates:
    """Places Candidates by how the cameras look.

    - Around what the cameras look at, if they do: as far away as the cameras nearby, up to straight above, down to 15
      degrees below the lowest camera, but not below 5 degrees unless a camera is, and within 60 degrees of a camera.
    - Beside cameras that look one way: in the plane of the mean camera, half as far again as the cameras spread,
      looking at what they look at.
    - Elsewhere, at 24 of the cameras' places, turned in eight directions around up, level and 30 degrees up and down.

    Args:
        poses: of the cameras.
        up: unit vector; None: `up_of`. Beside cameras that look one way, it is the mean camera's.

    Raises:
        ValueError: if there are fewer than two different cameras.
    """
    poses = np.asarray(poses, np.float64)
    up = up_of(poses) if up is None else up
    path, reason = default_kind(poses, up)
    kind = {"spiral": "beside", "turntable": "around", "arc": "around"}.get(path, "turned")
    return {"beside": _beside, "around": _around, "turned": _turned}[kind](poses, up, reason)


def farthest_poses(
    poses: Float[Array | np.ndarray, "V 3 4"], candidates: Float[np.ndarray, "N 3 4"], count: int
) -> list[int]:
    """Chooses candidates one after another, each the farthest from the nearest of the cameras and of those before it.

    The distance of two poses is that of their positions, over the cameras' mean distance from their mean, plus that of
    their viewing directions, which are unit vectors.

    Args:
        poses: of the cameras, which differ in position or direction.
        candidates: world units.
        count: of them to choose.

    Returns:
        Their indices in the order of choice; fewer than count where there are fewer.
    """
    poses, candidates = np.asarray(poses, np.float64), np.asarray(candidates, np.float64)
    spread = np.linalg.norm(poses[:, :, 3] - poses[:, :, 3].mean(axis=0), axis=1).mean() or 1.0

    def distance(others):
        return sum(
            np.linalg.norm(candidates[:, None, :, axis] - others[None, :, :, axis], axis=-1) / unit
            for axis, unit in ((3, spread), (2, 1.0))
        ).min(axis=1)

    chosen: list[int] = []
    nearest = distance(poses)
    for _ in range(min(count, len(candidates))):
        chosen.append(int(nearest.argmax()))
        nearest = np.minimum(nearest, distance(candidates[chosen[-1:]]))
        nearest[chosen] = -1
    return chosen


def azimuth_to_right(
    offsets: Float[np.ndarray, "N 3"], first: Float[np.ndarray, "3"], up: Float[np.ndarray, "3"]
) -> Float[np.ndarray, " N"]:
    """Returns the angle around up, radians in [-pi, pi), from a first offset to others, seen from the same point.

    Someone who walks around that point and faces it moves to the right where it grows; someone who stands at it turns
    to the left.
    """
    right, ahead = level_axes(up)
    angle = np.arctan2(offsets @ ahead, offsets @ right) - np.arctan2(first @ ahead, first @ right)
    return (angle + np.pi) % (2 * np.pi) - np.pi


def _around(poses, up, reason):
    cover = coverage(poses, up)
    away = (poses[:, :, 3] - cover.center) / np.maximum(cover.distance, 1e-30)[:, None]
    directions = np.array(spread_directions(_DIRECTIONS)) @ np.stack([*level_axes(up), up])
    lowest = cover.elevation.min()
    lowest = min(lowest, max(lowest - _LOWER, _LEAST_HEIGHT))
    cosines = directions @ away.T
    kept = (directions @ up >= np.sin(lowest)) & (cosines.max(axis=1) >= np.cos(_MOST_TURN))
    directions, cosines = directions[kept], cosines[kept]
    closeness = (cosines - 1) / _BANDWIDTH**2  # von Mises and Fisher
    weights = np.exp(closeness - closeness.max(axis=1, keepdims=True))
    distance = weights @ cover.distance / weights.sum(axis=1)
    height = np.degrees(np.arcsin(np.clip(directions @ up, -1, 1)))
    bands = np.clip((90 - height) // 30, 0, 5)
    rows = tuple(f"{60 - 30 * band} to {90 - 30 * band} degrees high" for band in range(6))
    return Candidates(
        kind="around",
        reason=reason,
        poses=_looking(cover.center + distance[:, None] * directions, cover.center, up),
        nearest=cosines.argmax(axis=1),
        group=np.stack([bands, _sector(azimuth_to_right(directions, away[0], up))], axis=-1).astype(int),
        rows=rows,
        columns=_SECTORS,
    )


def _beside(poses, up, reason):
    del up
    pose, radii, focus = forward_frame(poses)
    steps = np.linspace(-_REACH, _REACH, _PER_SIDE)
    y, x = (each.reshape(-1) for each in np.meshgrid(steps[::-1], steps, indexing="ij"))
    eyes = pose[:, 3] + radii[0] * x[:, None] * pose[:, 0] + radii[1] * y[:, None] * pose[:, 1]
    thirds = np.stack([-y, x], axis=-1) / (2 * _REACH / 3)
    return Candidates(
        kind="beside",
        reason=reason,
        poses=_looking(eyes, pose[:, 3] - focus * pose[:, 2], pose[:, 1]),
        nearest=np.linalg.norm(eyes[:, None] - poses[:, :, 3], axis=-1).argmin(axis=1),
        group=np.clip(np.rint(thirds), -1, 1).astype(int) + 1,
        rows=("above", "level", "below"),
        columns=("left", "middle", "right"),
    )


def _turned(poses, up, reason):
    places = _spread_places(poses[:, :, 3])
    right, ahead = level_axes(up)
    turn = 2 * np.pi * np.arange(_TURNS)[:, None] / _TURNS
    level = np.cos(turn) * right + np.sin(turn) * ahead
    pitch = _PITCHES[:, None, None]
    gaze = np.broadcast_to(np.cos(pitch) * level + np.sin(pitch) * up, (len(places), len(_PITCHES), _TURNS, 3))
    gaze, eyes = gaze.reshape(-1, 3), np.repeat(poses[places, :, 3], len(_PITCHES) * _TURNS, axis=0)
    row = np.tile(np.repeat(np.arange(len(_PITCHES)), _TURNS), len(places))
    return Candidates(
        kind="turned",
        reason=reason,
        poses=_looking(eyes, eyes + gaze, up),
        nearest=np.repeat(places, len(_PITCHES) * _TURNS),
        group=np.stack([row, _sector(-azimuth_to_right(gaze, -poses[0, :, 2], up))], axis=-1),
        rows=("30 degrees up", "level", "30 degrees down"),
        columns=_SECTORS,
    )


def _sector(azimuth):
    """Returns the index of the sector of 45 degrees around each azimuth, radians; 0 is the first one's middle."""
    return np.rint(np.degrees(azimuth) / 45).astype(int) % len(_SECTORS)


def _spread_places(places):
    """Returns the indices of at most 24 places, each the farthest from those before it."""
    chosen = [0]
    distance = np.linalg.norm(places - places[0], axis=1)
    while len(chosen) < min(_MOST_PLACES, len(places)):
        chosen.append(int(distance.argmax()))
        distance = np.minimum(distance, np.linalg.norm(places - places[chosen[-1]], axis=1))
    return chosen


def _looking(eyes, targets, up):
    """Returns the poses [N, 3, 4] of cameras at eyes [N, 3] that look at targets [3] or [N, 3]."""
    targets = np.broadcast_to(targets, eyes.shape)
    return np.asarray(_look_at(*np.float32([eyes, targets]), np.float32(up)), np.float64)
