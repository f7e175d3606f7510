"""One training step: it descends, sums over microbatches, and skips updates that are not finite."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from helpers import assert_same, random_rays
from jaxnerf.training import loop
from jaxnerf.training.checkpoint import Checkpoints
from jaxnerf.training.state import create_state
from jaxnerf.training.step import make_train_step
from runs import smoke_experiment
from toys import LOSSES, OPTIMIZER, toy_draw, toy_model


def run_toy(num_steps, *, num_microbatches=1, bad_steps=(-1,), model=None):
    """Returns the state before and after some steps on 16 rays, and each step's metrics."""
    model = model or toy_model()
    state = first = create_state(model, OPTIMIZER, 0)
    step = jax.jit(make_train_step(model, OPTIMIZER, toy_draw, LOSSES))
    data, rows = (random_rays(0, (16,)), jnp.array(bad_steps)), []
    for _ in range(num_steps):
        state, metrics = step(state, data, jnp.arange(16).reshape(num_microbatches, -1))
        rows.append({name: float(value) for name, value in metrics.items()})
    return first, state, rows


def test_loss_decreases_and_is_the_sum_of_both_networks():
    _, state, rows = run_toy(100)
    assert rows[-1]["loss"] < 0.01 * rows[0]["loss"]
    assert int(state.step) == 100
    for row in rows:
        assert row["loss"] == pytest.approx(row["mse"] + row["mse_coarse"], rel=1e-6)


@pytest.mark.parametrize("num_microbatches", [2, 8])
def test_microbatches_sum_to_the_whole_batch(num_microbatches):
    _, whole, rows = run_toy(5)
    _, parts, part_rows = run_toy(5, num_microbatches=num_microbatches)
    assert_same(parts, whole, rtol=1e-6, atol=1e-6)
    for row, part_row in zip(rows, part_rows, strict=True):
        assert row == pytest.approx(part_row, rel=1e-5)


def test_nonfinite_step_changes_nothing_and_is_counted():
    _, before, _ = run_toy(2)
    _, after, rows = run_toy(3, bad_steps=(2,))
    assert np.isnan(rows[-1]["loss"])
    assert_same((after.params, after.opt_state), (before.params, before.opt_state), rtol=0, atol=0)
    assert int(after.step) == 3
    _, state, rows = run_toy(6, bad_steps=(0, 2, 3))
    assert [row["nonfinite"] for row in rows] == [1, 1, 2, 3, 3, 3]
    assert [row["nonfinite_in_a_row"] for row in rows] == [1, 0, 1, 2, 0, 0]
    assert np.isfinite(rows[-1]["loss"])


def test_nonfinite_gradient_with_a_finite_loss_is_counted():
    model = toy_model(lambda params: jnp.sqrt(0 * params["fine"]["w"]).sum())  # 0, and its gradient is 0 * inf
    first, state, rows = run_toy(2, model=model)
    assert np.isfinite(rows[0]["loss"]) and not np.isfinite(rows[0]["grad_norm"])
    assert_same((state.params, state.opt_state), (first.params, first.opt_state), rtol=0, atol=0)
    assert rows[-1]["nonfinite_in_a_row"] == 2


def test_too_many_nonfinite_steps_in_a_row_stop_the_run(tmp_path):
    experiment = smoke_experiment(log_every=1, save_every=1, max_nonfinite=3)
    views = experiment.load_split("train")
    rays, bad_steps = random_rays(0, (64,)), jnp.arange(2, 20)
    experiment = experiment._replace(
        model=toy_model(), draw=lambda step, positions, data: toy_draw(step, positions, (rays, bad_steps))
    )
    (tmp_path / "run").mkdir()
    with pytest.raises(ValueError, match="3 steps in a row up to 5 is not finite .*train.lr_init") as caught:
        loop.run_training(experiment, views, tmp_path / "run")
    assert str(tmp_path / "run") in str(caught.value)
    assert Checkpoints(tmp_path / "run").steps() == [2, 3, 4]
