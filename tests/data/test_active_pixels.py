"""Valid cells and active pixels before training, their cache, and runs of pixel ids."""

import dataclasses

import jax
import numpy as np
import pytest

from helpers import assert_same, compiled
from jaxnerf.data import active_pixels, synthetic
from jaxnerf.data.active_pixels import active_region, find_active_pixels, valid_cells
from jaxnerf.models.grid_schedule import make_grid_schedule
from jaxnerf.runtime import cores
from jaxnerf.tools.embedded_scene import still_life

BOX = (-1.5, -1.5, -1.0), (1.5, 1.5, 1.3)  # contains the embedded scene


def a_schedule(box=BOX, **options):
    defaults = {"resolution": 8, "step_size": 0.1, "threshold": 0.01, "update_every": 16, "cells_per_update": 2**18}
    return make_grid_schedule(*box, field=None, **{**defaults, **options})


@pytest.fixture(scope="module")
def views():
    return synthetic.load_synthetic(size=24)


def test_all_cells_are_valid_without_alpha(views):
    schedule = a_schedule()
    assert valid_cells(views, schedule, use_alpha=False).all()
    opaque = dataclasses.replace(views, pixels=views.pixels[:, :3])
    valid = valid_cells(opaque, schedule, use_alpha=True)
    assert valid.all() and valid.shape == schedule.shape == (8, 8, 6)


@pytest.mark.parametrize("resolution", [16, 37])
def test_valid_cells_contain_all_matter_of_the_embedded_scene(views, resolution):
    """At resolution 37 the visual hull has more cells than the box."""
    schedule = a_schedule(resolution=resolution)
    valid = valid_cells(views, schedule, use_alpha=True)
    assert valid.shape == schedule.shape and valid.mean() < 0.8
    lower, upper = (np.float32(bound) for bound in BOX)
    x = lower + np.random.default_rng(2).uniform(size=(1, 200_000, 3)).astype(np.float32) * (upper - lower)
    density, _ = compiled(still_life.still_life)(x, x)
    cells = np.floor((x[0] - lower) / (upper - lower) * schedule.shape).astype(int)
    dense = density[0] > 1.0  # thinner matter may leave no alpha
    assert dense.mean() > 0.02 and valid[tuple(cells[dense].T)].all()


def all_ids(active):
    return np.asarray(active.ids(np.arange(active.size)))


@pytest.mark.parametrize("step_size", [0.05, 0.3])
def test_pixels_with_alpha_are_active(views, step_size):
    schedule = a_schedule(resolution=32, step_size=step_size)
    (valid, empty), active, cells = active_region(views, schedule, use_alpha=True)
    assert empty is None
    np.testing.assert_array_equal(cells, np.flatnonzero(valid))
    ids = all_ids(active)
    assert ids.dtype == cells.dtype == np.int32 and (np.diff(ids) > 0).all()
    assert np.isin(np.flatnonzero(views.pixels[:, 3] > 0), ids).all()
    assert ids.size < 0.98 * len(views.pixels)
    # Without use_alpha the same pixels are found by their rays.
    np.testing.assert_array_equal(ids, all_ids(find_active_pixels(views, schedule, valid)))


def test_masked_pixels_are_not_active(views):
    mask = np.arange(len(views.pixels)) % 3 == 0
    masked = dataclasses.replace(views, mask=mask)
    schedule = a_schedule()
    valid = np.ones(schedule.shape, bool)
    expected = all_ids(find_active_pixels(views, schedule, valid))
    got = all_ids(find_active_pixels(masked, schedule, valid, chunk=1000))  # the chunk has no effect
    np.testing.assert_array_equal(got, expected[mask[expected]])
    fourth = np.where(np.arange(mask.size)[:, None] % 4 == 0, np.uint16(9), np.uint16(0)).repeat(4, axis=1)
    masked = dataclasses.replace(masked, pixels=fourth)
    got = all_ids(find_active_pixels(masked, schedule, ~valid, use_alpha=True))
    np.testing.assert_array_equal(got, np.arange(0, mask.size, 12))


def test_tiles_contain_all_active_pixels(views, monkeypatch):
    mask = np.random.default_rng(0).random(len(views.pixels)) < 0.9
    pixels = np.where(np.arange(len(mask))[:, None] == 7, 9, np.zeros_like(views.pixels))  # in a corner
    views = dataclasses.replace(views, pixels=pixels, mask=mask | (np.arange(len(mask)) == 7))
    schedule = a_schedule(resolution=32)
    valid = np.zeros(schedule.shape, bool)
    valid[13:19, 13:19, 9:14] = True
    expected = all_ids(find_active_pixels(views, schedule, valid, use_alpha=True))
    monkeypatch.setattr(active_pixels, "_MAX_RAYS", 0)
    monkeypatch.setattr(active_pixels, "_NUM_TILES", len(mask) / 2.5**2)  # of 3 x 3 px
    got = all_ids(find_active_pixels(views, schedule, valid, use_alpha=True))
    assert 7 in expected and np.isin(expected, got).all() and views.mask[got].all()
    assert expected.size < got.size < 0.6 * mask.sum()


def test_without_empty_cells_the_rays_through_the_box_are_active(views):
    """One invalid cell in a corner, which hides the corner's rays alone, makes the rays march through the grid."""
    schedule = a_schedule(box=((-0.3,) * 3, (0.3,) * 3))
    valid = np.ones(schedule.shape, bool)
    through = set(all_ids(active_pixels.find_active_pixels(views, schedule, valid)).tolist())
    valid[0, 0, 0] = False
    marched = set(all_ids(active_pixels.find_active_pixels(views, schedule, valid)).tolist())
    assert marched <= through and 0.95 * len(through) < len(marched) < len(views.pixels)


def test_a_box_that_no_ray_hits_is_an_error(views):
    with pytest.raises(ValueError, match=r"no ray of 60 views .*\(50, 50, 50\).* correct scene.lower"):
        active_region(views, a_schedule(box=((50, 50, 50), (51, 51, 51))), use_alpha=False)


@pytest.mark.slow
def test_a_region_is_cached_until_something_that_it_depends_on_changes(views, tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setattr(active_pixels, "_SLOW", 0.0)
    calls = []

    def recorded(*args, **options):
        calls.append(options)
        return find_active_pixels(*args, **options)

    monkeypatch.setattr(active_pixels, "find_active_pixels", recorded)

    def find(views=views, use_alpha=True, **options):
        return active_region(views, a_schedule(**options), use_alpha=use_alpha)

    first, again = find(), find()
    assert len(calls) == 1 and all_ids(first[1]).size == again[1].size > 0
    for one, other in zip(first, again, strict=True):
        assert_same(one, other, rtol=0, atol=0)
    pixels = views.pixels.copy()
    pixels[0, 0] ^= 1  # a change of colour has no effect, a change of alpha has
    find(dataclasses.replace(views, pixels=pixels))
    assert len(calls) == 1
    pixels[0, 3] += 1
    changes = (
        {"views": dataclasses.replace(views, pixels=pixels)},
        {"views": dataclasses.replace(views, near=views.near + np.float32(0.1))},
        {"views": dataclasses.replace(views, mask=np.arange(len(pixels)) % 3 > 0)},
        {"use_alpha": False},
        {"resolution": 9},
        {"step_size": 0.2},
    )
    for count, change in enumerate(changes, 2):
        find(**change)
        assert len(calls) == count, change
    with monkeypatch.context() as patched:
        patched.setattr(active_pixels, "_VERSION", 0)
        find()
    assert len(calls) == len(changes) + 2
    for file in (tmp_path / "jaxnerf").iterdir():
        file.write_bytes(file.read_bytes()[:-9])
    assert_same(find()[1], first[1], rtol=0, atol=0)
    assert len(calls) == len(changes) + 3


# Valid cells and active pixels by version: in the visual hull, and seen by at least 58 of the 60 cameras.
FOUND = {2: ((6095, 30_416), (6577, 31_435))}


def test_results_that_change_have_a_new_version(views):
    """Otherwise a run would take the cells and pixels that other code has cached. Rounding may move a few."""
    found = []
    for options in ({"use_alpha": True}, {"use_alpha": False, "min_views": 58}):
        (valid, _), active, _ = active_region(views, a_schedule(resolution=24), **options)
        found.append((valid.sum(), active.size))
    expected = np.array(FOUND[active_pixels._VERSION])
    assert found == pytest.approx(expected, rel=0.003), "increase active_pixels._VERSION and add what it finds to FOUND"


def test_any_number_of_cores_finds_the_same_cells_and_pixels(views, monkeypatch):
    found = []
    for count in (1, 2, 3):
        monkeypatch.setattr(cores, "usable", lambda count=count: count)
        schedule = a_schedule(resolution=32)
        valid = valid_cells(views, schedule, use_alpha=True)
        found.append((valid, vars(find_active_pixels(views, schedule, valid, chunk=2**10))))
    for other in found[1:]:
        jax.tree.map(np.testing.assert_array_equal, found[0], other)


@pytest.mark.parametrize("fraction", [0.02, 0.5, 1.0])
def test_runs_give_the_positions_and_counts_of_single_ids(fraction):
    chosen = np.random.default_rng(1).random(500) < fraction
    ids = np.flatnonzero(chosen)
    parts = [active_pixels.runs_of(chosen[start : start + 125], start) for start in range(0, 500, 125)]
    runs = active_pixels.join_runs(parts)
    assert runs.size == ids.size and runs.first.dtype == runs.before.dtype == np.int32
    np.testing.assert_array_equal(all_ids(runs), ids)
    got = jax.jit(lambda runs, positions: runs.ids(positions))(runs, np.arange(ids.size))
    np.testing.assert_array_equal(got, ids)
    bounds = np.arange(501)
    counts = jax.jit(lambda runs, bounds: runs.count_below(bounds))(runs, bounds)
    np.testing.assert_array_equal(counts, np.searchsorted(ids, bounds))


def test_empty_runs():
    runs = active_pixels.join_runs([active_pixels.runs_of(np.zeros(4, bool))])
    assert runs.size == 0 and all_ids(runs).size == 0
