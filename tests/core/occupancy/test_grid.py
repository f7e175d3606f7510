"""The occupancy grid: where its cells are, what updates find, and which samples it masks."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxnerf
from helpers import checked_grid, compiled, full_grid, rays_past_origin
from jaxnerf.core.occupancy.from_scene import drop_thin_density, keep_cells
from jaxnerf.core.occupancy.grid import (
    clip_rays_to_box,
    create_grid,
    estimate_optical_depth,
    is_occupied,
    mark_cells,
    update_grid,
)

SIZES = (16, 12, 14)  # cells of the box that is updated
LOWER, UPPER = np.float32([-3.0, -2.0, -2.5]), np.float32([3.0, 2.5, 2.0])
is_occupied = compiled(is_occupied)
estimate_optical_depth = compiled(estimate_optical_depth)
keep_cells, mark_cells = compiled(keep_cells), compiled(mark_cells)


def fog(x, viewdirs):
    return 4 * jnp.exp(-2 * (x**2).sum(axis=-1)), jnp.zeros_like(x)


def one_ray(origin, direction):
    names = ("origins", "directions", "viewdirs", "near", "far")
    values = (origin, direction, direction, 0.0, 9.0)
    return jaxnerf.Rays(**{name: np.float32([value]) for name, value in zip(names, values, strict=True)})


@compiled
def update(key, grid, cells):
    return update_grid(key, grid, fog, cells, threshold=0.5, decay=0.5)


def middles(grid):
    """Returns the middles [X, Y, Z, 3] of cells, and half of a cell's diagonal."""
    size = (np.asarray(grid.upper) - np.asarray(grid.lower)) / grid.occupied.shape
    places = np.moveaxis(np.indices(grid.occupied.shape), 0, -1) + 0.5
    return np.asarray(grid.lower) + places * size, np.linalg.norm(size) / 2


@pytest.mark.parametrize("axis, size", [(0, 6), (1, 5), (2, 8)])
def test_each_position_is_in_its_cell(axis, size):
    """Along one axis, from the middle of the box's first cell: every other cell is empty."""
    cell = 3 / np.float32([6, 5, 8])
    direction = 2 * np.eye(3)[axis]
    rays = one_ray(-1.5 + cell / 2, direction)
    t = cell[axis] / 2 * np.float32([[0, 0.4, 0.6, 1, 2, size - 1, size - 0.4, -0.4, -0.6, np.nan]])
    empty_last = size % 2 == 0
    np.testing.assert_array_equal(
        is_occupied(checked_grid(), rays, t)[0],
        [True, True, False, False, True, not empty_last, False, True, False, True],
    )


def test_rays_are_clipped_to_the_box():
    grid = full_grid(half=1.0)
    directions = np.float32([[2, 0, 0], [2, 0, 0], [0, 0, 1], [1, 1, 0], [-1, 0, 0]])
    origins = np.float32([[-3, 0, 0], [-3, 2, 0], [0.5, 0.5, 0], [-2, -2, 0.5], [-3, 0, 0]])
    near, far = np.zeros(5, np.float32), np.full(5, 10, np.float32)
    rays = jaxnerf.Rays(origins=origins, directions=directions, viewdirs=directions, near=near, far=far)
    got = compiled(clip_rays_to_box)(grid, rays)
    np.testing.assert_allclose(got.near[[0, 2, 3]], [1, 0, 1])
    np.testing.assert_allclose(got.far[[0, 2, 3]], [2, 1, 3])
    np.testing.assert_array_equal(got.near[[1, 4]], got.far[[1, 4]])


def test_updates_empty_cells_without_density_and_keep_the_others():
    grid = create_grid(LOWER, UPPER, np.ones(SIZES, bool), initial_density=1.9)
    cells = np.arange(np.prod(SIZES), dtype=np.int32)
    first = update(jax.random.key(0), grid, cells)
    assert first.occupied.all()  # one update is not enough: it leaves 0.95 of the initial density
    grid = update(jax.random.key(1), first, cells)
    places, half = middles(grid)
    away = np.linalg.norm(places, axis=-1)
    radius = np.sqrt(np.log(4 / 0.5) / 2)  # where the density is at the threshold
    assert grid.occupied[away < radius].all()  # the neighbours keep what one update might miss
    assert not grid.occupied[away > radius + 3.1 * half].any()  # its own cell's half, and a neighbour
    truth = 4 * np.exp(-2 * away**2)
    assert np.corrcoef(np.maximum(grid.density_mean, 0).reshape(-1), truth.reshape(-1))[0, 1] > 0.95
    np.testing.assert_array_equal(grid.density_mean < 0, ~grid.occupied)


def test_a_cell_with_a_density_at_the_threshold_is_empty():
    grid = create_grid(LOWER, UPPER, np.ones((2, 2, 2), bool), initial_density=0.0)

    @compiled
    def occupied(density):
        fog = lambda x, viewdirs: (jnp.full(x.shape[:-1], density), x)  # noqa: E731
        return update_grid(jax.random.key(0), grid, fog, np.arange(8), threshold=0.5).occupied

    assert not occupied(0.5).any() and occupied(0.501).all()


def test_an_update_of_some_cells_does_not_change_the_others():
    grid = checked_grid(1.0, SIZES)
    cells = np.resize(np.int32([0, 3, 77, 300]), 4)
    got = update(jax.random.key(2), grid, cells)
    changed = np.flatnonzero(got.density_max != np.asarray(grid.density_max))
    assert set(changed) <= set(cells)
    valid = np.asarray(grid.valid).reshape(-1)
    assert set(np.flatnonzero(got.density_mean > 0)) == {cell for cell in cells if valid[cell]} != set(cells)
    assert not got.occupied[~np.asarray(grid.valid)].any()


def test_each_update_evaluates_a_point_inside_its_cell():
    """Here the density at x is the index of its cell."""
    grid = create_grid(LOWER, UPPER, np.ones(SIZES, bool), initial_density=0.0)

    def numbered(x, viewdirs):
        sizes = zip(LOWER, UPPER, SIZES, strict=True)
        cells = [(x[..., i] - low) / (high - low) * size for i, (low, high, size) in enumerate(sizes)]
        first, second, third = (jnp.floor(cell) for cell in cells)
        return (first * SIZES[1] + second) * SIZES[2] + third, x

    cells = np.random.default_rng(0).permutation(np.prod(SIZES))[:500].astype(np.int32)
    update_numbered = jax.jit(
        lambda key: update_grid(key, grid, numbered, cells, threshold=0.5, smoothing=1.0, chunk=96)
    )
    np.testing.assert_array_equal(update_numbered(jax.random.key(0)).density_max.reshape(-1)[cells], cells)


def test_a_density_that_is_nan_keeps_its_cell_occupied():
    """So that NaN is evaluated and shows, in images and in training."""
    grid = create_grid(np.full(3, -1.5), np.full(3, 1.5), np.ones((6, 5, 8), bool), initial_density=0.0)

    def wrong(x, viewdirs):
        return jnp.where(x[..., 0] > 0.5, jnp.nan, 0.0), jnp.zeros_like(x)

    got = jax.jit(lambda key: update_grid(key, grid, wrong, jnp.arange(240), threshold=0.5))(jax.random.key(0))
    occupied = np.asarray(got.occupied)
    assert occupied[4:].all() and occupied[3].all()  # and the neighbours
    assert not occupied[:3].any()
    rays = one_ray((-2.9, 0.1, 0.1), (1.0, 0.0, 0.0))
    samples = jaxnerf.samples_from_points(np.float32([[1.5, 2.0, 3.6, 4.0]]), last_delta=0.1)
    np.testing.assert_array_equal(is_occupied(got, rays, samples.t), [[False, False, True, True]])
    np.testing.assert_array_equal(estimate_optical_depth(got, rays, samples)[0], [[False, False, True, True]])


def test_grid_from_scene_finds_the_dense_cells():
    @compiled
    def extract(key):
        return jaxnerf.grid_from_scene(key, fog, LOWER, UPPER, SIZES, threshold=0.5)

    grid = extract(jax.random.key(3))
    places, half = middles(grid)
    away = np.linalg.norm(places, axis=-1)
    radius = np.sqrt(np.log(4 / 0.5) / 2)
    assert grid.valid.all() and grid.occupied.shape == SIZES
    assert grid.occupied[away < radius].all()
    assert not grid.occupied[away > radius + 3.1 * half].any()
    inner = away < 0.7 * radius
    np.testing.assert_allclose(grid.density_mean[inner], 4 * np.exp(-2 * away[inner] ** 2), atol=0.7)


def test_a_half_empty_cell_transmits_half_of_the_light():
    halved = lambda x, viewdirs: (jnp.where(x[..., 0] % 1 < 0.5, 1e6, 0.0), jnp.zeros_like(x))  # noqa: E731
    options = {"threshold": 0.02, "num_updates": 200}
    grid = jaxnerf.grid_from_scene(jax.random.key(0), halved, np.zeros(3), np.full(3, 4.0), (4, 4, 4), **options)
    spacing = 0.01 / 0.02
    np.testing.assert_allclose(np.exp(-spacing * grid.density_mean), 0.5, atol=0.12)
    solid = lambda x, viewdirs: (jnp.full(x.shape[:-1], jnp.inf), jnp.zeros_like(x))  # noqa: E731
    full = jaxnerf.grid_from_scene(jax.random.key(0), solid, grid.lower, grid.upper, (4, 4, 4), **options)
    assert np.isfinite(full.density_mean).all() and (full.density_mean * spacing > 60).all()


def plain_optical_depth(grid, rays, samples):
    """Returns which samples are occupied [B, S] and their optical depth [B, S], sample by sample, in float64."""
    shape = np.array(grid.density_mean.shape)
    occupied, depth = np.zeros(samples.t.shape, bool), np.zeros(samples.t.shape)
    for ray, index in np.ndindex(*samples.t.shape):
        t, delta = float(samples.t[ray, index]), float(samples.delta[ray, index])
        x = np.float64(rays.origins[ray]) + t * np.float64(rays.directions[ray])
        cell = np.floor((x - grid.lower) / (np.float64(grid.upper) - grid.lower) * shape).astype(int)
        inside = (cell >= 0).all() and (cell < shape).all() and delta > 0
        if inside and grid.occupied[tuple(cell)]:
            occupied[ray, index] = True
            depth[ray, index] = grid.density_mean[tuple(cell)] * delta * np.linalg.norm(rays.directions[ray])
    return occupied, depth


def test_the_optical_depth_is_that_of_a_plain_loop():
    grid = checked_grid()
    density = np.random.default_rng(1).exponential(size=(6, 5, 8)) * (
        np.random.default_rng(2).uniform(size=(6, 5, 8)) < 0.8
    )
    grid = dataclasses.replace(grid, density_mean=jnp.where(grid.occupied, np.float32(density), -1))
    grid = jax.tree.map(np.asarray, grid)
    rays = rays_past_origin(4, 30)
    # Some samples are masked already, as those behind far.
    samples = jaxnerf.samples_from_edges(
        None, np.minimum(np.linspace(1, 8, 61, dtype=np.float32), rays.far[:, None] - rays.near[:, None])
    )
    got, depth = estimate_optical_depth(grid, rays, samples)
    occupied, expected = plain_optical_depth(grid, rays, samples)
    np.testing.assert_array_equal(got, occupied)
    np.testing.assert_array_equal(got, is_occupied(grid, rays, samples.t) & (samples.delta > 0))
    np.testing.assert_allclose(depth, expected, rtol=1e-5)
    assert 0.05 < occupied.mean() < 0.95


def test_a_t_that_is_nan_is_kept_and_shows():
    """In training as in images: a broken ray must not look like an empty one."""
    samples = jaxnerf.samples_from_points(np.float32([[np.nan, 1.0]]), last_delta=0.1)
    assert estimate_optical_depth(full_grid(), one_ray((0, 0, 0), (1, 0, 0)), samples)[0][0, 0]


def test_wrong_arguments():
    with pytest.raises(ValueError, match="create_grid: upper"):
        create_grid(np.zeros(3), np.zeros(2), np.ones((2, 2, 2), bool), initial_density=1.0)
    with pytest.raises(ValueError, match="create_grid: valid"):
        create_grid(np.zeros(3), np.ones(3), np.ones((2, 2), bool), initial_density=1.0)
    with pytest.raises(ValueError, match="update_grid: cells"):
        update(jax.random.key(0), full_grid(), np.zeros((2, 2), np.int32))


def test_keep_cells_keeps_marked_cells():
    grid, rays = full_grid(4.0, (8, 8, 8)), rays_past_origin(0, 64)
    t = rays.near[:, None] + (rays.far - rays.near)[:, None] * np.linspace(0, 1, 65, dtype=np.float32)
    chosen = np.abs(t - 4) < 0.1
    marked = mark_cells(np.zeros((8, 8, 8), bool), grid, rays, t, chosen)
    assert 0 < marked.sum() < 64
    x = rays.origins[:, None] + t[..., None] * rays.directions[:, None]
    cells = np.floor((x + 4) / 1).astype(int)[chosen & (np.abs(x) < 4).all(axis=-1)]
    want = np.zeros((8, 8, 8), bool)
    want[tuple(cells.T)] = True
    np.testing.assert_array_equal(marked, want)
    kept = keep_cells(grid, marked)
    assert kept.occupied[marked].all() and kept.occupied.sum() < grid.occupied.sum()
    assert (kept.density_mean[~kept.occupied] == -1).all()


def test_keep_cells_keeps_what_is_between_two_marked_cells():
    """Rays may have passed a cell on both sides."""
    marked = np.zeros((4, 4, 4), bool)
    marked[[0, 2], 0, 0] = marked[3, [1, 3], 3] = marked[0, 3, [0, 2]] = True
    want = marked.copy()
    want[1, 0, 0] = want[3, 2, 3] = want[0, 3, 1] = True
    kept = keep_cells(full_grid(4.0, (4, 4, 4)), jnp.asarray(marked))
    np.testing.assert_array_equal(kept.occupied, want)
    assert not keep_cells(kept, jnp.ones((4, 4, 4), bool)).occupied[~want].any()


@pytest.mark.parametrize("per_cell", [False, True])
def test_density_up_to_its_cells_threshold_is_dropped(per_cell):
    grid = full_grid(4.0, (2, 2, 2))
    threshold = np.arange(8, dtype=np.float32).reshape(2, 2, 2) if per_cell else 3.0
    density = np.float32([2.0, 3.0, 3.5, 7.0, 8.0, np.nan])
    x = np.float32([[-2, -2, 2], [-2, 2, 2], [-2, 2, 2], [2, 2, 2], [2, 2, 2], [2, 2, 2]])
    scene = drop_thin_density(lambda x, viewdirs: (density, x), grid, threshold)
    want = [2, 0, 3.5, 0, 8, np.nan] if per_cell else [0, 0, 3.5, 7, 8, np.nan]
    clear, rgb = scene(x, x)
    np.testing.assert_array_equal(clear, np.float32(want))
    np.testing.assert_array_equal(rgb, x)


def test_a_masked_scene_may_be_evaluated_nowhere():
    masked = jaxnerf.mask_scene(lambda x, viewdirs: (x[..., 0], x), full_grid())
    density, rgb = masked(jnp.zeros((0, 3)), jnp.zeros((0, 3)))
    assert density.shape == (0,) and rgb.shape == (0, 3)


def test_without_spread_only_dense_cells_count():
    grid = full_grid(4.0, (8, 8, 8))
    ball = lambda x, viewdirs: (jnp.where((x**2).sum(-1) < 4, 9.0, 0.0), x)  # noqa: E731
    options = {"threshold": 0.5, "decay": 0.0}
    update_ball = jax.jit(
        lambda spread: update_grid(jax.random.key(0), grid, ball, jnp.arange(512), spread=spread, **options)
    )
    wide, narrow = update_ball(True), update_ball(False)
    np.testing.assert_array_equal(narrow.occupied, narrow.density_max > 0.5)
    assert 0 < narrow.occupied.sum() < wide.occupied.sum() and wide.occupied[narrow.occupied].all()
