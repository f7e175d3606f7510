"""Runs whose field asks for everything: rays have it in training, evaluation, exports and the viewer."""

import functools
import json
import shutil

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import captures
import jaxnerf
from jaxnerf.core.scene import NEEDS, needs_of
from jaxnerf.evaluation.restore import restore_with_grid
from jaxnerf.fields.base import Field
from jaxnerf.tools.exporters.base import export_run
from jaxnerf.tools.viewer.frame_renderer import FrameCamera, FrameRenderer
from jaxnerf.training import auto_config, build
from jaxnerf.training.step import ProgressData
from runs import PACKED, evaluate, smoke_config

pytest_plugins = ["run_fixtures"]
pytestmark = pytest.mark.usefixtures("unoptimized")
STEPS = 6


def apply(params, x, viewdirs, *, radius, length, time, image_index, progress):
    """A ball that shrinks with the time; its colours depend on all else."""
    size = ((x - 0.1) ** 2).sum(axis=-1)
    density = params["density"] * jax.nn.sigmoid(40 * (0.5 - 0.2 * time - size)) * (1 + radius + 0.1 * length)
    shown = jnp.stack([progress + 0 * size, 0.1 * image_index + 0 * size, params["shade"] * time + 0 * size], axis=-1)
    return density, jax.nn.sigmoid(shown)


FIELD = Field(lambda key: {"density": jnp.float32(40.0), "shade": jnp.float32(0.5)}, apply)
jaxnerf.register_field("needy", lambda options, box: FIELD)


def config_of(sampler, folder):
    config = smoke_config(max_steps=STEPS, lr_steps=STEPS, save_every=3, log_every=3)
    dense = {"sampling.num_fine": 0, "sampling.num_coarse": 64}
    config.update_from_flattened_dict(PACKED if sampler == "occupancy" else dense)
    config.field, config.eval.at_end = "needy", False
    config.data.format, config.data.dir, config.data.background = "auto", str(folder), "white"
    config.data.world, config.data.hold_out = "file", 3
    return config


@pytest.fixture(scope="module")
def dataset(tmp_path_factory):
    """Returns the folder of eight images of noise with times."""
    folder = tmp_path_factory.mktemp("timed")
    content = captures.write_transforms(folder, captures.noise(captures.orbit(8)))
    for index, frame in enumerate(content["frames"]):
        frame["time"] = index / 7
    (folder / "transforms.json").write_text(json.dumps(content))
    return folder


@pytest.fixture(scope="module", params=[pytest.param("hierarchical", marks=pytest.mark.extra), "occupancy"])
def workdir(request, dataset, tmp_path_factory):
    folder = tmp_path_factory.mktemp(request.param, numbered=False) / "run"
    assert jaxnerf.train_and_evaluate(config_of(request.param, dataset), folder)
    return folder


def test_checkpoints_have_the_progress_of_their_step(workdir):
    run = jaxnerf.restore_run(workdir)
    assert set(run.experiment.model.needs) == set(NEEDS)
    for step in (3, STEPS):
        assert float(run.variables(step)[0]["progress"]) == step / STEPS


def test_images_are_those_of_the_scene_at_that_progress(workdir):
    run = jaxnerf.restore_run(workdir)
    views, pixels = run.experiment.load_split("train"), jaxnerf.pixel_grid(4, 4) * 4
    rays = run.experiment.view_rays(views, 2, pixels)
    np.testing.assert_array_equal(rays.time, np.full((4, 4), views.time[2]))
    assert (np.asarray(rays.image_index) == 2).all() and (np.asarray(rays.radius) > 0).all()
    params, grid = run.variables(3)
    image = run.render_image((params, grid), rays)
    scene = functools.partial(apply, params["fine"], progress=0.5)
    if grid is not None:
        scene = jaxnerf.mask_scene(scene, grid)
    exact = jax.jit(lambda rays: jaxnerf.render_rays(None, scene, rays, num_samples=512, background=(1.0, 1.0, 1.0)))(
        rays
    )
    assert np.abs(image.rgb - exact.rgb).mean() < 0.05
    hit = np.asarray(exact.opacity) > 0.9
    assert hit.any()
    np.testing.assert_allclose(image.rgb[..., 1][hit], exact.rgb[..., 1][hit], atol=0.02)


def test_other_code_loads_the_scene_with_the_progress_bound(workdir):
    scene, render = jaxnerf.load_scene(workdir)
    assert needs_of(scene) == ("radius", "length", "time", "image_index")
    run = jaxnerf.restore_run(workdir)
    rays = run.experiment.view_rays(run.experiment.load_split("train"), 1, jaxnerf.pixel_grid(2, 2) * 8)
    assert render(rays).rgb.shape == (2, 2, 3)
    rendering = jax.jit(lambda rays: jaxnerf.render_rays(None, scene, rays, num_samples=16))(rays)
    assert np.isfinite(rendering.rgb).all()


def test_a_resumed_run_equals_an_uninterrupted_one(workdir, dataset, tmp_path):
    folder = shutil.copytree(workdir, tmp_path / "run")
    shutil.rmtree(folder / "checkpoints" / str(STEPS))
    assert jaxnerf.train_and_evaluate(config_of(workdir.parent.name, dataset), folder)
    both = [jax.device_get(jaxnerf.restore_run(each).variables(STEPS)) for each in (workdir, folder)]
    jax.tree.map(np.testing.assert_array_equal, *both)


def test_images_that_are_not_trained_on_have_the_index_0(workdir):
    experiment = jaxnerf.restore_run(workdir).experiment
    held_out = experiment.load_split("held_out")
    assert experiment.load_split("train").image_index is None and not held_out.image_index.any()
    assert held_out.time.shape == (2,) and held_out.time.any()


@pytest.mark.extra
def test_it_is_scored_exported_and_viewed(workdir, tmp_path):
    folder = shutil.copytree(workdir, tmp_path / "run")
    assert evaluate(folder, split="held_out")["views"] == 2
    for kind in ("points", "splats"):
        export_run(folder, kind, resolution=16, num_views=4, num_points=500)
    run = restore_with_grid(folder)
    renderer = FrameRenderer(run, run.experiment.load_split("train"), chunk=512)
    state = renderer.scene_state(STEPS, run.variables(STEPS))
    pose = np.eye(3, 4, dtype=np.float32)
    pose[:, 3] = [0, 0, 4]
    frame = renderer.render(state, FrameCamera(pose, 0.8, 24, 24))
    assert (frame.opacity > 0.5).any()
    seen = frame.rgb[frame.opacity > 0.99]
    np.testing.assert_allclose(seen[:, 1], 0.5, atol=0.01)  # image_index 0
    np.testing.assert_allclose(seen[:, 0], 1 / (1 + np.exp(-1)), atol=0.01)  # progress 1


def test_progress_is_that_of_the_steps_or_of_the_time():
    data = ProgressData(np.float32(10), np.float32(0.35))
    np.testing.assert_allclose([data.at(step) for step in (0, 2, 5, 10, 12)], [0.35, 0.35, 0.5, 1, 1], rtol=1e-6)


def test_a_model_that_needs_nothing_has_neither_progress_nor_fields():
    config = auto_config.resolve_for_device(smoke_config())[0]
    experiment = build.build(config)
    views = experiment.load_split("train")
    _, data = experiment.prepare(views)
    assert experiment.model.needs == () and data.progress is None
    rays = experiment.view_rays(views, 0, jaxnerf.pixel_grid(2, 2))
    assert rays.radius is None and rays.time is None and rays.image_index is None
