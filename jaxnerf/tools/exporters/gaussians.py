"""Gaussians as other programs read them, and a rasterizer of the package that draws them."""

import gzip
import os
import struct
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from scipy.sparse import coo_matrix

from jaxnerf.core.safe_math import norm
from jaxnerf.core.types import Camera, Vector
from jaxnerf.fields.hash_grid import harmonics
from jaxnerf.tools.exporters.points import write_ply

_LOW_PASS = 0.3  # px^2, added to each projected covariance: a Gaussian is at least about a pixel wide
_MIN_ALPHA, MAX_ALPHA = 1 / 255, 0.99
_REACH = 3.0  # standard deviations at which a Gaussian is cut off
_MAX_SLOPE = 1.3  # of the ray to a Gaussian's center, over that to the image's edge, for its projection
_NEAR = 1e-2  # of the largest depth: Gaussians closer to the camera are not drawn
_MAX_PAIRS = 4_000_000  # of pixels and Gaussians that are held at once
# The file's harmonics of degrees 0, 1 and 2 are those of `harmonics` in this order and with these signs.
_ORDER, _SIGNS = [0, 1, 2, 3, 4, 5, 7, 6, 8], np.float32([1, -1, 1, -1, 1, -1, 1, -1, 1])
_SPZ_HEADER, _SPZ_MAGIC, _SPZ_VERSION = struct.Struct("<IIIBBBB"), 0x5053474E, 2
_SPZ_COLOR = 0.15  # of a byte's range, for a coefficient of degree 0
_SPZ_BITS = {1: 5, 2: 4}  # of a coefficient, by degree


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
    """Writes the PLY layout of the released code, which viewers read: logits, logarithms and harmonics.

    Of these it has the 9 up to degree 2, by whose number readers find the degree, and there are no normals, which the
    released code sets to 0.
    """
    ordered = _in_file(gaussians.harmonics)
    rest = ordered[:, 1:].transpose(0, 2, 1).reshape(len(ordered), 24)  # channel by channel
    columns = dict(zip("xyz", gaussians.mean.T, strict=True))
    columns |= {f"f_dc_{i}": ordered[:, 0, i] for i in range(3)}
    columns |= {f"f_rest_{i}": values for i, values in enumerate(rest.T)}
    columns["opacity"] = np.log(gaussians.opacity / (1 - gaussians.opacity))
    columns |= {f"scale_{i}": np.log(gaussians.scale[:, i]) for i in range(3)}
    columns |= {f"rot_{i}": gaussians.rotation[:, i] for i in range(4)}
    write_ply(path, columns)


def write_spz(path: str | os.PathLike, gaussians: Gaussians) -> None:
    """Writes version 2 of SPZ (github.com/nianticlabs/spz), which web viewers read: a tenth of the bytes of the PLY.

    Numbers are rounded: means to 24 bits of the largest, opacities, colours, rotations and logarithms of scales to 8,
    and harmonics of degree 1 to 5 and of degree 2 to 4 bits, which clips those beyond 1. Axes and units stay those of
    the dataset's files; the format's own convention is that y is up.
    """
    largest = max(float(np.abs(gaussians.mean).max(initial=0)), 1e-30)
    bits = int(np.clip(np.floor(23 - np.log2(largest * (1 + 1e-6))), 0, 23))
    fixed = np.rint(np.float64(gaussians.mean) * 2**bits).astype("<i4")
    quaternion = _with_large_w(gaussians.rotation)
    ordered = _in_file(gaussians.harmonics)
    coarse = np.array([1 << (8 - _SPZ_BITS[degree]) for degree in (1, 1, 1, 2, 2, 2, 2, 2)])[None, :, None]
    higher = np.rint((ordered[:, 1:] * 128 + 128) / coarse) * coarse
    parts = [
        _SPZ_HEADER.pack(_SPZ_MAGIC, _SPZ_VERSION, len(fixed), 2, bits, 0, 0),
        fixed.view(np.uint8).reshape(-1, 3, 4)[:, :, :3].tobytes(),
        _bytes(gaussians.opacity * 255),
        _bytes(ordered[:, 0] * (_SPZ_COLOR * 255) + 127.5),
        _bytes((np.log(gaussians.scale) + 10) * 16),
        _bytes(quaternion[:, 1:] * 127.5 + 127.5),
        _bytes(higher),
    ]
    with open(path, "wb") as file:
        file.write(gzip.compress(b"".join(parts), mtime=0))


def read_spz(path: str | os.PathLike) -> Gaussians:
    """Reads what `write_spz` has written."""
    with open(path, "rb") as file:
        raw = gzip.decompress(file.read())
    magic, version, count, degree, bits, _, _ = _SPZ_HEADER.unpack_from(raw)
    if (magic, version, degree) != (_SPZ_MAGIC, _SPZ_VERSION, 2):
        raise ValueError(f"{path}: is no SPZ file of version {_SPZ_VERSION} and degree 2; export it again")
    numbers, place = [], _SPZ_HEADER.size
    for size in (9, 1, 3, 3, 3, 24):
        numbers.append(np.frombuffer(raw, np.uint8, size * count, place).reshape(count, size))
        place += size * count
    fixed, opacity, color, scale, rotation, higher = numbers
    fixed = (
        np.pad(fixed.reshape(count, 3, 3), [(0, 0), (0, 0), (1, 0)]).copy().view("<i4")[..., 0] >> 8
    )  # with its sign
    xyz = rotation / 127.5 - 1
    w = np.sqrt(np.maximum(1 - (xyz**2).sum(axis=1, keepdims=True), 0))
    ordered = np.concatenate([(color / 255 - 0.5)[:, None] / _SPZ_COLOR, higher.reshape(count, 8, 3) / 128 - 1], axis=1)
    coefficients = np.empty_like(ordered)
    coefficients[:, _ORDER] = ordered * _SIGNS[None, :, None]
    values = (fixed / 2**bits, np.concatenate([w, xyz], axis=1), np.exp(scale / 16 - 10), opacity[:, 0] / 255)
    return Gaussians(*(np.float32(value) for value in (*values, coefficients)))


def _in_file(coefficients):
    """Returns harmonics [N, 9, 3] in the order and with the signs of files."""
    return coefficients[:, _ORDER] * _SIGNS[None, :, None]


def _with_large_w(quaternions):
    """Returns quaternions [N, 4] of the same Gaussians with w >= 0.5, as files hold the rest alone.

    Half a turn about an axis of its own leaves a Gaussian as it is, and exchanges w with x, y or z.
    """
    w, x, y, z = quaternions.T
    turned = np.array([[w, x, y, z], [-x, w, z, -y], [-y, -z, w, x], [-z, y, -x, w]])
    chosen = turned[np.abs(quaternions).argmax(axis=1), :, np.arange(len(quaternions))]
    return chosen * np.where(chosen[:, :1] < 0, -1, 1)


def _bytes(values):
    return np.clip(np.rint(values), 0, 255).astype(np.uint8).tobytes()


def rotation_matrices(quaternions: Float[Any, "N 4"], xp: Any = np) -> Float[Any, "N 3 3"]:
    """Returns the rotations of unit quaternions (w, x, y, z); xp: numpy or jax.numpy."""
    w, x, y, z = quaternions.T
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return xp.stack([xp.stack(row, axis=-1) for row in rows], axis=-2)


class Projection(NamedTuple):
    """Gaussians in an image, as `project` finds them.

    Attributes:
        depth: [N] along the camera's axis; the rest is meaningless where it is not positive.
        center: [N, 2] px.
        covariance: [N] each, its entries xx, xy and yy, px^2.
        conic: [N, 3], the entries xx, xy and yy of its inverse.
    """

    depth: Any
    center: Any
    covariance: tuple[Any, Any, Any]
    conic: Any


def project(gaussians: Gaussians, camera: Sequence[Any], size: tuple[int, int], xp: Any = np) -> Projection:
    """Projects Gaussians through a pinhole, linearized at their centers (arXiv:2308.04079, Eq. 5).

    Args:
        gaussians: of which mean, rotation and scale are read.
        camera: pose [3, 4], focal length [2] and principal point [2].
        size: height and width, px.
        xp: numpy, or jax.numpy for derivatives.
    """
    pose, focal, middle = camera
    axes = pose[:, :3] * np.float32([[1, -1, -1]])  # right, down, forward, in which depth is positive
    local = (gaussians.mean - pose[None, :, 3]) @ axes
    z = xp.where(local[:, 2:] > 1e-6, local[:, 2:], 1.0)
    slope = local[:, :2] / z
    limit = (_MAX_SLOPE * xp.maximum(middle, np.float32(size[::-1]) - middle) / focal)[None]
    held = xp.clip(slope, -limit, limit)
    turned = xp.einsum("wc,nwk->nck", axes, rotation_matrices(gaussians.rotation, xp) * gaussians.scale[:, None, :])
    spread = (focal[None] / z)[:, :, None] * (turned[:, :2] - held[:, :, None] * turned[:, 2:])
    xx, xy, yy = ((spread[:, i] * spread[:, j]).sum(axis=-1) for i, j in ((0, 0), (0, 1), (1, 1)))
    xx, yy = xx + _LOW_PASS, yy + _LOW_PASS
    conic = xp.stack([yy, -xy, xx], axis=-1) / (xx * yy - xy * xy)[:, None]
    return Projection(local[:, 2], focal[None] * slope + middle[None], (xx, xy, yy), conic)


def colors_at(gaussians: Gaussians, eye: Float[Any, "3"]) -> Float[Array, "N 3"]:
    """Returns the colours of Gaussians that are seen from a position."""
    away = gaussians.mean - eye[None]
    basis = harmonics(away / norm(away)[:, None])
    return jnp.maximum(jnp.einsum("nk,nkc->nc", basis, gaussians.harmonics) + 0.5, 0)


def rasterize(gaussians: Gaussians, camera: Camera, background: Vector | None = None) -> Float[np.ndarray, "H W 3"]:
    """Draws Gaussians through a pinhole (arXiv:2308.04079), exact rather than fast.

    The Gaussians of each pixel are sorted by depth, and only what is below the thresholds of the released code is
    skipped.

    Args:
        gaussians: to draw.
        camera: in the units and axes of the Gaussians; its lens is ignored.
        background: [3]; None: black.

    Returns:
        [H, W, 3] colours.
    """
    rgb, image = None, []
    for pairs in visible_pairs(gaussians, camera):
        rgb = np.asarray(colors_at(gaussians, np.asarray(camera.to_world)[:, 3])) if rgb is None else rgb
        weight = pairs.alpha * pairs.transmittance
        rows = [np.bincount(pairs.pixel, weight * rgb[pairs.source, i], pairs.size) for i in range(3)]
        part = np.stack(rows, axis=-1).astype(np.float64)  # of integers where there is no pair
        if background is not None:
            part += pairs.left[:, None] * np.asarray(background)
        image.append(part)
    return np.concatenate(image).reshape(camera.height, camera.width, 3)


class Pairs(NamedTuple):
    """Which Gaussians reach which pixels of some rows, by pixel and then by depth.

    Attributes:
        size: the number of pixels.
        pixel: [P] index among them.
        source: [P] index of the Gaussian.
        alpha: [P] what it absorbs.
        transmittance: [P] what those in front of it leave.
        left: [size] what all leave.
    """

    size: int
    pixel: np.ndarray
    source: np.ndarray
    alpha: np.ndarray
    transmittance: np.ndarray
    left: np.ndarray


def visible_pairs(gaussians: Gaussians, camera: Camera) -> Iterator[Pairs]:
    """Yields the Pairs of rows of a pinhole's image from the top, as many rows at once as fit into memory."""
    drawn = _sorted_by_depth(gaussians, camera)
    step = max(1, _MAX_PAIRS // max(1, int(drawn.area.sum() // max(camera.height, 1))))
    for top in range(0, camera.height, step):
        yield _pairs_of_rows(drawn, top, min(top + step, camera.height), camera.width)


class _Drawn(NamedTuple):
    """Projected Gaussians [M] by depth: their index, pixel centers, inverse covariances, opacities and pixel ranges."""

    index: np.ndarray
    center: np.ndarray
    conic: np.ndarray
    opacity: np.ndarray
    first: np.ndarray
    end: np.ndarray

    @property
    def area(self):
        """The number of pixels in each range."""
        return np.prod(np.maximum(self.end - self.first, 0), axis=1)


def _sorted_by_depth(gaussians, camera):
    """Returns the Gaussians in front of a camera as _Drawn."""
    lens = (np.float64(each) for each in (camera.to_world, camera.focal, camera.center))
    found = project(gaussians, [*lens], (camera.height, camera.width))
    kept = np.flatnonzero(found.depth > _NEAR * max(found.depth.max(initial=0), 0))
    kept = kept[np.argsort(found.depth[kept], kind="stable")]
    center, conic, opacity = found.center[kept], found.conic[kept], gaussians.opacity[kept]
    xx, xy, yy = (each[kept] for each in found.covariance)
    half = (xx + yy) / 2
    radius = _REACH * np.sqrt(half + np.sqrt(np.maximum(half**2 - (xx * yy - xy * xy), 0)))
    # Beyond these sides of the ellipse, alpha is below _MIN_ALPHA.
    sigmas = np.sqrt(2 * np.log(np.maximum(opacity / _MIN_ALPHA, 1)))
    reach = np.minimum(sigmas[:, None] * np.sqrt(np.stack([xx, yy], axis=-1)), radius[:, None])
    size = np.array([camera.width, camera.height])
    first = np.clip(np.floor(center - reach), 0, size).astype(np.int32)
    end = np.clip(np.ceil(center + reach), 0, size).astype(np.int32)
    return _Drawn(kept, center, conic, opacity, first, end)


def _pairs_of_rows(drawn, top, bottom, width):
    first, end = drawn.first.copy(), drawn.end.copy()
    first[:, 1], end[:, 1] = np.maximum(first[:, 1], top), np.minimum(end[:, 1], bottom)
    columns, lines = np.maximum(end - first, 0).T
    count = columns * lines
    source = np.repeat(np.arange(len(count), dtype=np.int32), count)
    place = np.arange(len(source), dtype=np.int32) - np.repeat(np.cumsum(count, dtype=np.int32) - count, count)
    line, column = np.divmod(place, columns[source])
    x, y = first[source, 0] + column, first[source, 1] + line
    shapes = np.column_stack([drawn.center - 0.5, drawn.conic, drawn.opacity])
    across, down, a, b, c, opacity = np.float32(shapes).T[:, source]
    dx, dy = x - across, y - down
    alpha = np.minimum(opacity * np.exp(-0.5 * (a * dx * dx + c * dy * dy) - b * dx * dy), np.float32(MAX_ALPHA))
    kept = np.flatnonzero(alpha >= _MIN_ALPHA)
    size, pixel = (bottom - top) * width, ((y - top) * width + x)[kept]
    # A sort by counting, which keeps the order of equal pixels: of each the nearest first, as the source is by depth.
    table = coo_matrix((np.ones(len(kept), bool), (pixel, np.arange(len(kept)))), shape=(size, len(kept))).tocsr()
    order, starts = table.indices, table.indptr
    pixel, alpha, source = pixel[order], alpha[kept][order], source[kept][order]
    before = np.concatenate([[0.0], np.cumsum(-np.log1p(-np.float64(alpha)))])  # optical depth
    transmittance = np.exp(before[starts[pixel]] - before[:-1])
    left = np.exp(before[starts[:-1]] - before[starts[1:]])
    return Pairs(size, pixel, drawn.index[source], alpha, transmittance, left)
