"""NaN, infinity, half precision, no rays at all, unused slots and shards: all of the occupancy functions at once."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.sharding import PartitionSpec

import jaxnerf
from helpers import all_finite, assert_same, full_grid, rays_past_origin
from jaxnerf.core.occupancy.from_scene import visible_grid, visible_samples
from jaxnerf.core.occupancy.grid import clip_rays_to_box, estimate_optical_depth, is_occupied
from jaxnerf.core.occupancy.importance import importance_samples
from jaxnerf.core.occupancy.packed import render_placed
from jaxnerf.core.occupancy.ray_culling import rays_may_hit
from jaxnerf.core.occupancy.ray_marching import march_rays
from jaxnerf.core.types import without_samples

CELL = (1.0, 1.2, 0.75)
GRID = full_grid(3.0, (6, 5, 8))
FIELDS = ("origins", "directions", "near", "far")
NAN = [(name, axis) for name in FIELDS[:2] for axis in range(3)] + [("near", ...), ("far", ...)]


def ball(x, viewdirs):
    """Dense inside a ball. At NaN its density is 0, so that only the renderer can make NaN visible."""
    return jnp.where((x**2).sum(axis=-1) < 1, 3.0, 0.0), 0.5 + 0.2 * jnp.sin(x + viewdirs)


def march(grid, rays):
    return march_rays(None, grid, rays, step_size=0.4, cell=CELL)


def training(scene, grid, rays, max_samples=60):
    """Renders as a training step does."""
    candidates = march(grid, rays)
    options = {"max_samples": max_samples, "uniform_fraction": 0.5}
    placed, _ = importance_samples(jax.random.key(0), grid, rays, candidates, **options)
    return render_placed(scene, rays, placed, longest=candidates.t.shape[-1])


def image(scene, grid, rays):
    """Renders as evaluation does."""
    return jaxnerf.render_packed(scene, grid, rays, march(grid, rays), max_samples=16, early_stop_eps=1e-3)


def packed(scene, grid, rays):
    return jaxnerf.render_packed(scene, grid, rays, march(grid, rays), max_samples=500)


def axis_rays(count):
    """Returns Rays along x, so that the other components of their directions are 0, through the ball."""
    origins, directions = (np.tile(np.float32(v), (count, 1)) for v in ((-2.5, 0.1, 0.2), (1, 0, 0)))
    near, far = np.zeros(count, np.float32), np.full(count, 5, np.float32)
    return jaxnerf.Rays(origins=origins, directions=directions, viewdirs=directions, near=near, far=far)


@pytest.fixture(scope="module")
def broken():
    """Rays [9]: each of the first 8 has NaN in another place; the last has none."""
    rays = axis_rays(9)
    for index, (name, axis) in enumerate(NAN):
        getattr(rays, name)[index, axis] = np.nan
    return rays


@pytest.mark.slow
@pytest.mark.parametrize("contracted", [False, True])
def test_nan_in_a_ray_shows_and_stays_in_its_ray(broken, contracted):
    grid = dataclasses.replace(GRID, contracted=contracted)

    @jax.jit
    def render(grid, rays):
        chosen = dataclasses.replace(rays, near=jnp.zeros(9), far=jnp.full(9, 5.0))
        samples = jaxnerf.samples_from_edges(None, jaxnerf.uniform_edges(chosen.near, chosen.far, num_segments=8))
        kept = is_occupied(grid, rays, samples.t)
        masked = dataclasses.replace(samples, delta=jnp.where(kept, samples.delta, 0))
        given = jaxnerf.render_packed(ball, None, rays, masked, max_samples=500)
        clear = jaxnerf.render_samples(jaxnerf.mask_scene(ball, grid), rays, march(grid, rays))
        renderings = [render(ball, grid, rays).rgb for render in (training, image, packed)]
        return [*renderings, clear.rgb, given.rgb[:6], given.rgb[-1:]], rays_may_hit(grid, rays, cell=CELL)

    colors, may_hit = render(grid, broken)
    for rgb in colors:
        np.testing.assert_array_equal(np.isnan(rgb).any(axis=-1), np.arange(9)[-len(rgb) :] < 8 if len(rgb) != 6 else 1)
        assert len(rgb) == 6 or (np.asarray(rgb)[-1] > 0.1).all()
    assert may_hit.all()


def test_clipping_keeps_an_origin_that_is_nan(broken):
    got = jax.jit(clip_rays_to_box)(GRID, broken)
    assert np.isnan(got.near[:8]).all() and np.isnan(got.far[:8]).all()
    assert got.near[8] == 0 and got.far[8] == 5


@pytest.mark.parametrize("render", [training, packed])
def test_unused_slots_do_not_touch_gradients(render):
    """The density is infinite, and its gradient NaN, at the cameras, where nothing is rendered."""
    rays = dataclasses.replace(axis_rays(4), near=np.full(4, 0.5, np.float32))
    camera = jnp.asarray(rays.origins[0])

    def scene(strength, x, viewdirs):
        inverse = 1 / ((x - camera.reshape(1, 1, 3)) ** 2).sum(axis=-1)
        return strength * inverse, jnp.full_like(x, 0.5)

    @jax.jit
    @jax.value_and_grad
    def total(strength, grid, far):
        used = dataclasses.replace(rays, far=far)
        seen = render(functools.partial(scene, strength), grid, used)
        return seen.rgb.sum() + (seen.samples.t.size - seen.samples.used.sum()) * 1e-30  # some slots are unused

    for far in (rays.far, rays.near):  # nothing is used at all
        value, slope = total(jnp.float32(0.3), GRID, far)
        assert np.isfinite(value) and np.isfinite(slope) and (slope > 0.1) == (far is rays.far)


def test_a_masked_scene_is_not_evaluated_in_empty_cells():
    occupied = dataclasses.replace(GRID, occupied=GRID.occupied.at[:3].set(False))  # x < 0

    def total(strength, x):
        scene = jaxnerf.mask_scene(lambda x, viewdirs: (strength * jnp.sqrt(x[..., 0]), x), occupied)
        density, _ = scene(x, x[..., :1, :])
        return density.sum()

    x = jnp.linspace(-2.0, 2.0, 8)[None, :, None] * jnp.ones(3).reshape(1, 1, 3)
    value, slopes = jax.jit(jax.value_and_grad(total, argnums=(0, 1)))(2.0, x)
    assert np.isfinite(value) and all_finite(slopes)
    np.testing.assert_array_equal(slopes[1][:, :4], 0)


def test_infinite_density_needs_no_sample_behind_it():
    rays = axis_rays(1)
    edges = jaxnerf.uniform_edges(rays.near, rays.far, num_segments=25)
    samples = jaxnerf.samples_from_edges(None, edges)
    samples = dataclasses.replace(samples, delta=samples.delta.at[:, 10].set(0))

    def needed(density):
        solid = lambda x, viewdirs: (jnp.where(x[..., 0] > -1, density, 0.0), jnp.ones_like(x))  # noqa: E731
        return visible_samples(solid, GRID, rays, samples, error=0.01, max_samples=25)

    got = np.asarray(jax.jit(needed)(jnp.float32(np.inf)))[0]
    np.testing.assert_array_equal(np.flatnonzero(got), [8])
    mean = dataclasses.replace(GRID, density_mean=jnp.full((6, 5, 8), jnp.inf))
    _, depth = jax.jit(lambda: estimate_optical_depth(mean, rays, samples))()
    np.testing.assert_array_equal(depth[0, :10], 1e4)


def test_a_weight_of_0_at_infinity_adds_no_depth():
    rays = dataclasses.replace(axis_rays(2), directions=np.float32([[1, 0.1, 0.1]] * 2))
    t = np.float32([[2.0, 2.4, np.inf]] * 2)
    samples = jaxnerf.Samples(t=t, delta=np.full((2, 3), 0.4, np.float32), rule="segments")
    fog = lambda x, viewdirs: (jnp.where(jnp.isfinite(x[..., 0]), 1.0, 0.0), jnp.full_like(x, 0.5))  # noqa: E731
    got, want = jax.jit(
        lambda: (
            jaxnerf.render_packed(fog, None, rays, samples, max_samples=8),
            jaxnerf.render_samples(fog, rays, samples),
        )
    )()
    assert_same(without_samples(got), without_samples(want))
    assert np.isfinite(got.depth).all()


def test_contracted_space_has_cells_for_every_finite_t():
    """Each lies inside the box, as points at infinity do."""
    grid = dataclasses.replace(GRID, contracted=True)
    rays = rays_past_origin(0, 32)
    rays.directions[:3] = np.eye(3)
    rays.directions[3:6] = -np.eye(3)
    t = np.broadcast_to(np.append(np.geomspace(1, 1e30, 61), 3e38).astype(np.float32), (32, 62))
    far = dataclasses.replace(rays, far=np.full(32, 3e38, np.float32))

    @jax.jit
    def run(rays, t):
        samples = march(grid, rays)
        return is_occupied(grid, rays, t), samples, is_occupied(grid, rays, samples.t) | (samples.delta == 0)

    given, samples, marched = run(far, t)
    assert given.all() and marched.all()
    assert np.isfinite(samples.t).all() and (np.where(samples.delta > 0, samples.t, 0) > 10).any()


@pytest.mark.parametrize("dtype", [jnp.float16, jnp.bfloat16])
def test_rays_of_half_precision_have_norms_of_full_precision(dtype):
    half = jax.tree.map(lambda leaf: jnp.asarray(leaf, dtype), rays_past_origin(1, 8))
    full = jax.tree.map(lambda leaf: leaf.astype(jnp.float32), half)

    @jax.jit
    def run(rays):
        samples = [march(dataclasses.replace(GRID, contracted=contracted), rays) for contracted in (False, True)]
        _, depth = estimate_optical_depth(GRID, rays, samples[0])
        return [each.t for each in samples], depth, without_samples(jaxnerf.render_samples(ball, rays, samples[0]))

    got, want = run(half), run(full)
    assert got[0][0].dtype == jnp.float32
    assert_same(got, want, rtol=1e-6, atol=1e-7)


def test_no_rays_have_an_empty_result():
    """Traced only, as that is where shapes are found to be wrong."""

    def everything(rays):
        samples = march(GRID, rays)
        whole = {
            "image": image(ball, GRID, rays),
            "packed": packed(ball, GRID, rays),
            "dense": jaxnerf.render_rays(None, ball, rays, num_samples=4),
            "fine": jaxnerf.render_hierarchical(None, ball, ball, rays, num_coarse=4, num_fine=4)[1],
        }
        if rays.near.ndim == 1:
            whole["training"] = training(ball, GRID, rays)
        needed = visible_samples(ball, GRID, rays, samples, error=0.1, max_samples=4)
        return whole, samples, needed, rays_may_hit(GRID, rays, cell=CELL)

    for shape in ((0,), (0, 3)):
        rays = jax.tree.map(lambda leaf, shape=shape: jnp.zeros((*shape, *leaf.shape[1:])), axis_rays(1))
        whole, samples, needed, may_hit = jax.eval_shape(everything, rays)
        for name, got in whole.items():
            assert got.rgb.shape == (*shape, 3) and got.num_dropped.shape == got.depth.shape == shape, name
            assert name in ("dense", "fine") or got.samples is None or got.samples.ray_index.shape == (0,)
        assert needed.shape == samples.t.shape and may_hit.shape == shape


def test_no_rays_have_no_gradient_where_the_scene_is_undefined_at_the_origin():
    rays = jax.tree.map(lambda leaf: leaf[:0], axis_rays(1))

    @jax.jit
    @jax.grad
    def slope(density):
        scene = lambda x, viewdirs: (density * jnp.log((x**2).sum(axis=-1)), jnp.ones_like(x))  # noqa: E731
        return sum(render(scene, GRID, rays).rgb.sum() for render in (training, packed))

    assert slope(1.0) == 0


@pytest.mark.filterwarnings("error::FutureWarning")
def test_an_update_keeps_the_type_of_the_grid_in_double_precision():
    fog = lambda x, viewdirs: (jnp.ones_like(x[..., 0], jnp.float64), x)  # noqa: E731
    with jax.enable_x64(True):
        got = jax.eval_shape(
            lambda: jaxnerf.update_grid(jax.random.key(0), GRID, fog, jnp.arange(4), threshold=0.5).density_max
        )
    assert got.dtype == jnp.float32


def test_counts_are_int32_in_double_precision():
    with jax.enable_x64(True):
        rays = jax.tree.map(lambda leaf: jnp.asarray(leaf, jnp.float64), axis_rays(3))
        for render in (training, packed, image):
            got = jax.eval_shape(functools.partial(render, ball), GRID, rays)
            assert got.num_dropped.dtype == jnp.int32 and got.rgb.dtype == jnp.float64
            assert got.samples is None or got.samples.ray_index.dtype == jnp.int32


BOX = np.full(3, -1.0), np.full(3, 1.0)


def some_results(grid, rays):
    """Returns the results of the functions with loops; the other loops are in visible_grid."""
    return {
        "image": without_samples(image(ball, grid, rays)),
        "visible": visible_samples(ball, grid, rays, march(grid, rays), error=0.01, max_samples=16),
        "may_hit": rays_may_hit(grid, rays, cell=CELL),
        "training": without_samples(training(ball, grid, rays)),
    }


def sharded(function, count):
    """Returns the function of a grid and rays with its rays on several devices, and JAX's checks of what varies."""
    options = {"axis_types": (jax.sharding.AxisType.Auto,), "devices": jax.devices()[:count]}
    specs = {"in_specs": (PartitionSpec(), PartitionSpec("ray")), "out_specs": PartitionSpec("ray")}
    return jax.shard_map(function, mesh=jax.make_mesh((count,), ("ray",), **options), **specs)


def test_every_loop_may_run_on_shards_of_the_rays():
    """Traced only: the checks compare the types of what a loop carries before and after its body."""

    def find(grid, rays):
        options = {"shape": (4, 4, 4), "step_size": 0.5, "threshold": 1.0, "max_samples": 64}
        return visible_grid(ball, rays, lower=np.full(3, -1.0), upper=np.full(3, 1.0), **options).occupied

    assert set(jax.eval_shape(sharded(some_results, 4), GRID, axis_rays(8))) == {
        "image",
        "visible",
        "may_hit",
        "training",
    }
    assert jax.eval_shape(sharded(find, 2), GRID, axis_rays(2 * 2048)).shape == (8, 4, 4)


@pytest.mark.slow
def test_shards_of_rays_render_as_one_device_does():
    rays = rays_past_origin(0, 8)

    def image_and_visible(grid, rays):
        results = some_results(grid, rays)
        return results["image"], results["visible"], results["may_hit"]

    assert_same(jax.jit(sharded(image_and_visible, 2))(GRID, rays), jax.jit(image_and_visible)(GRID, rays))
