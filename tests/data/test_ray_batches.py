"""Drawn rays have the colours of their pixels, uniformly over pixels, and do not depend on how a batch is split."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from helpers import assert_same
from jaxnerf import Camera, Views
from jaxnerf.data import ray_batches
from jaxnerf.data.active_pixels import unmasked_pixels

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
def test_colours_are_those_of_the_rays_pixels(batching, pixel_offset):
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
    active_ids = active.all_ids()
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
