"""One training step: it descends, adds up blocks, and leaves out what is not finite."""

import types

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

from helpers import assert_same, random_rays
from jaxnerf import Batch
from jaxnerf.training import loop
from jaxnerf.training.build import build
from jaxnerf.training.checkpoint import Checkpoints
from jaxnerf.training.state import create_state
from jaxnerf.training.step import make_train_step
from runs import smoke_config

OPTIMIZER = optax.adam(0.1)


def toy_model(trouble=lambda params: 0.0):
    """Colours linear in the direction; two renderings as a hierarchy has. trouble is added to them."""

    def render(keys, params, grid, rays, step):
        colours = [rays.viewdirs @ params[name]["w"] + trouble(params) for name in ("coarse", "fine")]
        whole = jnp.zeros(rays.near.shape, jnp.int32)
        return tuple(types.SimpleNamespace(rgb=rgb, num_dropped=whole) for rgb in colours)

    def init(key):
        return {name: {"w": jax.random.normal(key, (3, 3))} for name in ("coarse", "fine")}

    return types.SimpleNamespace(init=init, render=render, grid_schedule=None, input_layers={})


def toy_draw(step, positions, data):
    """The rays at the positions; their colours are NaN at the steps that data names."""
    rays, bad_steps = data
    rays = jax.tree.map(lambda leaf: jnp.asarray(leaf)[positions], rays)
    rgb = rays.viewdirs @ jnp.array([[0.1, 0.2, 0.3], [0.3, 0.1, 0.0], [0.0, 0.4, 0.2]])
    return None, Batch(rays=rays, rgb=jnp.where((bad_steps == step).any(), jnp.nan, rgb))


def run_toy(num_steps, *, blocks=1, bad_steps=(-1,), model=None):
    """Returns the state before and after some steps on 16 rays, and each step's metrics."""
    model = model or toy_model()
    state = first = create_state(model, OPTIMIZER, 0)
    step = jax.jit(make_train_step(model, OPTIMIZER, toy_draw))
    data, rows = (random_rays(0, (16,)), jnp.array(bad_steps)), []
    for _ in range(num_steps):
        state, metrics = step(state, data, jnp.arange(16).reshape(blocks, -1))
        rows.append({name: float(value) for name, value in metrics.items()})
    return first, state, rows


def test_the_loss_falls_and_is_the_sum_of_both_networks():
    _, state, rows = run_toy(100)
    assert rows[-1]["loss"] < 0.01 * rows[0]["loss"]
    assert int(state.step) == 100
    for row in rows:
        assert row["loss"] == pytest.approx(row["mse"] + row["mse_coarse"], rel=1e-6)


@pytest.mark.parametrize("blocks", [2, 8])
def test_blocks_add_up_to_the_whole_batch(blocks):
    _, whole, rows = run_toy(5)
    _, parts, part_rows = run_toy(5, blocks=blocks)
    assert_same(parts, whole, rtol=1e-6, atol=1e-6)
    for row, part_row in zip(rows, part_rows, strict=True):
        assert row == pytest.approx(part_row, rel=1e-5)


def test_a_step_that_is_not_finite_changes_nothing_and_is_counted():
    _, before, _ = run_toy(2)
    _, after, rows = run_toy(3, bad_steps=(2,))
    assert np.isnan(rows[-1]["loss"])
    assert_same((after.params, after.opt_state), (before.params, before.opt_state), rtol=0, atol=0)
    assert int(after.step) == 3
    _, state, rows = run_toy(6, bad_steps=(0, 2, 3))
    assert [row["nonfinite"] for row in rows] == [1, 1, 2, 3, 3, 3]
    assert [row["nonfinite_in_a_row"] for row in rows] == [1, 0, 1, 2, 0, 0]
    assert np.isfinite(rows[-1]["loss"])


def test_a_gradient_that_is_not_finite_counts_too():
    model = toy_model(lambda params: jnp.sqrt(0 * params["fine"]["w"]).sum())  # 0, with a slope of 0 * inf
    first, state, rows = run_toy(2, model=model)
    assert np.isfinite(rows[0]["loss"]) and not np.isfinite(rows[0]["grad_norm"])
    assert_same((state.params, state.opt_state), (first.params, first.opt_state), rtol=0, atol=0)
    assert rows[-1]["nonfinite_in_a_row"] == 2


def test_too_many_in_a_row_stop_the_run(tmp_path):
    config = smoke_config(log_every=1, save_every=1, max_nonfinite=3)
    experiment = build(config)
    views = experiment.load_views("train")
    rays, bad_steps = random_rays(0, (64,)), jnp.arange(2, 20)
    experiment = experiment._replace(
        model=toy_model(), draw=lambda step, positions, data: toy_draw(step, positions, (rays, bad_steps))
    )
    (tmp_path / "run").mkdir()
    with pytest.raises(ValueError, match="3 steps in a row up to 5 .* not finite .*train.lr_init") as caught:
        loop.train(experiment, views, tmp_path / "run")
    assert str(tmp_path / "run") in str(caught.value)
    assert Checkpoints(tmp_path / "run").steps() == [2, 3, 4]
