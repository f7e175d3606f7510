"""Atlases of meshes whose charts are known, and textures of which any point of the surface has the right colour."""

import numpy as np
import pytest
import trimesh
from scipy.ndimage import map_coordinates

from jaxnerf.tools.exporters import texture
from jaxnerf.tools.exporters.texture import rasterize, textured, unwrap

SIZE = 256


def smooth(points):
    """A colour that changes slowly."""
    return np.uint8(np.rint(127 + 100 * np.sin(2 * points)))


def winding(turns=2, around=60, across=3):
    """A ramp that winds up around the z axis: connected, everywhere facing up, and above itself."""
    angle = np.linspace(0, 2 * np.pi * turns, around * turns + 1)[:, None]
    radius = np.linspace(0.5, 1, across + 1)[None]
    x, y, z = np.broadcast_arrays(radius * np.cos(angle), radius * np.sin(angle), 0.05 * angle)
    index = np.arange(x.size).reshape(x.shape)
    a, b, c, d = (each.reshape(-1) for each in (index[:-1, :-1], index[:-1, 1:], index[1:, :-1], index[1:, 1:]))
    faces = np.concatenate([np.stack([a, b, d], axis=1), np.stack([a, d, c], axis=1)])
    return trimesh.Trimesh(np.stack([x, y, z], axis=-1).reshape(-1, 3), faces, process=False)


@pytest.mark.parametrize("mesh", [trimesh.creation.icosphere(subdivisions=3), winding()], ids=["ball", "winding"])
def test_any_point_of_the_surface_has_its_color(mesh):
    """Bilinear filters of the image at points in the triangles, also beside the edges of charts."""
    result = textured(mesh, SIZE, smooth)
    rng = np.random.default_rng(0)
    face = rng.integers(len(mesh.faces), size=20_000)
    weights = rng.dirichlet([0.5] * 3, size=len(face))[..., None]  # many near edges
    place = (weights * result.visual.uv[result.faces[face]]).sum(axis=1)
    column, row = place[:, 0] * SIZE - 0.5, (1 - place[:, 1]) * SIZE - 0.5
    image = np.asarray(result.visual.material.baseColorTexture, float)
    found = np.stack([map_coordinates(plane, [row, column], order=1) for plane in np.moveaxis(image, -1, 0)], axis=1)
    expected = smooth((weights * mesh.vertices[mesh.faces[face]]).sum(axis=1))
    error = np.abs(found - expected)
    # Where two layers of the ramp end beside each other in one chart, a filter mixes them within half a texel.
    assert np.quantile(error, 0.995) < 5 and error.mean() < 1 and error.max() < (12 if len(mesh.faces) > 1000 else 60)
    np.testing.assert_array_equal(result.vertices[result.faces], mesh.vertices[mesh.faces])


def test_charts_do_not_meet():
    """The ball has six charts, which gutters separate; the ramp is cut where it is above itself."""
    ball = trimesh.creation.icosphere(subdivisions=3)
    atlas, texels = unwrap(ball, SIZE)
    assert not len(texels.overlapping) and len(np.unique(texels.index)) == len(texels.index)
    assert 0.4 < len(texels.index) / SIZE**2 < 0.9
    chart = trimesh.graph.connected_component_labels(trimesh.graph.face_adjacency(atlas.faces), len(atlas.faces))
    assert len(np.unique(chart)) == 6
    image = np.full((SIZE, SIZE), -1)
    image.reshape(-1)[texels.index] = chart[texels.face]
    for shift in range(1, 2 * texture._GUTTER + 1):
        for axis in range(2):
            near, far = np.split(image, [SIZE - shift], axis)[0], np.split(image, [shift], axis)[1]
            assert (near == far)[(near >= 0) & (far >= 0)].all()
    ramp = winding()
    single = texture._placed(ramp, np.zeros(len(ramp.faces), int), texture._directions(ramp), SIZE)
    assert len(rasterize(single).overlapping) > 50
    assert not len(unwrap(ramp, SIZE)[1].overlapping)


def test_narrow_triangles_have_texels_up_to_their_tips():
    """The second covers no centre, and the third is a point."""
    corners = np.array([[2, 2], [14, 2.2], [2, 2.4], [5.1, 9.1], [5.2, 9.1], [5.1, 9.2], [9, 9], [9, 9], [9, 9]])
    texels = rasterize(texture.Atlas(np.arange(9), np.arange(9).reshape(3, 3), corners, 16))
    owner = np.full(256, -1)
    owner[texels.index] = texels.face
    owner = owner.reshape(16, 16)
    assert (owner[2, 2:14] == 0).all() and owner[9, 5] == 1 and set(texels.face) == {0, 1}
    place = (texels.weights[..., None] * corners.reshape(3, 3, 2)[texels.face]).sum(axis=1)
    centers = np.stack([texels.index % 16, texels.index // 16], axis=1) + 0.5
    assert (texels.weights >= 0).all() and np.linalg.norm(place - centers, axis=1).max() < 1


def test_settings_that_have_no_texture_are_named():
    with pytest.raises(ValueError, match="no room for the .* charts .* larger --texture"):
        unwrap(trimesh.creation.icosphere(subdivisions=3), 16)
