"""The occupancy grid's schedule: when which cells are updated; and ray marching through its box."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxnerf
from helpers import compiled, full_grid, rays_past_origin
from jaxnerf import Rays
from jaxnerf.core.occupancy import ray_marching
from jaxnerf.core.occupancy.from_scene import crop_grid
from jaxnerf.core.occupancy.grid import NUM_TIMES, clip_rays_to_box, is_occupied
from jaxnerf.fields.base import Field
from jaxnerf.models.grid_schedule import make_grid_schedule

BOX = (-1.5, -1.5, -1.0), (1.5, 1.5, 1.3)  # holds the embedded scene
KEY = jax.random.key(0)
DENSITY = 1e4  # everywhere
STEP_SIZE = 0.1


def a_schedule(density=DENSITY, box=BOX, **options):
    field = Field(None, lambda params, x, viewdirs: (jnp.full(x.shape[:-1], density), x))
    given = {"resolution": 8, "step_size": STEP_SIZE, "threshold": 0.01, "update_every": 16, "cells_per_update": 2**18}
    return make_grid_schedule(*box, field=field, **{**given, **options})


@functools.cache
def updates_of_cells(num_steps, num_cells, **options):
    """Returns [num_steps, num_cells], how often each of some cells was updated up to each step; and the others.

    Each update lets a fifth less light through, as no light passes the density.
    """
    schedule = a_schedule(**options)
    cells = np.random.default_rng(0).permutation(np.prod(schedule.shape))[:num_cells].astype(np.int32)

    def step(grid, index):
        grid = schedule.update(KEY, index, {"fine": None}, grid, jnp.asarray(cells))
        return grid, grid.density_mean.reshape(-1)

    first = schedule.create(np.ones(schedule.shape, bool))
    mean = jax.jit(lambda grid: jax.lax.scan(step, grid, jnp.arange(num_steps)))(first)[1]
    counts = np.float64(mean) * STEP_SIZE / -np.log(0.8)
    return counts.round().astype(int)[:, cells], np.delete(counts, cells, axis=1)


def test_thresholds_of_contracted_cells_follow_their_stretch_and_are_no_constants_of_a_program():
    """Far from the center a step is longer by the square of the distance there, and absorbs as much at less density."""
    schedule = a_schedule(box=((-2.0, -2.0, -1.0), (2.0, 2.0, 1.0)), contracted=True, resolution=16)
    places = [np.abs(4 * (np.arange(size) + 0.5) / size - 2) for size in schedule.shape]
    largest = np.max(np.meshgrid(*places, indexing="ij"), axis=0)
    expected = 0.01 / STEP_SIZE * np.minimum(2 - largest, 1) ** 2
    np.testing.assert_allclose(schedule.threshold, expected, rtol=1e-6)
    assert a_schedule().threshold == pytest.approx(0.01 / STEP_SIZE)
    grid, cells = schedule.create(np.ones(schedule.shape, bool)), np.arange(8)
    update = jax.make_jaxpr(lambda grid, cells: schedule.update(KEY, 0, {"fine": None}, grid, cells))(grid, cells)
    sizes = [np.size(const) for const in update.consts]
    assert max(sizes, default=0) <= max(schedule.shape), "the compiler copies constants many times"


def test_cells_are_cubes_along_all_sides():
    schedule = a_schedule(resolution=20)
    assert schedule.shape == (20, 20, 15) and schedule.cell == pytest.approx((0.15, 0.15, 2.3 / 15))
    assert a_schedule(box=((0, 0, 0), (1e-3, 1, 1))).shape == (1, 8, 8)


@pytest.mark.parametrize("cells_per_update", [2**18, 100])
def test_a_body_that_is_there_for_a_fiftieth_of_the_time_is_never_skipped(cells_per_update):
    """Whenever it is there, once cells were updated 150 times; and those that are always empty become so."""
    begins = jnp.linspace(0, 0.98, 8)  # of the body in each layer of cells along x

    def apply(params, x, viewdirs, *, time):
        layer = jnp.clip((x[..., 0] + 1) * 4, 0, 7).astype(int)
        there = (begins[layer] <= time) & (time < begins[layer] + 1 / NUM_TIMES) & (x[..., 1] < 0)
        return jnp.where(there, 10.5 * 0.01 / STEP_SIZE, 0.0), x

    box = (-1.0, -1.0, -1.0), (1.0, 1.0, 1.0)
    options = {"resolution": 8, "step_size": STEP_SIZE, "threshold": 0.01, "update_every": 16}
    schedule = make_grid_schedule(*box, field=Field(None, apply), cells_per_update=cells_per_update, **options)
    cells = jnp.arange(8**3)

    def step(grid, index):
        grid = schedule.update(jax.random.fold_in(KEY, index), index, {"fine": None}, grid, cells)
        return grid, (grid.occupied[:, :4].all(), grid.occupied[:, 5:].any())

    start = schedule.create(np.ones(schedule.shape, bool))
    full, others = jax.jit(lambda grid: jax.lax.scan(step, grid, jnp.arange(16 * 1300))[1])(start)
    rounds = -(-(8**3) // cells_per_update)
    assert full[16 * 150 * rounds :].all() and not full.all() and not others[16 * 7 * rounds :].any()


def test_half_a_dozen_updates_empty_a_cell_without_density():
    schedule = a_schedule(density=0.0)
    grid, cells = schedule.create(np.ones(schedule.shape, bool)), np.arange(np.prod(schedule.shape))
    assert grid.occupied.all()
    update, fractions = jax.jit(schedule.update), []
    for index in range(6):
        grid = update(KEY, 16 * index + 15, {"fine": None}, grid, cells)
        fractions.append(float(grid.occupied.mean()))
    assert fractions[3] == 1 and fractions[5] == 0


def test_cells_that_are_not_valid_stay_empty():
    schedule = a_schedule()
    valid = np.random.default_rng(1).uniform(size=schedule.shape) < 0.1
    grid = schedule.create(valid)
    np.testing.assert_array_equal(grid.occupied, valid)
    got = jax.jit(schedule.update)(KEY, 15, {"fine": None}, grid, np.flatnonzero(valid).astype(np.int32))
    np.testing.assert_array_equal(got.occupied, valid)
    assert schedule.update(KEY, 15, {"fine": None}, grid, np.zeros(0, np.int32)) is grid


def test_if_an_update_covers_all_cells_each_is_updated_once_per_interval():
    counts, others = updates_of_cells(50, 300)
    assert not others.any()
    expected = (np.arange(50) + 1) // 16  # at steps 15, 31, 47
    np.testing.assert_array_equal(counts, np.broadcast_to(expected[:, None], counts.shape))


def test_with_more_cells_updates_come_more_often_at_first():
    """A quarter of the cells at once: every 4 steps for 8 times 16 steps, then every 16."""
    counts, _ = updates_of_cells(200, 384, cells_per_update=96)
    updated = np.flatnonzero(np.diff(counts.sum(1), prepend=0))
    np.testing.assert_array_equal(updated, [*range(3, 128, 4), 143, 159, 175, 191])
    assert (np.diff(counts.sum(1), prepend=0)[updated] == 96).all()
    for step in range(15, 128, 16):
        assert (counts[step] == (step + 1) // 16).all()  # 8 times from the start, each cell as often
    assert (counts[191] == 9).all()  # and once more in four intervals


@pytest.mark.parametrize("num_cells, cells_per_update, update_every", [(300, 70, 16), (301, 300, 16), (300, 9, 4)])
def test_every_cell_is_updated(num_cells, cells_per_update, update_every):
    """Also if the numbers do not divide, and if an update in every step is too few for an interval."""
    options = {"cells_per_update": cells_per_update, "update_every": update_every}
    counts, others = updates_of_cells(200, num_cells, **options)
    assert not others.any()
    rounds = -(-num_cells // cells_per_update)
    often = max(update_every * cells_per_update // num_cells, 1)
    young = 8 * update_every
    if rounds * often <= young:
        assert (counts[rounds * often - 1] >= 1).all()
        assert (counts[young - 1] >= 8 - 1).all()
    later = np.arange(young, 200 - rounds * update_every, update_every)
    for step in later:
        assert (counts[step + rounds * update_every - 1] > counts[step - 1]).all()
    assert (counts[-1] >= 1).all()


def test_updates_that_together_cover_all_cells_have_the_same_size():
    counts, _ = updates_of_cells(26, 10_000, resolution=24, cells_per_update=9000)  # every 8 steps
    assert set(np.diff(counts.sum(1), prepend=0)) == {0, 5000}
    assert (counts[-1] >= 1).all()


@pytest.mark.parametrize("contracted", [False, True])
@pytest.mark.parametrize("threshold", [0.003, 0.03])
def test_half_empty_cells_transmit_half_of_the_light_over_a_step(contracted, threshold):
    def halved(params, x, viewdirs):
        bits = jax.lax.bitcast_convert_type(x[..., 0], jnp.int32) >> 10
        return jnp.where(bits % 2 == 0, 1e9, 0.0), x  # as good as random, also far away

    options = {"threshold": threshold, "update_every": 1, "cells_per_update": 2**18, "contracted": contracted}
    schedule = make_grid_schedule(
        (-2.0,) * 3, (2.0,) * 3, resolution=8, step_size=0.1, field=Field(None, halved), **options
    )
    cells = jnp.arange(np.prod(schedule.shape))

    def step(grid, index):
        grid = schedule.update(jax.random.fold_in(KEY, index), index, {"fine": None}, grid, cells)
        return grid, grid.density_mean

    means = jax.lax.scan(step, schedule.create(np.ones(schedule.shape, bool)), jnp.arange(300))[1][20:]
    middles = np.abs((np.indices(schedule.shape) + 0.5) / 2 - 2).max(axis=0)  # of the cells, from -2 to 2
    spacing = 0.1 / np.minimum(2 - middles, 1) ** 2 if contracted else 0.1
    through = np.exp(-spacing * np.float64(means)).mean(axis=0)
    np.testing.assert_allclose(through.mean(), 0.5, atol=0.02)
    np.testing.assert_allclose(through, 0.5, atol=0.2)


def test_an_update_depends_on_its_key_alone():
    schedule = make_grid_schedule(
        *BOX,
        resolution=8,
        step_size=0.1,
        field=Field(None, lambda params, x, viewdirs: (jnp.abs(x[..., 0]), x)),
        threshold=0.01,
        update_every=4,
        cells_per_update=1000,
    )
    cells, grid = np.arange(np.prod(schedule.shape)), schedule.create(np.ones(schedule.shape, bool))
    update = compiled(schedule.update)
    keys = jax.random.split(KEY)[np.array([0, 0, 1])]
    first, again, later = (update(key, 3, {"fine": None}, grid, cells).density_mean for key in keys)
    np.testing.assert_array_equal(first, again)
    assert (first != later).mean() > 0.9


def lengths(rays):
    return np.linalg.norm(np.float64(rays.directions), axis=-1)


@pytest.mark.parametrize(
    "step, random",
    [
        (0.3, True),
        (0.0777, False),
        (5.0, True),
        (np.sqrt(3) / 7, False),
    ],
)
def test_samples_cover_the_whole_way_through_the_box(step, random):
    """For any step size; also along the diagonal, the longest way through the box."""
    grid, rays = full_grid(0.5), rays_past_origin(5, 60)
    diagonal = np.float32([[1, 1, 1], [-2, 2, 2], [0.5, 0.5, 0.5], [1, 0, 0]])
    rays = jax.tree.map(lambda a, b: np.concatenate([a, np.float32(b)]), rays, Rays(
        origins=-2 * diagonal, directions=diagonal, viewdirs=diagonal, near=np.zeros(4), far=np.full(4, 9)
    ))  # fmt: skip
    keys = jax.random.split(jax.random.key(0), 64) if random else None
    march_rays = compiled(ray_marching.march_rays, "step_size", "cell")
    cell = tuple(1 / size for size in grid.valid.shape)
    samples = march_rays(keys, grid, rays, step_size=float(step), cell=cell)
    inside = compiled(clip_rays_to_box)(grid, rays)
    way = np.float64(inside.far) - inside.near
    assert (way > 0).mean() > 0.4 and (way == 0).any()
    np.testing.assert_allclose(np.float64(samples.delta).sum(-1), way, atol=1e-5)
    assert (samples.delta >= 0).all()
    assert (samples.delta * lengths(rays)[:, None]).max() <= step * (1 + 1e-4)
    counted = (samples.delta > 0).sum(-1)
    assert (counted <= way * lengths(rays) / step + 2.001).all()  # no ray has more samples than its length needs


def test_an_empty_cell_becomes_occupied_when_its_density_grows():
    """Also long after the start, when neighbours no longer count."""
    field = Field(None, lambda params, x, viewdirs: (jnp.where(x[..., 0] > 0, params, 0.0), x))
    options = {"resolution": 8, "step_size": 0.1, "threshold": 0.01, "update_every": 16, "cells_per_update": 2**18}
    schedule = make_grid_schedule(*BOX, field=field, **options)
    grid, cells = schedule.create(jnp.ones(schedule.shape, bool)), jnp.arange(np.prod(schedule.shape))
    update = jax.jit(schedule.update)
    for step in range(15, 400, 16):
        grid = update(KEY, step, {"fine": 0.0}, grid, cells)
    assert not grid.occupied.any()
    grid = update(KEY, 415, {"fine": 9.0}, grid, cells)
    half = schedule.shape[0] // 2
    assert grid.occupied[half:].all() and not grid.occupied[:half].any()


def test_a_cropped_grid_is_occupied_in_the_same_places():
    grid = full_grid(4.0, (8, 8, 8))
    occupied = np.zeros((8, 8, 8), bool)
    occupied[2, 3, 1] = occupied[4, 3, 6] = True
    grid = dataclasses.replace(grid, occupied=jnp.asarray(occupied))
    cropped = crop_grid(grid)
    assert cropped.occupied.shape == (3, 1, 6) and cropped.occupied.sum() == 2
    rays = rays_past_origin(0, 256)
    t = jaxnerf.uniform_edges(rays.near, rays.far, num_segments=64)
    inside = is_occupied(cropped, rays, t)
    assert inside.any()
    np.testing.assert_array_equal(inside, is_occupied(grid, rays, t))
    empty = dataclasses.replace(grid, occupied=jnp.zeros((8, 8, 8), bool))
    assert crop_grid(empty) is empty
