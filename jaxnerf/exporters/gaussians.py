"""Gaussian splats: their PLY file, and a small reference rasterizer that measures them (arXiv:2308.04079).

The rasterizer is exact rather than fast: it sorts the Gaussians of each pixel by depth, and skips only what is below
the thresholds of the released code.
"""

import os
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from jaxnerf.core.types import Camera, Vector
from jaxnerf.exporters.ply import write_ply
from jaxnerf.fields.hash_grid import harmonics

_LOW_PASS = 0.3  # px^2, added to each projected covariance: a Gaussian is at least about a pixel wide
_MIN_ALPHA, _MAX_ALPHA = 1 / 255, 0.99
_REACH = 3.0  # standard deviations at which a Gaussian is cut off
_MAX_SLOPE = 1.3  # of the ray to a Gaussian's center, over that to the image's edge, for its projection
_NEAR = 1e-2  # of the largest depth: Gaussians closer to the camera are not drawn
_MAX_PAIRS = 4_000_000  # of pixels and Gaussians that are held at once
# The file's harmonics of degrees 0, 1 and 2 are those of `harmonics` in this order and with these signs.
_ORDER, _SIGNS = [0, 1, 2, 3, 4, 5, 7, 6, 8], np.float32([1, -1, 1, -1, 1, -1, 1, -1, 1])
_REST = 15  # harmonics above degree 0 in the file, which viewers expect up to degree 3


class Gaussians(NamedTuple):
    """N Gaussians, in the units and axes of the dataset's files.

    Attributes:
        mean: [N, 3].
        rotation: [N, 4] unit quaternions (w, x, y, z), from the Gaussian's axes to the world's.
        scale: [N, 3] standard deviation along each axis.
        opacity: [N] in (0, 1), that of the center.
        harmonics: [N, 9, 3] coefficients of `harmonics` of the viewing direction; their sum plus 0.5 is the colour.
    """

    mean: Float[np.ndarray, "N 3"]
    rotation: Float[np.ndarray, "N 4"]
    scale: Float[np.ndarray, "N 3"]
    opacity: Float[np.ndarray, " N"]
    harmonics: Float[np.ndarray, "N 9 3"]


def write_gaussians(path: str | os.PathLike, gaussians: Gaussians) -> None:
    """Writes the PLY layout of the released code, which viewers read: logits, logarithms and 3 x 16 harmonics."""
    count = len(gaussians.mean)
    ordered = gaussians.harmonics[:, _ORDER] * _SIGNS[None, :, None]
    rest = np.zeros((count, 3, _REST), np.float32)  # channel by channel; degree 3 is 0
    rest[:, :, :8] = ordered[:, 1:].transpose(0, 2, 1)
    columns = dict(zip("xyz", gaussians.mean.T, strict=True))
    columns |= dict.fromkeys(("nx", "ny", "nz"), np.zeros(count, np.float32))
    columns |= {f"f_dc_{i}": ordered[:, 0, i] for i in range(3)}
    columns |= {f"f_rest_{i}": values for i, values in enumerate(rest.reshape(count, -1).T)}
    columns["opacity"] = np.log(gaussians.opacity / (1 - gaussians.opacity))
    columns |= {f"scale_{i}": np.log(gaussians.scale[:, i]) for i in range(3)}
    columns |= {f"rot_{i}": gaussians.rotation[:, i] for i in range(4)}
    write_ply(path, columns)


def rotation_matrices(quaternions: Float[np.ndarray, "N 4"]) -> Float[np.ndarray, "N 3 3"]:
    """Returns the rotations of unit quaternions (w, x, y, z)."""
    w, x, y, z = quaternions.T
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def rasterize(gaussians: Gaussians, camera: Camera, background: Vector | None = None) -> Float[np.ndarray, "H W 3"]:
    """Draws Gaussians through a pinhole.

    Args:
        gaussians: to draw.
        camera: in the units and axes of the Gaussians; its lens is ignored.
        background: [3]; None: black.

    Returns:
        [H, W, 3] colours.
    """
    height, width = camera.height, camera.width
    drawn = _project(gaussians, camera)
    image = np.empty((height * width, 3))
    step = max(1, _MAX_PAIRS // max(1, int(drawn.area.sum() // max(height, 1))))
    for top in range(0, height, step):
        bottom = min(top + step, height)
        image[top * width : bottom * width] = _strip(drawn, top, bottom, width, background)
    return image.reshape(height, width, 3)


class _Drawn(NamedTuple):
    """Projected Gaussians [M] by depth: pixel centers, inverse covariances, opacities, colours and pixel ranges."""

    center: np.ndarray
    conic: np.ndarray
    opacity: np.ndarray
    rgb: np.ndarray
    first: np.ndarray
    end: np.ndarray

    @property
    def area(self):
        """The number of pixels in each range."""
        return np.prod(np.maximum(self.end - self.first, 0), axis=1)


def _project(gaussians, camera):
    pose, focal = np.float64(camera.to_world), np.float64(camera.focal)
    size = np.array([camera.width, camera.height])
    flip = np.array([1.0, -1.0, -1.0])  # to axes right, down, forward, in which depth is positive
    local = (gaussians.mean - pose[:, 3]) @ (pose[:, :3] * flip)
    depth = local[:, 2]
    kept = np.flatnonzero(depth > _NEAR * max(depth.max(), 0))
    kept = kept[np.argsort(depth[kept], kind="stable")]
    x, y, z = local[kept].T
    limit = _MAX_SLOPE * np.maximum(camera.center, size - camera.center) / focal
    slope = np.clip(np.stack([x / z, y / z], axis=-1), -limit, limit)
    jacobian = np.zeros((len(kept), 2, 3))
    jacobian[:, [0, 1], [0, 1]] = focal / z[:, None]
    jacobian[:, :, 2] = -focal * slope / z[:, None]
    axes = rotation_matrices(np.float64(gaussians.rotation[kept])) * gaussians.scale[kept, None, :]
    spread = jacobian @ ((pose[:, :3] * flip).T @ axes)
    covariance = spread @ spread.transpose(0, 2, 1) + _LOW_PASS * np.eye(2)
    center = focal * np.stack([x / z, y / z], axis=-1) + camera.center
    conic = np.linalg.inv(covariance)
    half = (covariance[:, 0, 0] + covariance[:, 1, 1]) / 2
    radius = _REACH * np.sqrt(half + np.sqrt(np.maximum(half**2 - np.linalg.det(covariance), 0)))
    first = np.clip(np.floor(center - radius[:, None]), 0, size).astype(int)
    end = np.clip(np.ceil(center + radius[:, None]), 0, size).astype(int)
    directions = gaussians.mean[kept] - pose[:, 3]
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    basis = np.asarray(harmonics(np.float32(directions)))
    rgb = np.maximum(np.einsum("nk,nkc->nc", basis, gaussians.harmonics[kept]) + 0.5, 0)
    return _Drawn(center, conic, gaussians.opacity[kept], rgb, first, end)


def _strip(drawn, top, bottom, width, background):
    """Returns the colours of the pixels in some rows [N, 3]."""
    first, end = drawn.first.copy(), drawn.end.copy()
    first[:, 1], end[:, 1] = np.maximum(first[:, 1], top), np.minimum(end[:, 1], bottom)
    columns, lines = np.maximum(end - first, 0).T
    count = columns * lines
    source = np.repeat(np.arange(len(count)), count)
    place = np.arange(count.sum()) - np.repeat(np.cumsum(count) - count, count)
    x, y = first[source, 0] + place % columns[source], first[source, 1] + place // columns[source]
    dx, dy = (np.stack([x, y], axis=-1) + 0.5 - drawn.center[source]).T
    a, b, c = drawn.conic[source, 0, 0], drawn.conic[source, 0, 1], drawn.conic[source, 1, 1]
    alpha = drawn.opacity[source] * np.exp(-0.5 * (a * dx * dx + c * dy * dy) - b * dx * dy)
    alpha = np.minimum(alpha, _MAX_ALPHA)
    kept = np.flatnonzero(alpha >= _MIN_ALPHA)
    pixel = ((y - top) * width + x)[kept]
    kept = kept[np.argsort(pixel, kind="stable")]  # of each pixel the nearest first, as the source is by depth
    pixel, alpha, source = ((y - top) * width + x)[kept], alpha[kept], source[kept]
    size = (bottom - top) * width
    depth = np.cumsum(-np.log1p(-alpha))
    starts = np.searchsorted(pixel, np.arange(size + 1))
    before = np.concatenate([[0.0], depth])
    weight = alpha * np.exp(-(before[:-1] - before[starts[pixel]]))
    rgb = np.stack([np.bincount(pixel, weight * drawn.rgb[source, i], size) for i in range(3)], axis=-1)
    if background is not None:
        rgb = rgb + np.exp(-(before[starts[1:]] - before[starts[:-1]]))[:, None] * np.asarray(background)
    return rgb
