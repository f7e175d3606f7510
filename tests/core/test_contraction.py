"""All of space in a box: the maps, the grid over them, and samples that grow with the distance."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from helpers import compiled
from jaxnerf import Rays, create_grid, mask_scene, render_packed, render_samples, update_grid
from jaxnerf.core.contraction import contract, expand
from jaxnerf.core.occupancy.from_scene import crop_grid, visible_grid
from jaxnerf.core.occupancy.grid import is_occupied
from jaxnerf.core.occupancy.ray_marching import march_rays
from jaxnerf.fields.base import Field, contract_field
from jaxnerf.models.grid_schedule import make_grid_schedule

pytest_plugins = ["run_fixtures"]
pytestmark = pytest.mark.usefixtures("unoptimized")

KEY = jax.random.key(0)
INNER, SIDE = 0.5, 32  # half the uncontracted part's side, cells per side
CELL = (4 * INNER / SIDE,) * 3
CENTER = np.float32([0.3, -0.2, 0.1])
BOX = CENTER - 2 * INNER, CENTER + 2 * INNER
march = compiled(march_rays, "step_size", "cell")


def a_grid(valid=None, **options):
    valid = np.ones((SIDE,) * 3, bool) if valid is None else valid
    return create_grid(*BOX, valid, initial_density=1.0, contracted=True, **options)


def some_rays(count=64, seed=0, near=0.05, far=1e4):
    """Returns Rays that look from outside and from inside the uncontracted part in all directions."""
    rng = np.random.default_rng(seed)
    origins = CENTER + rng.normal(size=(count, 3)) * np.linspace(0.1, 3, count)[:, None]
    directions = rng.normal(size=(count, 3))
    unit = directions / np.linalg.norm(directions, axis=-1, keepdims=True)
    return Rays(
        origins=np.float32(origins),
        directions=np.float32(directions),
        viewdirs=np.float32(unit),
        near=np.full(count, near, np.float32),
        far=np.full(count, far, np.float32),
    )


def test_rays_of_an_image_are_marched_as_in_a_row():
    rays = some_rays(count=12)
    image = jax.tree.map(lambda leaf: leaf.reshape(3, 4, *leaf.shape[1:]), rays)
    row, rows = (march(None, a_grid(), each, step_size=0.1, cell=CELL) for each in (rays, image))
    np.testing.assert_allclose(rows.t.reshape(12, -1), row.t, rtol=1e-6)


@settings(deadline=None, max_examples=100)
@given(st.lists(st.floats(-1e6, 1e6, width=32), min_size=3, max_size=3))
def test_expand_undoes_contract(x):
    x = np.float64(x)
    with jax.enable_x64(True):
        y = np.asarray(contract(jnp.asarray(x)))
        assert (np.abs(y) <= 2).all()
        np.testing.assert_allclose(expand(jnp.asarray(y)), x, rtol=1e-6, atol=1e-12)
    m = np.abs(x).max()
    np.testing.assert_allclose(y, x if m <= 1 else x / m * (2 - 1 / m), rtol=1e-12)


@pytest.mark.parametrize("function", [contract, expand])
def test_gradients_are_finite_everywhere(function):
    x = np.float32([[0, 0, 0], [1, 1, 1], [1, -1, 0.5], [1.5, 0, 0], [1.999, 1.5, -1.999], [1e-30, 0, 1e-20]])
    x = np.concatenate([x, np.float32([[1e18, 1, 1e18]])]) if function is contract else x
    slope = jax.vmap(jax.jacfwd(lambda p: function(p)))(x)
    assert np.isfinite(slope).all()


def test_shapes_are_checked():
    with pytest.raises(ValueError, match=r"contract: x has shape \(2,\)"):
        contract(jnp.zeros(2))


def test_a_cell_holds_what_contract_puts_there():
    """The grid's axis-by-axis arithmetic is contract's."""
    rng = np.random.default_rng(1)
    valid = rng.random((SIDE,) * 3) < 0.5
    x = np.float32(CENTER + rng.normal(size=(4000, 3)) * np.geomspace(0.01, 1e3, 4000)[:, None])
    place = (np.asarray(contract((x - CENTER) / INNER)) + 2) / 4 * SIDE
    index = np.clip(place.astype(int), 0, SIDE - 1)
    sure = (np.abs(place - np.rint(place)) > 1e-3).all(axis=-1)
    grid = a_grid(valid)
    rays = Rays(origins=x, directions=np.ones_like(x), viewdirs=np.ones_like(x), near=x[:, 0], far=x[:, 0])
    found = compiled(is_occupied)(grid, rays, np.zeros((4000, 1), np.float32))[:, 0]
    np.testing.assert_array_equal(found[sure], valid[tuple(index.T)][sure])


@pytest.mark.slow
def test_samples_reach_from_near_to_far_and_grow_only_outside():
    rays, step = some_rays(), 0.01
    samples = march_rays(None, a_grid(), rays, step_size=step, cell=CELL)
    t, delta = np.asarray(samples.t), np.asarray(samples.delta)
    used = delta > 0
    speed = np.linalg.norm(rays.directions, axis=-1)
    assert (np.diff(t, axis=-1) >= 0).all() and np.isfinite(t).all()
    first = np.array([row[mask][0] for row, mask in zip(t, used, strict=True)])
    assert (first >= rays.near).all()
    ends = np.array([(row + d / 2)[mask][-1] for row, d, mask in zip(t, delta, used, strict=True)])
    reach = np.linalg.norm(rays.origins + ends[:, None] * rays.directions - CENTER, axis=-1)
    assert (reach > 20 * INNER).all()  # all but to infinity
    x = rays.origins[:, None] + t[..., None] * rays.directions[:, None]
    largest = np.abs((x - CENTER) / INNER).max(axis=-1)
    length = delta * speed[:, None]
    assert (length[used & (largest < 0.5)] < 1.6 * step).all() and (length[used] > 0.99 * step)[3:].all()
    assert (length[used & (largest > 8)] > 4 * step).all()
    # As contracted cells do: no step crosses more of them than a plain step does, by far.
    start, end = (
        np.asarray(contract((p - CENTER) / INNER))
        for p in (
            x - delta[..., None] / 2 * rays.directions[:, None],
            x + delta[..., None] / 2 * rays.directions[:, None],
        )
    )
    crossed = np.linalg.norm(end - start, axis=-1)[used]
    assert crossed.max() < 6 * step / INNER and np.median(crossed) > 0.3 * step / INNER


def test_near_and_far_are_kept():
    rays = some_rays(near=0.3, far=0.9)
    samples = march(jax.random.key(0), a_grid(), rays, step_size=0.05, cell=CELL)
    edges = samples.t - samples.delta / 2, samples.t + samples.delta / 2
    used = samples.delta > 0
    assert edges[0][used].min() > 0.3 - 1e-5 and edges[1][used].max() < 0.9 + 1e-5
    np.testing.assert_allclose(samples.delta.sum(axis=-1), 0.6, rtol=1e-4)


@pytest.mark.slow
def test_packed_equals_dense_when_all_is_occupied():
    rays = some_rays(near=0.3)

    def scene(x, viewdirs):
        return jnp.exp(-(x**2).sum(axis=-1)) + 0.01, 0.5 + 0.4 * jnp.sin(x + viewdirs)

    samples = march_rays(None, a_grid(), rays, step_size=0.02, cell=CELL)
    packed = jax.jit(lambda r, s: render_packed(scene, a_grid(), r, s, max_samples=2**15, background=jnp.ones(3)))
    dense = jax.jit(lambda r, s: render_samples(scene, r, s, background=jnp.ones(3)))
    got, want = packed(rays, samples), dense(rays, samples)
    assert int(got.num_dropped.sum()) == 0
    np.testing.assert_allclose(got.rgb, want.rgb, atol=2e-6)
    np.testing.assert_allclose(got.opacity, want.opacity, atol=2e-6)


def test_an_update_evaluates_the_scene_where_the_cell_is():
    """A ball far outside the uncontracted part is found in the cells that contract puts it in."""
    middle, radius = CENTER + np.float32([4.0, 0, 0]), 1.2

    def scene(x, viewdirs):
        inside = jnp.linalg.norm(x - middle.reshape(1, 1, 3), axis=-1) < radius
        return jnp.where(inside, 50.0, 0.0), jnp.zeros_like(x)

    grid = a_grid()
    cells = jnp.arange(SIDE**3)
    updated = jax.jit(
        lambda grid: update_grid(jax.random.key(0), grid, scene, cells, threshold=1.0, decay=0.0, spread=True)
    )(grid)
    place = (np.stack(np.unravel_index(np.flatnonzero(updated.occupied), (SIDE,) * 3), -1) + 0.5) / SIDE * 4 - 2
    assert 0 < len(place) < 600
    image = np.asarray(contract((middle - CENTER) / INNER))
    assert (np.abs(place - image) < 0.8).all()
    kept = mask_scene(scene, updated)
    density, _ = jax.jit(kept)(middle.reshape(1, 1, 3), np.ones((1, 1, 3), np.float32))
    assert density.item() == 50.0


def test_thresholds_fall_where_steps_grow():
    schedule = make_grid_schedule(
        (-2.0,) * 3,
        (2.0,) * 3,
        resolution=16,
        step_size=0.1,
        contracted=True,
        threshold=0.01,
        update_every=1,
        cells_per_update=2**12,
        field=Field(None, lambda p, x, v: (jnp.full(x.shape[:-1], 0.05), x)),
    )
    grid = schedule.create(np.ones(schedule.shape, bool))
    update, cells = jax.jit(schedule.update), jnp.arange(16**3, dtype=jnp.int32)
    for step in range(20):
        grid = update(KEY, jnp.int32(200 + step), {"fine": None}, grid, cells)
    occupied = np.asarray(grid.occupied)
    assert not occupied[4:12, 4:12, 4:12].any()  # 0.05 over 0.1 is below 1 %
    assert occupied[0].all() and occupied[:, -1].all()  # over a far cell's step it is not


def test_a_contracted_field_is_evaluated_inside_its_box():
    field = Field(None, lambda params, x, viewdirs: (x[..., 0], x))
    whole = contract_field(field, *BOX)
    x = CENTER + np.float32([[0.1, 0.2, 0.3], [1e6, 0, 0], [0, -0.5, 0]])
    _, places = whole.apply(None, x[None], None)
    np.testing.assert_allclose(
        places[0], CENTER + np.float32([[0.1, 0.2, 0.3], [2 * INNER, 0, 0], [0, -0.5, 0]]), atol=1e-5
    )


@pytest.mark.slow
def test_a_grid_can_be_made_for_a_scene_trained_without_one():
    """Matter far outside the uncontracted part is kept, and renders as it does without a grid."""
    field = Field(None, lambda params, x, viewdirs: (jnp.zeros(x.shape[:-1]), x))
    options = {"threshold": 0.01, "update_every": 1, "cells_per_update": 2**15, "contracted": True}
    schedule = make_grid_schedule(
        *(tuple(bound.tolist()) for bound in BOX), resolution=SIDE, step_size=0.02, field=field, **options
    )

    def scene(x, viewdirs):
        near = jnp.linalg.norm(x - CENTER.reshape(1, 1, 3), axis=-1) < 0.3
        far = jnp.linalg.norm(x, axis=-1) > 8
        return jnp.where(near, 30.0, jnp.where(far, 1.0, 0.0)), 0.5 + 0.4 * jnp.tanh(x / 5)

    rays = some_rays(2048, near=0.3)
    find = jax.jit(lambda rays: visible_grid(scene, rays, **schedule.box(), max_samples=2**16, background=None))
    grid = crop_grid(find(rays))
    assert grid.contracted and grid.occupied.shape == (SIDE,) * 3 and 0.05 < grid.occupied.mean() < 0.9
    rays = jax.tree.map(lambda leaf: leaf[::16], rays)
    samples = march_rays(None, grid, rays, step_size=0.02, cell=CELL)
    show = jax.jit(lambda grid: render_packed(scene, grid, rays, samples, max_samples=2**16))
    np.testing.assert_allclose(show(grid).rgb, show(a_grid()).rgb, atol=0.02)
