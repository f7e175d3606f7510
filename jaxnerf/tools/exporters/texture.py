"""Textures of meshes: an atlas of charts, and the colours of its texels.

A chart is a connected part of the surface that faces one of the six directions along the axes, projected along it: a
height field, whose triangles are stretched by at most the square root of 3, or a little more at its border.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import trimesh
from jaxtyping import Float, Int, UInt8
from PIL import Image
from scipy.ndimage import distance_transform_edt
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from jaxnerf.runtime import stages

_GUTTER = 3  # texels around a chart with the colours of its border, which bilinear filters and mipmaps mix
_ROUNDS = 8  # in which parts of charts that overlap in the projection become charts of their own
_VOTES = 8  # rounds in which a triangle takes over the direction of its neighbours, so that charts are large
_VOTE = 0.3  # of a neighbour, beside the cosine between normal and direction
_MIN_COSINE = 0.3  # between normal and direction
_CANDIDATES = 2**22  # pairs of a texel and a triangle that are tested at once
_BISECTIONS = 12


class Atlas(NamedTuple):
    """A mesh whose triangles have places in a square image.

    Attributes:
        source: [N] the vertex of the given mesh where each vertex is. A vertex at which charts meet occurs in each.
        faces: [F, 3] indices of these, in the order of the given mesh.
        place: [N, 2] in texels, to the right and down from the image's upper left corner.
        size: texels along a side of the image.
    """

    source: Int[np.ndarray, " N"]
    faces: Int[np.ndarray, "F 3"]
    place: Float[np.ndarray, "N 2"]
    size: int


class Texels(NamedTuple):
    """Texels that triangles cover or touch.

    Attributes:
        index: [T] flat index of each, all different.
        face: [T] the triangle.
        weights: [T, 3] of the triangle's corners, at the texel's centre or a point of the triangle near it.
        overlapping: triangles that cover the centre of a texel of another triangle.
    """

    index: Int[np.ndarray, " T"]
    face: Int[np.ndarray, " T"]
    weights: Float[np.ndarray, "T 3"]
    overlapping: Int[np.ndarray, " O"]


def textured(
    mesh: trimesh.Trimesh, size: int, colors: Callable[[np.ndarray], UInt8[np.ndarray, "T 3"]]
) -> trimesh.Trimesh:
    """Returns a mesh with a texture in place of colours of vertices.

    Args:
        mesh: any.
        size: texels along a side of the square image.
        colors: [T, 3] points on the mesh -> their sRGB colours.

    Raises:
        ValueError: if the image has no room for all charts.
    """
    with stages.stage("unwrapping the surface"):
        atlas, texels = unwrap(mesh, size)
    corners = mesh.vertices[mesh.faces[texels.face]]
    image = np.zeros((size * size, 3), np.uint8)
    image[texels.index] = colors((texels.weights[..., None] * corners).sum(axis=1))
    empty = np.ones(size * size, bool)
    empty[texels.index] = False
    nearest = distance_transform_edt(empty.reshape(size, size), return_distances=False, return_indices=True)
    image = image.reshape(size, size, 3)[tuple(nearest)]
    material = trimesh.visual.material.PBRMaterial(
        name="mesh",  # and of the files beside an .obj
        baseColorTexture=Image.fromarray(image),
        baseColorFactor=[255] * 4,
        metallicFactor=0.0,
        roughnessFactor=1.0,
    )
    place = atlas.place / size * [1, -1] + [0, 1]
    return trimesh.Trimesh(
        mesh.vertices[atlas.source],
        atlas.faces,
        vertex_normals=mesh.vertex_normals[atlas.source],
        visual=trimesh.visual.TextureVisuals(uv=place, material=material),
        process=False,
    )


def unwrap(mesh: trimesh.Trimesh, size: int) -> tuple[Atlas, Texels]:
    """Makes an Atlas, all charts at one scale, and finds the texels of its triangles.

    Raises:
        ValueError: if the image has no room for all charts.
    """
    facing = _directions(mesh)
    label = facing.copy()
    for count in range(_ROUNDS):
        chart = _pieces(mesh, label)
        atlas = _placed(mesh, chart, facing, size)
        texels = rasterize(atlas)
        if not len(texels.overlapping):
            break
        label[texels.overlapping] = facing[texels.overlapping] + 6 * (count + 1)
    return atlas, texels


def rasterize(atlas: Atlas) -> Texels:
    """Finds the texels whose centres triangles cover, and those with a centre less than a texel beside a triangle.

    The latter have the weights of a point on the triangle's edge, so that filters read colours of the same chart also
    at the tip of a narrow triangle. A triangle that is a point has no texel.
    """
    corners = atlas.place[atlas.faces]
    low = np.floor(corners.min(axis=1) - 1.5).astype(int)
    sides = np.ceil(corners.max(axis=1) + 0.5).astype(int) - low + 1
    sizes = sides.prod(axis=1)
    owner, weights = np.full(atlas.size**2, -1), np.zeros((atlas.size**2, 3), np.float32)
    overlapping, beside = [], []
    splits = np.searchsorted(np.cumsum(sizes), np.arange(_CANDIDATES, sizes.sum(), _CANDIDATES))
    for faces in np.split(np.arange(len(sizes)), splits):
        face = np.repeat(faces, sizes[faces])
        rank = np.arange(len(face)) - np.repeat(np.cumsum(sizes[faces]) - sizes[faces], sizes[faces])
        texel = low[face] + np.stack([rank % sides[face, 0], rank // sides[face, 0]], axis=1)
        weight, index = _barycentric(corners[face], texel + 0.5), texel @ [1, atlas.size]
        covers = (weight > -1e-9).all(axis=1)
        on_edge, distance = _nearest_on_edges(corners[face[~covers]], texel[~covers] + 0.5)
        near = np.flatnonzero(~covers)[distance < 1]
        beside.append((distance[distance < 1], index[near], face[near], on_edge[distance < 1]))
        face, weight, index = face[covers], weight[covers], index[covers]
        first = np.unique(index, return_index=True)[1]
        free = first[owner[index[first]] < 0]
        owner[index[free]], weights[index[free]] = face[free], weight[free]
        inside = (weight > 1e-4).all(axis=1)  # not on an edge that two triangles share
        overlapping.append(face[inside & (owner[index] != face)])
    distance, index, face, on_edge = (np.concatenate(each) for each in zip(*beside, strict=True))
    order = np.argsort(distance, kind="stable")
    order = order[owner[index[order]] < 0]
    order = order[np.unique(index[order], return_index=True)[1]]
    owner[index[order]], weights[index[order]] = face[order], on_edge[order]
    index = np.flatnonzero(owner >= 0)
    return Texels(index, owner[index], weights[index], np.unique(np.concatenate(overlapping)))


def _barycentric(corners, points):
    """Returns the weights [N, 3] of the corners [N, 3, 2] of triangles at points [N, 2]; NaN without an area."""
    first, second = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    offset = points - corners[:, 0]
    area = first[:, 0] * second[:, 1] - first[:, 1] * second[:, 0]
    area = np.where(np.abs(area) > 1e-12, area, np.nan)
    b = (offset[:, 0] * second[:, 1] - offset[:, 1] * second[:, 0]) / area
    c = (first[:, 0] * offset[:, 1] - first[:, 1] * offset[:, 0]) / area
    return np.stack([1 - b - c, b, c], axis=1)


def _nearest_on_edges(corners, points):
    """Returns the weights [N, 3] of corners [N, 3, 2] at the point on an edge nearest to points [N, 2], and how far.

    The distance is infinite where an edge has no length.
    """
    best, found = np.full(len(points), np.inf), np.zeros((len(points), 3))
    for first, second in ((0, 1), (1, 2), (2, 0)):
        start, edge = corners[:, first], corners[:, second] - corners[:, first]
        square = (edge**2).sum(axis=1)
        along = np.clip(((points - start) * edge).sum(axis=1) / np.where(square > 0, square, 1), 0, 1)
        distance = np.linalg.norm(start + along[:, None] * edge - points, axis=1)
        nearer = (distance < best) & (square > 0)
        best[nearer] = distance[nearer]
        found[nearer] = 0
        found[nearer, first], found[nearer, second] = 1 - along[nearer], along[nearer]
    return found, best


def _directions(mesh):
    """Returns [F], the direction that each triangle faces: 0, 1, 2 along the axes, 3, 4, 5 against them."""
    cosine = np.concatenate([mesh.face_normals, -mesh.face_normals], axis=1)
    allowed = cosine >= np.minimum(_MIN_COSINE, cosine.max(axis=1, keepdims=True))
    label = cosine.argmax(axis=1)
    left, right = mesh.face_adjacency.T
    for _ in range(_VOTES):
        votes = np.zeros_like(cosine)
        np.add.at(votes, (left, label[right]), _VOTE)
        np.add.at(votes, (right, label[left]), _VOTE)
        label = np.where(allowed, cosine + votes, -np.inf).argmax(axis=1)
    return label


def _pieces(mesh, label):
    """Returns [F], the connected piece of triangles with equal labels [F] to which each belongs."""
    pairs = mesh.face_adjacency[(label[mesh.face_adjacency[:, 0]] == label[mesh.face_adjacency[:, 1]])]
    graph = coo_matrix((np.ones(len(pairs), bool), pairs.T), shape=(len(label),) * 2)
    return connected_components(graph, directed=False)[1]


def _placed(mesh, chart, facing, size):
    """Returns the Atlas of charts [F], each projected along the direction that its triangles face."""
    pairs, inverse = np.unique(
        np.stack([np.repeat(chart, 3), mesh.faces.reshape(-1)], axis=1), axis=0, return_inverse=True
    )
    chart_of, source = pairs.T
    axis = np.zeros(chart.max() + 1, int)
    axis[chart] = facing % 3
    kept = np.array([[1, 2], [0, 2], [0, 1]])[axis[chart_of]]
    flat = np.take_along_axis(mesh.vertices[source], kept, axis=1)
    low, high = np.full((len(axis), 2), np.inf), np.full((len(axis), 2), -np.inf)
    np.minimum.at(low, chart_of, flat)
    np.maximum.at(high, chart_of, flat)
    tall = np.diff(high - low, axis=1)[:, 0] > 0  # lies on its side
    flat = np.where(tall[chart_of, None], flat[:, ::-1], flat)
    low, high = (np.where(tall[:, None], each[:, ::-1], each) for each in (low, high))
    scale, corner = _pack(high - low, size)
    return Atlas(source, inverse.reshape(-1, 3), (flat - low[chart_of]) * scale + corner[chart_of], size)


def _pack(sides, size):
    """Returns the largest scale, in texels, at which charts with such sides [C, 2] fit, and their corners [C, 2].

    Charts stand on shelves, by height.
    """
    order = np.argsort(-sides[:, 1], kind="stable")
    scales, found = [0.0, size / np.sqrt(max(sides.prod(axis=1).sum(), 1e-30))], None
    for _ in range(_BISECTIONS):
        scale = sum(scales) / 2
        corner = _shelves(np.ceil(sides[order] * scale).astype(int) + 1 + 2 * _GUTTER, size)
        if corner is None:
            scales[1] = scale
        else:
            scales[0], found = scale, corner
    if found is None:
        raise ValueError(
            f"a texture of {size} x {size} has no room for the {len(sides):,} charts of the mesh; give a larger "
            "--texture or a smaller --max_faces"
        )
    corner = np.empty_like(found)
    corner[order] = found
    return scales[0], corner + _GUTTER + 0.5


def _shelves(sides, size):
    """Returns the corners [C, 2] of rectangles, ordered by height, on shelves of a square; None: they do not fit."""
    corners, x, y, height = [], 0, 0, 0
    for width, tall in sides.tolist():
        if x + width > size:
            x, y, height = 0, y + height, 0
        height = height or tall
        if width > size or y + height > size:
            return None
        corners.append((x, y))
        x += width
    return np.array(corners)
