"""Frames of a free camera: the program compiled once, equal to what jaxnerf-render writes, and its pictures."""

import json
import types

import imageio.v3 as iio
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import ball_runs
from jaxnerf.data.synthetic import load_synthetic
from jaxnerf.evaluation.restore import restore_with_grid
from jaxnerf.tools.viewer.frame_renderer import MAX_SIDE, FrameCamera, FrameRenderer, frame_image
from jaxnerf.tools.viewer.page import Page
from runs import render_path

pytest_plugins = ["run_fixtures"]
pytestmark = pytest.mark.usefixtures("unoptimized")


class Viewed:
    """A run, its renderer and the state of its checkpoint."""

    def __init__(self, folder, kind):
        self.folder = ball_runs.make_run(folder / kind, kind)
        self.run = restore_with_grid(self.folder)
        self.views = self.run.experiment.load_split("train")
        self.renderer = FrameRenderer(self.run, self.views, chunk=256)
        self.state = self.renderer.scene_state(20, self.run.variables(20))
        height, focal = float(self.views.size[0, 0]), float(self.views.cameras.focal[0, 1])
        self.fov = 2 * np.arctan(0.5 * height / focal)

    def camera(self, width=30, height=20, view=1):
        return FrameCamera(np.asarray(self.views.cameras.to_world)[view], self.fov, width, height)


class Solid:
    """The ball that compiles at once; its grid is None."""

    def __init__(self):
        self.run, self.views = ball_runs.solid_run()
        self.renderer = FrameRenderer(self.run, self.views, chunk=256)
        self.state = self.renderer.scene_state(20, ({"radius": np.float32(0.7)}, None))
        self.fov = 0.6

    camera = Viewed.camera


@pytest.fixture(scope="module")
def solid():
    return Solid()


def test_a_small_frame_is_the_mean_of_rays_as_dense_as_in_training(solid):
    """The ball's silhouette: with one ray a pixel is white or not, with several it is what is covered."""
    height = int(solid.views.size[0, 0])
    fov = 2 * np.arctan(0.5 * height / float(solid.views.cameras.focal[0, 1]))
    small = FrameCamera(np.asarray(solid.views.cameras.to_world)[1], fov, height // 4, height // 4)
    renderer = solid.renderer
    assert renderer.rays_per_side(small) == 4 and renderer.rays_per_side(small.resized(height, height)) == 1
    assert renderer.rays_per_side(small, max_rays=9.5) == 3 and renderer.rays_per_side(small, max_rays=0.1) == 1
    compiled = renderer.num_compiled
    frame, whole = (
        renderer.render(solid.state, small, side=4),
        renderer.render(solid.state, small.resized(height, height)),
    )
    assert frame.camera == small and renderer.num_compiled <= max(compiled, 3)
    np.testing.assert_allclose(frame.rgb, whole.rgb.reshape(height // 4, 4, -1, 4, 3).mean((1, 3)), atol=1e-6)
    np.testing.assert_allclose(frame.opacity, whole.opacity.reshape(height // 4, 4, -1, 4).mean((1, 3)), atol=1e-6)
    np.testing.assert_array_equal(frame.distance, whole.distance[2::4, 2::4])
    edge = (frame.opacity > 0.1) & (frame.opacity < 0.9)
    assert edge.any()


@pytest.mark.slow
@pytest.mark.parametrize("kind", ball_runs.KINDS)
def test_a_frame_equals_that_of_render(kind, tmp_path):
    it = Viewed(tmp_path, kind)
    camera = it.camera()
    frame = it.renderer.render(it.state, camera)
    to_file = np.eye(4) if it.views.to_file is None else np.asarray(it.views.to_file)
    pose = np.eye(4)
    pose[:3] = camera.to_world
    pose = to_file @ pose
    pose[:3, :3] /= np.cbrt(np.linalg.det(pose[:3, :3]))
    content = {"frames": [{"transform_matrix": pose.tolist()}], "w": 30, "h": 20, "fl_x": camera.focal}
    (tmp_path / "one.json").write_text(json.dumps(content))
    options = {"settings": {"bake_occupancy": True}, "max_rays_per_pixel": 1}
    folder, *_ = render_path(it.folder, path=str(tmp_path / "one.json"), video="none", overwrite=True, **options)
    expected = iio.imread(folder / "color" / "0000.png").astype(int)
    assert np.abs(frame_image(frame, "colour") - expected).max() <= 1
    assert np.ptp(expected) > 50 and 0.05 < (frame.opacity > 0.5).mean() < 0.95
    distance = iio.imread(folder / "depth" / "0000.tiff") / np.cbrt(np.linalg.det(to_file[:3, :3]))
    solid = frame.opacity > 0.999
    assert solid.any()
    np.testing.assert_allclose(frame.distance[solid], distance[solid], rtol=1e-3)
    check_crop(it)
    if kind in ("packed", "dense"):
        check_uncertainty(it, frame)
    compiled = it.renderer.num_compiled
    it.renderer.render(it.renderer.scene_state(40, it.run.variables(20)), it.camera(70, 9, view=2), crop=None)
    assert it.renderer.num_compiled == compiled


def test_no_window_camera_or_checkpoint_compiles_again(solid):
    it = solid
    it.renderer.compile(it.state)
    compiled = it.renderer.num_compiled
    params = {"radius": np.float32(0.3)}
    other = it.renderer.scene_state(40, (params, None))
    crop = np.array([[-1, -1, -1], [1, 1, 1.0]])
    small = it.renderer.render(other, it.camera(40, 90, view=3), fast=True, crop=crop)
    large = it.renderer.render(it.state, it.camera(90, 40), fast=True)
    it.renderer.render(it.state, it.camera(1, 1))
    assert it.renderer.num_compiled == compiled == 3
    assert small.rgb.shape == (90, 40, 3) and large.rgb.shape == (40, 90, 3)
    again = it.renderer.render(other, it.camera(90, 40), fast=True)
    assert 0 < (again.opacity > 0.5).sum() < (large.opacity > 0.5).sum(), "the other ball is smaller"


def test_a_frame_is_abandoned_within_a_chunk(solid):
    it, calls = solid, []

    def abandoned():
        calls.append(1)
        return len(calls) == 3

    assert it.renderer.render(it.state, it.camera(60, 40), abandoned=abandoned) is None
    assert len(calls) == 3


def test_what_is_outside_the_crop_box_is_not_shown(solid):
    it = solid
    check_crop(it)


def check_crop(it):
    camera = it.camera()
    whole = it.renderer.render(it.state, camera)
    origin, points = camera.to_world[:, 3], np.argwhere(whole.opacity > 0.5)
    at = origin + whole.distance[..., None] * _directions(camera)
    middle = np.median(at[whole.opacity > 0.5], axis=0)
    crop = np.array([[-100.0] * 3, [100.0] * 3])
    crop[1, 0] = middle[0]
    half = it.renderer.render(it.state, camera, crop=crop)
    shown = half.opacity > 0.5
    assert 0 < shown.sum() < len(points)
    found = origin + half.distance[..., None] * _directions(camera)
    assert found[shown][:, 0].max() < middle[0] + 0.1
    nothing = it.renderer.render(it.state, camera, crop=np.array([[50.0] * 3, [51.0] * 3]))
    assert not nothing.opacity.any() and (nothing.rgb == 1).all(), "the background is white"


def check_uncertainty(it, frame):
    """The ball's red is a function of position, which an estimate may have, too."""
    red = jax.tree_util.Partial(lambda factor, x: 1 / (1 + jnp.exp(factor * x[..., 0])), jnp.float32(-3))
    state = it.renderer.scene_state(20, it.run.variables(20), red)
    for fast in (False, True):
        found = it.renderer.render(state, frame.camera, uncertain=True, fast=fast)
        solid = frame.opacity > 0.999
        np.testing.assert_allclose(
            found.rgb[solid], frame.rgb[solid][:, :1].repeat(3, axis=1), atol=0.2 if fast else 1e-3
        )
        assert found.uncertain and (found.rgb[frame.opacity < 0.3] == 0).all()
    np.testing.assert_array_equal(frame_image(found, "uncertainty"), frame_image(found, "colour"))
    assert not it.renderer.render(it.state, frame.camera, uncertain=True).uncertain, "without an estimate it is colour"


def test_a_camera_far_away_sees_the_whole_scene(solid):
    """Unlike a frame of render, which ends where the training views end."""
    it = solid
    near = it.camera()
    away = near.to_world.copy()
    away[:, 3] += 30 * away[:, 2]
    frame = it.renderer.render(it.state, FrameCamera(away, 0.06, 30, 20))
    assert (frame.opacity > 0.5).sum() > 20


def test_images_of_a_frame(solid):
    it = solid
    frame = it.renderer.render(it.state, it.camera(40, 40))
    images = {mode: frame_image(frame, mode) for mode in ("colour", "depth", "opacity", "normals")}
    assert all(image.shape == (40, 40, 3) and image.dtype == np.uint8 for image in images.values())
    solid = frame.opacity > 0.999
    assert (images["opacity"][solid] == 255).all() and images["opacity"][0, 0, 0] == 0
    order = np.argsort(frame.distance[solid])
    shades = images["depth"][..., 0][solid][order].astype(int)
    assert (np.diff(shades) <= 0).all() and shades[0] == 255, "near is white"
    inside = frame.distance < np.quantile(frame.distance[solid], 0.5)  # the edge of the ball has no neighbours
    points = np.asarray(frame.camera.to_world)[:, 3] + frame.distance[..., None] * _directions(frame.camera)
    outward = np.where(np.isfinite(points), points, 0) - [0.1, 0, 0.2]
    outward /= np.linalg.norm(outward, axis=-1, keepdims=True)
    normals = images["normals"] / 127.5 - 1
    assert ((normals * outward).sum(axis=-1)[inside] > 0.9).mean() > 0.9
    with pytest.raises(ValueError, match="mode is 'infrared', expected one of colour"):
        frame_image(frame, "infrared")


@pytest.mark.parametrize("size", [(0, 5), (5, MAX_SIDE + 1)])
def test_a_size_beyond_the_limit_is_refused(solid, size):
    it = solid
    with pytest.raises(ValueError, match="expected sides of 1 to 4096"):
        it.renderer.render(it.state, it.camera(*size))


def _directions(camera):
    """Returns unit directions [H, W, 3] through the pixels' centres in the world."""
    x, y = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    local = np.stack([x - camera.width / 2, camera.height / 2 - y, np.full_like(x, -camera.focal)], axis=-1)
    local /= np.linalg.norm(local, axis=-1, keepdims=True)
    return local @ np.asarray(camera.to_world)[:, :3].T


@pytest.mark.parametrize("aspect, widens", [(1.6, 1.0), (1.0, 1.0), (0.5, 2.0), (None, 1.0)])
def test_a_narrow_window_shows_the_width_of_a_training_view(aspect, widens):
    """Square views fill the height of a wide window, and the width of a phone's."""
    views = load_synthetic(size=8)
    page = object.__new__(Page)
    page._viewer = types.SimpleNamespace(views=views)
    width, height = (None, None) if aspect is None else (100 * aspect, 100)
    page._client = types.SimpleNamespace(camera=types.SimpleNamespace(image_width=width, image_height=height))
    fov = page._view_fov(0, page._width_over_height(np.inf))
    assert np.tan(fov / 2) == pytest.approx(widens * 4 / views.cameras.focal[0, 1])
