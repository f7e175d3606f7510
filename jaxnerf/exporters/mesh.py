"""The export "mesh": the surfaces of a run as triangles with vertex colours."""

import pathlib

import numpy as np
import trimesh
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from jaxnerf.exporters.base import ExportSource, check_memory
from jaxnerf.exporters.fusion import fuse, grid_shape, level_set, solid_field
from jaxnerf.exporters.surfaces import export_box, render_depth_images
from jaxnerf.runtime import atomic_files, memory

_BYTES_PER_VOXEL = 16  # of the dense field, its index and what marching cubes keeps


def export_mesh(source: ExportSource, folder: pathlib.Path) -> None:
    """Writes mesh.ply, mesh.glb or mesh.obj: median depths, fused into a signed distance field.

    Raises:
        ValueError: if no surface is in the box, or the field does not fit into memory.
    """
    settings = source.settings
    images = render_depth_images(source, settings.image_size, all_around=True)
    box = export_box(source, images)
    _, shape = grid_shape(box, settings.resolution)
    check_memory(_BYTES_PER_VOXEL * float(np.prod(shape)), memory.available(), "give a smaller --resolution or --box")
    fused = fuse(images, box, settings.resolution, closed=settings.closed)
    vertices, faces, rgb = level_set(fused, solid_field(images, fused) if settings.closed else None)
    if not len(faces):
        raise ValueError(f"no surface is in the box {np.round(box, 4).tolist()}; give another --box")
    kept = keep_large_pieces(faces, settings.min_piece)
    mesh = decimated(trimesh.Trimesh(vertices, faces[kept], vertex_colors=rgb, process=False), settings.max_faces)
    mesh.remove_unreferenced_vertices()
    path = folder / f"mesh.{settings.format}"
    with atomic_files.naming(path):
        mesh.export(path)
    sides = " x ".join(f"{side:.4g}" for side in mesh.extents)
    source.say(f"{len(mesh.vertices):,} vertices, {len(mesh.faces):,} triangles, {sides} in the dataset's units")


def keep_large_pieces(faces: np.ndarray, fraction: float) -> np.ndarray:
    """Returns [F] bool, which faces [F, 3] belong to connected pieces with at least a fraction of all faces."""
    edges = np.concatenate([faces[:, :2], faces[:, 1:]])
    size = faces.max() + 1
    graph = coo_matrix((np.ones(len(edges), bool), edges.T), shape=(size, size))
    piece = connected_components(graph, directed=False)[1][faces[:, 0]]
    return np.bincount(piece)[piece] >= fraction * len(faces)


def decimated(mesh: trimesh.Trimesh, max_faces: int) -> trimesh.Trimesh:
    """Returns a mesh with at most about max_faces triangles (Garland and Heckbert 1997); 0: as it is.

    Each vertex has the colour of the nearest one before.
    """
    if not max_faces or len(mesh.faces) <= max_faces:
        return mesh
    fewer = mesh.simplify_quadric_decimation(face_count=max_faces)
    nearest = cKDTree(mesh.vertices).query(fewer.vertices)[1]
    return trimesh.Trimesh(
        fewer.vertices, fewer.faces, vertex_colors=np.asarray(mesh.visual.vertex_colors)[nearest], process=False
    )
