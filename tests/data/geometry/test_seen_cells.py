"""What cameras and sparse points tell of the cells of a grid before training."""

import dataclasses

import jax
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from helpers import compiled
from jaxnerf.core.cameras import project
from jaxnerf.core.types import Camera, SparsePoints
from jaxnerf.core.views import Views
from jaxnerf.data.active_pixels import active_region
from jaxnerf.data.geometry import free_space
from jaxnerf.data.geometry.free_space import surface_range
from jaxnerf.data.geometry.seen_cells import _may_see, clear_radii, likely_empty_cells, seen_cells
from jaxnerf.models.grid_schedule import make_grid_schedule
from jaxnerf.runtime import cores

SIZE, FOCAL = 48, 48.0  # px: each view covers 53 degrees
WALL = -4.0  # z of a wall that faces the cameras


def a_schedule(**options):
    sizes = {"resolution": 32, "step_size": 0.1, "threshold": 0.01, "update_every": 16, "cells_per_update": 2**18}
    return make_grid_schedule((-4.0,) * 3, (4.0,) * 3, field=None, **{**sizes, **options})


def some_views(x=(-0.25, 0.25), **fields):
    """Cameras at (x, 0, 0), all looking along -z."""
    count = len(x)
    to_world = np.tile(np.float32(np.eye(3, 4)), (count, 1, 1))
    to_world[:, 0, 3] = x
    cameras = Camera(
        to_world=to_world,
        focal=np.full((count, 2), FOCAL, np.float32),
        center=np.full((count, 2), SIZE / 2, np.float32),
        height=SIZE,
        width=SIZE,
    )
    views = Views(
        pixels=np.zeros((count * SIZE**2, 3), np.uint8),
        offset=np.arange(count, dtype=np.int32) * SIZE**2,
        size=np.full((count, 2), SIZE, np.int32),
        cameras=cameras,
        near=np.full(count, 0.05, np.float32),
        far=np.full(count, 3.9, np.float32),
        names=tuple(map(str, range(count))),
    )
    return dataclasses.replace(views, **fields)


def with_wall(views, rows=7):
    """Adds the observations of a grid of points on the wall, and one of a wrong point close to the first camera."""
    x, y = np.meshgrid(np.linspace(-1.5, 1.5, rows), np.linspace(-1.5, 1.5, rows))
    points = np.stack([x.ravel(), y.ravel(), np.full(x.size, WALL)], axis=-1)
    points = np.vstack([points, [-0.25, 0.3, -0.6]])
    view, point, pixel = [], [], []
    for index, pose in enumerate(views.cameras.to_world):
        local = points - pose[:, 3]
        at = FOCAL * local[:, :2] / -local[:, 2:] * (1, -1) + SIZE / 2
        shown = np.arange(len(points) - (index > 0))
        view.append(np.full(shown.size, index)), point.append(shown), pixel.append(at[shown])
    sparse = SparsePoints(
        positions=np.float32(points),
        view=np.concatenate(view),
        point=np.concatenate(point),
        pixel=np.float32(np.concatenate(pixel)),
    )
    return dataclasses.replace(views, sparse=sparse)


def centers(schedule):
    """Returns the centers [X, Y, Z, 3] of the cells."""
    lower, upper = np.array(schedule.lower), np.array(schedule.upper)
    return lower + (np.stack(np.indices(schedule.shape), axis=-1) + 0.5) * (upper - lower) / schedule.shape


def in_view(x, eye, slack):
    """Returns whether points are inside the frustum of the camera at (eye, 0, 0), widened by a slack."""
    depth, half = -x[..., 2], SIZE / 2 / FOCAL
    across = np.maximum(np.abs(x[..., 0] - eye), np.abs(x[..., 1]))
    return (depth > 0.05 - slack) & (depth < 3.9 + slack) & (across < half * depth + slack)


@pytest.mark.parametrize("min_views", [1, 2])
def test_seen_cells_are_those_in_the_frusta(min_views):
    schedule, views = a_schedule(), some_views((-1.0, 1.0))
    (seen, _), x = seen_cells(views, schedule, min_views=min_views), centers(schedule)
    counts = [sum(in_view(x, eye, slack).astype(int) for eye in (-1.0, 1.0)) for slack in (-0.15, 0.3)]
    assert seen[counts[0] >= min_views].all()
    assert not seen[counts[1] < min_views].any()


@pytest.mark.parametrize("contracted", [False, True])
def test_cells_far_from_all_that_a_view_shows_are_skipped(monkeypatch, contracted):
    poses = some_views((-1.0, 1.0)).cameras.to_world.copy()
    poses[1, :, :3] = Rotation.from_euler("xyz", (0.4, 2.0, 0.3)).as_matrix()
    views = some_views((-1.0, 1.0), free_depth=np.float32([0.0, 1.0]))
    views = dataclasses.replace(views, cameras=dataclasses.replace(views.cameras, to_world=poses))
    schedule, looked_at = a_schedule(contracted=contracted), []
    found = seen_cells(views, schedule, min_views=1)

    def every(*arguments):
        looked_at.append(_may_see(*arguments))
        return np.ones_like(looked_at[-1])

    monkeypatch.setattr("jaxnerf.data.geometry.seen_cells._may_see", every)
    np.testing.assert_array_equal(found, seen_cells(views, schedule, min_views=1))
    assert 0 < np.mean(looked_at) < 0.9


def test_a_masked_pixel_sees_nothing():
    schedule, views = a_schedule(), some_views((0.0,))
    mask = np.zeros((SIZE, SIZE), bool)
    mask[:, : SIZE // 2] = True
    seen, _ = seen_cells(dataclasses.replace(views, mask=mask.reshape(-1)), schedule, min_views=1)
    x = centers(schedule)
    assert seen[in_view(x, 0.0, -0.15) & (x[..., 0] < -0.15)].all() and not seen[x[..., 0] > 0.3].any()


def test_cells_are_seen_through_the_lens():
    """A lens that bends rays inwards shows less of the world at the same size."""
    schedule, plain = a_schedule(), some_views((0.0,))
    barrel = dataclasses.replace(plain.cameras, distortion=np.float32([[0.8, 0, 0, 0]]), lens="opencv")
    seen, _ = seen_cells(plain, schedule, min_views=1)
    through, _ = seen_cells(dataclasses.replace(plain, cameras=barrel), schedule, min_views=1)
    assert through.any() and not (through & ~seen).any() and through.sum() < 0.8 * seen.sum()
    x = centers(schedule)
    pixels, depth = compiled(project)(jax.tree.map(lambda leaf: leaf[0], barrel), x)
    inside = (pixels > 3).all(axis=-1) & (pixels < SIZE - 3).all(axis=-1) & (depth > 0.3) & (depth < 3.8)
    assert through[inside].all()
    outside = (pixels < -12).any(axis=-1) | (pixels > SIZE + 12).any(axis=-1)
    assert outside.any() and not through[outside & (depth > 2)].any()


def test_a_lens_that_shows_nothing_is_an_error():
    views = some_views((0.0,))
    center = np.full((1, 2), 1e5, np.float32)  # px: so far out that this barrel distortion maps no ray there
    cameras = dataclasses.replace(
        views.cameras, center=center, distortion=np.float32([[-10.0, 0, 0, 0]]), lens="opencv"
    )
    with pytest.raises(ValueError, match="view 0: its lens shows no pixel"):
        seen_cells(dataclasses.replace(views, cameras=cameras), a_schedule(), min_views=1)


@pytest.mark.parametrize("contracted", [False, True])
def test_the_space_in_front_of_the_stated_depth_is_free(contracted):
    schedule = a_schedule(contracted=contracted)
    views = some_views((0.0, 0.0), free_depth=np.float32([1.9, 1.9]))
    _, free = seen_cells(views, schedule, min_views=1)
    depth = -centers(schedule)[..., 2]  # the same in the inner half of a contracted box
    inside = in_view(centers(schedule), 0.0, -0.15)
    assert free[inside & (depth > 0.3) & (depth < 1.6)].all() and not free[depth > 1.9].any()
    assert not seen_cells(some_views((0.0, 0.0)), schedule, min_views=1)[1].any()


def test_two_views_that_see_a_cell_must_agree_that_it_is_free():
    schedule = a_schedule()
    x, views = centers(schedule), some_views((0.0, 0.5), free_depth=np.float32([3.0, 0.0]))
    _, free = seen_cells(views, schedule, min_views=1)
    near = (np.linalg.norm(x, axis=-1) > 2.6) & (-x[..., 2] < 2.8)  # and not within 2.25 of the first camera
    both, alone = (in_view(x, 0.0, -0.15) & seen & near for seen in (in_view(x, 0.5, -0.15), ~in_view(x, 0.5, 0.3)))
    assert both.any() and not free[both].any()  # the other view may show something there
    assert alone.any() and free[alone].all()


@pytest.mark.parametrize("contracted", [False, True])
def test_the_space_around_a_camera_is_free(contracted):
    """Also beside it and behind it, where only other cameras see."""
    schedule = a_schedule(contracted=contracted)
    views = some_views((-0.5, 0.5), free_depth=np.float32([0.8, 1.6]))
    _, free = seen_cells(views, schedule, min_views=1)
    x = centers(schedule)
    distance = np.stack([np.linalg.norm(x - [eye, 0, 0], axis=-1) for eye in (-0.5, 0.5)])
    radius = np.reshape([0.6, 1.2], (2, 1, 1, 1))
    behind = x[..., 2] > 0.2
    assert free[(distance < radius).any(axis=0)].all()
    assert not free[behind & (distance > radius + 0.25).all(axis=0)].any()  # 0.25: more than half a cell's diagonal


def test_the_nearest_points_bound_the_space_around_a_camera():
    """Points that a camera does not see count, too, unless there are so few that they may be wrong."""
    views = with_wall(some_views(free_depth=np.float32([1.0, 8.0])))
    to_wall = np.sort(np.linalg.norm(views.sparse.positions - views.cameras.to_world[1, :, 3], axis=-1))[15]
    np.testing.assert_allclose(clear_radii(views), 0.75 * np.array([1.0, to_wall]), rtol=1e-6)
    behind = np.float32([0.25, 0, 0.5]) + 1e-3 * np.arange(16, dtype=np.float32)[:, None]
    for count, nearest in ((14, to_wall), (16, np.linalg.norm(behind[15] - views.cameras.to_world[1, :, 3]))):
        positions = np.concatenate([views.sparse.positions, behind[:count]])
        more = dataclasses.replace(views, sparse=dataclasses.replace(views.sparse, positions=positions))
        assert clear_radii(more)[1] == pytest.approx(0.75 * nearest, rel=0.05)
    few = dataclasses.replace(views.sparse, positions=views.sparse.positions[:15])
    np.testing.assert_allclose(clear_radii(dataclasses.replace(views, sparse=few)), [0.75, 6.0])
    unknown = some_views(free_depth=np.float32([0.0, 0.0]))
    alone = clear_radii(dataclasses.replace(views, free_depth=unknown.free_depth))
    np.testing.assert_allclose(alone[1], 0.75 * to_wall, rtol=1e-6)
    for nothing in (unknown, dataclasses.replace(views, free_depth=None)):
        np.testing.assert_array_equal(clear_radii(nothing), [0, 0])


def test_surface_range_holds_the_wall_and_ignores_a_wrong_point():
    views = with_wall(some_views(free_depth=np.float32([0.3, 0.4])))
    pixels = np.float32([[24, 24], [24, 12], [14, 30], [0.5, 0.5]])
    for view in (0, 1):
        near, far = surface_range(views, view, pixels)
        np.testing.assert_allclose(near[:3], -0.85 * WALL, rtol=1e-5)
        np.testing.assert_allclose(far[:3], -1.15 * WALL, rtol=1e-5)
        assert near[3] == np.float32([0.3, 0.4])[view] and np.isinf(far[3])  # outside all triangles


def test_without_enough_points_nothing_is_known_of_surfaces():
    pixels = np.float32([[24, 24]])
    for views in (some_views(), with_wall(some_views(), rows=3)):
        near, far = surface_range(views, 0, pixels)
        assert near[0] == 0 and np.isinf(far[0])


def test_cells_between_cameras_and_surfaces_are_likely_to_be_empty():
    views, schedule = with_wall(some_views(far=np.full(2, 9.0, np.float32))), a_schedule()
    empty = likely_empty_cells(views, schedule)
    x = centers(schedule)
    between = (np.abs(x[..., :2]) < 0.2).all(axis=-1) & (x[..., 2] < -0.8) & (x[..., 2] > 0.75 * WALL)
    at_wall = (np.abs(x[..., :2]) < 0.8).all(axis=-1) & (np.abs(x[..., 2] - WALL) < 0.4)
    assert between.any() and empty[between].all() and at_wall.any() and not empty[at_wall].any()


def test_training_starts_from_what_is_known():
    views, schedule = with_wall(some_views(free_depth=np.float32([1.0, 1.0]))), a_schedule()
    cells, _, indices = active_region(views, schedule, use_alpha=False, min_views=1)
    grid = schedule.create(*cells)
    assert cells.empty.any() and not (cells.empty & ~cells.valid).any()
    np.testing.assert_array_equal(grid.occupied, cells.valid & ~cells.empty)
    assert 0 < np.asarray(grid.occupied).mean() < 0.9 * cells.valid.mean()
    np.testing.assert_array_equal(indices, np.flatnonzero(cells.valid))
    unknown, _, _ = active_region(dataclasses.replace(views, sparse=None), schedule, use_alpha=False, min_views=1)
    assert unknown.empty is None and (unknown.valid == cells.valid).all()


def test_any_number_of_cores_finds_the_same_cells(monkeypatch):
    x = np.linspace(-0.5, 0.5, 6)
    views, schedule = with_wall(some_views(x, far=np.full(6, 9.0, np.float32))), a_schedule()
    found = []
    for count in (1, 2, 3):
        monkeypatch.setattr(cores, "usable", lambda count=count: count)
        depths = free_space.interpolated_depths(views)
        cells = *seen_cells(views, schedule, min_views=2), likely_empty_cells(views, schedule)
        assert all(each.any() and not each.all() for each in cells[::2])
        found.append((*cells, depths, active_region(views, schedule, use_alpha=False, min_views=2)[2]))
    for other in found[1:]:
        jax.tree.map(np.testing.assert_array_equal, found[0], other)
