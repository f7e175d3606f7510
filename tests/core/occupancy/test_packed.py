"""render_packed renders as render_samples does, and evaluates the scene in occupied cells only."""

import dataclasses
import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxnerf
from helpers import all_finite, assert_same, checked_grid, compiled, full_grid, rays_past_origin
from jaxnerf.core import volume_rendering
from jaxnerf.core.occupancy import from_scene
from jaxnerf.core.occupancy import packed as packed_module
from jaxnerf.core.occupancy.grid import is_occupied
from jaxnerf.core.types import without_samples
from test_scenes import analytic

pytest_plugins = ["run_fixtures"]
pytestmark = pytest.mark.usefixtures("unoptimized")

RAYS, SEGMENTS = 24, 40
BACKGROUND = np.float32([0.9, 0.2, 0.5])
OUTPUTS = ("rgb", "opacity", "depth", "disparity")


def scene(x, viewdirs):
    """Fog around the origin, coloured by place and direction."""
    return 4 * jnp.exp(-2 * (x**2).sum(axis=-1)), jax.nn.sigmoid(3 * x + viewdirs)


@pytest.fixture(scope="module")
def rays():
    return rays_past_origin(0, RAYS)


@pytest.fixture(scope="module")
def samples(rays):
    edges = jaxnerf.uniform_edges(rays.near, rays.far, num_segments=SEGMENTS)
    return jaxnerf.samples_from_edges(jax.random.key(1), edges)


@compiled
def dense(rays, samples):
    return jaxnerf.render_samples(scene, rays, samples, background=BACKGROUND)


@compiled
def dense_and_masked(grid, rays, samples):
    masked = jaxnerf.mask_scene(scene, grid)
    return jaxnerf.render_samples(masked, rays, samples, background=BACKGROUND)


packed = compiled(
    lambda grid, rays, samples, max_samples, early_stop_eps=0.0: jaxnerf.render_packed(
        scene,
        grid,
        rays,
        samples,
        max_samples=max_samples,
        early_stop_eps=early_stop_eps,
        background=BACKGROUND,
    ),
    "max_samples",
    "early_stop_eps",
)


def assert_close(got, want, atol=1e-6):
    for name in OUTPUTS:
        np.testing.assert_allclose(getattr(got, name), getattr(want, name), rtol=1e-6, atol=atol)


def test_a_full_grid_changes_nothing(rays, samples):
    got = packed(full_grid(), rays, samples, max_samples=RAYS * SEGMENTS)
    assert_close(got, dense(rays, samples))
    assert got.weights is None and got.num_dropped.shape == (RAYS,) and not got.num_dropped.any()


@pytest.mark.parametrize("early_stop_eps", [0.0, 1e-6, 0.5])
def test_the_median_depth_is_that_of_all_samples(rays, samples, early_stop_eps):
    options = {"max_samples": 64 if early_stop_eps else RAYS * SEGMENTS, "early_stop_eps": early_stop_eps}
    dense = jax.jit(lambda: jaxnerf.render_samples(scene, rays, samples, median_depth=True))()
    got = jax.jit(lambda: jaxnerf.render_packed(scene, full_grid(), rays, samples, median_depth=True, **options))()
    np.testing.assert_allclose(got.median_depth, dense.median_depth, rtol=1e-5)
    opaque = np.asarray(dense.opacity) > 0.5
    assert 0.2 < opaque.mean() < 1 and (np.asarray(dense.median_depth == rays.far) == ~opaque).all()


def test_rays_do_not_end_before_their_median_depth(rays, samples):
    with pytest.raises(ValueError, match="early_stop_eps is 0.6"):
        jaxnerf.render_packed(scene, None, rays, samples, max_samples=8, early_stop_eps=0.6, median_depth=True)


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

    def packed_render(scene, rays, samples):
        return jaxnerf.render_packed(scene, full_grid(), rays, samples, max_samples=RAYS * SEGMENTS)

    given = jax.tree.map(jnp.asarray, (rays, samples)), jnp.float32(1.3)
    got = total(packed_render)(*given[0], given[1])
    want = total(jaxnerf.render_samples)(*given[0], given[1])
    for a, b in zip(jax.tree.leaves(got), jax.tree.leaves(want), strict=True):
        np.testing.assert_allclose(a, b, atol=2e-6 * max(1.0, np.abs(b).max()))


def test_an_empty_cell_is_as_if_the_scene_were_empty_there(rays, samples):
    """Compared with samples of length 0, and with a masked scene."""
    grid = checked_grid()
    kept = np.asarray(is_occupied(grid, rays, samples.t))
    assert 0.05 < kept.mean() < 0.6
    got = packed(grid, rays, samples, max_samples=RAYS * SEGMENTS)
    assert_close(got, dense(rays, dataclasses.replace(samples, delta=jnp.where(kept, samples.delta, 0))))
    assert_close(got, dense_and_masked(grid, rays, samples))
    assert np.abs(got.rgb - dense(rays, samples).rgb).max() > 0.05


def test_masked_samples_need_no_grid(rays, samples):
    grid = checked_grid()
    masked = dataclasses.replace(samples, delta=jnp.where(is_occupied(grid, rays, samples.t), samples.delta, 0))
    got = packed(None, rays, masked, max_samples=RAYS * SEGMENTS)
    assert_close(got, packed(grid, rays, samples, max_samples=RAYS * SEGMENTS))


def test_rays_that_hit_nothing_show_the_background(rays, samples):
    empty = dataclasses.replace(full_grid(), occupied=jnp.zeros((6, 5, 8), bool))
    for early_stop_eps in (0.0, 1e-3):
        got = packed(empty, rays, samples, max_samples=RAYS * SEGMENTS, early_stop_eps=early_stop_eps)
        np.testing.assert_allclose(got.rgb, np.broadcast_to(BACKGROUND, (RAYS, 3)), rtol=1e-6)
        np.testing.assert_array_equal(got.depth, rays.far)
        np.testing.assert_array_equal(got.disparity, 0)
        np.testing.assert_array_equal(got.opacity, 0)


def test_dropped_samples_are_counted_and_other_rays_are_exact(rays, samples):
    got = packed(full_grid(), rays, samples, max_samples=10 * SEGMENTS + 5)
    np.testing.assert_array_equal(got.num_dropped, [0] * 10 + [SEGMENTS - 5] + [SEGMENTS] * (RAYS - 11))
    first = jax.tree.map(lambda leaf: leaf[:10], got)
    assert_close(first, jax.tree.map(lambda leaf: leaf[:10], dense(rays, samples)))


@pytest.mark.parametrize("early_stop_eps, max_samples", [(0.5, RAYS), (0.1, 100), (1e-3, RAYS * SEGMENTS)])
def test_early_termination_is_within_its_bound_and_drops_nothing(rays, samples, early_stop_eps, max_samples):
    got, want = (
        packed(full_grid(), rays, samples, max_samples=max_samples, early_stop_eps=early_stop_eps),
        dense(rays, samples),
    )
    assert np.abs(got.rgb - want.rgb).max() <= early_stop_eps + 1e-6
    assert np.abs(got.opacity - want.opacity).max() <= early_stop_eps + 1e-6 and not got.num_dropped.any()
    terminated = got.opacity > 1 - 1e-6
    assert terminated.any() == (early_stop_eps > 1e-3) and (got.depth <= want.depth + 1e-5)[terminated].all()
    np.testing.assert_allclose(got.rgb[~terminated], want.rgb[~terminated], atol=1e-6)


@pytest.mark.parametrize("max_samples", [1, 30])
def test_fewer_slots_than_rays_render_every_ray(rays, samples, max_samples):
    """All outputs are the same whether one slot takes all rays or seven take some each."""
    grid = checked_grid()
    got = packed(grid, rays, samples, max_samples=max_samples, early_stop_eps=1e-30)
    assert_close(got, packed(grid, rays, samples, max_samples=RAYS * SEGMENTS), atol=2e-6)


def test_early_termination_evaluates_no_samples_behind_a_wall():
    evaluated = []
    wall = analytic.slab(1e4, lower=0.0, upper=1.0).scene

    def counting(x, viewdirs):
        jax.debug.callback(lambda x: evaluated.append(float(x[0, :, 2].min())), x)
        return wall(x, viewdirs)

    one = np.float32([[0.0, 0.0, -1.0]])
    rays = jaxnerf.Rays(origins=-2 * one, directions=one, viewdirs=one, near=np.zeros(1, "f"), far=np.full(1, 20, "f"))
    samples = jaxnerf.samples_from_edges(None, jaxnerf.uniform_edges(rays.near, rays.far, num_segments=200))
    options = {"max_samples": 4, "early_stop_eps": 1e-4}
    seen = jax.jit(lambda: jaxnerf.render_packed(counting, full_grid(), rays, samples, **options))()
    jax.effects_barrier()
    np.testing.assert_allclose(seen.opacity, 1, atol=1e-4)
    assert len(evaluated) == 3 and min(evaluated) > 0.4  # 12 of 200 samples: 10 before the wall, 2 in it


def test_thin_fog_keeps_its_digits(rays, samples):
    """1 - exp(-x) and 1 - transmittance would have none left at an optical depth of 1e-9."""

    @compiled
    def render(rays, samples):
        fog = lambda x, viewdirs: (jnp.full(x.shape[:-1], 1e-9), jnp.full_like(x, 0.5))  # noqa: E731
        options = {"max_samples": RAYS * SEGMENTS}
        return [jaxnerf.render_packed(fog, None, rays, samples, early_stop_eps=eps, **options) for eps in (0.0, 1e-30)]

    want = 1e-9 * (rays.far - rays.near) * np.linalg.norm(rays.directions, axis=-1)
    for got in render(rays, samples):
        np.testing.assert_allclose(got.opacity, want, rtol=1e-5)
        np.testing.assert_allclose(got.rgb, np.tile(want[:, None] / 2, 3), rtol=1e-5)


def test_packed_weights_are_those_of_each_ray():
    rng = np.random.default_rng(3)
    density = np.float32(rng.exponential(size=(5, 7)) * (rng.uniform(size=(5, 7)) < 0.7))
    density[1, 2], density[3, 0] = np.inf, 1e30
    length = np.float32(rng.uniform(size=(5, 7)))
    starts = np.arange(35) % 7 == 0
    slopes = np.float32(rng.normal(size=35))

    def total(density):
        weights, _ = volume_rendering.packed_weights(density, length.reshape(-1), starts, longest=7)
        return (weights * slopes).sum(), weights

    def separate(density):
        weights = jaxnerf.weights_from_density(density.reshape(5, 7), length).reshape(-1)
        return (weights * slopes).sum(), weights

    got, want = (compiled(jax.value_and_grad(value, has_aux=True))(density.reshape(-1)) for value in (total, separate))
    assert all_finite((got, want))
    assert_same(got, want, rtol=0)

    @jax.jit
    def forward(density):
        return [jax.jvp(lambda x, f=f: f(x)[1], (density,), (slopes,))[1] for f in (total, separate)]

    np.testing.assert_allclose(*forward(density.reshape(-1)), atol=1e-5)


@pytest.mark.parametrize("shape", [(), (2, 3)])
def test_leading_axes_do_not_matter(rays, samples, shape):
    count = int(np.prod(shape))

    def part(leaf):
        return None if leaf is None else np.asarray(leaf)[:count].reshape((*shape, *np.shape(leaf)[1:]))

    some = jax.tree.map(part, (rays, samples))
    got = packed(full_grid(), *some, max_samples=count * SEGMENTS)
    assert_close(got, jax.tree.map(part, dense(rays, samples)))


def test_nan_of_a_scene_shows_only_where_the_scene_is_evaluated(rays, samples):
    grid = checked_grid()

    def half_wrong(x, viewdirs):
        density, rgb = scene(x, viewdirs)
        return jnp.where(x[..., 0] > 0.0, jnp.nan, density), rgb

    @jax.jit
    @jax.value_and_grad
    def value(rays, kept):
        masked = dataclasses.replace(samples, delta=jnp.where(kept, samples.delta, 0))
        return jaxnerf.render_packed(half_wrong, grid, rays, masked, max_samples=RAYS * SEGMENTS).rgb.sum()

    kept = np.asarray(jaxnerf.points_on_rays(rays, samples.t))[..., 0] <= 0.0
    given = jax.tree.map(jnp.asarray, rays)
    assert all_finite(value(given, kept))
    assert np.isnan(value(given, np.ones_like(kept))[0])


@pytest.mark.parametrize("early_stop_eps", [0.0, 0.1])
def test_rays_without_samples_show_the_background(rays, early_stop_eps):
    none = jaxnerf.Samples(t=jnp.zeros((RAYS, 0)), delta=jnp.zeros((RAYS, 0)))
    options = {"background": BACKGROUND, "median_depth": True}

    @compiled
    def both(rays, none):
        packed = {"max_samples": 4, "early_stop_eps": early_stop_eps}
        found = jaxnerf.render_packed(scene, full_grid(), rays, none, **packed, **options)
        return found, jaxnerf.render_samples(scene, rays, none, **options)

    for got in both(rays, none):
        np.testing.assert_array_equal(got.rgb, np.broadcast_to(BACKGROUND, (RAYS, 3)))
        np.testing.assert_array_equal(got.median_depth, rays.far)
        assert not got.opacity.any() and not got.num_dropped.any()


def test_wrong_arguments(rays, samples):
    pairs, grid = dataclasses.replace(samples, rule="gauss"), full_grid()
    for message, call in {
        "max_samples is 0": lambda: jaxnerf.render_packed(scene, grid, rays, samples, max_samples=0),
        "gauss": lambda: jaxnerf.render_packed(scene, grid, rays, pairs, max_samples=30),
        "the scene returned": lambda: jaxnerf.render_packed(
            lambda x, viewdirs: (x, x), grid, rays, samples, max_samples=30
        ),
    }.items():
        with pytest.raises(ValueError, match=f"render_packed: .*{message}"):
            jax.eval_shape(call)


def test_render_rays_accepts_it_as_its_renderer(rays):
    def render(scene, rays, samples, *, background=None):
        return jaxnerf.render_packed(
            scene, full_grid(), rays, samples, max_samples=RAYS * SEGMENTS, background=background
        )

    @compiled
    def seen(key, rays):
        options = {"num_samples": SEGMENTS, "background": BACKGROUND}
        got = jaxnerf.render_rays(key, scene, rays, render=render, **options)
        return without_samples(got), without_samples(jaxnerf.render_rays(key, scene, rays, **options))

    got, want = seen(jax.random.key(4), rays)
    assert_same(got, want, atol=2e-6)


visible = compiled(
    lambda scene, grid, rays, samples, error=0.02, background=BACKGROUND: from_scene.visible_samples(
        scene, grid, rays, samples, error=error, max_samples=100, background=background
    ),
    "scene",
    "error",
)


def without(samples, kept):
    return dataclasses.replace(samples, delta=np.where(kept, samples.delta, 0))


@pytest.mark.parametrize("error", [0.002, 0.02, 0.2])
def test_colors_of_the_visible_samples_are_within_the_error(rays, samples, error):
    grid = checked_grid()
    kept = visible(scene, grid, rays, samples, error=error)
    occupied = np.asarray(is_occupied(grid, rays, samples.t) & (samples.delta > 0))
    assert not kept[~occupied].any() and 0 < kept.sum() < 0.9 * occupied.sum()
    whole = packed(grid, rays, samples, max_samples=RAYS * SEGMENTS)
    fewer = packed(grid, rays, without(samples, kept), max_samples=RAYS * SEGMENTS)
    off = abs(whole.rgb - fewer.rgb).max()
    assert error / 10 < off <= error + 1e-6


@compiled
def visible_in_ball(density, color, rays, samples):
    """Returns a ball's visible samples before white for an error of 0.002, and colours of all and of these."""

    def ball(x, viewdirs):
        inside = (x**2).sum(axis=-1) < 1
        return jnp.where(inside, density, 0.0), jnp.broadcast_to(color, x.shape)

    options = {"error": 0.002, "max_samples": 100, "background": jnp.ones(3)}
    kept = from_scene.visible_samples(ball, full_grid(), rays, samples, **options)
    fewer = dataclasses.replace(samples, delta=jnp.where(kept, samples.delta, 0))
    colors = [jaxnerf.render_samples(ball, rays, chosen, background=jnp.ones(3)).rgb for chosen in (samples, fewer)]
    return kept, *colors


def test_white_fog_before_white_is_not_needed_and_a_body_of_one_color_is(rays, samples):
    """Also where the body is divided among many samples, each of which could be dropped on its own."""
    for density in (0.05, 0.5):
        kept, _, _ = visible_in_ball(density, jnp.ones(3), rays, samples)
        assert not kept.any()
    for density, color in itertools.product((0.3, 3.0, 30.0, 1e6), ((1.0, 0.0, 0.0), (0.0, 0.0, 0.0))):
        kept, whole, fewer = visible_in_ball(density, jnp.float32(color), rays, samples)
        assert kept.any()
        np.testing.assert_allclose(fewer, whole, atol=0.0021)


def test_opaque_samples_are_needed_whatever_their_color(rays, samples):
    wall = lambda x, viewdirs: (jnp.full(x.shape[:-1], 1e6), jnp.ones_like(x))  # noqa: E731
    kept = visible(wall, full_grid(), rays, samples, background=np.ones(3))
    np.testing.assert_array_equal(kept.sum(axis=-1), 1)
    assert kept[:, 0].all()


@pytest.mark.parametrize("wrong", [{"max_samples": 0}, {"samples": "gauss"}])
def test_visible_samples_names_wrong_arguments(rays, samples, wrong):
    given = {"max_samples": 8, "samples": samples} | wrong
    if given["samples"] == "gauss":
        given["samples"] = dataclasses.replace(samples, rule="gauss")
    with pytest.raises(ValueError, match="visible_samples"):
        from_scene.visible_samples(scene, full_grid(), rays, error=0.1, **given)


@pytest.mark.parametrize("most", [7, 2**31 - 1])
def test_long_rays_come_first_whatever_the_number_of_samples(most):
    count = np.random.default_rng(0).integers(0, 8, 100).astype(np.int32)
    order = packed_module._longest_first(jnp.asarray(count), most)
    np.testing.assert_array_equal(order, np.argsort(-count, kind="stable"))
