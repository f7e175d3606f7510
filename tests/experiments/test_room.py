"""The embedded room: exact depths and free space, and colours that depend on the surface alone or on the direction."""

import numpy as np
import pytest

from test_scenes import room


@pytest.fixture(scope="module")
def rays():
    """Origins and directions [400, 3]: from free space, half of them towards the table."""
    rng = np.random.default_rng(0)
    origins = rng.uniform(room.LOWER, room.UPPER, (1000, 3)) * [0.5, 0.5, 0.6]
    origins = origins[~room.is_matter(origins)][:400]
    directions = rng.normal(size=(400, 3))
    directions[::2] = [0, 0, 0.8] - origins[::2] + 0.3 * directions[::2]
    return origins, directions


def test_the_depth_is_that_of_marching_through_free_space(rays):
    origins, directions = (values[::4] for values in rays)
    t = room.trace(origins, directions).t
    fractions = np.linspace(0, 1, 1500)[:-1]
    x = origins[:, None] + (t[:, None] * fractions)[..., None] * directions[:, None]
    assert not room.is_matter(x).any()
    beyond = origins + (t * (1 + 1e-9))[:, None] * directions
    assert room.is_matter(beyond).all()


def test_rays_hit_all_shapes_and_normals_face_them(rays):
    hits = room.trace(*rays)
    shapes = {room._bodies()[index].shape for index in hits.body if index >= 0}
    assert shapes == {"box", "ball", "cylinder"} and (hits.body == -1).any()
    assert (hits.t > 0).all()
    np.testing.assert_allclose(np.linalg.norm(hits.normal, axis=-1), 1, rtol=1e-12)
    assert ((hits.normal * rays[1]).sum(axis=-1) < 0).all()
    x = rays[0] + hits.t[:, None] * rays[1]
    assert not room.is_matter(x + 1e-6 * hits.normal).any() and room.is_matter(x - 1e-6 * hits.normal).all()


def test_t_is_in_units_of_the_direction(rays):
    origins, directions = rays
    hits, doubled = room.trace(origins, directions), room.trace(origins, 2 * directions)
    np.testing.assert_allclose(hits.t, 2 * doubled.t, rtol=1e-12)
    along = np.tile([1.0, 0.0, 0.0], (2, 1))  # two components are 0
    found = room.trace(np.array([[0.0, 0.0, 1.9], [3.0, 0.0, 3.0]]), along)
    np.testing.assert_allclose(found.t, [5.0, 2.0], rtol=1e-12)


def test_a_color_depends_on_its_ray_alone(rays):
    origins, directions = rays
    rgb, depth = room.render(origins.reshape(20, 20, 3), directions.reshape(20, 20, 3))
    assert rgb.shape == (20, 20, 3) and depth.shape == (20, 20)
    assert rgb.min() >= 0 and rgb.max() <= 1 and rgb.std(axis=(0, 1)).min() > 0.1
    for part in (slice(0, 400, 7), slice(3, 4)):
        alone, _ = room.render(origins[part], directions[part])
        np.testing.assert_allclose(alone, rgb.reshape(-1, 3)[part], atol=1e-12)


def test_only_glossy_bodies_depend_on_the_direction():
    bodies = room._bodies()
    glossy = next(index for index, body in enumerate(bodies) if body.shape == "ball" and body.gloss)
    matt = next(index for index, body in enumerate(bodies) if body.shape == "ball" and not body.gloss)
    rng = np.random.default_rng(1)
    for index, changes in ((glossy, True), (matt, False)):
        normal = np.array([[0.3, -0.4, np.sqrt(0.75)]])
        x = bodies[index].center + normal * bodies[index].half
        towards = rng.normal(size=(200, 3))
        towards *= np.sign(-(towards @ normal[0]))[:, None] / np.linalg.norm(towards, axis=-1, keepdims=True)
        hits = room.Hits(np.ones(200), np.full(200, index), np.tile(normal, (200, 1)))
        rgb = room.surface_colors(np.tile(x, (200, 1)), towards, hits)
        assert (np.ptp(rgb, axis=0).max() > 0.05) == changes


def test_walls_and_bodies_are_matter():
    assert room.is_matter(np.stack([body.center for body in room._bodies()])).all()
    assert room.is_matter(np.array([[9.0, 0, 1], [0, 0, -0.1], [0, 0, room.TABLE_TOP - 0.01]])).all()
    assert not room.is_matter(np.array([[2.0, 0, 1.5], [0, 0, 0.3]])).any()
