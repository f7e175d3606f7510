"""Silhouettes: where a view is not clear, in tables that count such pixels in any box. numpy on the host.

A view behind a lens is straightened first, so that who asks knows pinholes only.
"""

import functools
from typing import NamedTuple

import jax
import numpy as np

from jaxnerf.core.cameras import project, undistort
from jaxnerf.core.types import Camera

_MARGIN = 1  # px around a box: what covers but a pixel's corner may have left no trace in its alpha
_WIDEST = 3.0  # the tangent of the angle from the axis up to which a lens's image is used


class Silhouette(NamedTuple):
    """What one view may see something in, as an image of a pinhole."""

    table: np.ndarray  # [H + 3, W + 3] int32, sums over what is above and left, of the pixels within their rim
    focal: np.ndarray  # [2] px, (x, y)
    center: np.ndarray  # [2] px
    turn: np.ndarray  # [3, 3] world -> x right, y down, z along the axis
    eye: np.ndarray  # [3] world units


def silhouette(views, index):
    """Returns the Silhouette of a view with alpha: blocked is a pixel of alpha > 0, or outside the mask."""
    (height, width), first = np.asarray(views.size)[index], np.asarray(views.offset)[index]
    pixels = slice(first, first + height * width)
    blocked = np.asarray(views.pixels)[pixels, 3] > 0
    if views.mask is not None:
        blocked |= ~np.asarray(views.mask)[pixels]
    table = _sums(blocked.reshape(height, width))
    camera = jax.tree.map(lambda leaf: np.asarray(leaf)[index], views.cameras)
    focal, center = camera.focal, camera.center
    if camera.distortion is not None and camera.lens != "pinhole":
        numbers = (tuple(np.ravel(value).tolist()) for value in (focal, center, camera.distortion))
        low, high, focal, center = _straight(height, width, camera.lens, *numbers)
        table = _sums((count(table, low, high)[0] > 0).reshape(height, width))
    turn = np.float64(camera.to_world[:, :3]).T * [[1], [-1], [-1]]
    return Silhouette(table, np.float64(focal), np.float64(center), turn, np.float64(camera.to_world[:, 3]))


def count(table, low, high):
    """Returns how many pixels are blocked in boxes with their margin, and how many there are.

    Args:
        table: of a Silhouette. All around the image lies a rim of blocked pixels.
        low, high: [2, N] float px, (x, y), low <= high. What is outside the image is taken to the rim.

    Returns:
        blocked [N] and all [N], integers, all > 0.
    """
    rim = np.array(table.shape[::-1], low.dtype)[:, None] - 2
    left, top = np.clip(low + (1 - _MARGIN), 0, rim).astype(np.intp)  # after the clip this rounds down
    right, bottom = np.clip(high + (2 + _MARGIN), 1, rim + 1).astype(np.intp)
    area = (right - left) * (bottom - top)
    top, bottom, table = top * table.shape[1], bottom * table.shape[1], table.reshape(-1)
    return table[bottom + right] - table[top + right] - table[bottom + left] + table[top + left], area


def _sums(blocked):
    table = np.zeros((blocked.shape[0] + 3, blocked.shape[1] + 3), np.int32)
    np.pad(blocked, 1, constant_values=True).cumsum(0, np.int32).cumsum(1, out=table[1:, 1:])
    return table


@functools.lru_cache(8)  # a scene has few lenses
def _straight(height, width, lens, focal, center, distortion):
    """Returns what a lens sees of each pixel of a pinhole with as many, low and high [2, H W] px, and which.

    A straight pixel is small, so that its image behind the lens bends by far less than the margin.
    """
    camera = Camera(
        to_world=np.eye(3, 4, dtype=np.float32),
        focal=np.float32(focal),
        center=np.float32(center),
        distortion=np.float32(distortion),
        lens=lens,
    )
    probe = np.stack(np.meshgrid(np.linspace(0, width, 33), np.linspace(0, height, 33)), -1)
    points = np.asarray(jax.jit(undistort)(camera, np.float32(probe))[0]).reshape(-1, 2)
    # Any part of the image will do, as the rest counts as blocked; all of 180 degrees fit no plane.
    lower, upper = (np.clip(bound, -_WIDEST, _WIDEST) for bound in (points.min(0), points.max(0) + 1e-6))
    focal = np.array([width, height]) / (upper - lower)
    x, y = (np.arange(size + 1) / focal[axis] + lower[axis] for axis, size in enumerate((width, height)))
    x, y = np.meshgrid(x, y)
    seen = np.asarray(jax.jit(project)(camera, np.float32(np.stack([x, -y, -np.ones_like(x)], -1)))[0])
    four = np.stack([seen[:-1, :-1], seen[1:, :-1], seen[:-1, 1:], seen[1:, 1:]])
    low, high = (bound.reshape(-1, 2).T for bound in (four.min(0), four.max(0)))
    return low, high, focal, -lower * focal
