"""march_near_matter: the samples of march_rays that may matter, and importance_samples of them."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxnerf
from helpers import assert_same, compiled
from jaxnerf.core.occupancy.grid import create_grid, is_occupied, near_occupied
from jaxnerf.core.occupancy.importance import importance_samples
from jaxnerf.core.occupancy.ray_marching import march_rays
from jaxnerf.core.occupancy.sample_runs import WIDTH, march_near_matter
from jaxnerf.fields.base import Field
from jaxnerf.models import occupancy
from jaxnerf.models.base import ViewOptions
from jaxnerf.models.grid_schedule import make_grid_schedule
from jaxnerf.models.occupancy import OccupancyOptions, occupancy_model

SHAPE, STEP, RAYS = (21, 18, 15), 0.045, 96
CELL = (1 / 21, 1 / 21, 1 / 21)
UPPER = np.array(SHAPE) / 21
march = compiled(march_near_matter, "step_size", "cell", "max_runs")
march_all = compiled(march_rays, "step_size", "cell")
in_matter = compiled(lambda grid, rays, samples: is_occupied(grid, rays, samples.t) & (samples.delta > 0))
choose = compiled(importance_samples, "max_samples", "uniform_fraction")


@pytest.fixture(scope="module")
def grid():
    """Returns a grid in which a clump and a few other cells are occupied, also on its faces."""
    occupied = np.random.default_rng(0).random(SHAPE) < 0.003
    occupied[9:13, 7:11, 6:9] = True
    occupied[0, 0, 0] = occupied[-1, -1, -1] = True
    made = create_grid(np.zeros(3), UPPER, occupied, initial_density=1.0)
    density = np.linspace(0, 20, occupied.size, dtype=np.float32).reshape(SHAPE)
    return dataclasses.replace(made, density_mean=jnp.where(occupied, density, -1))


@pytest.fixture(scope="module")
def rays():
    """Returns rays in all directions: some miss the box, some begin in it, the first ones run along an axis."""
    random = np.random.default_rng(1)
    directions = random.normal(size=(RAYS, 3)) * random.uniform(0.3, 3, size=(RAYS, 1))
    directions[:3] = np.eye(3)
    targets = random.uniform(0.2, 0.8, size=(RAYS, 3)) * UPPER
    targets[3:9] += 2  # outside the box
    origins = targets - directions * random.uniform(0, 4, size=(RAYS, 1))
    origins, directions = origins.astype(np.float32), directions.astype(np.float32)
    near, far = np.zeros(RAYS, np.float32), np.full(RAYS, 50, np.float32)
    return jaxnerf.Rays(origins=origins, directions=directions, viewdirs=directions, near=near, far=far)


def found(grid, rays, max_runs=2000):
    return march(grid, rays, step_size=STEP, cell=CELL, max_runs=max_runs)


def test_runs_hold_all_samples_in_occupied_cells(grid, rays):
    runs, complete = found(grid, rays)
    every = march_all(None, grid, rays, step_size=STEP, cell=CELL)
    occupied = in_matter(grid, rays, every)
    assert complete and 20 < occupied.sum() and int(runs.count.sum()) * WIDTH < every.t.size / 2
    for ray in range(RAYS):
        mine = np.arange(runs.first[ray], runs.first[ray] + runs.count[ray])
        np.testing.assert_array_equal(runs.ray_index[mine], ray)
        t, delta = (np.asarray(leaf)[mine].ravel() for leaf in (runs.samples.t, runs.samples.delta))
        assert (np.diff(t) >= 0).all()
        place = np.searchsorted(t, every.t[ray][occupied[ray]] - 1e-4)
        np.testing.assert_allclose(t[place], every.t[ray][occupied[ray]], atol=1e-5)
        np.testing.assert_allclose(delta[place], every.delta[ray][occupied[ray]], atol=1e-5)
    np.testing.assert_array_equal(np.asarray(runs.samples.delta)[int(runs.count.sum()) :], 0)


@pytest.mark.parametrize("step", [0.9, 3.5])
@pytest.mark.parametrize("cell", [(0.05, 0.05, 0.05), (0.02, 0.1, 0.05)])
def test_rays_along_the_axes_lose_no_cell_that_is_far_from_others(cell, step):
    """A run is then as many cells long as it can be."""
    shape, size = (35, 35, 35), np.float32(cell)
    occupied = np.zeros(shape, bool)
    occupied[::17, ::17, ::17] = True
    grid = create_grid(np.zeros(3), shape * size, occupied, initial_density=1.0)
    random, axes = np.random.default_rng(4), np.arange(600) % 3
    directions = np.eye(3)[axes] * random.choice([-1, 1], size=(600, 1))
    cells = random.choice([0, 17, 34], size=(600, 3))
    at = (cells + random.random((600, 3))) * size - 5 * directions
    at, directions = np.float32(at), np.float32(directions)
    near, far = np.float32(random.uniform(0, 5, 600)), np.full(600, 20, np.float32)
    rays = jaxnerf.Rays(origins=at, directions=directions, viewdirs=directions, near=near, far=far)
    steps = {"step_size": step * min(cell), "cell": cell}
    every = march_all(None, grid, rays, **steps)
    runs, complete = march(grid, rays, max_runs=9000, **steps)
    along = jax.tree.map(lambda leaf: leaf[runs.ray_index], rays)
    expected, kept = (in_matter(grid, each, found).sum() for each, found in ((rays, every), (along, runs.samples)))
    assert complete and kept == expected > 50
    assert runs.count.sum() < 600 * every.t.shape[-1] / WIDTH


def test_a_contracted_grid_is_refused(grid, rays):
    with pytest.raises(ValueError, match="the grid is contracted, expected one that is not"):
        found(dataclasses.replace(grid, contracted=True), rays)


@pytest.mark.parametrize("limit, slots", [(np.inf, 4000), (np.inf, 60), (0.5, 60), (0.5, 20)])
def test_the_same_samples_are_chosen_from_runs(grid, rays, limit, slots):
    runs, _ = found(grid, rays)
    options = {"max_samples": slots, "uniform_fraction": 0.4}
    key, limit = jax.random.key(3), np.float32(limit)
    every = march_all(None, grid, rays, step_size=STEP, cell=CELL)
    old, was_hidden = choose(key, grid, rays, every, max_optical_depth=limit, **options)
    new, is_hidden = choose(key, grid, rays, runs, max_optical_depth=limit, **options)
    assert np.asarray(old.used).sum() >= 20 and (np.isinf(limit) or np.asarray(was_hidden).any())
    assert_same(new, old, rtol=0, atol=1e-4)
    assert_same(is_hidden, was_hidden, rtol=0, atol=0)


def test_runs_that_do_not_fit_are_reported(grid, rays):
    runs, _ = found(grid, rays)
    needed = int(runs.count.sum())
    assert found(grid, rays, needed)[1] and not found(grid, rays, needed - 1)[1]


def test_rays_that_are_nan_have_all_runs(grid, rays):
    near = rays.near.copy()
    near[5] = np.nan
    runs, complete = found(grid, dataclasses.replace(rays, near=near))
    assert complete and runs.count[5] == runs.max_count and np.isnan(runs.samples.t[runs.first[5]]).all()
    samples, _ = choose(jax.random.key(0), grid, rays, runs, max_samples=4000, uniform_fraction=0.4)
    assert (np.asarray(samples.used) & (np.asarray(samples.ray_index) == 5)).any()


def test_an_empty_grid_has_no_runs(grid, rays):
    empty = dataclasses.replace(grid, occupied=jnp.zeros(SHAPE, bool), density_mean=jnp.full(SHAPE, -1.0))
    runs, complete = found(empty, rays)
    assert complete and not np.asarray(runs.count).any()
    assert np.isfinite(runs.samples.t).all()
    samples, hidden = choose(jax.random.key(0), empty, rays, runs, max_samples=100, uniform_fraction=0.4)
    assert not np.asarray(samples.used).any() and not np.asarray(hidden).any() and np.isfinite(samples.t).all()


@pytest.mark.parametrize("radius", [1, 4, 30])
def test_cells_within_the_radius_are_near(grid, radius):
    """A radius that exceeds the grid makes all of it one coarse cell."""
    random = np.random.default_rng(2)
    at = random.integers(0, SHAPE, size=(300, 3))
    places = np.float32((at + 0.5) / 21)
    there = jaxnerf.Rays(
        origins=places,
        directions=np.eye(3, dtype=np.float32)[at[:, 0] % 3],
        viewdirs=places,
        near=np.zeros(300, np.float32),
        far=np.ones(300, np.float32),
    )
    near = compiled(near_occupied, "radius")(grid, there, jnp.zeros((300, 1)), radius=radius)[:, 0]
    cells = np.argwhere(np.asarray(grid.occupied))
    distance = np.abs(at[:, None] - cells).max(axis=-1).min(axis=-1)
    assert near[distance <= radius].all() and not near[distance >= 2 * radius].any()


@pytest.mark.parametrize("part, complete", [(0.5, True), (0.001, False), (0.5, None)])
def test_a_model_with_fine_cells_places_the_same_samples(grid, rays, monkeypatch, part, complete):
    """Those near matter, or all of march_rays: where the buffer does not hold the former, or space is contracted."""
    contracted = complete is None
    grid = dataclasses.replace(grid, contracted=contracted)

    def apply(params, x, viewdirs):
        return 5 + params * x[..., 0], jax.nn.sigmoid(x)

    field = Field(init=lambda key: jnp.ones(()), apply=apply)
    updates = {"threshold": 0.01, "update_every": 16, "cells_per_update": 64}
    schedule = make_grid_schedule(
        (0, 0, 0), tuple(UPPER), resolution=21, step_size=STEP, field=field, contracted=contracted, **updates
    )
    options = OccupancyOptions(pool_samples_per_ray=1.0, max_optical_depth=1.0, occlusion_start_step=0)
    view = ViewOptions(early_stop_eps=0.0, max_samples=1)

    def rendered():
        model = occupancy_model(field, schedule, options, view, background=(1.0, 1.0, 1.0))
        return jax.jit(lambda: model.render(jax.random.key(0), {"fine": jnp.ones(())}, grid, rays, 1)["fine"])()

    expected, marched = rendered(), []
    monkeypatch.setattr(occupancy, "_MAX_RESOLUTION", 1)
    monkeypatch.setattr(occupancy, "_MAX_NEAR_MATTER", part)

    def spy(*args, max_runs, **options):
        marched.append(max_runs)
        return march_near_matter(*args, max_runs=max_runs, **options)

    monkeypatch.setattr(occupancy, "march_near_matter", spy)
    assert_same(rendered(), expected, rtol=1e-4, atol=1e-4)
    assert [bool(found(grid, rays, max_runs)[1]) for max_runs in marched] == [complete] * (not contracted)
