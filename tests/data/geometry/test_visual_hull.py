"""The visual hull contains all matter; the projection that it uses is the inverse of the rays."""

import dataclasses
import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import captures
from helpers import all_finite, assert_batch_is_vmap_is_jit, compiled
from jaxnerf import Camera, Views, look_at, pixel_grid, rays_from_pixels
from jaxnerf.core.cameras import project
from jaxnerf.data.geometry.visual_hull import hull_bounds, visual_hull
from jaxnerf.data.ray_batches import view_rays

LENSES = [
    ("pinhole", None),
    ("opencv", [-0.25, 0.06, 0.002, 0.001, 0.01]),
    ("fisheye", [-0.04, 0.01, -0.003, 0.0005]),
]
SHAPE = (65, 65)  # of the rays of an image of up to 64 x 64; the hull projects as many corners
BOX = [-1.3] * 3, [1.3] * 3
SIDES = [[4.0, 0, 0], [0, 4, 0], [0, 0, 4], [-4, 0, 0], [0, -4, 0], [0, 0, -4]]
fast_project, fast_rays = compiled(project), compiled(rays_from_pixels)
fast_look_at, fast_view_rays = compiled(look_at), compiled(view_rays)


def a_camera(lens="pinhole", distortion=None, eye=(1.0, -2.0, 1.5), size=60, focal=50.0):
    return Camera(
        to_world=fast_look_at(np.float32(eye), np.zeros(3), np.float32([0, 0, 1])),
        focal=np.float32([focal, 1.1 * focal]),
        center=np.float32([size / 2 + 1, size / 2 - 1]),
        distortion=None if distortion is None else np.float32(distortion),
        lens=lens,
    )


def views_of_balls(cameras, sizes, balls):
    """Returns Views of opaque balls (center [3], radius), with one ray through the center of each pixel."""
    pixels = []
    for camera, size in zip(cameras, sizes, strict=True):
        # A single compiled shape: the remainder repeats the first pixels.
        rays = fast_rays(camera, np.resize(pixel_grid(size, size), (*SHAPE, 2)), near=0.0, far=9.0)
        hit = np.zeros(SHAPE, bool)
        for center, radius in balls:
            offset = np.float32(center)[None, None] - rays.origins
            along = (offset * rays.viewdirs).sum(-1)
            hit |= (offset**2).sum(-1) - along**2 < radius**2
        hit = (hit & (rays.far > rays.near)).reshape(-1)[: size * size]
        pixels.append(np.stack([0 * hit, 0 * hit, 0 * hit, 255 * hit], -1).astype(np.uint8))
    count = len(cameras)
    return Views(
        pixels=np.concatenate(pixels),
        offset=np.cumsum([0] + [size * size for size in sizes[:-1]]).astype(np.int32),
        size=np.int32([[size, size] for size in sizes]),
        cameras=jax.tree.map(lambda *leaves: np.stack(leaves), *cameras),
        near=np.zeros(count, np.float32),
        far=np.full(count, 9, np.float32),
    )


def around(count):
    """Returns eyes [count, 3] at distance 4 on a golden spiral."""
    steps = np.arange(count)
    height, turn = -0.9 + 1.8 * (steps + 0.5) / count, 2.4 * steps
    ring = np.sqrt(1 - height**2)
    return 4 * np.stack([ring * np.cos(turn), ring * np.sin(turn), height], -1)


def cells_with_matter(balls, resolution):
    """Returns [R, R, R] bool, the cells of BOX that intersect a ball."""
    edges = np.linspace(-1.3, 1.3, resolution + 1)
    met = np.zeros((resolution,) * 3, bool)
    for center, radius in balls:
        # Squared distances to the nearest point of a cell, along each axis.
        gaps = [np.maximum(0, np.maximum(edges[:-1] - c, c - edges[1:])) ** 2 for c in center]
        met |= gaps[0][:, None, None] + gaps[1][None, :, None] + gaps[2][None, None] < radius**2
    return met


@pytest.mark.parametrize("lens, k", LENSES, ids=str)
def test_project_is_the_inverse_of_rays_from_pixels(lens, k):
    camera = a_camera(lens, k)
    pixels = np.random.default_rng(0).uniform(0, 60, (*SHAPE, 2)).astype(np.float32)
    depth = np.linspace(0.5, 9, 65 * 65, dtype=np.float32).reshape(SHAPE)
    rays = fast_rays(camera, pixels, near=0.0, far=9.0)
    seen, along = fast_project(camera, rays.origins + depth[..., None] * rays.directions)
    assert seen.shape == (*SHAPE, 2) and along.shape == SHAPE
    np.testing.assert_allclose(seen, pixels, atol=1e-3)
    np.testing.assert_allclose(along, depth, atol=1e-5)


def test_points_that_no_pixel_sees_are_projected_to_infinity():
    camera = a_camera()
    eye, back = camera.to_world[:, 3], camera.to_world[:, 2]
    pixels, depth = fast_project(camera, np.stack([eye + 2 * back, eye, eye - 2 * back]))
    np.testing.assert_allclose(depth, [-2, 0, 2], atol=1e-6)
    np.testing.assert_array_equal(np.isinf(pixels).all(-1), [True, True, False])
    np.testing.assert_allclose(pixels[2], camera.center, atol=1e-4)
    # r (1 - r^2 / 2) has its maximum at r = 0.816 and is 0 again at 1.414.
    bent = dataclasses.replace(a_camera("opencv", [-0.5, 0, 0, 0]), to_world=np.eye(3, 4, dtype=np.float32))
    pixels, depth = fast_project(bent, np.float32([[0.8, 0, -1], [0.83, 0, -1], [1.41, 0, -1]]))
    np.testing.assert_array_equal(np.isinf(pixels).all(-1), [False, True, True])
    assert (depth == 1).all()


def test_gradients_of_project_are_finite():
    x = np.float32([[0.1, 0.2, -1], [0, 0, -1], [0, 0, 0], [1e3, 0, -1e-3], [0, 0, 1], [3, 0, -1]])
    camera = dataclasses.replace(a_camera(*LENSES[2]), to_world=np.eye(3, 4, dtype=np.float32))

    def total(x):
        pixels, depth = project(camera, x)
        return jnp.where(jnp.isfinite(pixels), pixels, 0).sum() + depth.sum()

    assert all_finite(jax.jit(jax.grad(total))(x))


def test_project_batch_equals_vmap_equals_jit_and_wrong_arguments_are_errors():
    camera = a_camera()
    assert_batch_is_vmap_is_jit(lambda x: project(camera, x), jnp.linspace(0, 1, 24).reshape(2, 4, 3))
    with pytest.raises(ValueError, match="project: x has shape"):
        project(camera, jnp.ones((4, 2)))
    with pytest.raises(ValueError, match="project: lens 'mirror'"):
        project(a_camera("mirror", [0.0] * 4), jnp.ones(3))


def test_a_ball_from_six_sides():
    """The hull of six views of a ball of radius 0.6 is larger than the ball and smaller than a cube."""
    balls = [((0.0, 0.0, 0.0), 0.6)]
    views = views_of_balls([a_camera(eye=eye, size=64, focal=60.0) for eye in SIDES], [64] * 6, balls)
    valid = visual_hull(views, *BOX, resolution=64)
    assert valid.shape == (64,) * 3 and valid.dtype == bool
    assert valid[cells_with_matter(balls, 64)].all()
    assert not valid[~cells_with_matter([((0.0, 0.0, 0.0), 0.8 * np.sqrt(3))], 64)].any()
    assert 0.6**3 * np.pi * 4 / 3 < valid.mean() * 2.6**3 < 1.3**3
    lower, upper = hull_bounds(views, *BOX)
    assert (lower < -0.6).all() and (lower > -0.85).all() and (upper > 0.6).all() and (upper < 0.85).all()


@pytest.mark.parametrize("lens, k, resolution", [(*LENSES[0], 30), (*LENSES[0], 64), (*LENSES[2], 64)], ids=str)
def test_no_matter_is_lost(lens, k, resolution):
    """Balls of different sizes, in images of different sizes, some of which show only a part of the box."""
    balls = [((0.5, -0.2, 0.3), 0.5), ((-0.9, 0.8, -0.7), 0.06), ((-0.2, -0.4, -1.0), 0.1)]
    sizes = [64] * 24 if k else [64, 50, 33, 47] * 6  # a lens is compiled for each size
    wide = (0.8, 1.2, 2.5, 1.4)  # focal / size; the third shows only the center
    cameras = [
        a_camera(lens, k, eye=eye, size=size, focal=wide[i % 4] * size)
        for i, (eye, size) in enumerate(zip(around(24), sizes, strict=True))
    ]
    views = views_of_balls(cameras, sizes, balls)
    valid = visual_hull(views, *BOX, resolution=resolution)
    assert valid[cells_with_matter(balls, resolution)].all()
    assert valid.mean() < 3 * cells_with_matter(balls, resolution).mean()


def test_cells_that_no_view_sees_completely_stay_valid():
    views = views_of_balls([a_camera(eye=(4.0, 0, 0), size=64, focal=110.0)], [64], [])
    valid = visual_hull(views, *BOX, resolution=32)
    assert not valid[:, 14:18, 14:18].any()  # along the camera's axis
    assert valid[20:, 0].all() and valid[20:, -1].all()  # beside its image
    behind = visual_hull(views, [3.9, -0.1, -0.1], [5.0, 0.1, 0.1], resolution=8)
    assert behind.all()  # around and behind the camera


def test_pixels_outside_the_mask_are_ignored():
    views = views_of_balls([a_camera(eye=(4.0, 0, 0), size=64, focal=40.0)], [64], [])
    assert not visual_hull(views, *BOX, resolution=16).any()
    masked = dataclasses.replace(views, mask=np.arange(4096) % 64 < 32)  # only the left half is used
    valid = visual_hull(masked, *BOX, resolution=16)
    assert not valid[:, :4].any() and valid[:, 10:].all()


def test_wrong_arguments_are_errors():
    views = views_of_balls([a_camera(eye=eye, size=64, focal=40.0) for eye in SIDES], [64] * 6, [])
    with pytest.raises(ValueError, match=r"6 views show all of 8\^3 cells from \[-1.3"):
        hull_bounds(views, *BOX, resolution=8)
    opaque = dataclasses.replace(views, pixels=views.pixels[:, :3])
    for function in (visual_hull, hull_bounds):
        with pytest.raises(ValueError, match=r"pixels have shape \(24576, 3\)"):
            function(opaque, *BOX, resolution=8)
    for lower, upper, resolution in ((BOX[1], BOX[0], 8), ([0.0], [1.0], 8), (*BOX, 0)):
        with pytest.raises(ValueError, match="the box is"):
            visual_hull(views, lower, upper, resolution=resolution)


@pytest.mark.scenes("lego")
def test_rays_of_lego_test_pixels_with_alpha_hit_the_hull_of_the_training_views(scenes_dir, tmp_path):
    content = json.loads((scenes_dir / "lego" / "transforms_train.json").read_text())
    content["frames"] = content["frames"][::3]  # reading the images takes most of the time
    (tmp_path / "transforms_train.json").write_text(json.dumps(content))
    (tmp_path / "train").symlink_to(scenes_dir / "lego" / "train")
    train = captures.load_blender(tmp_path, split="train")
    valid = visual_hull(train, *BOX, resolution=128)
    assert 0.03 < valid.mean() < 0.2
    test = captures.load_blender(scenes_dir / "lego", split="test")
    pixels = np.asarray(pixel_grid(800, 800)[::16, ::16]).reshape(-1, 2)
    t = np.linspace(2, 6, 400, dtype=np.float32)[None]  # half a cell apart
    for index in range(0, len(test.offset), 9):
        rays = fast_view_rays(test, index, pixels)
        shown = test.pixels[test.offset[index] :, 3][:640000].reshape(800, 800)[::16, ::16].reshape(-1) > 0
        x = (rays.origins[:, None] + t[..., None] * rays.directions[:, None])[shown]
        cells = np.floor((x + 1.3) / 2.6 * 128).astype(int)
        inside = ((cells >= 0) & (cells < 128)).all(-1)
        met = inside & valid[tuple(np.clip(cells, 0, 127).transpose(2, 0, 1))]
        assert met.any(-1).all()
