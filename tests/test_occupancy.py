import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxnerf
from helpers import all_finite, assert_same, compiled, random_rays
from jaxnerf.core import compositing, occupancy
from jaxnerf.fields import analytic

RAYS, SEGMENTS, RESOLUTION = 24, 40, 8
BACKGROUND = np.float32([0.9, 0.2, 0.5])
OUTPUTS = ("rgb", "opacity", "depth", "disparity")


def scene(x, viewdirs):
    """Fog around the origin, coloured by place and direction."""
    return 4 * jnp.exp(-2 * (x**2).sum(axis=-1)), jax.nn.sigmoid(3 * x + viewdirs)


def full_grid(half=30.0):
    everywhere = np.ones((RESOLUTION,) * 3, bool)
    return occupancy.create_grid(np.full(3, -half), np.full(3, half), everywhere, assumed=1.0)


def checked_grid():
    """Returns a grid of which every other cell is empty."""
    possible = np.indices((RESOLUTION,) * 3).sum(axis=0) % 2 == 0
    return occupancy.create_grid(np.full(3, -1.5), np.full(3, 1.5), possible, assumed=1.0)


@pytest.fixture(scope="module")
def rays():
    """Rays that pass near the origin."""
    rays = random_rays(0, (RAYS,), near=1.0, far=7.0)
    return dataclasses.replace(rays, origins=np.float32(0.4 * rays.origins - 4 * rays.directions))


@pytest.fixture(scope="module")
def samples(rays):
    edges = jaxnerf.uniform_edges(rays.near, rays.far, num_segments=SEGMENTS)
    return jaxnerf.samples_from_edges(jax.random.key(1), edges)


@compiled
def dense(rays, samples):
    return jaxnerf.render_samples(scene, rays, samples, background=BACKGROUND)


packed = compiled(
    lambda grid, rays, samples, capacity, stop=0.0: jaxnerf.render_packed(
        scene, grid, rays, samples, capacity=capacity, stop=stop, background=BACKGROUND
    ),
    "capacity",
    "stop",
)


def assert_close(got, want, atol=1e-6):
    for name in OUTPUTS:
        np.testing.assert_allclose(getattr(got, name), getattr(want, name), rtol=1e-6, atol=atol)


def test_a_full_grid_changes_nothing(rays, samples):
    got = packed(full_grid(), rays, samples, capacity=RAYS * SEGMENTS)
    assert_close(got, dense(rays, samples))
    assert got.weights is None and got.dropped.shape == (RAYS,) and not got.dropped.any()


def test_a_full_grid_changes_no_gradient(rays, samples):
    slopes = np.float32(np.random.default_rng(2).normal(size=(RAYS, 6)))

    def total(render):
        def value(rays, samples, strength):
            def own(x, viewdirs):
                density, rgb = scene(x, viewdirs)
                return strength * density, rgb

            seen = render(own, rays, samples)
            parts = jnp.stack([seen.opacity, seen.depth, seen.disparity], axis=-1)
            return (jnp.concatenate([seen.rgb, parts], axis=-1) * slopes).sum()

        return jax.jit(jax.grad(value, argnums=(0, 1, 2)))

    def in_pool(scene, rays, samples):
        return jaxnerf.render_packed(scene, full_grid(), rays, samples, capacity=RAYS * SEGMENTS)

    given = jax.tree.map(jnp.asarray, (rays, samples)), jnp.float32(1.3)
    got = total(in_pool)(*given[0], given[1])
    want = total(jaxnerf.render_samples)(*given[0], given[1])
    for a, b in zip(jax.tree.leaves(got), jax.tree.leaves(want), strict=True):
        np.testing.assert_allclose(a, b, atol=2e-6 * max(1.0, np.abs(b).max()))


def test_an_empty_cell_is_as_if_the_scene_were_empty_there(rays, samples):
    grid = checked_grid()
    kept = np.asarray(occupancy.occupied_at(grid, rays, samples.t))
    assert 0.05 < kept.mean() < 0.6
    seen = dataclasses.replace(samples, delta=jnp.where(kept, samples.delta, 0))
    assert_close(packed(grid, rays, samples, capacity=int(kept.sum())), dense(rays, seen))


def test_a_cell_is_found_by_hand():
    grid = checked_grid()
    rays = jaxnerf.Rays(
        origins=np.float32([[-1.4, -1.4, -1.4]]),
        directions=np.float32([[0.0, 0.0, 1.0]]),
        viewdirs=np.float32([[0.0, 0.0, 1.0]]),
        near=np.float32([0.0]),
        far=np.float32([9.0]),
    )
    t = np.float32([[0.0, 0.2, 0.3, 0.7, 2.8, 3.0, np.nan]])  # cells 0 0 1 2 7, outside, unknown
    np.testing.assert_array_equal(
        occupancy.occupied_at(grid, rays, t)[0], [True, True, False, True, False, False, True]
    )


def test_rays_that_miss_everything_see_the_background(rays, samples):
    nothing = dataclasses.replace(full_grid(), occupied=jnp.zeros((RESOLUTION,) * 3, bool))
    for stop in (0.0, 0.01):
        got = packed(nothing, rays, samples, capacity=64, stop=stop)
        np.testing.assert_allclose(got.rgb, np.broadcast_to(BACKGROUND, (RAYS, 3)), rtol=1e-6)
        np.testing.assert_array_equal(got.depth, rays.far)
        np.testing.assert_array_equal(got.disparity, 0)
        np.testing.assert_array_equal(got.opacity, 0)


def test_an_overflow_is_counted_and_spares_the_rays_that_fit(rays, samples):
    got = packed(full_grid(), rays, samples, capacity=10 * SEGMENTS + 5)
    np.testing.assert_array_equal(got.dropped, [0] * 10 + [SEGMENTS - 5] + [SEGMENTS] * (RAYS - 11))
    first = jax.tree.map(lambda leaf: leaf[:10], got)
    assert_close(first, jax.tree.map(lambda leaf: leaf[:10], dense(rays, samples)))


@pytest.mark.parametrize("stop, capacity", [(0.5, RAYS), (0.1, 100), (1e-3, 60), (1e-3, RAYS * SEGMENTS)])
def test_what_stops_early_is_within_its_bound_and_drops_nothing(rays, samples, stop, capacity):
    got, want = packed(full_grid(), rays, samples, capacity=capacity, stop=stop), dense(rays, samples)
    assert np.abs(got.rgb - want.rgb).max() <= stop + 1e-6
    assert (got.opacity <= want.opacity + 1e-6).all() and not got.dropped.any()
    still = 1 - got.opacity > stop
    np.testing.assert_allclose(got.rgb[still], want.rgb[still], atol=1e-6)


def test_a_small_pool_asks_for_less_than_all():
    """Behind a wall nothing is asked once the pool has come to it."""
    asked = []
    wall = analytic.slab(1e4, lower=0.0, upper=1.0).scene

    def counting(x, viewdirs):
        jax.debug.callback(lambda x: asked.append(float(x[0, :, 2].min())), x)
        return wall(x, viewdirs)

    one = np.float32([[0.0, 0.0, -1.0]])
    rays = jaxnerf.Rays(
        origins=-2 * one, directions=one, viewdirs=one, near=np.zeros(1, "f"), far=np.full(1, 20, "f")
    )
    samples = jaxnerf.samples_from_edges(None, jaxnerf.uniform_edges(rays.near, rays.far, num_segments=200))
    seen = jaxnerf.render_packed(counting, full_grid(), rays, samples, capacity=4, stop=1e-4)
    jax.effects_barrier()
    np.testing.assert_allclose(seen.opacity, 1, atol=1e-4)
    assert len(asked) == 3 and min(asked) > 0.4  # 12 of 200 samples: 10 before the wall, 2 in it


def test_packed_weights_are_those_of_each_ray():
    rng = np.random.default_rng(3)
    density = np.float32(rng.exponential(size=(5, 7)) * (rng.uniform(size=(5, 7)) < 0.7))
    density[1, 2], density[3, 0] = np.inf, 1e30
    length = np.float32(rng.uniform(size=(5, 7)))
    starts = np.arange(35) % 7 == 0
    slopes = np.float32(rng.normal(size=35))

    def total(density):
        return (compositing.packed_weights(density, length.reshape(-1), starts, longest=7)[0] * slopes).sum()

    def separate(density):
        weights = jaxnerf.weights_from_density(density.reshape(5, 7), length)
        return (weights.reshape(-1) * slopes).sum()

    for function in (total, separate):
        assert all_finite(jax.jit(jax.grad(function))(density.reshape(-1)))
    got, _ = compositing.packed_weights(density.reshape(-1), length.reshape(-1), starts, longest=7)
    np.testing.assert_allclose(got.reshape(5, 7), jaxnerf.weights_from_density(density, length), atol=1e-7)
    np.testing.assert_allclose(
        jax.grad(total)(density.reshape(-1)), jax.grad(separate)(density.reshape(-1)), atol=1e-6
    )


@pytest.mark.parametrize("shape", [(), (4,), (2, 3)])
def test_leading_axes_do_not_matter(rays, samples, shape):
    count = int(np.prod(shape))

    def part(leaf):
        return None if leaf is None else np.asarray(leaf)[:count].reshape((*shape, *np.shape(leaf)[1:]))

    some = jax.tree.map(part, (rays, samples))
    got = packed(full_grid(), *some, capacity=count * SEGMENTS)
    assert_close(got, jax.tree.map(part, dense(rays, samples)))


def test_nan_of_a_scene_is_seen_only_where_it_is_asked(rays, samples):
    grid = checked_grid()

    def half_wrong(x, viewdirs):
        density, rgb = scene(x, viewdirs)
        return jnp.where(x[..., 0] > 0.0, jnp.nan, density), rgb

    @jax.jit
    def value(rays, kept):
        masked = dataclasses.replace(samples, delta=jnp.where(kept, samples.delta, 0))
        return jaxnerf.render_packed(half_wrong, grid, rays, masked, capacity=RAYS * SEGMENTS).rgb.sum()

    kept = np.asarray(jaxnerf.positions(rays, samples.t))[..., 0] <= 0.0
    given = jax.tree.map(jnp.asarray, rays)
    assert all_finite(jax.value_and_grad(value)(given, kept))
    assert np.isnan(value(given, np.ones_like(kept)))


def test_rays_are_cut_to_the_box():
    grid = full_grid(half=1.0)
    directions = np.float32([[2, 0, 0], [2, 0, 0], [0, 0, 1], [1, 1, 0], [-1, 0, 0]])
    origins = np.float32([[-3, 0, 0], [-3, 2, 0], [0.5, 0.5, 0], [-2, -2, 0.5], [-3, 0, 0]])
    near, far = np.zeros(5, np.float32), np.full(5, 10, np.float32)
    rays = jaxnerf.Rays(origins=origins, directions=directions, viewdirs=directions, near=near, far=far)
    got = compiled(occupancy.cut_to_box)(grid, rays)
    np.testing.assert_allclose(got.near[[0, 2, 3]], [1, 0, 1])
    np.testing.assert_allclose(got.far[[0, 2, 3]], [2, 1, 3])
    np.testing.assert_array_equal(got.near[[1, 4]], got.far[[1, 4]])


@compiled
def look(key, grid, cells):
    return occupancy.update_grid(key, grid, scene, cells, threshold=0.5, decay=0.5)


def test_looks_leave_out_what_is_empty_and_keep_what_is_not():
    resolution = 16
    everywhere = np.ones((resolution,) * 3, bool)
    grid = occupancy.create_grid(np.full(3, -3.0), np.full(3, 3.0), everywhere, assumed=1.9)
    cells = np.arange(resolution**3, dtype=np.int32)
    first = look(jax.random.key(0), grid, cells)
    assert first.occupied.all()  # one look is not enough: 0.95 is left of what was assumed
    grid = look(jax.random.key(1), first, cells)
    middles = (np.indices(grid.occupied.shape) + 0.5) * 6 / resolution - 3
    away = np.sqrt((middles**2).sum(axis=0))
    radius = np.sqrt(np.log(4 / 0.5) / 2)  # where the density is at the threshold
    assert grid.occupied[away < radius].all()  # the neighbours keep what one look might miss
    assert not grid.occupied[away > radius + 6 / resolution * 3].any()
    truth = 4 * np.exp(-2 * away**2)
    assert np.corrcoef(np.asarray(grid.mean).reshape(-1), truth.reshape(-1))[0, 1] > 0.95


def test_a_look_at_some_cells_leaves_the_others_as_they_were():
    grid = dataclasses.replace(full_grid(1.0), possible=jnp.asarray(checked_grid().possible))
    cells = np.int32([3, 77, 300])
    got = look(jax.random.key(2), grid, cells)
    changed = np.flatnonzero(np.asarray(got.peak != grid.peak))
    assert set(changed) <= set(cells) and set(np.flatnonzero(got.mean)) == set(cells)
    assert not got.occupied[~np.asarray(grid.possible)].any()


def test_wrong_arguments(rays, samples):
    with pytest.raises(ValueError, match="create_grid: upper"):
        occupancy.create_grid(np.zeros(3), np.zeros(2), np.ones((2, 2, 2), bool), assumed=1.0)
    with pytest.raises(ValueError, match="create_grid: possible"):
        occupancy.create_grid(np.zeros(3), np.ones(3), np.ones((2, 2, 3), bool), assumed=1.0)
    with pytest.raises(ValueError, match="capacity is 3 for 24 rays"):
        jaxnerf.render_packed(scene, full_grid(), rays, samples, capacity=3, stop=0.1)
    with pytest.raises(ValueError, match="gauss"):
        pairs = dataclasses.replace(samples, rule="gauss")
        jaxnerf.render_packed(scene, full_grid(), rays, pairs, capacity=30)
    with pytest.raises(ValueError, match="render_packed: the scene returned"):
        jaxnerf.render_packed(lambda x, v: (x, x), full_grid(), rays, samples, capacity=30)


def test_render_rays_takes_it_as_its_renderer(rays):
    def render(scene, rays, samples, *, background=None):
        return jaxnerf.render_packed(
            scene, full_grid(), rays, samples, capacity=RAYS * SEGMENTS, background=background
        )

    options = {"num_samples": SEGMENTS, "background": BACKGROUND}
    got = jaxnerf.render_rays(jax.random.key(4), scene, rays, render=render, **options)
    want = jaxnerf.render_rays(jax.random.key(4), scene, rays, **options)
    assert_same(dataclasses.replace(got, weights=None), dataclasses.replace(want, weights=None), atol=2e-6)
