"""Parameters of the training images: they are recovered, absent where they are off, and resumed bit for bit."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxnerf
from helpers import all_finite
from jaxnerf import Batch, Camera, Views
from jaxnerf.data import ray_batches
from jaxnerf.evaluation.evaluate import train_and_evaluate
from jaxnerf.evaluation.restore import refined_views, restore_run
from jaxnerf.fields.base import Field
from jaxnerf.models.base import Model
from jaxnerf.registry import FIELDS
from jaxnerf.training import auto_config, build
from jaxnerf.training.camera_parameters import (
    CAMERAS,
    CameraOptions,
    CameraParameters,
    corrected_cameras,
    exposure_gains,
    nearest_to_axes,
)
from jaxnerf.training.checkpoint import Checkpoints
from jaxnerf.training.config import read_config
from jaxnerf.training.optimizer import OptimizerOptions, make_optimizer
from jaxnerf.training.state import create_state
from jaxnerf.training.step import TrainData, make_train_step
from runs import evaluate, smoke_config
from toys import LOSSES, toy_rendering

pytest_plugins = ["run_fixtures"]
pytestmark = pytest.mark.usefixtures("unoptimized")

BOTH = {"cameras.exposure": True, "cameras.refine": True, "cameras.refine_focal": True, "cameras.refine_start_step": 0}
COUNT, SIZE = 6, 24
TRAIN = {"lr_init": 1e-2, "lr_final": 1e-4, "lr_steps": 100, "warmup_steps": 0, "averaging_power": 0.0, "muon": 0.0}
TRAIN |= {"beta2": 0.99, "epsilon": 1e-15}
RATES = {"exposure_lr": 0.03, "refine_lr": 0.01, "refine_start_step": 0}


def cameras():
    """Returns six cameras around the origin, at different heights."""
    angles = np.arange(COUNT) * 2.1
    eyes = np.stack([3 * np.cos(angles), 3 * np.sin(angles), np.linspace(-1, 2, COUNT)], axis=-1)
    poses = jnp.stack([jaxnerf.look_at(eye, np.zeros(3), [0.0, 0.0, 1.0]) for eye in eyes])
    focal, center = jnp.full((COUNT, 2), 1.5 * SIZE), jnp.full((COUNT, 2), SIZE / 2)
    return Camera(to_world=poses, focal=focal, center=center, height=SIZE, width=SIZE)


corrected = jax.jit(corrected_cameras)


def random_twists(seed, size):
    return jnp.float32(np.random.default_rng(seed).normal(size=(COUNT, 6)) * size)


def angles_between(a, b):
    """Returns the angle between the orientations of two stacks of cameras, in degrees."""
    difference = np.linalg.norm(a.to_world[:, :, :3] - b.to_world[:, :, :3], axis=(1, 2))
    return np.degrees(2 * np.arcsin(difference / np.sqrt(8)))


# The gauge of the corrections


def test_what_all_cameras_have_in_common_is_no_correction():
    start = cameras()
    eyes = np.asarray(start.to_world[:, :, 3])
    common = np.tile([0.1, -0.2, 0.3, 0.4, 0.5, -0.6], (COUNT, 1))
    scaling = np.concatenate([np.zeros((COUNT, 3)), 0.1 * (eyes - eyes.mean(axis=0))], axis=-1)
    for twists in (np.zeros((COUNT, 6)), common, scaling, common + scaling):
        np.testing.assert_allclose(corrected(start, jnp.float32(twists)).to_world, start.to_world, atol=1e-6)
    assert angles_between(corrected(start, random_twists(0, 0.1)), start).min() > 1
    np.testing.assert_allclose(exposure_gains(jnp.full((COUNT, 3), 0.3)), 1, atol=1e-6)


@pytest.mark.parametrize("twists", [jnp.zeros((COUNT, 6)), random_twists(0, 0.1)])
def test_cameras_at_one_point_only_turn(twists):
    start = dataclasses.replace(cameras(), to_world=cameras().to_world.at[:, :, 3].set(1.0))
    np.testing.assert_allclose(corrected(start, twists).to_world[:, :, 3], 1, atol=1e-6)
    slopes = jax.grad(lambda twists: (corrected(start, twists).to_world ** 2 * jnp.arange(4)[None, None]).sum())
    assert all_finite(slopes(twists))


def test_turns_are_about_what_the_cameras_look_at():
    start, target = cameras(), np.float32([0.3, -0.2, 0.5])
    shifted = dataclasses.replace(start, to_world=start.to_world.at[:, :, 3].add(target[None]))
    np.testing.assert_allclose(jax.jit(nearest_to_axes)(shifted.to_world), target, atol=2e-3)
    moved = corrected(shifted, random_twists(3, 0.2).at[:, 3:].set(0))

    def seen(stack):
        poses = np.asarray(stack.to_world)
        return np.einsum("vij,vi->vj", poses[:, :, :3], target - poses[:, :, 3])

    np.testing.assert_allclose(seen(moved), seen(shifted), atol=5e-3)  # the point stays where it was in each image
    assert np.linalg.norm(moved.to_world[:, :, 3] - shifted.to_world[:, :, 3], axis=1).min() > 0.1


def test_parallel_axes_look_at_no_point_far_away():
    poses = cameras().to_world.at[:, :, :3].set(jnp.eye(3))
    found = jax.jit(nearest_to_axes)(poses)
    np.testing.assert_allclose(found, poses[:, :, 3].mean(axis=0), atol=1e-3)


# Recovery from images of a known scene


def ball(x, viewdirs):
    """Returns a soft ball with a wavy surface, in closed form."""
    inside = 1.0 - jnp.linalg.norm(x, axis=-1)
    return 40 * jax.nn.sigmoid(20 * inside), 0.5 + 0.3 * jnp.sin(5 * x) + 0 * viewdirs


def render(rays):
    return jaxnerf.render_rays(None, ball, rays, num_samples=40)


def images(stack, gains):
    """Returns Views of the ball with these cameras and gains."""
    pixels = jaxnerf.pixel_grid(SIZE, SIZE)
    empty = jnp.zeros(COUNT)
    views = Views(
        pixels=jnp.zeros((COUNT * SIZE * SIZE, 3), jnp.uint16),
        offset=jnp.arange(COUNT) * SIZE * SIZE,
        size=jnp.full((COUNT, 2), SIZE),
        cameras=stack,
        near=empty + 1.5,
        far=empty + 5,
    )
    rays = jax.vmap(lambda index: ray_batches.view_rays(views, index, pixels))(jnp.arange(COUNT))
    rgb = jax.jit(render)(rays).rgb * gains[:, None, None]
    stored = jnp.round(jnp.clip(rgb, 0, 1) * (2**16 - 1)).astype(jnp.uint16)
    return dataclasses.replace(views, pixels=stored.reshape(-1, 3))


def recover(views, num_steps, *, exposure=False, refine=False):
    """Returns CameraParameters and the parameters that training through the known scene finds."""
    parameters = CameraParameters(COUNT, exposure, refine, ray_batches.view_rays, refine_focal=refine)
    model = Model(
        init=lambda key: {"fine": {"unused": jnp.zeros(())}},
        render=lambda keys, params, grid, rays, step: {"fine": render(rays)},
        view=None,
        scene=None,
        samples_per_ray=1.0,
    )
    model = parameters.added_to(model)
    optimizer, _ = make_optimizer(OptimizerOptions(**{**TRAIN, "lr_steps": num_steps}), CameraOptions(**RATES))

    def draw(step, positions, data):
        return ray_batches.draw_batch(data.seed, step, positions, data.views, extras=parameters.needs)

    step = jax.jit(make_train_step(model, optimizer, draw, LOSSES, parameters))
    state, data = create_state(model, optimizer, 0), TrainData(jnp.uint32(0), views, None, None)
    for _ in range(num_steps):
        state, metrics = step(state, data, jnp.arange(384)[None])
    assert metrics["nonfinite"] == 0
    return parameters, state.params


@pytest.mark.extra
def test_a_drift_of_exposure_is_recovered():
    drift = np.float32(np.random.default_rng(1).normal(size=(COUNT, 3)) * 0.15)
    gains = exposure_gains(drift)
    _, found = recover(images(cameras(), gains), 80, exposure=True)
    np.testing.assert_allclose(exposure_gains(found[CAMERAS]["log_gains"]), gains, rtol=0.01)


@pytest.mark.extra
def test_pose_noise_and_focal_length_are_recovered():
    truth = cameras()
    noisy = corrected(truth, random_twists(2, 0.01))
    noisy = dataclasses.replace(noisy, focal=1.02 * noisy.focal)
    views = dataclasses.replace(images(truth, jnp.ones((COUNT, 3))), cameras=noisy)
    parameters, found = recover(views, 200, refine=True)
    refined = parameters.refined_views(found, views, "train").cameras

    def errors(found):
        moved = np.linalg.norm(found.to_world[:, :, 3] - truth.to_world[:, :, 3], axis=-1)
        return np.array(
            [angles_between(found, truth).mean(), moved.mean(), np.abs(found.focal / truth.focal - 1).max()]
        )

    before, after = errors(noisy), errors(refined)
    assert before[0] > 0.5 and (after < 0.25 * before).all(), (before, after)
    held_out = parameters.refined_views(found, views, "held_out").cameras
    np.testing.assert_array_equal(held_out.to_world, noisy.to_world)
    np.testing.assert_array_equal(held_out.focal, refined.focal)


def test_cameras_do_not_move_before_their_first_step():
    parameters = CameraParameters(COUNT, True, True, None, refine_focal=True)
    params = {"fine": jnp.ones(3), CAMERAS: parameters.init()}
    optimizer, _ = make_optimizer(OptimizerOptions(**TRAIN), CameraOptions(**{**RATES, "refine_start_step": 2}))

    @jax.jit
    def updates(params):
        def step(state, _):
            update, state = optimizer.update(jax.tree.map(jnp.ones_like, params), state, params)
            return state, update

        return jax.lax.scan(step, optimizer.init(params), length=4)[1]

    found = updates(params)
    for name, rate in (("twists", RATES["refine_lr"]), ("log_focal", 0.1 * RATES["refine_lr"])):
        moved = np.abs(found[CAMERAS][name]).reshape(4, -1).max(axis=1)
        np.testing.assert_allclose(moved, [0, 0, rate, rate], rtol=0.2)
    np.testing.assert_allclose(np.abs(found[CAMERAS]["log_gains"]), RATES["exposure_lr"], rtol=0.2)
    np.testing.assert_allclose(np.abs(found["fine"]), TRAIN["lr_init"], rtol=0.2)


def test_exposure_changes_the_object_and_not_its_background():
    parameters = CameraParameters(2, True, False, None, background=(1.0, 0.5, 0.25))
    params = {CAMERAS: {"log_gains": jnp.log(jnp.float32([[2, 2, 2], [0.5, 0.5, 0.5]]))}}
    rgb = jnp.float32([[0.2, 0.3, 0.4], [1, 0.5, 0.25], [0.6, 0.4, 0.325]])
    batch = Batch(rays=None, rgb=rgb, image_index=jnp.array([0, 0, 1]), alpha=jnp.float32([1, 0, 0.5]))
    exposed = parameters.exposed(params, {"fine": toy_rendering(rgb)}, batch)["fine"]
    np.testing.assert_allclose(exposed.rgb, [[0.4, 0.6, 0.8], [1, 0.5, 0.25], [0.55, 0.325, 0.225]], atol=1e-6)


def test_a_saturated_colour_only_says_that_there_was_enough_light():
    parameters = CameraParameters(2, True, False, None)
    params = {CAMERAS: {"log_gains": jnp.log(jnp.float32([[2, 2, 2], [0.5, 0.5, 0.5]]))}}
    batch = Batch(rays=None, rgb=jnp.float32([[1, 1, 0.99]]), image_index=jnp.array([0]), alpha=jnp.ones(1))
    exposed = parameters.exposed(params, {"fine": toy_rendering(jnp.float32([[0.9, 0.4, 0.9]]))}, batch)["fine"]
    np.testing.assert_allclose(exposed.rgb, [[1, 0.8, 1.8]], atol=1e-6)


# In a run


def init_blob(key):
    return {"log_density": jnp.float32(0.5), "rgb": jax.random.normal(key, (3,))}


def blob(params, x, viewdirs):
    """A field of four parameters, which compiles in no time."""
    density = jnp.exp(params["log_density"] - (x**2).sum(axis=-1))
    return density, jnp.broadcast_to(jax.nn.sigmoid(params["rgb"]).reshape((1,) * (x.ndim - 1) + (3,)), x.shape)


@pytest.fixture
def blob_field(monkeypatch):
    monkeypatch.setattr(FIELDS, "_parts", dict(FIELDS._parts))
    jaxnerf.register_field("blob", lambda options, box: Field(init_blob, blob))


def blob_config(fields=BOTH, **train):
    config = smoke_config(**train)
    config.update_from_flattened_dict({"field": "blob", "sampling.num_fine": 0, **fields})
    return config


def make_step(config):
    """Returns the training step of a config, the shapes of its state, and its data."""
    resolved = auto_config.resolve(config)
    experiment = build.build(auto_config.resolve_for_device(resolved.config)[0])
    valid, data = experiment.prepare(resolved.views)
    state = jax.eval_shape(lambda: create_state(experiment.model, experiment.optimizer, 0, valid))
    step = make_train_step(
        experiment.model, experiment.optimizer, experiment.draw, experiment.losses, experiment.cameras
    )
    return jax.jit(step), state, data


def test_what_is_off_is_absent(blob_field):
    assert make_step(blob_config({}))[1].params.keys() == {"fine"}
    focal = {"cameras.refine": True, "cameras.refine_focal": True}
    for fields, names in (
        ({"cameras.exposure": True}, {"log_gains"}),
        ({"cameras.refine": True}, {"twists"}),
        (focal, {"twists", "log_focal"}),
    ):
        found = make_step(blob_config(fields))[1].params[CAMERAS]
        assert found.keys() == names and all(leaf.shape[:1] in ((), (60,)) for leaf in found.values())


@pytest.mark.extra
def test_a_resumed_run_equals_an_uninterrupted_one(blob_field, tmp_path, capsys):
    options = {"averaging_power": 2.0, "muon": 0.5, "log_every": 5}
    whole, parts = tmp_path / "whole", tmp_path / "parts"
    config = blob_config(max_steps=10, **options)
    assert train_and_evaluate(config, whole)
    for steps in (5, 10):
        assert train_and_evaluate(blob_config(max_steps=steps, lr_steps=config.train.lr_steps, **options), parts)
    like = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), make_step(config)[1])
    states = [jax.device_get(Checkpoints(folder).load(10, like)) for folder in (whole, parts)]
    jax.tree.map(np.testing.assert_array_equal, *states)
    assert np.abs(states[0].params[CAMERAS]["twists"]).max() > 1e-4
    out = "".join(capsys.readouterr())
    assert out.count(" times the mean exposure\n") == 3 and out.count("cameras       refined by 0.") == 3
    # The run's own functions use the refined cameras and report the aligned scores.
    run = restore_run(whole)
    params, views = run.variables(10)[0], run.experiment.load_split("train")
    refined = refined_views(run, views, "train", params)
    assert 0.01 < angles_between(refined.cameras, views.cameras).max() < 5
    results = evaluate(whole, split="train")
    assert results["exposure"] and results["psnr_aligned"] >= results["psnr"] - 0.05
    assert [row["psnr_aligned"] for row in results["images"]]


@pytest.mark.parametrize(
    "fields, message",
    [
        ({"cameras.num_images": 7}, "cameras.num_images is 7, expected 60, the training images"),
        ({"cameras.exposure_lr": 0.0}, "--config.cameras.exposure_lr is 0.0, expected more than 0"),
        ({"cameras.refine_lr": -1.0}, "--config.cameras.refine_lr is -1.0, expected more than 0"),
        ({"cameras.refine_start_step": -1}, "--config.cameras.refine_start_step is -1, expected at least 0"),
    ],
)
def test_wrong_values_are_errors(blob_field, fields, message):
    config = blob_config({**BOTH, **fields})
    with pytest.raises(ValueError, match=message):
        make_step(config)


def test_an_unresolved_number_of_images_is_an_error():
    with pytest.raises(ValueError, match="cameras.num_images is 'auto'; resolve the config"):
        build.build_cameras(read_config(blob_config()))
