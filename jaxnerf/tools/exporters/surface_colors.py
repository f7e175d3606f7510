"""Colours of points on the surfaces of a run: what most of its training views see there, on average."""

from collections.abc import Callable, Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, UInt8
from scipy.spatial import cKDTree

from jaxnerf.core.cameras import project
from jaxnerf.core.occupancy.grid import cell_inputs
from jaxnerf.core.safe_math import norm
from jaxnerf.core.volume_rendering import weights_from_density
from jaxnerf.data.geometry.world import poses_in_file
from jaxnerf.runtime import stages
from jaxnerf.tools.exporters.base import ExportSource
from jaxnerf.tools.exporters.surfaces import DepthImage

_NUM_VIEWS = 8  # that see a point best; the field is evaluated for each
_AGREEING = 0.1  # largest difference of a channel from the colour that is nearest to those of all views
_NUM_SAMPLES = 4  # of the field along the ray of each view
_MIN_COSINE = 0.15  # between ray and normal; a view at a steeper angle does not count
_OTHER_POSES = 1e-3  # weight of a pose that is not of a training view: the field was not trained for it
_MIN_OPACITY = 1e-3  # of what a view sees; less has no colour
_CHUNK = 2**13  # points whose views are selected at once
_BATCH = 2**7  # of these, points at which the field is evaluated at once: activations stay in the cache of a CPU


def surface_colors(
    source: ExportSource,
    images: Sequence[DepthImage],
    points: Float[np.ndarray, "N 3"],
    normals: Float[np.ndarray, "N 3"],
    reach: float,
) -> UInt8[np.ndarray, "N 3"]:
    """Computes the mean colour of points on surfaces, over most of the views that see them at the steepest angles.

    The colour that a view sees is that of the field along the view's ray, from `reach` in front of the point to as far
    behind it, composited as in an image (Eq. 3 of arXiv:2003.08934). Views count by the cosine between ray and normal
    and by the opacity there. Those whose colour is far from that of most others do not count: a view whose matte cuts
    the object has taught the field to show the background from there. What the field looks like in detail does not
    depend on the size of the images.

    Args:
        source: the run.
        images: all of one size; they show whether something is in front of a point.
        points: in units of the dataset's files.
        normals: of unit length, outwards.
        reach: how far a point may be from the surface that an image shows.

    Returns:
        The colours; a point that no image sees has the colour of the nearest one that is seen, or black.
    """
    cameras = jax.tree.map(lambda *leaves: jnp.stack(leaves), *[image.camera for image in images])
    surfaces = jnp.stack([image.depth.reshape(-1) for image in images])
    trained = np.float32([_OTHER_POSES if image.name is None else 1 for image in images])
    evaluate = _color_function(source, reach)

    @jax.jit
    def colors(params, grid, cameras, surfaces, points, normals):
        weights = _weights(cameras, surfaces, trained, points, normals, reach)
        weight, view = jax.lax.top_k(weights.T, min(_NUM_VIEWS, len(images)))
        offset = points[:, None] - cameras.to_world[view, :, 3]
        rgba = evaluate(params, grid, points, offset / norm(offset)[..., None])
        total = (_of_most(weight, rgba)[..., None] * rgba).sum(axis=1)
        seen = total[:, 3:] > _OTHER_POSES * _MIN_OPACITY
        rgb = total[:, :3] / jnp.where(seen, total[:, 3:], 1)
        return jnp.rint(255 * jnp.clip(jnp.where(seen, rgb, 0), 0, 1)).astype(jnp.uint8), seen[:, 0]

    count, parts = len(points), [(np.zeros((0, 3), np.uint8), np.zeros(0, bool))]
    with stages.stage("evaluating colours") as stage:
        for start in range(0, count, _CHUNK):
            index = np.minimum(np.arange(start, start + _CHUNK), count - 1)  # one compiled shape
            some = np.float32(points[index]), np.float32(normals[index])
            parts.append(jax.tree.map(np.asarray, colors(*source.variables, cameras, surfaces, *some)))
            stage.update(min(start + _CHUNK, count), count)
    rgb, seen = (np.concatenate(each)[:count] for each in zip(*parts, strict=True))
    if seen.any() and not seen.all():
        rgb[~seen] = rgb[seen][cKDTree(points[seen]).query(points[~seen])[1]]
    return rgb


def _of_most(weight, rgba):
    """Returns weights [N, K] of views, 0 for those whose colour [N, K, 4] is far from the one nearest to all others."""
    opacity = rgba[..., 3]
    rgb = rgba[..., :3] / jnp.where(opacity > 0, opacity, 1)[..., None]
    apart = jnp.abs(rgb[:, :, None] - rgb[:, None]).max(axis=-1)
    middle = ((weight * opacity)[:, None] * apart).sum(axis=-1)
    middle = jnp.where(weight * opacity > 0, middle, jnp.inf).argmin(axis=1)
    return jnp.where(jnp.take_along_axis(apart, middle[:, None, None], axis=1)[:, 0] <= _AGREEING, weight, 0)


def _weights(cameras, surfaces, trained, points, normals, reach):
    """Returns [V, N], by how much each view counts for the colour of each point."""

    def weights(camera, surface, trained):
        pixels, depth = project(camera, points)
        column, line = (jnp.floor(jnp.clip(pixels[:, axis], -1, 1e6)).astype(jnp.int32) for axis in range(2))
        there = (column >= 0) & (column < camera.width) & (line >= 0) & (line < camera.height)
        shown = surface[jnp.where(there, line * camera.width + column, 0)]
        towards = camera.to_world[None, :, 3] - points
        cosine = (towards * normals).sum(axis=-1) / norm(towards)
        seen = there & (depth > 0) & (jnp.abs(shown - depth) < reach) & (cosine > _MIN_COSINE)
        return jnp.where(seen, trained * cosine, 0)

    return jax.vmap(weights)(cameras, surfaces, trained)


def _color_function(source, reach):
    """Returns the function (params, grid, points [N, 3], directions [N, K, 3]) -> rgb and opacity [N, K, 4]."""
    rotation = np.float32(poses_in_file(np.eye(3, 4)[None], source.views.to_file)[0, :, :3])
    to_field = field_position(source)
    edges = np.linspace(-reach, reach, _NUM_SAMPLES + 1, dtype=np.float32)
    middles = (edges[1:] + edges[:-1]) / 2

    def evaluate(params, grid, points, directions):
        scene = source.run.experiment.model.scene(params, grid)

        def some(part):
            points, directions = part  # [M, 3], [M, K, 3]
            along = np.append(edges, middles).reshape(1, 1, -1, 1)
            place = points[:, None, None] + directions[:, :, None] * along
            x = to_field(place.reshape(-1, len(edges) + len(middles), 3))
            length = norm(jnp.diff(x[:, : len(edges)], axis=1))
            x, viewdirs = x[:, len(edges) :], jnp.matmul(directions, rotation, precision="highest").reshape(-1, 1, 3)
            density, rgb = scene(x, viewdirs, **cell_inputs("export", scene, grid, x))
            weights = weights_from_density(density, length)
            rgba = jnp.concatenate([rgb, jnp.ones_like(rgb[..., :1])], axis=-1)
            return (weights[..., None] * rgba).sum(axis=1).reshape(*directions.shape[:-1], 4)

        parts = tuple(leaf.reshape(-1, _BATCH, *leaf.shape[1:]) for leaf in (points, directions))
        return jax.lax.map(some, parts).reshape(*directions.shape[:-1], 4)

    return evaluate


def field_position(source: ExportSource) -> Callable[[Float[Array, "*batch 3"]], Float[Array, "*batch 3"]]:
    """Returns the function from positions in units of the dataset's files to those at which the field is evaluated."""
    to_file = np.eye(4) if source.views.to_file is None else np.float64(source.views.to_file)
    to_run = np.float32(np.linalg.inv(to_file))

    def vector(values, x):
        return values.reshape(*(1,) * (x.ndim - 1), -1)

    def in_run(x):
        return jnp.matmul(x, to_run[:3, :3].T, precision="highest") + vector(to_run[:3, 3], x)

    if not source.run.experiment.config.data.ndc:
        return in_run
    cameras, (height, width) = source.views.cameras, source.views.size[0]
    scale = 2 * np.float32(cameras.focal)[0] / np.float32([width, height])

    def in_ndc(x):
        """Normalised device coordinates of the first view's lens, see `ndc_rays`, with the near plane at z = -1."""
        x = in_run(x)
        depth = jnp.maximum(-x[..., 2:], 1e-6)
        return jnp.concatenate([vector(scale, x) * x[..., :2] / depth, 1 - 2 / depth], axis=-1)

    return in_ndc
