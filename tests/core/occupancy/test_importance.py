"""importance_samples: as many samples as the buffer holds, in occupied cells, most of them where rays end."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxnerf
from helpers import compiled
from jaxnerf.core.occupancy.grid import estimate_optical_depth, is_occupied
from jaxnerf.core.occupancy.importance import divide_slots, importance_samples
from jaxnerf.core.occupancy.packed import render_placed

RAYS, STEPS = 16, 64
WALL = 0.6  # where the dense cells begin


@pytest.fixture(scope="module")
def grid():
    """A box [0, 1]^3 of 16^3 cells: thin fog, an empty slab, and a wall behind WALL."""
    x = np.arange(16)[:, None, None] / 16
    mean = np.where(x < 0.25, -1, np.where((x >= WALL) & (x < WALL + 0.1), 60, 0.2)) * np.ones((16, 16, 16))
    made = jaxnerf.create_grid(np.zeros(3), np.ones(3), np.ones((16, 16, 16), bool), initial_density=1.0)
    return dataclasses.replace(made, density_mean=jnp.float32(mean), occupied=jnp.asarray(mean >= 0))


@pytest.fixture(scope="module")
def rays():
    origins, directions = (np.tile(np.float32(v), (RAYS, 1)) for v in ((0, 0.5, 0.5), (1, 0.01, 0.02)))
    near, far = np.zeros(RAYS, np.float32), np.ones(RAYS, np.float32)
    return jaxnerf.Rays(origins=origins, directions=directions, viewdirs=directions, near=near, far=far)


@pytest.fixture(scope="module")
def candidates(rays):
    return jaxnerf.samples_from_edges(None, jaxnerf.uniform_edges(rays.near, rays.far, num_segments=STEPS))


run = compiled(importance_samples, "max_samples", "uniform_fraction")


def place(key, *arrays, max_samples=11 * RAYS + 3, uniform_fraction=0.3, max_optical_depth=np.inf):
    """Calls importance_samples with the same static arguments for most tests, so that it is compiled rarely."""
    options = {"max_samples": max_samples, "uniform_fraction": uniform_fraction}
    return run(key, *arrays, max_optical_depth=np.float32(max_optical_depth), **options)


def by_ray(samples, index):
    kept = np.asarray(samples.used) & (np.asarray(samples.ray_index) == index)
    return np.asarray(samples.t)[kept], np.asarray(samples.delta)[kept]


@pytest.mark.parametrize("fraction", [0.3, 1.0])
def test_all_slots_are_filled_with_samples_of_occupied_cells(grid, rays, candidates, fraction):
    samples, occluded = place(jax.random.key(0), grid, rays, candidates, uniform_fraction=fraction)
    assert np.asarray(samples.used).all() and not np.asarray(occluded).any()
    np.testing.assert_array_equal(samples.num_dropped, 0)
    np.testing.assert_array_equal(np.bincount(samples.ray_index), [12] * 3 + [11] * (RAYS - 3))
    kept = np.asarray(is_occupied(grid, rays, candidates.t))
    one = jax.tree.map(lambda leaf: leaf[np.asarray(samples.ray_index)], rays)
    assert np.asarray(is_occupied(grid, one, samples.t[:, None])).all()
    in_wall = 0
    for index in range(RAYS):
        t, delta = by_ray(samples, index)
        assert (np.diff(t) > 0).all() and (delta > 0).all()
        np.testing.assert_allclose(delta.sum(), (kept * np.asarray(candidates.delta))[index].sum(), rtol=1e-5)
        in_wall += np.mean((t >= WALL) & (t < WALL + 0.15))
    assert in_wall / RAYS > 0.5 if fraction < 1 else in_wall / RAYS < 0.25


def test_samples_are_equally_spaced_where_all_fit(grid, rays, candidates):
    samples, _ = place(jax.random.key(1), grid, rays, candidates, max_samples=STEPS * RAYS)
    kept = np.asarray(is_occupied(grid, rays, candidates.t))
    np.testing.assert_array_equal(np.bincount(np.asarray(samples.ray_index)[np.asarray(samples.used)]), kept.sum(-1))
    t, delta = by_ray(samples, 3)
    np.testing.assert_allclose(delta[1:-1], 1 / STEPS, rtol=1e-4)
    np.testing.assert_allclose(np.diff(t[1:-1]), 1 / STEPS, rtol=1e-4)
    assert len(np.unique(by_ray(samples, 4)[0] - t)) > 0


def test_the_mean_over_keys_is_the_integral(grid, rays, candidates):
    """Few samples, most of them in the wall, must not change how much light a ray collects on average."""

    def scene(x, viewdirs):
        density = jnp.where(x[..., 0] < 0.25, 0, 2 * x[..., 0])
        return density, jnp.stack([x[..., 0], 1 - x[..., 0], x[..., 1]], axis=-1)

    def rendered(key):
        samples, _ = importance_samples(key, grid, rays, candidates, max_samples=8 * RAYS, uniform_fraction=0.4)
        return render_placed(scene, rays, samples, longest=STEPS).rgb.mean(axis=0)

    got = np.asarray(jax.jit(jax.vmap(rendered))(jax.random.split(jax.random.key(2), 64))).mean(axis=0)
    fine = jaxnerf.samples_from_edges(None, jaxnerf.uniform_edges(rays.near, rays.far, num_segments=1024))
    want = np.asarray(jaxnerf.render_samples(scene, rays, fine).rgb).mean(axis=0)
    np.testing.assert_allclose(got, want, atol=0.01)


def test_occluded_candidates_are_skipped(grid, rays, candidates):
    samples, occluded = place(jax.random.key(0), grid, rays, candidates, max_optical_depth=1.5)
    assert np.asarray(occluded).all()
    t, _ = by_ray(samples, 0)
    assert t.max() < WALL + 0.08


@pytest.mark.parametrize("limit", [np.inf, 2.0, 0.5])
def test_the_skipped_candidates_are_those_of_a_plain_loop(grid, rays, candidates, limit):
    density = np.random.default_rng(1).exponential(size=grid.density_mean.shape) * np.linspace(0, 6, 16)[:, None]
    density[12, 12] = np.inf  # as older checkpoints may have it
    heights = np.float32([(0, (index + 0.5) / RAYS, 0.5) for index in range(RAYS)])
    rays = dataclasses.replace(rays, origins=heights, directions=np.tile(np.float32([1, 0, 0]), (RAYS, 1)))
    grid = dataclasses.replace(grid, density_mean=jnp.where(grid.occupied, np.float32(density), -1))
    kept, depths = (np.asarray(part) for part in estimate_optical_depth(grid, rays, candidates))
    expected, skipped = np.zeros(RAYS, bool), kept.copy()
    for index in range(RAYS):
        before = 0.0
        for step in range(STEPS):
            skipped[index, step] = kept[index, step] and before > limit
            before += float(depths[index, step])
        expected[index] = skipped[index].any()
    samples, occluded = place(
        jax.random.key(0), grid, rays, candidates, max_samples=STEPS * RAYS, max_optical_depth=limit
    )
    np.testing.assert_array_equal(occluded, expected)
    number = np.bincount(np.asarray(samples.ray_index)[np.asarray(samples.used)], minlength=RAYS)
    np.testing.assert_array_equal(number, (kept & ~skipped).sum(axis=1))
    assert expected.any() == (limit < np.inf) and not expected.all()


def test_a_ray_that_is_nan_has_samples_and_empty_rays_have_none(grid, rays, candidates):
    broken = dataclasses.replace(candidates, t=candidates.t.at[2].set(jnp.nan), delta=candidates.delta.at[5].set(0))
    samples, _ = place(jax.random.key(0), grid, rays, broken)
    assert np.isnan(by_ray(samples, 2)[0]).all() and len(by_ray(samples, 2)[0])
    assert not len(by_ray(samples, 5)[0])


@pytest.mark.parametrize("seed", range(4))
def test_slots_are_shared_evenly(seed):
    rng = np.random.default_rng(seed)
    count = rng.integers(0, 90, size=200).astype(np.int32)
    for slots in (50, 4000, int(count.sum()), 10**6):
        number = np.asarray(divide_slots(count, slots))
        assert number.sum() == min(slots, count.sum()) and (number <= count).all()
        short = number[number < count]
        assert not short.size or (short.max() - short.min() <= 1 and number.max() <= short.min() + 1)


def test_samples_are_at_most_half_a_candidate_outside_of_occupied_cells(rays, candidates):
    """A candidate counts as occupied by its middle."""
    cells = (np.indices((16,) * 3).reshape(3, -1).T + 0.5) / 16 - 0.5
    ball = (np.linalg.norm(cells, axis=1) < 0.3).reshape(16, 16, 16)
    grid = jaxnerf.create_grid(-np.ones(3) / 2, np.ones(3) / 2, ball, initial_density=1.0)
    rng, length = np.random.default_rng(0), 1 / STEPS
    offsets = rng.uniform(-0.2, 0.2, (2, RAYS, 3)).astype(np.float32)
    moved = dataclasses.replace(rays, origins=offsets[0] - [0.5, 0, 0], directions=rays.directions + offsets[1])
    samples, _ = place(jax.random.key(0), grid, moved, candidates)
    used = np.asarray(samples.used)
    one = jax.tree.map(lambda leaf: leaf[np.asarray(samples.ray_index)[used]], moved)
    inside = [is_occupied(grid, one, samples.t[used][:, None] + shift * length) for shift in (-0.5, 0, 0.5)]
    assert 0.001 < 1 - np.asarray(inside[1]).mean() < 0.1
    assert np.any(inside, axis=0).all()


def test_without_candidates_there_are_no_samples(grid, rays):
    none = jaxnerf.Samples(t=jnp.zeros((RAYS, 0)), delta=jnp.zeros((RAYS, 0)))
    samples, occluded = importance_samples(jax.random.key(0), grid, rays, none, max_samples=4, uniform_fraction=0.5)
    assert not samples.used.any() and samples.num_dropped.shape == occluded.shape == (RAYS,) and not occluded.any()


def test_a_single_slot_is_used(grid, rays, candidates):
    samples, _ = place(jax.random.key(0), grid, rays, candidates, max_samples=1)
    assert samples.used.shape == (1,) and samples.used.all()


def test_wrong_arguments_are_named(grid, rays, candidates):
    with pytest.raises(ValueError, match="max_samples 0"):
        importance_samples(jax.random.key(0), grid, rays, candidates, max_samples=0, uniform_fraction=0.5)
    with pytest.raises(ValueError, match="uniform_fraction 0"):
        importance_samples(jax.random.key(0), grid, rays, candidates, max_samples=9, uniform_fraction=0)
    gauss = dataclasses.replace(candidates, rule="gauss")
    with pytest.raises(ValueError, match="rule is 'gauss'"):
        importance_samples(jax.random.key(0), grid, rays, gauss, max_samples=9, uniform_fraction=0.5)
