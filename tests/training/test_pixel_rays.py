"""Several rays a pixel in the last part of training, and in images."""

import dataclasses
import functools
import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from helpers import assert_same
from jaxnerf.core.cameras import pixel_grid
from jaxnerf.core.types import Rendering
from jaxnerf.data import ray_batches
from jaxnerf.data.ray_batches import BatchPixels
from jaxnerf.evaluation.evaluate import score_run, train_and_evaluate
from jaxnerf.evaluation.output_images import to_8_bits
from jaxnerf.evaluation.previews import Previews
from jaxnerf.evaluation.restore import restore_run
from jaxnerf.evaluation.supersampling import trained_footprint
from jaxnerf.options import Device, Facts
from jaxnerf.runtime import devices
from jaxnerf.training import auto_config, build
from jaxnerf.training.checkpoint import Checkpoints
from jaxnerf.training.compiled_step import _gather_ahead
from jaxnerf.training.options import TrainOptions
from jaxnerf.training.state import create_state
from jaxnerf.training.step import PixelRays, ProgressData, make_train_step
from runs import PACKED, smoke_config

pytest_plugins = ["run_fixtures"]
pytestmark = pytest.mark.usefixtures("unoptimized")
SEVERAL = {"train.rays_per_side": 2, "train.one_ray_fraction": 0.6}
STEPS, RAYS = 10, 64


def config_of(sampler="occupancy", **changes):
    config = smoke_config(max_steps=STEPS, lr_steps=STEPS, save_every=STEPS, log_every=1)
    config.update_from_flattened_dict({**(PACKED if sampler == "occupancy" else {}), **SEVERAL, **changes})
    return config


@functools.cache
def experiment_of(sampler="occupancy", **changes):
    """Returns the Experiment, the Views, the cells and the TrainData of a config."""
    resolved = auto_config.resolve(config_of(sampler, **changes))
    experiment = build.build(auto_config.resolve_for_device(resolved.config)[0])
    return experiment, resolved.views, *experiment.prepare(resolved.views)


def step_of(experiment):
    return make_train_step(
        experiment.model, experiment.optimizer, experiment.draw, experiment.losses, pixel_rays=experiment.pixel_rays
    )


@functools.cache
def compiled_step(sampler="occupancy", **changes):
    return jax.jit(step_of(experiment_of(sampler, **changes)[0]))


def positions_of(size=RAYS):
    return np.arange(RAYS, dtype=np.int32).reshape(-1, size)


@functools.partial(jax.jit, static_argnames="whole")
def draw(side, views, whole=False):
    options = {"extras": ("pixel",), "needs": ("radius",)}
    options |= {} if whole else {"rays_per_side": side}
    return ray_batches.draw_batch(3, 5, jnp.arange(RAYS), views, **options)


@pytest.mark.parametrize("side", [2, 4])
def test_the_rays_of_a_pixel_are_a_regular_grid_of_narrow_cones(side):
    views = experiment_of()[1]
    keys, batch = draw(side, views)
    pixels = np.asarray(batch.pixel).reshape(-1, side, side, 2)
    offsets = (np.arange(side) + 0.5) / side - 0.5
    np.testing.assert_allclose(pixels[..., 0] - np.floor(pixels[..., 0]) - 0.5, pixels[..., 0] * 0 + offsets, atol=1e-4)
    np.testing.assert_allclose(pixels[..., 1] - np.floor(pixels[..., 1]) - 0.5, offsets[:, None] + pixels[..., 1] * 0)
    whole_keys, whole = draw(1, views, whole=True)
    first = slice(None, None, side**2)
    np.testing.assert_array_equal(np.floor(pixels).reshape(-1, 2)[first], np.floor(whole.pixel)[first])
    np.testing.assert_array_equal(batch.rgb, np.repeat(np.asarray(whole.rgb)[first], side**2, axis=0))
    np.testing.assert_allclose(batch.rays.radius[first], whole.rays.radius[first] / side, rtol=0.01)
    np.testing.assert_array_equal(jax.random.key_data(keys), jax.random.key_data(whole_keys))
    ids = jax.jit(lambda side: ray_batches.draw_pixels(3, 5, jnp.arange(RAYS), views, rays_per_side=side)[1])(side)
    assert (ids.reshape(-1, side**2) == ids[first, None]).all() and len(set(ids.tolist())) > RAYS / side**2 / 2


def test_one_ray_a_pixel_is_the_ray_through_its_centre():
    views = experiment_of()[1]
    (keys, batch), (whole_keys, whole) = draw(1, views), draw(1, views, whole=True)
    np.testing.assert_array_equal(jax.random.key_data(keys), jax.random.key_data(whole_keys))
    assert_same(batch, whole, rtol=0, atol=0)


def test_a_pixel_shows_the_mean_of_its_rays():
    rng = np.random.default_rng(0)
    planes = {name: jnp.asarray(rng.uniform(size=8)) for name in ("opacity", "depth", "disparity")}
    dropped = jnp.asarray([0, 0, 0, 0, 0, 2, 0, 1])
    rendering = Rendering(rgb=jnp.asarray(rng.uniform(size=(8, 3))), weights=None, num_dropped=dropped, **planes)
    found = PixelRays(2, 0.5).averaged(rendering, 2)
    for name in (*planes, "rgb"):
        values = np.asarray(getattr(rendering, name))
        expected = np.repeat(values.reshape(2, 4, *values.shape[1:]).mean(axis=1), 4, axis=0)
        np.testing.assert_allclose(getattr(found, name), expected, rtol=1e-6)
    assert found.num_dropped.tolist() == [0, 0, 0, 0, 3, 3, 3, 3]
    assert_same(PixelRays(2, 0.5).averaged(rendering, 1), rendering, rtol=0, atol=0)
    with pytest.raises(ValueError, match="8 rays of a microbatch on a device, expected a multiple of 9"):
        PixelRays(3, 0.5).averaged(rendering, 3)


@pytest.mark.parametrize("sampler", ["occupancy", pytest.param("hierarchical", marks=pytest.mark.slow)])
def test_the_loss_compares_the_mean_colour_in_the_last_part_only(sampler):
    experiment, _, cells, data = experiment_of(sampler)
    state = create_state(experiment.model, experiment.optimizer, 0, cells)
    step, positions, render = compiled_step(sampler), positions_of(), jax.jit(experiment.model.render)
    for when, side in ((5, 1), (6, 2)):
        state = dataclasses.replace(state, step=jnp.int32(when))
        keys, batch = experiment.draw(when, positions[0], data)
        renderings = render(keys, state.params, state.grid, batch.rays, state.step)
        expected = 0
        for name in experiment.model.image_networks:
            rgb = np.asarray(renderings[name].rgb).reshape(-1, side**2, 3).mean(axis=1)
            expected += ((rgb - np.asarray(batch.rgb)[:: side**2]) ** 2).mean()
        after, metrics = step(state, data, positions)
        np.testing.assert_allclose(metrics["loss"], expected, rtol=1e-5)
        assert int(metrics["rays"]) == RAYS and int(after.step) == when + 1


def test_before_the_last_part_the_step_is_that_of_one_ray_a_pixel():
    _, _, cells, data = experiment_of()
    plain, _, _, plain_data = experiment_of(**{"train.rays_per_side": 1})
    state = create_state(plain.model, plain.optimizer, 0, cells)
    one = compiled_step(**{"train.rays_per_side": 1})(state, plain_data, positions_of())[0]
    several = compiled_step()(state, data, positions_of())[0]
    assert_same(several.params, one.params, rtol=1e-6, atol=1e-7)
    late = data._replace(progress=ProgressData(np.float32(STEPS), np.float32(0.6)))  # by time
    after = compiled_step()(state, late, positions_of())[0]
    with pytest.raises(AssertionError):
        assert_same(after.params, one.params, rtol=1e-6, atol=1e-7)


def test_one_ray_a_pixel_leaves_the_program_as_it_is():
    texts = []
    for fraction in (0.6, 0.3):
        changes = {"train.rays_per_side": 1, "train.one_ray_fraction": fraction}
        experiment, _, cells, data = experiment_of(**changes)
        assert experiment.pixel_rays is None and data.progress is None
        state = jax.eval_shape(lambda: create_state(experiment.model, experiment.optimizer, 0, cells))  # noqa: B023
        without = make_train_step(experiment.model, experiment.optimizer, experiment.draw, experiment.losses)
        for step in (step_of(experiment), without):
            text = str(jax.make_jaxpr(step)(state, data, positions_of()))
            texts.append(re.sub(r"0x[0-9a-f]+", "", text))
    assert len(set(texts)) == 1


_SPLITS = [(1, 16), (4, 4)]


@pytest.mark.parametrize(
    ("num_devices", "size"), [(4, 16), *(pytest.param(*x, marks=pytest.mark.extra) for x in _SPLITS)]
)
def test_it_does_not_depend_on_how_the_batch_is_split(num_devices, size):
    experiment, _, cells, data = experiment_of()
    state = dataclasses.replace(create_state(experiment.model, experiment.optimizer, 0, cells), step=jnp.int32(7))
    _, expected = compiled_step()(state, data, positions_of())
    options = {"batch_size": RAYS, "devices": jax.devices()[:num_devices], "microbatch_size": size}
    run, state, data = devices.compile_step(step_of(experiment), state, data, **options)
    _, metrics = run(state, data)
    for name in ("loss", "grad_norm", "rays"):
        np.testing.assert_allclose(metrics[name], expected[name], rtol=1e-4)


@pytest.fixture(scope="module")
def uninterrupted(compiled_once, tmp_path_factory):
    folder = tmp_path_factory.mktemp("several") / "run"
    assert train_and_evaluate(config_of(**{"eval.at_end": False}), folder)
    return folder


@pytest.mark.slow
@pytest.mark.parametrize(
    ("resumed_at", "per_dispatch"),
    [pytest.param(4, 1, marks=pytest.mark.extra), (8, 1), (STEPS, 5)],
)
def test_a_run_resumed_in_either_part_and_one_of_several_steps_a_dispatch_are_the_same(
    uninterrupted, tmp_path, resumed_at, per_dispatch, monkeypatch
):
    monkeypatch.setattr("jaxnerf.training.compiled_step.steps_per_dispatch", lambda *_: per_dispatch)
    changes = {"eval.at_end": False, "train.log_every": per_dispatch}
    for steps in sorted({resumed_at, STEPS}):
        assert train_and_evaluate(config_of(**changes, **{"train.max_steps": steps}), tmp_path / "run")
    template = create_state(*(getattr(experiment_of()[0], name) for name in ("model", "optimizer")), 0)
    found, expected = (Checkpoints(each).load(STEPS, template) for each in (tmp_path / "run", uninterrupted))
    assert_same(found.params, expected.params, rtol=0, atol=0)


def test_pixels_that_are_sent_ahead_are_those_of_the_progress_with_which_they_were_drawn():
    """By time, the last part may begin between the drawing of pixels and their step."""
    pixels, seen = np.arange(10)[:, None], []

    def ids(step, data):
        return np.full(4, 10 * float(data.progress.time_fraction), int)

    def run(state, data):
        seen.append((int(data.views.pixels.rows[0, 0]), round(10 * float(data.progress.time_fraction))))
        return state, {}

    _, views, _, data = experiment_of()
    views = dataclasses.replace(views, pixels=BatchPixels(rows=jnp.zeros((4, 1), int), shape=(10, 1)))
    step = _gather_ahead(run, ids, pixels)
    state = create_state(*(getattr(experiment_of()[0], name) for name in ("model", "optimizer")), 0)
    for passed in (0.3, 0.5, 0.8, 0.9):
        progress = ProgressData(np.float32(10), np.float32(passed))
        step(state, data._replace(views=views, progress=progress))
    assert seen == [(3, 3), (3, 3), (5, 5), (8, 8)]


def test_images_show_the_mean_of_as_many_rays(uninterrupted, tmp_path):
    run = restore_run(uninterrupted)
    views, variables = run.experiment.load_split("test"), run.variables(STEPS)
    assert trained_footprint(run, run.experiment.load_split("train")).covered == 0.5
    height, width = (int(side) for side in views.size[0])
    fine = (pixel_grid(2 * height, 2 * width) / 2).astype(np.float32)
    image = run.render_image(variables, run.experiment.view_rays(views, 0, fine)).rgb
    expected = np.asarray(image).reshape(height, 2, width, 2, 3).mean((1, 3))
    score, shown = Previews(uninterrupted)._render(variables, views, 0)
    assert np.abs(shown[:, :width].astype(int) - to_8_bits(expected)).max() <= 1
    results = score_run(run, uninterrupted)
    assert results["images"][0]["psnr"] == pytest.approx(score, abs=0.01)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"cameras.refine": True}, "train.rays_per_side is 2, expected 1, as the section cameras has parameters"),
        ({"losses.depth": 0.1}, "train.rays_per_side is 2, expected 1, as losses.depth needs rays through sparse"),
        ({"train.batch_size": 66}, "batch_size is 66 and rays_per_side 2, expected a multiple of 4"),
        ({"train.microbatch_size": 2}, "microbatch_size is 2 and rays_per_side 2, expected a multiple of 4"),
    ],
)
def test_what_does_not_go_with_several_rays_is_refused(changes, message):
    with pytest.raises(ValueError, match=message):
        build.build(auto_config.resolve_for_device(auto_config.resolve(config_of(**changes)).config)[0])


@pytest.mark.parametrize(
    ("facts", "changes", "expected", "line"),
    [
        ({}, {}, 2, "4 rays each after 60 % of training, as data.factor is 8"),
        ({"has_alpha": False}, {}, 1, "1 ray each, as alpha does not bound the scene"),
        ({"factor": 4}, {}, 1, "1 ray each, as data.factor is 4"),
        ({"trains_cameras": True}, {}, 1, "1 ray each, as cameras are trained"),
        ({}, {"max_seconds": 10.0}, 1, "1 ray each, as train.max_seconds is 10"),
        ({}, {"max_seconds": 30.0}, 2, "4 rays each after 60 % of training, as data.factor is 8"),
        ({}, {"max_steps": 1500}, 1, "1 ray each, as train.max_steps is 1500"),
        ({}, {"batch_size": 1022}, 1, "1 ray each, as train.batch_size is 1022"),
        ({}, {"microbatch_size": 6}, 1, "1 ray each, as train.microbatch_size is 6"),
        ({"factor": 1}, {"rays_per_side": 3}, 3, None),
    ],
)
def test_small_images_of_what_alpha_bounds_get_several_rays(facts, changes, expected, line):
    facts = Facts(num_views=10, side=100.0, footprint=0.01, **{"has_alpha": True, "factor": 8, **facts})
    options = TrainOptions(**{"rays_per_side": "auto", **changes})
    resolved, lines = options.resolve(facts, Device("cpu"))
    assert resolved.rays_per_side == expected
    assert [each for each in lines if each.startswith("pixels")] == ([f"pixels        {line}"] if line else [])
