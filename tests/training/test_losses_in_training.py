"""The config's losses in the training step: weights, schedules, absent losses, regularizers, fields of the batch."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

import jaxnerf
from jaxnerf.core.cameras import project
from jaxnerf.fields.base import Field
from jaxnerf.registry import FIELDS, LOSSES
from jaxnerf.training import auto_config
from jaxnerf.training.build import build, build_losses
from jaxnerf.training.state import create_state
from jaxnerf.training.step import make_train_step
from runs import PACKED, smoke_config

pytest_plugins = ["run_fixtures"]
pytestmark = pytest.mark.usefixtures("unoptimized")
RAYS, LEARNING_RATE = 64, 0.1


def blob(params, x, viewdirs):
    """A field of five parameters, which compiles in no time: a Gaussian cloud of one colour."""
    squares = (x**2).sum(axis=-1)
    density = jnp.exp(params["log_density"] - squares * jnp.exp(-2 * params["log_width"]))
    return density, jnp.broadcast_to(jax.nn.sigmoid(params["rgb"]).reshape((1,) * (x.ndim - 1) + (3,)), x.shape)


def init_blob(key):
    return {"log_density": jnp.float32(0.5), "log_width": jnp.float32(0.2), "rgb": jax.random.normal(key, (3,))}


@pytest.fixture(autouse=True)
def registries(monkeypatch):
    """Forgets after each test what the test has registered."""
    for registry in (LOSSES, FIELDS):
        monkeypatch.setattr(registry, "_parts", dict(registry._parts))
    jaxnerf.register_field("blob", lambda options, box: Field(init_blob, blob))


@functools.cache
def experiment_and_data(packed=False):
    config = smoke_config()
    config.update_from_flattened_dict(PACKED)
    config.field, config.sampling.num_fine = "blob", 0
    if not packed:
        config.sampler = "hierarchical"
    resolved = auto_config.resolve(config)
    experiment = build(auto_config.resolve_for_device(resolved.config)[0])
    valid, data = experiment.prepare(resolved.views)
    return experiment, valid, data


def make_step(weights, packed=False):
    """Returns the training step, by plain gradient descent, and its arguments."""
    experiment, valid, data = experiment_and_data(packed)
    losses, optimizer = build_losses(weights), optax.sgd(LEARNING_RATE)
    extras = tuple(sorted({need for loss in losses for need in loss.needs}))
    draw = functools.partial(jaxnerf.draw_batch, extras=extras)
    state = create_state(experiment.model, optimizer, 0, valid)
    step = make_train_step(
        experiment.model,
        optimizer,
        lambda step, positions, data: draw(data.seed, step, positions, data.views, data.active_pixels),
        losses,
    )
    return step, (state, data, jnp.arange(RAYS)[None])


def train(weights, num_steps=1, packed=False):
    """Returns the state after some steps, and the metrics of each."""
    step, (state, data, positions) = make_step(weights, packed)
    step, rows = jax.jit(step), []
    for _ in range(num_steps):
        state, metrics = step(state, data, positions)
        rows.append({name: float(value) for name, value in metrics.items()})
    return state, rows


def test_the_loss_is_the_weighted_sum_by_name():
    _, (row,) = train({"mse": 2.0, "distortion": 0.3})
    assert row["loss_distortion"] > 1e-4
    assert row["loss"] == pytest.approx(2 * row["loss_mse"] + 0.3 * row["loss_distortion"], rel=1e-5)
    assert row["loss_mse"] == pytest.approx(row["mse_fine"], rel=1e-5)


@pytest.mark.parametrize("packed", [False, True])
def test_a_loss_of_weight_0_is_absent_from_the_step(packed):
    """The step's operations are those of a config without it, one by one; a weight adds operations."""

    def text(weights):
        step, given = make_step(weights, packed)
        return jax.jit(step).lower(*given).as_text()

    alone = text({"mse": 1.0})
    names = ("distortion", "depth", "total_variation")
    assert text({"mse": 1.0, **dict.fromkeys(names, 0.0)}) == alone
    assert len(text({"mse": 1.0, "distortion": 0.1})) > len(alone)


def test_a_schedule_is_linear_between_its_points():
    _, rows = train({"mse": 1.0, "distortion": ((1, 0.0), (3, 0.5))}, num_steps=5)
    weights = [(row["loss"] - row["loss_mse"]) / row["loss_distortion"] for row in rows]
    np.testing.assert_allclose(weights, [0, 0, 0.25, 0.5, 0.5], atol=1e-5)


def test_a_schedule_with_descending_steps_is_an_error():
    with pytest.raises(ValueError, match=r"losses.mse is .* expected points \(step, weight\) with ascending steps"):
        build_losses({"mse": ((3, 1.0), (1, 0.0))})


def test_a_regularizer_adds_its_gradient():
    jaxnerf.register_loss("half_squares", lambda params: optax.tree.norm(params, squared=True) / 2, on="params")
    plain, _ = train({"mse": 1.0})
    decayed, (row,) = train({"mse": 1.0, "half_squares": 0.25})
    start = make_step({"mse": 1.0})[1][0].params
    assert row["loss_half_squares"] == pytest.approx(float(optax.tree.norm(start, squared=True)) / 2, rel=1e-5)
    assert row["loss"] == pytest.approx(row["loss_mse"] + 0.25 * row["loss_half_squares"], rel=1e-5)
    for without, with_it, value in zip(*map(jax.tree.leaves, (plain.params, decayed.params, start)), strict=True):
        np.testing.assert_allclose(with_it, without - LEARNING_RATE * 0.25 * value, atol=1e-6)


@pytest.mark.parametrize("needs", [(), ("alpha",), ("image_index", "pixel")])
def test_a_loss_gets_the_fields_of_the_batch_that_it_needs_and_no_others(needs):
    found = {}

    def record(outputs, batch):
        found.update({name: getattr(batch, name) for name in ("alpha", "image_index", "pixel", "depth")})
        return jnp.zeros(batch.rgb.shape[0])

    jaxnerf.register_loss("record", record, needs=needs)
    step, given = make_step({"mse": 1.0, "record": 1.0})
    jax.eval_shape(step, *given)
    shapes = {"alpha": (RAYS,), "image_index": (RAYS,), "pixel": (RAYS, 2)}
    assert {name: value.shape for name, value in found.items() if value is not None} == {
        name: shapes[name] for name in needs
    }


def test_the_fields_of_the_batch_are_those_of_the_drawn_pixels():
    data = experiment_and_data()[2]
    extras = ("alpha", "image_index", "pixel")
    given = (data.seed, 0, jnp.arange(RAYS), data.views, data.active_pixels)
    batch = jax.jit(lambda *given: jaxnerf.draw_batch(*given, extras=extras)[1])(*given)
    views = jax.tree.map(np.asarray, data.views)
    column, row = np.floor(batch.pixel).astype(int).T
    index = views.offset[batch.image_index] + row * views.size[batch.image_index, 1] + column
    largest = np.iinfo(views.pixels.dtype).max
    np.testing.assert_allclose(batch.alpha, views.pixels[index, 3] / largest, atol=1e-6)
    colors = views.pixels[index, :3] / largest * np.asarray(batch.alpha)[:, None] + 1 - np.asarray(batch.alpha)[:, None]
    np.testing.assert_allclose(batch.rgb, colors, atol=1e-6)


def test_an_unknown_loss_names_the_registration():
    with pytest.raises(ValueError, match="no loss 'depht', expected one of 'mse'.*jaxnerf.register_loss.*--plugins"):
        build_losses({"mse": 1.0, "depht": 0.1})


def test_a_loss_that_needs_what_no_dataset_gives_is_an_error():
    jaxnerf.register_loss("normal", lambda outputs, batch: batch.normal, needs=("normal",))
    with pytest.raises(ValueError, match="losses.normal needs normal in the batch"):
        build_losses({"mse": 1.0, "normal": 0.1})


@pytest.mark.parametrize("weights", [{}, {"mse": 0.0}])
def test_a_config_without_a_loss_of_the_renderings_is_an_error(weights):
    jaxnerf.register_loss("decay", optax.tree.norm, on="params")
    with pytest.raises(ValueError, match="no loss of the renderings has a weight"):
        build_losses({**weights, "decay": 1.0})


@pytest.mark.slow
def test_the_distortion_loss_gathers_the_weights_of_a_packed_ray():
    """Training with the loss ends with less distortion than training without it, from the same start."""
    last = [train({"mse": 2.0, "distortion": weight}, 12, packed=True)[1][-1] for weight in (1e-6, 3.0)]
    assert last[1]["loss_distortion"] < 0.9 * last[0]["loss_distortion"]
    assert last[1]["loss"] == pytest.approx(2 * last[1]["loss_mse"] + 3 * last[1]["loss_distortion"], rel=1e-5)
    assert last[1]["loss_mse"] == last[1]["mse_fine"]
    assert all(np.isfinite(row["grad_norm"]) for row in last)


def experiment_of(views, **losses):
    """Returns the Experiment of a blob trained with these losses on Views, its TrainData, and the compiled step."""
    config = smoke_config()
    config.update_from_flattened_dict(PACKED)
    config.field = "blob"
    config.losses.update(losses)
    config.train.batch_size = RAYS
    config = auto_config.resolve_for_device(auto_config.resolve(config, views).config)[0]
    experiment = build(config)
    valid, data = experiment.prepare(views)
    step = make_train_step(experiment.model, optax.sgd(LEARNING_RATE), experiment.draw, experiment.losses)
    return experiment, data, jax.jit(step), create_state(experiment.model, optax.sgd(LEARNING_RATE), 0, valid)


@pytest.fixture
def observed_views():
    """Returns the Views of the embedded scene with points at the origin, which lies in the middle of each image."""
    views = experiment_and_data()[0].load_split("train")
    origin = np.zeros((1, 3), np.float32)
    pixel = np.asarray(jax.jit(jax.vmap(lambda camera: project(camera, origin[0])[0]))(views.cameras))
    view = np.arange(len(pixel), dtype=np.int32)
    sparse = jaxnerf.SparsePoints(positions=origin, view=view, point=np.zeros_like(view), pixel=pixel)
    return dataclasses.replace(views, sparse=sparse)


def test_depth_supervision_is_absent_unless_its_loss_is_on(observed_views):
    plain = dataclasses.replace(observed_views, sparse=None)
    texts = []
    for views in (plain, observed_views):
        experiment, data, step, state = experiment_of(views, depth=0.0)
        assert data.views.sparse is None
        texts.append(step.lower(state, data, jnp.arange(RAYS)[None]).as_text())
    assert texts[0] == texts[1]
    with pytest.raises(ValueError, match="losses.depth is set, and the dataset has no observations"):
        experiment_of(plain, depth=0.1)


@pytest.mark.slow
def test_the_depth_loss_moves_matter_to_the_sparse_points(observed_views):
    experiment, data, step, state = experiment_of(observed_views, depth=200.0)
    assert data.views.sparse.confidence.shape == observed_views.sparse.view.shape
    positions, rows = jnp.arange(RAYS)[None], []
    for _ in range(8):
        again = state
        state, row = step(state, data, positions)
        rows.append(float(row["loss_depth"]))
    assert rows[-1] < 0.9 * rows[0]
    resumed, _ = step(again, data, positions)
    jax.tree.map(np.testing.assert_array_equal, resumed.params, state.params)


@pytest.mark.slow
def test_a_regularizer_of_levels_gets_those_of_the_hash_grid():
    config = smoke_config()
    config.update_from_flattened_dict(PACKED)
    config.losses.total_variation = 0.5
    config = auto_config.resolve_for_device(auto_config.resolve(config).config)[0]
    experiment = build(config)
    (variation,) = [loss for loss in experiment.losses if loss.name == "total_variation"]
    params = jax.jit(experiment.model.init)(jax.random.key(0))
    # Of independent entries, uniform in [-0.025, 0.025], along three axes.
    assert variation.needs == () and variation.function(params) == pytest.approx(3 * 2 * 0.05**2 / 12, rel=0.1)
    with pytest.raises(ValueError, match="losses.total_variation needs a field that brings it, as a hash grid does"):
        build_losses({"mse": 1.0, "total_variation": 0.1})
