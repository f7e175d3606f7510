"""Drawn rays have the colours of their pixels, uniformly over pixels, and do not depend on how a batch is split."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from helpers import assert_same
from jaxnerf import Camera, SparsePoints, Views
from jaxnerf.core.cameras import project
from jaxnerf.core.types import Batch
from jaxnerf.data import ray_batches
from jaxnerf.data.active_pixels import unmasked_pixels

pytest_plugins = ["run_fixtures"]
pytestmark = pytest.mark.usefixtures("unoptimized")
SIZES = np.int32([[3, 4], [5, 2], [4, 4]])  # height, width
OFFSET = np.int32([0, 12, 22])
FOCAL = 10.0
WHITE = (1.0, 0.5, 0.25)


def views(channels=4, mask=None, background=WHITE):
    """Returns three views of random pixels from three positions, all looking along -z."""
    rng = np.random.default_rng(0)
    pose = np.tile(np.eye(3, 4, dtype=np.float32), (3, 1, 1))
    pose[:, 0, 3] = [0, 1, 2]
    return Views(
        pixels=rng.integers(0, 256, (38, channels), np.uint8),
        offset=OFFSET,
        size=SIZES,
        cameras=Camera(to_world=pose, focal=np.full((3, 2), FOCAL, np.float32), center=np.float32(SIZES[:, ::-1] / 2)),
        near=np.float32([1, 2, 3]),
        far=np.float32([4, 5, 6]),
        mask=mask,
        names=("a", "b", "c"),
        background=background,
    )


@functools.partial(jax.jit, static_argnames=("batching", "pixel_offset"))
def draw(step, positions, views, active=None, *, batching="all_images", pixel_offset=0.5):
    return ray_batches.draw_batch(7, step, positions, views, active, batching=batching, pixel_offset=pixel_offset)


def pixel_ids(rays, pixel_offset=0.5):
    """Returns the view and the pixel's place in Views of each ray, found from its geometry alone."""
    view = np.rint(rays.origins[:, 0]).astype(int)
    height, width = SIZES[view].T
    x = np.asarray(rays.directions[:, 0]) * FOCAL + width / 2 - pixel_offset
    y = -np.asarray(rays.directions[:, 1]) * FOCAL + height / 2 - pixel_offset
    column, row = np.rint(x).astype(int), np.rint(y).astype(int)
    np.testing.assert_allclose([x, y], [column, row], atol=1e-4)
    assert (0 <= column).all() and (column < width).all() and (0 <= row).all() and (row < height).all()
    return view, OFFSET[view] + row * width + column


@pytest.mark.slow
@pytest.mark.parametrize("batching", ray_batches.BATCHINGS)
@pytest.mark.parametrize("pixel_offset", [0.0, 0.5])
def test_colors_are_those_of_the_rays_pixels(batching, pixel_offset):
    scene = views()
    _, batch = draw(3, jnp.arange(64), scene, batching=batching, pixel_offset=pixel_offset)
    view, index = pixel_ids(batch.rays, pixel_offset)
    rgb, alpha = scene.pixels[index, :3] / 255, scene.pixels[index, 3:] / 255
    np.testing.assert_allclose(batch.rgb, rgb * alpha + np.array(WHITE) * (1 - alpha), atol=1e-6)
    np.testing.assert_array_equal(batch.rays.near, scene.near[view])
    np.testing.assert_array_equal(batch.rays.far, scene.far[view])


@pytest.mark.parametrize("batching", ray_batches.BATCHINGS)
def test_a_batch_does_not_depend_on_how_it_is_split(batching):
    scene, positions = views(), np.arange(32)
    data = jax.jit(jax.random.key_data)
    keys, batch = draw(5, positions, scene, batching=batching)
    for part in (positions[:16], positions[:15:-1]):
        part_keys, part_batch = draw(5, part, scene, batching=batching)
        np.testing.assert_array_equal(data(part_keys), np.asarray(data(keys))[part])
        assert_same(part_batch, jax.tree.map(lambda leaf, part=part: leaf[part], batch))


def test_keys_and_rays_differ_between_rays_and_steps():
    scene = views()
    (keys, first), (later, second) = draw(0, jnp.arange(50), scene), draw(1, jnp.arange(50), scene)
    data = np.concatenate([jax.random.key_data(keys), jax.random.key_data(later)])
    assert len(np.unique(data, axis=0)) == 100
    assert (np.asarray(first.rgb) != np.asarray(second.rgb)).any(axis=-1).mean() > 0.8


def test_every_pixel_is_drawn_equally_often():
    _, batch = draw(0, jnp.arange(19_000), views())
    counts = np.bincount(pixel_ids(batch.rays)[1], minlength=38)
    assert ((counts - 500) ** 2 / 500).sum() < 80  # chi squared of 37 degrees: 1 in 20,000 exceeds it


def test_single_image_batches_draw_from_one_random_view_per_step():
    seen = []
    for step in range(60):
        view, _ = pixel_ids(draw(step, jnp.arange(8), views(), batching="single_image")[1].rays)
        assert (view == view[0]).all()
        seen.append(view[0])
    assert (np.bincount(seen, minlength=3) > 8).all()
    _, batch = draw(0, jnp.arange(8000), views(), batching="single_image")
    view, index = pixel_ids(batch.rays)
    counts = np.bincount(index)[OFFSET[view[0]] :]
    assert len(counts) == SIZES[view[0]].prod()
    np.testing.assert_allclose(counts / counts.mean(), 1, atol=0.2)


@pytest.mark.parametrize("batching", ray_batches.BATCHINGS)
def test_exactly_the_unmasked_pixels_are_drawn(batching):
    mask = np.arange(38) % 3 != 0
    scene = views(mask=mask)
    active = unmasked_pixels(scene)
    active_ids = np.asarray(active.ids(np.arange(active.size)))
    np.testing.assert_array_equal(active_ids, np.flatnonzero(mask))
    drawn = [pixel_ids(draw(step, jnp.arange(500), scene, active, batching=batching)[1].rays)[1] for step in range(12)]
    assert set(np.concatenate(drawn)) == set(active_ids)


def test_a_view_without_an_unmasked_pixel_is_an_error():
    assert unmasked_pixels(views()) is None
    mask = np.arange(38) < 22
    with pytest.raises(ValueError, match="view c: its mask excludes all pixels"):
        unmasked_pixels(views(mask=mask))


def test_an_unknown_batching_is_an_error():
    with pytest.raises(ValueError, match="batching is 'all', expected one of"):
        ray_batches.draw_batch(0, 0, jnp.arange(2), views(), batching="all")


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_alpha_is_composited_over_the_background(dtype):
    top = np.iinfo(dtype).max
    pixels = np.array([[top, 0, 0, top], [top, 0, 0, 0], [0, top, 0, top // 5]], dtype)
    alpha = (top // 5) / top
    over = np.array([[1, 0, 0], WHITE, alpha * np.array([0, 1, 0]) + (1 - alpha) * np.array(WHITE)])
    np.testing.assert_allclose(ray_batches.pixel_colors(pixels, WHITE), over, atol=1e-6)
    np.testing.assert_allclose(ray_batches.pixel_colors(pixels, None), [[1, 0, 0], [0, 0, 0], [0, alpha, 0]], atol=1e-6)
    np.testing.assert_allclose(ray_batches.pixel_colors(pixels[:, :3], WHITE), pixels[:, :3] / top, atol=1e-6)


@pytest.mark.parametrize("ndc", [False, True])
def test_world_depth_is_the_distance_in_the_files_units(ndc):
    scene, pixels = views(), np.float32([[0.5, 1.5], [3.5, 3.5]])
    axis = np.float32([2.0, 8.0])  # along the camera's axis
    t = 1 - 1 / axis if ndc else axis  # Eq. 25 for a camera at the origin looking along -z
    place = np.stack([(pixels[:, 0] - 2) / FOCAL, (2 - pixels[:, 1]) / FOCAL, [-1, -1]], axis=-1)
    expected = np.linalg.norm(place * axis[:, None], axis=-1)
    # NDC need the cameras' height and width, which views of one size have.
    alike = Views(**{**vars(scene), "cameras": Camera(**{**vars(scene.cameras), "height": 4, "width": 4})})
    np.testing.assert_allclose(ray_batches.world_depth(alike, 2, pixels, t, ndc=ndc), expected, rtol=1e-5)
    turn = np.array([[0, 0, 1], [1, 0, 0], [0, 1, 0]])
    file = np.block([[0.01 * turn, np.full((3, 1), 7.0)], [np.zeros((1, 3)), 1.0]])
    scaled = Views(**{**vars(alike), "to_file": file})
    np.testing.assert_allclose(ray_batches.world_depth(scaled, 2, pixels, t, ndc=ndc), 0.01 * expected, rtol=1e-5)


DEPTH, POSITIONS = ("depth", "depth_weight", "image_index", "pixel"), np.arange(2560)


def views_with_points(per_view=(5, 0, 7)):
    """Returns views of one size and their sparse points: random positions between near and far of one view each."""
    rng, scene = np.random.default_rng(1), views()
    view = np.repeat(np.arange(3), per_view).astype(np.int32)
    pixel = np.float32(rng.uniform(0, 1, (view.size, 2)) * SIZES[view, ::-1])
    depth = rng.uniform(scene.near[view], scene.far[view]).astype(np.float32)
    local = (pixel - SIZES[view, ::-1] / 2) / FOCAL * [1, -1] * depth[:, None]
    positions = np.float32(np.column_stack([local, -depth]) + scene.cameras.to_world[view, :, 3])
    order = rng.permutation(view.size)
    points = np.empty_like(positions)
    points[order] = positions
    confidence = np.linspace(0.5, 1, view.size, dtype=np.float32)
    sparse = SparsePoints(positions=points, view=view, point=order.astype(np.int32), pixel=pixel, confidence=confidence)
    return dataclasses.replace(scene, sparse=sparse), depth


@functools.partial(jax.jit, static_argnames=("batching", "extras", "pixel_offset", "ndc"))
def draw_with(step, positions, views, *, extras=DEPTH, **options):
    return ray_batches.draw_batch(7, step, positions, views, None, extras=extras, **options)[1]


@pytest.mark.parametrize("pixel_offset", [0.5, pytest.param(0.0, marks=pytest.mark.slow)])
def test_one_ray_in_16_goes_through_an_observation_of_a_sparse_point(pixel_offset):
    scene, depths = views_with_points()
    batch = draw_with(3, POSITIONS, scene, pixel_offset=pixel_offset)
    observed = POSITIONS % 16 == 0
    assert not batch.depth[~observed].any() and not batch.depth_weight[~observed].any()
    chosen = np.argmin(np.abs(np.asarray(batch.depth)[observed, None] - depths), axis=1)
    assert set(chosen) == set(range(12))  # each is drawn
    np.testing.assert_allclose(np.asarray(batch.depth)[observed], depths[chosen], rtol=1e-6)
    np.testing.assert_array_equal(np.asarray(batch.depth_weight)[observed], scene.sparse.confidence[chosen])
    rays = jax.tree.map(lambda leaf: np.asarray(leaf)[observed], batch.rays)
    if pixel_offset == 0.5:  # otherwise rays are half a pixel off, as all others
        hit = rays.origins + depths[chosen, None] * rays.directions
        np.testing.assert_allclose(hit, scene.sparse.positions[scene.sparse.point[chosen]], atol=1e-5)
        for index, (view, x) in enumerate(zip(scene.sparse.view[chosen], hit, strict=True)):
            camera = jax.tree.map(lambda leaf, view=view: leaf[view], scene.cameras)
            np.testing.assert_allclose(project(camera, x)[0], scene.sparse.pixel[chosen[index]], atol=1e-4)
    column, row = np.floor(np.asarray(batch.pixel)[observed] + 0.5 - pixel_offset).astype(int).T
    view = np.asarray(batch.image_index)[observed]
    np.testing.assert_array_equal(view, scene.sparse.view[chosen])
    pixels = scene.pixels[OFFSET[view] + row * SIZES[view, 1] + column]
    np.testing.assert_allclose(np.asarray(batch.rgb)[observed], ray_batches.pixel_colors(pixels, WHITE), atol=1e-6)


def test_other_rays_are_those_of_a_run_without_depth():
    scene, _ = views_with_points()
    positions = np.arange(64)
    with_depth, without = (
        draw_with(3, positions, scene, extras=extras) for extras in (DEPTH, ("image_index", "pixel"))
    )
    others = positions % 16 != 0
    plain = jax.tree.map(lambda leaf: leaf[others], dataclasses.replace(with_depth, depth=None, depth_weight=None))
    assert_same(plain, jax.tree.map(lambda leaf: leaf[others], without), rtol=0, atol=0)


@pytest.mark.parametrize("batching", ray_batches.BATCHINGS)
def test_batches_with_depth_do_not_depend_on_how_they_are_split(batching):
    scene, _ = views_with_points()
    whole = draw_with(5, POSITIONS, scene, batching=batching)
    backwards = draw_with(5, POSITIONS[::-1], scene, batching=batching)
    assert_same(backwards, jax.tree.map(lambda leaf: leaf[::-1], whole), rtol=0, atol=0)


def test_the_ids_of_drawn_pixels_are_those_of_observations_too():
    """Pixels that are gathered by these ids give the same batch."""
    scene, _ = views_with_points()
    options = {"batching": "single_image", "extras": DEPTH}
    ids = jax.jit(lambda scene: ray_batches.draw_pixels(7, 5, POSITIONS, scene, **options)[1])(scene)
    rows = ray_batches.BatchPixels(rows=scene.pixels[np.asarray(ids)], shape=scene.pixels.shape)
    found = draw_with(5, POSITIONS, dataclasses.replace(scene, pixels=rows), batching="single_image")
    assert_same(found, draw_with(5, POSITIONS, scene, batching="single_image"), rtol=0, atol=0)


def test_single_image_batches_take_the_observations_of_that_image():
    scene, _ = views_with_points()
    found = {}
    for step in range(12):
        batch = draw_with(step, POSITIONS, scene, batching="single_image")
        assert len(set(batch.image_index.tolist())) == 1
        found.setdefault(int(batch.image_index[0]), []).append(int((batch.depth_weight > 0).sum()))
    assert set(found[0] + found[2]) == {len(POSITIONS) // 16} and set(found[1]) == {
        0
    }  # the second view has no observation


def test_the_depth_of_ndc_rays_is_theirs():
    scene, depths = views_with_points()
    cameras = dataclasses.replace(scene.cameras, height=4, width=4)
    scene = dataclasses.replace(scene, cameras=cameras, near=scene.near * 0)
    batch = draw_with(3, POSITIONS, scene, ndc=True)
    seen = np.asarray(batch.depth_weight) > 0
    assert seen.sum() == len(POSITIONS) // 16
    hit = (batch.rays.origins + batch.depth[:, None] * batch.rays.directions)[seen]  # z = 1 + 2 / world z
    np.testing.assert_allclose(hit[:, 2], 2 * np.asarray(batch.depth)[seen] - 1, atol=1e-5)
    world = 1 / (1 - np.asarray(batch.depth)[seen])
    assert np.abs(world[:, None] - depths).min(axis=1).max() < 1e-4


def test_depths_outside_near_and_far_have_no_weight():
    scene, depths = views_with_points()
    scene = dataclasses.replace(scene, far=scene.near + 0.5 * (scene.far - scene.near))
    batch = draw_with(3, POSITIONS, scene)
    inside = (depths < scene.far[scene.sparse.view]).mean()
    assert 0 < (batch.depth_weight > 0).sum() < len(POSITIONS) // 16 and 0 < inside < 1
    assert (batch.depth < batch.rays.far).all()


def test_a_depth_without_observations_is_an_error():
    for sparse in (None, views_with_points((0, 0, 0))[0].sparse):
        scene = dataclasses.replace(views(), sparse=sparse)
        with pytest.raises(ValueError, match="the views have no observations of sparse points"):
            draw_with(0, np.arange(2), scene)
    assert draw_with(0, np.arange(2), views(), extras=()).depth is None
    assert set(ray_batches.DEPTH_FIELDS) < {field.name for field in dataclasses.fields(Batch)}


def test_rays_have_the_fields_that_are_needed():
    scene = dataclasses.replace(views(), time=np.float32([0.1, 0.2, 0.3]))
    pixels = np.float32([[0.5, 0.5], [2.5, 1.5]])
    bare = ray_batches.view_rays(scene, 1, pixels)
    assert (bare.radius, bare.time, bare.image_index) == (None, None, None)
    rays = ray_batches.view_rays(scene, 1, pixels, needs=("radius", "time", "image_index", "length", "progress"))
    np.testing.assert_allclose(rays.radius, 2 / np.sqrt(12) / FOCAL, rtol=1e-6)
    np.testing.assert_array_equal(rays.time, np.float32([0.2, 0.2]))
    np.testing.assert_array_equal(rays.image_index, np.int32([1, 1]))
    np.testing.assert_array_equal(rays.directions, bare.directions)
    still = ray_batches.view_rays(views(), 1, pixels, needs=("time",))
    assert still.time is None and still.radius is None
    held_out = dataclasses.replace(scene, image_index=np.zeros(3, np.int32))
    assert not ray_batches.view_rays(held_out, 2, pixels, needs=("image_index",)).image_index.any()


def test_each_drawn_ray_has_the_time_and_the_index_of_its_view():
    scene = dataclasses.replace(views(), time=np.float32([0.1, 0.2, 0.3]))
    needs = ("time", "image_index", "radius")
    _, batch = jax.jit(functools.partial(ray_batches.draw_batch, 7, 0, needs=needs))(jnp.arange(64), scene)
    view, _ = pixel_ids(batch.rays)
    np.testing.assert_array_equal(batch.rays.image_index, view)
    np.testing.assert_array_equal(batch.rays.time, scene.time[view])
    _, same = draw(0, jnp.arange(64), scene)
    np.testing.assert_allclose(batch.rgb, same.rgb, rtol=1e-6)
    assert same.rays.time is None
    rays = ray_batches.random_rays(scene, 9, functools.partial(ray_batches.view_rays, needs=("time",)))
    np.testing.assert_array_equal(rays.time, np.float32([0.1, 0.2, 0.3]).repeat(3))
