"""Where a trained run has surfaces: median depths, rendered at the poses of its training views.

Everything here is in the units and axes of the dataset's files, see `Views.to_file`.
"""

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Num, UInt8

from jaxnerf.core.cameras import pixel_grid
from jaxnerf.core.occupancy.grid import cell_inputs
from jaxnerf.core.poses import look_at, spread_directions
from jaxnerf.core.rendering import points_on_rays
from jaxnerf.core.safe_math import norm
from jaxnerf.core.types import Camera
from jaxnerf.data.geometry.poses import gaze_center, look_one_way, up_of
from jaxnerf.data.geometry.world import points_in_run, poses_in_file
from jaxnerf.evaluation.image_renderer import image_renderer
from jaxnerf.evaluation.output_images import to_8_bits
from jaxnerf.evaluation.paths.camera_path import path_pixels, posed_views, resize, through_first_lens
from jaxnerf.runtime import stages
from jaxnerf.tools.exporters.base import ExportSource

_CHUNK = 8192  # points at which the field is evaluated at once
_MIN_OPACITY = 0.6  # of a pixel that shows a surface
_MAX_EMPTY_OPACITY = 0.1  # of a pixel that shows empty space
_MIN_COSINE = 0.15  # between normal and ray: a pixel whose depths differ more is at an edge, or grazes its surface


class DepthImage(NamedTuple):
    """A pinhole's view of the surfaces.

    Attributes:
        name: of the training view whose pose it has; None at another pose.
        camera: the pinhole.
        depth: [H, W] float32, the median depth along the camera's axis; inf where the pixel shows empty space, 0
            where it shows neither that nor a surface.
        rgb: [H, W, 3] uint8; None if it was not asked for.
        extinction: [H, W] float32, 1 / unit, the density at the surface: matter of less than a few per voxel is
            transparent, and its depth is uncertain.
        field_x: [H, W, 3] float32, where the run's field is evaluated for that surface: it may be in other
            coordinates, such as NDC.
    """

    name: str | None
    camera: Camera
    depth: Float[np.ndarray, "H W"]
    rgb: UInt8[np.ndarray, "H W 3"] | None
    extinction: Float[np.ndarray, "H W"]
    field_x: Float[np.ndarray, "H W 3"]

    def points(self) -> Float[np.ndarray, "H W 3"]:
        """Returns the points on the surface; the camera's position where there is none."""
        pose = np.asarray(self.camera.to_world, np.float32)
        depth = np.where(np.isfinite(self.depth), self.depth, 0)
        return (self._local() * depth[..., None]) @ pose[:, :3].T + pose[:, 3]

    def normals(self) -> tuple[Float[np.ndarray, "H W 3"], Float[np.ndarray, "H W"]]:
        """Returns the unit normals, towards the camera, and their cosines with the rays.

        Both are 0 where a neighbour has no surface, at edges, and where the ray grazes the surface.
        """
        points, there = self.points(), np.isfinite(self.depth) & (self.depth > 0)
        normal, inside = np.zeros_like(points), (slice(1, -1), slice(1, -1))
        across = points[1:-1, 2:] - points[1:-1, :-2]
        down = points[2:, 1:-1] - points[:-2, 1:-1]
        normal[inside] = np.cross(down, across)
        sides = there[1:-1, 2:] & there[1:-1, :-2] & there[2:, 1:-1] & there[:-2, 1:-1]
        there &= np.pad(sides, 1)
        pose = np.asarray(self.camera.to_world, np.float32)
        towards = -self._local() @ pose[:, :3].T
        towards /= np.linalg.norm(towards, axis=-1, keepdims=True)
        normal /= np.maximum(np.linalg.norm(normal, axis=-1, keepdims=True), 1e-30)
        cosine = (normal * towards).sum(axis=-1)
        kept = there & (cosine > _MIN_COSINE)
        return np.where(kept[..., None], normal, 0), np.where(kept, cosine, 0)

    def _local(self):
        """Returns [H, W, 3], the directions of the rays in the camera's axes, to the plane at distance 1."""
        grid = np.asarray(pixel_grid(self.camera.height, self.camera.width))
        x, y = np.moveaxis((grid - self.camera.center) / self.camera.focal, -1, 0)
        return np.stack([x, -y, -np.ones_like(x)], axis=-1).astype(np.float32)


def render_depth_images(
    source: ExportSource, size: int | None, *, all_around: bool = False, colors: bool = True
) -> list[DepthImage]:
    """Renders the DepthImages of a run at the poses of its training views, or of as many as the settings allow.

    They have the pinhole of the first view, without a lens.

    Args:
        source: the run.
        size: px, the longer side; None: that of the first view.
        all_around: whether half as many poses all around the scene follow, unless its space is unbounded. They show
            at a steep angle what the training views see at a grazing one.
        colors: whether they have colours. Without, they take a quarter of the time: see `_depth_renderer`.

    Raises:
        ValueError: if the run's sampler renders no median depth, or no surface is found.
    """
    run, views = source.run, source.views
    path = _poses_of(source, size, all_around)
    render = functools.partial(run.render_image, median_depth=True) if colors else _depth_renderer(run)
    posed, images = posed_views(views, path), []
    names = views.names or tuple(f"{index:04d}" for index in range(len(views.size)))
    names = [names[index] for index in _chosen(len(views.size), source.settings.num_views)]
    names += [None] * (len(path.poses) - len(names))
    poses = poses_in_file(path.poses, views.to_file)
    surface = _surface_function(source, posed)
    with stages.stage("rendering depth images") as stage:
        for index, name in enumerate(names):
            pixels = path_pixels(posed, path, index, offset=0.5)
            rays = run.experiment.view_rays(posed, index, pixels)
            seen = render(source.variables, rays)
            distance, extinction, x = (np.asarray(each) for each in surface(index, pixels, seen.median_depth))
            camera = Camera(
                to_world=np.float32(poses[index]),
                focal=np.float32(path.focal[index]),
                center=np.float32(path.center[index]),
                height=path.height,
                width=path.width,
            )
            image = DepthImage(name, camera, distance, to_8_bits(seen.rgb) if colors else None, extinction, x)
            depth = distance / np.linalg.norm(image._local(), axis=-1)
            opacity = np.asarray(seen.opacity)
            there = (
                (opacity > _MIN_OPACITY) & (np.asarray(seen.median_depth) < np.asarray(rays.far)) & np.isfinite(depth)
            )
            depth = np.where(there, depth, np.where(opacity < _MAX_EMPTY_OPACITY, np.inf, 0)).astype(np.float32)
            images.append(image._replace(depth=depth))
            stage.update(index + 1, len(names))
    if not any(
        np.isfinite(image.depth).any() and (image.depth[np.isfinite(image.depth)] > 0).any() for image in images
    ):
        raise ValueError(f"step {source.step}: no view shows a surface; train the run for longer")
    return images


def _depth_renderer(run):
    """Returns the function (variables, Rays [...]) -> Rendering [...] with the median depth, but without colours.

    The colours of the field are not evaluated. A ray ends where its opacity shows that it meets a surface, which
    is behind its median depth, and its samples are no denser than those of training.
    """
    options = run.experiment.config.eval
    settings = {
        "early_stop_eps": max(options.early_stop_eps, 1 - _MIN_OPACITY),
        "sample_multiplier": min(options.sample_multiplier, 1.0),
    }
    model = run.model_with(settings, _without_colors)

    def cull(variables, rays):
        return model.cull(variables[1], rays, median_depth=True)

    part = jax.jit(lambda variables, rays: model.view(*variables, rays, median_depth=True))
    return image_renderer(part, options.chunk, model.cull and jax.jit(cull))


def _without_colors(field):
    """Returns a Field whose colours are 0, so that the compiled program does not compute them."""

    @functools.wraps(field.apply)
    def apply(params, x, viewdirs, **options):
        density, rgb = field.apply(params, x, viewdirs, **options)
        return density, jnp.zeros_like(rgb)

    return field._replace(apply=apply)


def inside(points: Num[np.ndarray, "*batch 3"], box: np.ndarray | None) -> np.ndarray:
    """Returns which points are in a box [2, 3]; None: all."""
    if box is None:
        return np.ones(points.shape[:-1], bool)
    return ((points >= box[0]) & (points <= box[1])).all(axis=-1)


def export_box(source: ExportSource, images: list[DepthImage]) -> Float[np.ndarray, "2 3"]:
    """Returns the box of the settings, or else of the surfaces.

    Without a setting it holds the points on the surfaces but for the outermost 0.5 % along each axis, and a margin of
    a tenth of its sides. If the run's space is contracted, only the points in its inner half count.
    """
    if source.settings.corners is not None:
        return source.settings.corners
    parts = [image.points()[np.isfinite(image.depth) & (image.depth > 0)][::7] for image in images]
    points = np.concatenate(parts)
    grid = source.variables[1]
    if grid.contracted:
        lower, upper = np.asarray(grid.lower), np.asarray(grid.upper)
        quarter = (upper - lower) / 4
        points = points[
            inside(points_in_run(points, source.views.to_file), np.stack([lower + quarter, upper - quarter]))
        ]
    if not len(points):
        raise ValueError("no surface is between the cameras; give --box=X0,Y0,Z0,X1,Y1,Z1")
    lower, upper = np.quantile(points, [0.005, 0.995], axis=0)
    margin = 0.1 * (upper - lower)
    return np.stack([np.maximum(lower - margin, points.min(axis=0)), np.minimum(upper + margin, points.max(axis=0))])


def _chosen(count, number):
    return np.arange(min(number, count)) * count // min(number, count)


def _poses_of(source, size, all_around):
    """Returns the CameraPath through the poses of the chosen training views, and then through those all around."""
    views = source.views
    chosen = _chosen(len(views.size), source.settings.num_views)
    poses = np.asarray(views.cameras.to_world)[chosen]
    # The rays of NDC are no world rays: they begin elsewhere.
    bounded = not source.variables[1].contracted and not source.run.experiment.config.data.ndc
    if all_around and bounded and not look_one_way(poses):
        poses = np.concatenate([poses, _around(poses, max(len(poses) // 2, 1))])
    path = through_first_lens("export", poses, views)
    if size is None:
        return path
    return resize(path, width=size) if path.width >= path.height else resize(path, height=size)


def _around(poses, count):
    """Returns poses [N, 3, 4] on a sphere around what cameras look at, as far away as they are."""
    center, up = gaze_center(poses), up_of(np.float64(poses))
    radius = np.median(np.linalg.norm(poses[:, :, 3] - center, axis=1))
    eyes = np.float32(center + radius * np.array(spread_directions(count)))
    return np.asarray(jax.vmap(look_at, in_axes=(0, None, None))(eyes, np.float32(center), np.float32(up)))


def _surface_function(source, posed):
    """Returns the function (view, pixels, median depth) -> distance, extinction, x of the field."""
    run, (params, grid) = source.run, source.variables

    @jax.jit
    def surface(params, grid, index, pixels, median):
        rays = run.experiment.view_rays(posed, index, pixels)
        distance, slope = jax.jvp(
            lambda t: run.experiment.world_depth(posed, index, pixels, t), (median,), (jnp.ones_like(median),)
        )
        x = points_on_rays(rays, median[..., None])[..., 0, :]
        scene = run.experiment.model.scene(params, grid)
        flat = x.reshape(-1, 3), rays.viewdirs.reshape(-1, 3)
        flat = *flat, cell_inputs("export", scene, grid, flat[0])

        def density_at(place):
            x, viewdir, inputs = jax.tree.map(lambda leaf: leaf[None, None], place)
            return scene(x, viewdir, **inputs)[0][0, 0]

        density = jax.lax.map(density_at, flat, batch_size=min(_CHUNK, flat[0].shape[0])).reshape(median.shape)
        return distance, density * norm(rays.directions) / slope, x

    return lambda index, pixels, median: surface(params, grid, index, pixels, median)
