"""Training steps of real networks on degenerate batches and parameters."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

from helpers import all_finite, assert_same, random_rays
from jaxnerf import Batch
from jaxnerf.training.build import build_losses, build_model
from jaxnerf.training.state import create_state
from jaxnerf.training.step import make_train_step
from runs import smoke_config

pytest_plugins = ["run_fixtures"]
pytestmark = pytest.mark.usefixtures("unoptimized")

RAYS, STEPS = 64, 3
OPTIMIZER = optax.adam(1e-2)

each_network = pytest.mark.parametrize(
    "kind",
    [
        pytest.param(("float32", "segments"), id="float32-segments"),
        pytest.param(("bfloat16", "gauss"), id="bfloat16-gauss", marks=pytest.mark.slow),
    ],
)


@functools.cache
def network(kind):
    """Returns (the state at step 0, the compiled step) of the small networks."""
    config, (dtype, rule) = smoke_config(), kind
    config.coarse.compute_dtype = config.fine.compute_dtype = dtype
    config.sampling.rule = rule
    model = build_model(config)

    def draw(step, positions, batch):
        keys = jax.vmap(functools.partial(jax.random.fold_in, jax.random.key(0)))(positions)
        return keys, jax.tree.map(lambda leaf: leaf[positions], batch)

    step = jax.jit(make_train_step(model, OPTIMIZER, draw, build_losses({"mse": 1.0})))
    return create_state(model, OPTIMIZER, 0), lambda state, batch: step(state, batch, np.arange(RAYS)[None])


def a_batch(rgb=None, near=2.0, far=6.0):
    """Returns a Batch of random rays and colours, or of one colour."""
    colors = np.random.default_rng(1).uniform(size=(RAYS, 3)) if rgb is None else np.full((RAYS, 3), rgb)
    return jax.tree.map(jnp.asarray, Batch(rays=random_rays(0, (RAYS,), near, far), rgb=np.float32(colors)))


def with_params(state, change):
    """Returns the state with parameters change(name, leaf); a name is "fine/density/bias"."""

    def renamed(path, leaf):
        return change("/".join(key.key for key in path), leaf)

    return dataclasses.replace(state, params=jax.tree_util.tree_map_with_path(renamed, state.params))


def biased(value, layer="density"):
    """Returns a change that sets the bias of a layer in both networks."""
    return lambda name, leaf: jnp.full_like(leaf, value) if name.endswith(f"{layer}/bias") else leaf


def scaled(factor):
    return lambda name, leaf: leaf * factor


HARD = {  # name: (the batch, the change of the parameters)
    "a batch that misses the scene": (a_batch(far=2.0), None),
    "a batch that misses the scene at 0": (a_batch(near=0.0, far=0.0), None),
    "an all-white image": (a_batch(rgb=1.0), None),
    "an all-black image": (a_batch(rgb=0.0), None),
    "opaque everywhere": (a_batch(), biased(1e4)),
    "opaque beyond overflow": (a_batch(), biased(1e38)),
    "empty everywhere": (a_batch(), biased(-1e6)),
    "colours saturated": (a_batch(), biased(1e4, "rgb")),
    "colours saturated at 0": (a_batch(rgb=1.0), biased(-1e4, "rgb")),
    "all parameters 0": (a_batch(), scaled(0.0)),
    "parameters of 1e3": (a_batch(), scaled(1e3)),
    "parameters of 1e6": (a_batch(), scaled(1e6)),
    "white, empty and saturated": (a_batch(rgb=1.0), biased(-1e6)),
    "far = 1e6": (a_batch(far=1e6), None),
}


@each_network
@pytest.mark.parametrize("name", HARD)
def test_loss_and_gradients_are_finite(name, kind):
    batch, change = HARD[name]
    state, step = network(kind)
    state = with_params(state, change) if change else state
    for _ in range(STEPS):
        state, metrics = step(state, batch)
        assert all_finite(metrics), metrics
    assert all_finite(state.params) and int(metrics["nonfinite"]) == 0


@each_network
def test_overflowing_layers_change_nothing(kind):
    """Whether infinities of both signs add up to NaN depends on the order in which the device adds."""
    state, step = network(kind)
    first = with_params(state, scaled(1e15))
    state, metrics = step(first, a_batch())
    if int(metrics["nonfinite"]):
        assert_same(state.params, first.params, rtol=0, atol=0)
    assert all_finite(state.params) and int(metrics["nonfinite"]) == (not all_finite(metrics))


@each_network
def test_batch_that_misses_the_scene_shows_the_background_without_gradient(kind):
    first, step = network(kind)
    batch = a_batch(far=2.0)
    state, metrics = step(first, batch)
    error = float(((1 - batch.rgb) ** 2).mean())
    assert metrics["mse_fine"] == pytest.approx(error, rel=1e-6)
    assert metrics["mse_coarse"] == pytest.approx(error, rel=1e-6)
    assert metrics["grad_norm"] == 0
    assert_same(state.params, first.params, rtol=0, atol=0)


@each_network
@pytest.mark.parametrize("name", ["an all-white image", "white, empty and saturated"])
def test_white_image_over_a_white_background_is_learned(name, kind):
    """Empty space has a loss of 0, with any parameters."""
    batch, change = HARD[name]
    state, step = network(kind)
    state = with_params(state, change) if change else state
    rows = []
    for _ in range(30):
        state, metrics = step(state, batch)
        rows.append(float(metrics["mse_fine"]))
    assert rows[-1] <= 0.5 * rows[0] and rows[-1] < 1e-3


@each_network
@pytest.mark.parametrize(
    "where",
    ["coarse/density/bias", "fine/density/bias", "fine/trunk_0/kernel", "fine/rgb/bias", "a pixel", "a ray"],
)
def test_one_nan_is_counted_and_changes_nothing(where, kind):
    first, step = network(kind)
    batch = a_batch()
    if where == "a pixel":
        batch = Batch(rays=batch.rays, rgb=batch.rgb.at[5, 1].set(jnp.nan))
    elif where == "a ray":
        origins = batch.rays.origins.at[5, 1].set(jnp.nan)
        batch = Batch(rays=dataclasses.replace(batch.rays, origins=origins), rgb=batch.rgb)
    else:
        first = with_params(first, lambda name, leaf: leaf.at[..., 0].set(jnp.nan) if name == where else leaf)
    state, metrics = step(first, batch)
    assert np.isnan(metrics["loss"])
    assert int(metrics["nonfinite"]) == int(metrics["nonfinite_in_a_row"]) == 1
    np.testing.assert_equal(
        jax.tree.map(np.asarray, (state.params, state.opt_state)),
        jax.tree.map(np.asarray, (first.params, first.opt_state)),
    )
