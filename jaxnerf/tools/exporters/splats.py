"""The export "splats": Gaussians on the surfaces of a run (after arXiv:2405.09717), fitted to it, and their PSNR."""

import pathlib

import jax
import jax.numpy as jnp
import numpy as np
from scipy import ndimage
from scipy.spatial import cKDTree

from jaxnerf.core.cameras import pixel_grid, undistort
from jaxnerf.core.metrics import psnr
from jaxnerf.core.occupancy.grid import cell_inputs
from jaxnerf.core.poses import spread_directions
from jaxnerf.core.types import Camera
from jaxnerf.data.geometry.world import poses_in_file
from jaxnerf.evaluation.metrics import pixel_mask
from jaxnerf.evaluation.restore import refined_views
from jaxnerf.evaluation.supersampling import render_pixels
from jaxnerf.fields.hash_grid import harmonics
from jaxnerf.options import is_auto
from jaxnerf.runtime import stages
from jaxnerf.tools.exporters.base import ExportSource, can_be_scored
from jaxnerf.tools.exporters.gaussians import Gaussians, rasterize, read_spz, write_gaussians, write_spz
from jaxnerf.tools.exporters.points import surface_points, thinned
from jaxnerf.tools.exporters.splat_fit import fit_gaussians
from jaxnerf.tools.exporters.surfaces import export_box, render_depth_images

_NUM_DIRECTIONS = 32  # from which the colour of a point is evaluated
_NUM_NEIGHBORS = 4
_WIDTH, _THICKNESS = 0.6, 0.15  # standard deviations along and across the surface, in distances to the neighbours
_RIDGE = 0.02  # keeps the harmonics small in directions from which the surface is not seen
_CHUNK = 4096  # points whose colours are evaluated at once
_NUM_SCORED = 12  # views


def export_splats(source: ExportSource, folder: pathlib.Path) -> None:
    """Writes splats.ply and splats.spz, and states the PSNR of both on held-out views.

    There is one Gaussian at each of the points on the surfaces. It begins as a disk in the surface, as wide as the
    distance to its neighbours. Its opacity is that of the field over its width, and its colours are the field's from
    all directions in front of the surface, in harmonics of degree 2. Then all are fitted to the images of the field.

    Raises:
        ValueError: if no surface is in the box.
    """
    settings = source.settings
    longest = int(source.views.size[0].max())
    size = min(settings.image_size, longest) if is_auto(settings.size) else settings.size
    images = render_depth_images(source, size)
    box = export_box(source, images)
    with stages.stage("selecting points"):
        points, normals, _, extinction, field_x = surface_points(images, box)
        chosen = thinned(points, settings.num_points)
    points, normals, extinction, field_x = (each[chosen] for each in (points, normals, extinction, field_x))
    gaussians = make_gaussians(points, normals, extinction, colors_of(source, field_x, normals))
    if settings.fit_steps:
        background = source.run.experiment.background
        gaussians = fit_gaussians(gaussians, images, background, box=box, steps=settings.fit_steps)
    write_gaussians(folder / "splats.ply", gaussians)
    write_spz(folder / "splats.spz", gaussians)
    measured = ""
    if can_be_scored(source):
        value, count = score(source, gaussians)
        rounded, of_run = score(source, read_spz(folder / "splats.spz"))[0], score(source, None)[0]
        split = source.run.experiment.config.eval.split
        measured = f"; PSNR {value:.2f} dB, as SPZ {rounded:.2f} dB, over {count} views of {split}, "
        measured += f"where the run has {of_run:.2f} dB"
    source.say(f"{len(points):,} Gaussians{measured}")


def make_gaussians(points: np.ndarray, normals: np.ndarray, extinction: np.ndarray, colors: np.ndarray) -> Gaussians:
    """Makes Gaussians on a surface.

    Args:
        points, normals: [N, 3].
        extinction: [N] 1 / unit, the density of the matter.
        colors: [N, 9, 3] harmonics, see Gaussians.
    """
    number = max(min(_NUM_NEIGHBORS, len(points) - 1), 0)
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
    directions = np.float32(spread_directions(_NUM_DIRECTIONS))
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
    with stages.stage("evaluating colours from all directions") as stage:
        for start in range(0, count, _CHUNK):
            index = np.minimum(np.arange(start, start + _CHUNK), count - 1)  # one compiled shape
            parts.append(np.asarray(fit(params, grid, np.float32(field_x[index]), np.float32(normals[index]))))
            stage.update(min(start + _CHUNK, count), count)
    return np.concatenate(parts)[:count]


def score(source: ExportSource, gaussians: Gaussians | None) -> tuple[float, int]:
    """Returns the mean PSNR of rasterized Gaussians over views of the split `eval.split`, and how many these are.

    Behind the Gaussians is the run's background, which the file does not hold. None: the run itself is scored.
    """
    run, split = source.run, source.run.experiment.config.eval.split
    views = refined_views(run, run.experiment.load_split(split), split, source.variables[0])
    count = min(_NUM_SCORED, len(views.size))
    values = []
    with stages.stage(f"scoring the {'run' if gaussians is None else 'splats'}, by images") as stage:
        for index in map(int, np.arange(count) * len(views.size) // count):
            if gaussians is None:
                pixels = pixel_grid(*(int(side) for side in views.size[index]))
                image = render_pixels(run, source.variables, views, index, pixels)[0].rgb
            else:
                image = _image_of(source, gaussians, views, index)
            image = np.clip(image, 0, 1).astype(np.float32)
            values.append(float(psnr(jnp.asarray(image), views.image(index), mask=pixel_mask(views, index))))
            stage.update(len(values), count)
    return float(np.mean(values)), count


def _image_of(source, gaussians, views, index):
    """Returns what Gaussians look like through the camera of a view, with its lens."""
    pose = poses_in_file(np.asarray(views.cameras.to_world)[index : index + 1], views.to_file)[0]
    camera = jax.tree.map(lambda leaf: np.asarray(leaf)[index], views.cameras)
    height, width = (int(side) for side in views.size[index])
    pinhole = Camera(to_world=pose, focal=camera.focal, center=camera.center, height=height, width=width)
    image = rasterize(gaussians, pinhole, source.run.experiment.background)
    if camera.distortion is None:
        return image
    pixels = undistort(camera, pixel_grid(height, width))[0] * camera.focal + camera.center - 0.5
    rows = np.asarray(pixels).reshape(-1, 2).T[::-1]
    planes = [ndimage.map_coordinates(plane, rows, order=1, mode="nearest") for plane in np.moveaxis(image, -1, 0)]
    return np.stack(planes, axis=-1).reshape(height, width, 3)
