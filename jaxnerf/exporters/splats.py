"""The export "splats": Gaussians on the surfaces of a run (after arXiv:2405.09717), and their held-out PSNR."""

import os
import pathlib
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from scipy import ndimage
from scipy.spatial import cKDTree

from jaxnerf.core.cameras import pixel_grid, undistort
from jaxnerf.core.metrics import psnr
from jaxnerf.core.occupancy.grid import cell_inputs
from jaxnerf.core.types import Camera, Vector
from jaxnerf.data.geometry.world import poses_in_file
from jaxnerf.evaluation.metrics import pixel_mask
from jaxnerf.evaluation.restore import refined_views
from jaxnerf.exporters.base import ExportSource
from jaxnerf.exporters.points import surface_points, thinned, write_ply
from jaxnerf.exporters.surfaces import export_box, render_depth_images, sphere_directions
from jaxnerf.fields.hash_grid import harmonics
from jaxnerf.registry import Exporter

_NUM_DIRECTIONS = 32  # from which the colour of a point is evaluated
_NUM_NEIGHBORS = 4
_WIDTH, _THICKNESS = 0.6, 0.15  # standard deviations along and across the surface, in distances to the neighbours
_RIDGE = 0.02  # keeps the harmonics small in directions from which the surface is not seen
_CHUNK = 4096  # points whose colours are evaluated at once
_NUM_SCORED = 12  # views
_LOW_PASS = 0.3  # px^2, added to each projected covariance: a Gaussian is at least about a pixel wide
_MIN_ALPHA, _MAX_ALPHA = 1 / 255, 0.99
_REACH = 3.0  # standard deviations at which a Gaussian is cut off
_MAX_SLOPE = 1.3  # of the ray to a Gaussian's center, over that to the image's edge, for its projection
_NEAR = 1e-2  # of the largest depth: Gaussians closer to the camera are not drawn
_MAX_PAIRS = 4_000_000  # of pixels and Gaussians that are held at once
# The file's harmonics of degrees 0, 1 and 2 are those of `harmonics` in this order and with these signs.
_ORDER, _SIGNS = [0, 1, 2, 3, 4, 5, 7, 6, 8], np.float32([1, -1, 1, -1, 1, -1, 1, -1, 1])


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


def export_splats(source: ExportSource, folder: pathlib.Path) -> None:
    """Writes splats.ply: one Gaussian at each of the points on the surfaces, and states its PSNR on held-out views.

    A Gaussian is a disk in the surface, as wide as the distance to its neighbours. Its opacity is that of the field
    over its width, and its colours are the field's from all directions in front of the surface, in harmonics of
    degree 2.

    Raises:
        ValueError: if no surface is in the box.
    """
    settings = source.settings
    images = render_depth_images(source, settings.image_size)
    points, normals, _, extinction, field_x = surface_points(images, export_box(source, images))
    chosen = thinned(points, settings.num_points)
    points, normals, extinction, field_x = (each[chosen] for each in (points, normals, extinction, field_x))
    gaussians = make_gaussians(points, normals, extinction, colors_of(source, field_x, normals))
    write_gaussians(folder / "splats.ply", gaussians)
    value, count = score(source, gaussians)
    split = source.run.experiment.config.eval.split
    source.say(f"{len(points):,} Gaussians; PSNR {value:.2f} dB over {count} views of {split}")


EXPORTER = Exporter(export_splats)


def make_gaussians(points: np.ndarray, normals: np.ndarray, extinction: np.ndarray, colors: np.ndarray) -> Gaussians:
    """Makes Gaussians on a surface.

    Args:
        points, normals: [N, 3].
        extinction: [N] 1 / unit, the density of the matter.
        colors: [N, 9, 3] harmonics, see Gaussians.
    """
    number = min(_NUM_NEIGHBORS, len(points) - 1)
    distance = np.ones(len(points))
    if number:
        distance = cKDTree(points).query(points, k=number + 1)[0][:, 1:].mean(axis=1)
        distance = np.clip(distance, 1e-12, 4 * np.median(distance))  # a lone point is no large disk
    opacity = np.clip(-np.expm1(-np.maximum(extinction, 0) * 2 * distance), 0.02, 0.98)
    half = np.concatenate([1 + normals[:, 2:], np.cross([0.0, 0.0, 1.0], normals)], axis=1)  # from z to the normal
    half[normals[:, 2] < -1 + 1e-6] = [0, 1, 0, 0]
    rotation = half / np.linalg.norm(half, axis=1, keepdims=True)
    scale = distance[:, None] * np.array([_WIDTH, _WIDTH, _THICKNESS])
    floats = (np.float32(each) for each in (points, rotation, scale, opacity, colors))
    return Gaussians(*floats)


def colors_of(source: ExportSource, field_x: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """Fits harmonics [N, 9, 3] to the field's colours at points [N, 3] in the field's coordinates.

    The fit is linear least squares over directions, weighted by the cosine at which they meet the normals.
    """
    rotation = poses_in_file(np.eye(3, 4)[None], source.views.to_file)[0, :, :3]
    directions = np.float32(sphere_directions(_NUM_DIRECTIONS))
    basis, in_world = harmonics(directions), jnp.float32(directions @ rotation)
    ridge = _RIDGE * jnp.diag(jnp.float32([1e-3, *[1.0] * 8]))
    params, grid = source.variables

    @jax.jit
    def fit(params, grid, x, normals):
        scene = source.run.experiment.model.scene(params, grid)
        shape = (len(x), *directions.shape)
        x = jnp.broadcast_to(x[:, None], shape)
        _, rgb = scene(x, jnp.broadcast_to(in_world[None], shape), **cell_inputs("export", scene, grid, x))
        weights = jnp.maximum(-normals @ directions.T, 0)
        square = jnp.einsum("nd,dk,dl->nkl", weights, basis, basis) + ridge[None]
        return jnp.linalg.solve(square, jnp.einsum("nd,dk,ndc->nkc", weights, basis, rgb - 0.5))

    count, parts = len(field_x), []
    for start in range(0, count, _CHUNK):
        index = np.minimum(np.arange(start, start + _CHUNK), count - 1)  # one compiled shape
        parts.append(np.asarray(fit(params, grid, np.float32(field_x[index]), np.float32(normals[index]))))
    return np.concatenate(parts)[:count]


def score(source: ExportSource, gaussians: Gaussians) -> tuple[float, int]:
    """Returns the mean PSNR of rasterized Gaussians over views of the split `eval.split`, and how many these are.

    Behind the Gaussians is the run's background, which the file does not hold.
    """
    run, split = source.run, source.run.experiment.config.eval.split
    views = refined_views(run, run.experiment.load_split(split), split, source.variables[0])
    poses = poses_in_file(np.asarray(views.cameras.to_world), views.to_file)
    count = min(_NUM_SCORED, len(views.size))
    values = []
    for index in map(int, np.arange(count) * len(views.size) // count):
        camera = jax.tree.map(lambda leaf, index=index: np.asarray(leaf)[index], views.cameras)
        height, width = (int(side) for side in views.size[index])
        pinhole = Camera(to_world=poses[index], focal=camera.focal, center=camera.center, height=height, width=width)
        image = rasterize(gaussians, pinhole, run.experiment.background)
        if camera.distortion is not None:
            pixels = undistort(camera, pixel_grid(height, width))[0] * camera.focal + camera.center - 0.5
            rows = np.asarray(pixels).reshape(-1, 2).T[::-1]
            planes = [
                ndimage.map_coordinates(plane, rows, order=1, mode="nearest") for plane in np.moveaxis(image, -1, 0)
            ]
            image = np.stack(planes, axis=-1).reshape(height, width, 3)
        image = np.clip(image, 0, 1).astype(np.float32)
        values.append(float(psnr(jnp.asarray(image), views.image(index), mask=pixel_mask(views, index))))
    return float(np.mean(values)), count


def write_gaussians(path: str | os.PathLike, gaussians: Gaussians) -> None:
    """Writes the PLY layout of the released code, which viewers read: logits, logarithms and harmonics.

    Of these it has the 9 up to degree 2, by whose number readers find the degree, and there are no normals, which the
    released code sets to 0.
    """
    ordered = gaussians.harmonics[:, _ORDER] * _SIGNS[None, :, None]
    rest = ordered[:, 1:].transpose(0, 2, 1).reshape(len(ordered), -1)  # channel by channel
    columns = dict(zip("xyz", gaussians.mean.T, strict=True))
    columns |= {f"f_dc_{i}": ordered[:, 0, i] for i in range(3)}
    columns |= {f"f_rest_{i}": values for i, values in enumerate(rest.T)}
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
