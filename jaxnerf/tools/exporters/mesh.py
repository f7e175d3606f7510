"""The export "mesh": the surfaces of a run as triangles with vertex colours.

Depth images are fused into a truncated signed distance field, whose zero level set is extracted (Curless and Levoy
1996). Only voxels near a surface of some depth image are stored and updated, a few per cent of the box.
"""

import functools
import pathlib
from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import trimesh
from jaxtyping import Float, Int
from scipy import ndimage
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation
from skimage import measure

from jaxnerf.core.cameras import project
from jaxnerf.data.geometry.poses import AXES, axis_of, up_of
from jaxnerf.data.geometry.world import poses_in_file
from jaxnerf.options import is_auto
from jaxnerf.runtime import atomic_files, memory, stages
from jaxnerf.tools.exporters.base import ExportSource, check_memory
from jaxnerf.tools.exporters.surface_colors import surface_colors
from jaxnerf.tools.exporters.surfaces import DepthImage, export_box, inside, render_depth_images
from jaxnerf.tools.exporters.texture import textured

_TEXTURED_FACES = 30_000  # the detail is in the texture
_BYTES_PER_VOXEL = 16  # of the dense field, its index and what marching cubes keeps
_TRUNCATION = 2.5  # voxels
_FREE = 3.0  # truncations in front of a surface, from which on space counts as free whatever the surface's normal
_MIN_WEIGHT = 0.05  # of all views of a vertex; one that sees an opaque surface at 45 degrees has 0.7
_CHUNK = 2**15  # vertices updated at once
_NEARLY_AXIS = 15.0  # degrees from an axis of the files, within which up may be meant to be that axis
_EMPTY_WEIGHT = 0.3  # of a pixel that shows empty space


def export_mesh(source: ExportSource, folder: pathlib.Path) -> None:
    """Writes mesh.ply, mesh.glb or mesh.obj: median depths, fused into a signed distance field.

    A texture is in the .glb, or in mesh.png beside the .obj and its mesh.mtl.

    Raises:
        ValueError: if no surface is in the box, or the field does not fit into memory.
    """
    settings = source.settings
    size = settings.resolution if is_auto(settings.size) else settings.size
    images = render_depth_images(source, size, all_around=True, colors=False)
    box = export_box(source, images)
    voxel, shape = grid_shape(box, settings.resolution)
    check_memory(_BYTES_PER_VOXEL * float(np.prod(shape)), memory.available(), "give a smaller --resolution or --box")
    fused = fuse(images, box, settings.resolution, closed=settings.closed)
    with stages.stage("extracting the surface"):
        vertices, faces = level_set(fused, solid_field(images, fused) if settings.closed else None)
        if not len(faces):
            raise ValueError(f"no surface is in the box {np.round(box, 4).tolist()}; give another --box")
        surface = trimesh.Trimesh(vertices, faces[keep_large_pieces(faces, settings.min_piece)], process=False)
        surface.remove_unreferenced_vertices()
        mesh = decimated(surface, settings.max_faces or (_TEXTURED_FACES if settings.texture else 0))

    def colors(points):
        return surface_colors(source, images, *on_surface(surface, points), reach=_TRUNCATION * voxel)

    if settings.texture:
        mesh = textured(mesh, settings.texture, colors)
    else:
        mesh.visual.vertex_colors = colors(mesh.vertices)
    path = folder / f"mesh.{settings.format}"
    with atomic_files.naming(path):
        if settings.format == "glb":
            poses = poses_in_file(np.asarray(source.views.cameras.to_world), source.views.to_file)
            given = source.run.experiment.config.data.up if is_auto(settings.up) else settings.up
            up = axis_of(given) if given else up_of(poses)
            nearest = max(AXES, key=lambda axis: axis_of(axis) @ up)
            angle = np.degrees(np.arccos(np.clip(axis_of(nearest) @ up, -1, 1)))
            if not given and 0.1 < angle < _NEARLY_AXIS:
                where = f"{angle:.1f} degrees from {nearest}"
                source.say(f"up is {where}, by how the cameras are held; --up={nearest} sets it")
            write_glb(mesh, path, up=up)
        else:
            mesh.export(path, **{"mtl_name": "mesh.mtl"} if settings.texture else {})
    sides = " x ".join(f"{side:.4g}" for side in mesh.extents)
    texture = f"a texture of {settings.texture} x {settings.texture}, " if settings.texture else ""
    count = f"{len(mesh.vertices):,} vertices, {len(mesh.faces):,} triangles"
    source.say(f"{count}, {texture}{sides} in the dataset's units")


def write_glb(mesh: trimesh.Trimesh, path: pathlib.Path, *, up: Float[np.ndarray, "3"]) -> None:
    """Writes a mesh with vertex colours or a texture as glTF 2.0 defines it.

    Colours of vertices become linear, in float32, as 8 bits of linear light would show bands in dark places; a texture
    is in sRGB. The material is not lit, since the colours hold the light of the scene. A node turns the mesh, whose
    vertices stay in the units and axes of the dataset's files, so that up is y.

    Args:
        mesh: with sRGB colours of 8 bits.
        path: of the file.
        up: unit vector in the axes of the mesh.
    """
    turn = np.eye(4)
    turn[:3, :3] = Rotation.align_vectors([[0.0, 1.0, 0.0]], [up])[0].as_matrix()
    has_texture = mesh.visual.kind == "texture"

    def complete(tree):
        # trimesh writes colours in 8 bits only, and other attributes under names that begin with _.
        if not has_texture:
            rough = {"metallicFactor": 0.0, "roughnessFactor": 1.0}  # for programs without the extension
            tree["materials"] = [{"pbrMetallicRoughness": rough}]
            for primitive in (primitive for part in tree["meshes"] for primitive in part["primitives"]):
                primitive["attributes"]["COLOR_0"] = primitive["attributes"].pop("_COLOR_0")
                primitive["material"] = 0
        for material in tree["materials"]:
            material["extensions"] = {"KHR_materials_unlit": {}}
        tree["extensionsUsed"] = ["KHR_materials_unlit"]

    scene = trimesh.Scene()
    scene.add_geometry(mesh if has_texture else _with_linear_colors(mesh), transform=turn)
    scene.export(path, file_type="glb", include_normals=True, tree_postprocessor=complete)


def _with_linear_colors(mesh):
    """Returns a mesh with linear colours of vertices as the attribute _COLOR_0."""
    colors = np.asarray(mesh.visual.vertex_colors) / 255
    rgb = np.where(colors[:, :3] <= 0.04045, colors[:, :3] / 12.92, ((colors[:, :3] + 0.055) / 1.055) ** 2.4)
    bare = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
    bare.vertex_attributes["_COLOR_0"] = np.float32(np.concatenate([rgb, colors[:, 3:]], axis=1))
    return bare


def keep_large_pieces(faces: np.ndarray, fraction: float) -> np.ndarray:
    """Returns [F] bool, which faces [F, 3] belong to connected pieces with at least a fraction of all faces."""
    edges = np.concatenate([faces[:, :2], faces[:, 1:]])
    size = faces.max() + 1
    graph = coo_matrix((np.ones(len(edges), bool), edges.T), shape=(size, size))
    piece = connected_components(graph, directed=False)[1][faces[:, 0]]
    return np.bincount(piece)[piece] >= fraction * len(faces)


def decimated(mesh: trimesh.Trimesh, max_faces: int) -> trimesh.Trimesh:
    """Returns a mesh with at most about max_faces triangles (Garland and Heckbert 1997); 0: as it is."""
    if not max_faces or len(mesh.faces) <= max_faces:
        return mesh.copy()
    fewer = mesh.simplify_quadric_decimation(face_count=max_faces)
    return trimesh.Trimesh(fewer.vertices, fewer.faces, process=False)


def on_surface(mesh: trimesh.Trimesh, points: Float[np.ndarray, "N 3"]) -> tuple[np.ndarray, np.ndarray]:
    """Returns points [N, 3] moved to the surface of a mesh, and the surface's normals [N, 3] there.

    That is the plane through the nearest vertex, perpendicular to its normal.
    """
    nearest = cKDTree(mesh.vertices).query(points)[1]
    normals = mesh.vertex_normals[nearest]
    above = ((points - mesh.vertices[nearest]) * normals).sum(axis=1, keepdims=True)
    return points - above * normals, normals


class Fused(NamedTuple):
    """A truncated signed distance field on the vertices of a grid of voxels, stored where it is known.

    Attributes:
        lower: [3] the grid's lower corner, in units of the dataset's files.
        voxel: the spacing of the vertices.
        shape: vertices along x, y and z.
        index: [M] flat index of each stored vertex, ascending.
        distance: [M] in truncations, in [-1, 1], positive outside; NaN where no view sees the vertex.
        rgb: [M, 3] in [0, 255].
    """

    lower: Float[np.ndarray, "3"]
    voxel: float
    shape: tuple[int, int, int]
    index: Int[np.ndarray, " M"]
    distance: Float[np.ndarray, " M"]


def grid_shape(box: Float[np.ndarray, "2 3"], resolution: int) -> tuple[float, tuple[int, int, int]]:
    """Returns the side of a voxel and the number of vertices along x, y and z."""
    sides = box[1] - box[0]
    voxel = float(sides.max() / resolution)
    return voxel, tuple(int(count) for count in np.ceil(sides / voxel - 1e-9).astype(int) + 1)


def fuse(
    images: Sequence[DepthImage], box: Float[np.ndarray, "2 3"], resolution: int, *, closed: bool = False
) -> Fused:
    """Fuses depth images.

    The distance of a vertex from a surface is measured along the normal at the pixel that sees the vertex, not along
    the ray: that is exact for a plane, however obliquely it is seen. A view counts by the cosine between its ray and
    the normal and by the light that the surface absorbs within the truncation: views along a surface and those
    into glass or fog are least accurate. Vertices well in front of a surface, and those before empty space, count as
    outside; those behind a surface are not seen. Pixels at the edges of surfaces are not used. What no
    image at the pose of a training view sees, at whatever angle, is unknown unless the surface is to be closed: the
    field was not trained there, but it often continues what it was trained on.

    Args:
        images: all of one size.
        box: what is fused.
        resolution: voxels along its longest side.
        closed: whether all images count, see above.

    Returns:
        Fused, without a vertex if no surface is in the box.
    """
    voxel, shape = grid_shape(box, resolution)
    truncation = _TRUNCATION * voxel
    with stages.stage("finding voxels near surfaces"):
        surfaces = [(image.points(), *image.normals()) for image in images]
        index = _vertices_near([points[cosine > 0] for points, _, cosine in surfaces], box[0], voxel, shape)
    x = np.float32(box[0] + voxel * np.stack(np.unravel_index(index, shape), axis=-1))
    x = jnp.asarray(np.resize(x, (-(-max(len(x), 1) // _CHUNK), _CHUNK, 3)))  # padded with copies of the first
    total = jnp.zeros((*x.shape[:2], 3), jnp.float32)
    with stages.stage("fusing depth images") as stage:
        for done, (image, (points, normal, cosine)) in enumerate(zip(images, surfaces, strict=True)):
            absorbed = -np.expm1(-np.maximum(image.extinction, 0) * truncation)
            weight = np.where(np.isinf(image.depth), _EMPTY_WEIGHT, cosine * absorbed)
            plane = (points * normal).sum(axis=-1)
            planes = np.dstack([image.depth, weight, plane, normal]).astype(np.float32)
            trained = np.float32(closed or image.name is not None)
            total = _integrate(total, image.camera, planes, x, np.float32(truncation), trained)
            jax.block_until_ready(total)
            stage.update(done + 1, len(images))
    weight, distance, views = np.moveaxis(np.asarray(total).reshape(-1, 3)[: len(index)], -1, 0)
    seen = (weight > _MIN_WEIGHT) & (views > 0)
    distance = np.where(seen, distance / np.where(seen, weight, 1), np.nan)
    return Fused(box[0], voxel, shape, index, distance)


def solid_field(images: Sequence[DepthImage], fused: Fused) -> Float[np.ndarray, "X Y Z"]:
    """Computes a field for `level_set` in which all space is solid that no image sees to be free.

    The boundary between the two closes the holes of the surface (Curless and Levoy 1996, Section 4). It is found at
    every second vertex.

    Args:
        images: the DepthImages that were fused.
        fused: for its grid.

    Returns:
        [X, Y, Z] from -1, solid, to 1, free; linear in between.
    """
    coarse = tuple(size // 2 + 1 for size in fused.shape)
    x = np.float32(fused.lower + 2 * fused.voxel * np.stack(np.indices(coarse), axis=-1))
    free = jnp.zeros(coarse, bool)
    with stages.stage("finding free space") as stage:
        for done, image in enumerate(images):
            free = _mark_free(free, image.camera, image.depth, x, np.float32(_TRUNCATION * fused.voxel))
            jax.block_until_ready(free)
            stage.update(done + 1, len(images))
    field = 2 * np.asarray(free, np.float32) - 1.01  # nowhere 0 below, which would make degenerate triangles
    for axis, size in enumerate(fused.shape):
        place = np.arange(size)
        field = (field.take(place // 2, axis) + field.take((place + 1) // 2, axis)) / 2
    return field


def level_set(fused: Fused, solid: Float[np.ndarray, "X Y Z"] | None = None) -> tuple[np.ndarray, np.ndarray]:
    """Extracts the surface at distance 0 by marching cubes (Lorensen and Cline 1987, in scikit-image).

    Args:
        fused: the field.
        solid: the field where no view sees a vertex, see `solid_field`. The surface is then closed, also where it
            meets the border of the grid. None: no face is in a voxel with a corner that no view sees.

    Returns:
        vertices [V, 3] in units of the dataset's files; and faces [F, 3], counterclockwise seen from outside. Both are
        empty where there is no surface.
    """
    known = ~np.isnan(fused.distance)
    index = fused.index[known]
    if not len(index):
        return np.zeros((0, 3)), np.zeros((0, 3), int)
    field = np.ones(fused.shape, np.float32) if solid is None else solid
    field.reshape(-1)[index] = fused.distance[known]
    cubes = None
    if solid is None:
        cubes = np.zeros(fused.shape, bool)
        cubes.reshape(-1)[index] = True
        for axis in range(3):  # scikit-image marches the cube below each vertex that is in the mask
            lower = np.roll(cubes, 1, axis=axis)
            lower[tuple(0 if i == axis else slice(None) for i in range(3))] = False
            cubes &= lower
    else:
        field = np.pad(field, 1, constant_values=1)  # free space around it closes the surface
    try:
        vertices, faces, _, _ = measure.marching_cubes(field, 0.0, mask=cubes, allow_degenerate=False)
    except (ValueError, RuntimeError):  # the level is outside the field's range, or no cube has a surface
        return np.zeros((0, 3)), np.zeros((0, 3), int)
    padding = (field.shape[0] - fused.shape[0]) // 2
    return fused.lower + fused.voxel * (vertices - padding), faces


def _vertices_near(parts, lower, voxel, shape):
    """Returns the flat indices of the vertices within the truncation of points, given as arrays [N, 3]."""
    near = np.zeros(shape, bool)
    for points in parts:
        place = np.rint((points - lower) / voxel).astype(int)
        place = place[inside(place, np.array([[0, 0, 0], np.subtract(shape, 1)]))]
        near[tuple(place.T)] = True
    reach = int(np.ceil(_TRUNCATION))  # more than the level set needs, as pixels leave gaps
    for axis in range(3):
        near = ndimage.maximum_filter1d(near, 2 * reach + 1, axis=axis, mode="constant")
    return np.flatnonzero(near)


@jax.jit
def _mark_free(free, camera, surface, x, truncation):
    """Returns free [X, Y, Z], also True where a view sees that x [X, Y, Z, 3] is in front of what it shows."""
    pixel, depth, visible = _pixels_of(camera, x, surface.shape)
    ahead = surface.reshape(-1)[pixel] - depth
    return free | (visible & (ahead > truncation) & (surface.reshape(-1)[pixel] > 0))


def _pixels_of(camera, x, shape):
    """Returns the flat indices [...] of the pixels that see x [..., 3], its depth, and whether there is one."""
    height, width = shape
    pixels, depth = project(camera, x)
    column, line = (jnp.floor(jnp.clip(pixels[..., axis], -1, 1e6)).astype(jnp.int32) for axis in range(2))
    visible = (depth > 0) & (column >= 0) & (column < width) & (line >= 0) & (line < height)
    return jnp.where(visible, line * width + column, 0), depth, visible


@functools.partial(jax.jit, donate_argnums=0)
def _integrate(total, camera, planes, x, truncation, trained):
    """Returns total [C, N, 3] with what one view sees of vertices x [C, N, 3].

    The sums are those of weights, of weights times distances, and of training views. planes [H, W, 6] are the depth,
    the weight, the distance of the surface's tangent plane from the origin, and its normal.
    """
    height, width = planes.shape[:2]
    rows = planes.reshape(height * width, -1)

    def add(part):
        total, x = part
        pixel, depth, visible = _pixels_of(camera, x, (height, width))
        row = rows[pixel]
        surface, weight, plane, normal = row[:, 0], row[:, 1], row[:, 2], row[:, 3:]
        ahead = (surface - depth) / truncation
        distance = jnp.clip(((x * normal).sum(axis=-1) - plane) / truncation, -1, 1)
        distance = jnp.where(ahead > _FREE, 1, distance)
        visible &= ahead > -1
        weight = jnp.where(visible, weight, 0)
        seen = jnp.where(visible & (surface > 0), trained, 0)
        return total + jnp.stack([weight, weight * distance, seen], axis=-1)

    return jax.lax.map(add, (total, x))
