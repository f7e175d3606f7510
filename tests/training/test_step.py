"""One training step: it descends, sums over microbatches, and skips updates that are not finite."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from helpers import assert_same, random_rays
from jaxnerf.training import compiled_step, loop, metric_log
from jaxnerf.training.checkpoint import Checkpoints
from jaxnerf.training.state import create_state
from jaxnerf.training.step import make_train_step, repeat_step
from runs import smoke_experiment
from toys import LOSSES, OPTIMIZER, run_steps, toy_draw, toy_model


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
        assert row["loss"] == pytest.approx(row["mse_fine"] + row["mse_coarse"], rel=1e-6)


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


def test_too_many_nonfinite_steps_in_a_row_stop_the_run(tmp_path, monkeypatch):
    monkeypatch.setattr(loop, "_MAX_NONFINITE", 3)
    experiment = smoke_experiment(log_every=1, save_every=1)
    views = experiment.load_split("train")
    rays, bad_steps = random_rays(0, (64,)), jnp.arange(2, 20)
    experiment = dataclasses.replace(
        experiment, model=toy_model(), draw=lambda step, positions, data: toy_draw(step, positions, (rays, bad_steps))
    )
    (tmp_path / "run").mkdir()
    with pytest.raises(ValueError, match="3 steps in a row up to 5 is not finite .*train.lr_init") as caught:
        loop.run_training(experiment, views, tmp_path / "run")
    assert str(tmp_path / "run") in str(caught.value)
    assert Checkpoints(tmp_path / "run").steps() == [2, 3, 4]


@pytest.mark.parametrize("num_devices", [1, 4])
def test_steps_of_one_dispatch_are_the_same_bit_for_bit(num_devices):
    model, data = toy_model(), (random_rays(0, (16,)), jnp.array([3]))
    step, options = make_train_step(model, OPTIMIZER, toy_draw, LOSSES), {"batch_size": 16, "num_devices": num_devices}
    single, rows = run_steps(step, create_state(model, OPTIMIZER, 0), data, 6, **options)
    several, dispatches = run_steps(repeat_step(step, 3), create_state(model, OPTIMIZER, 0), data, 2, **options)
    assert_same(several, single, rtol=0, atol=0)
    for name in rows[0]:
        whole = np.concatenate([metrics[name] for metrics in dispatches])
        np.testing.assert_array_equal(whole, [row[name] for row in rows])


def test_a_run_of_several_steps_a_dispatch_logs_and_saves_at_the_same_steps(tmp_path, monkeypatch):
    rows, states = [], []
    for count in (1, 4):
        monkeypatch.setattr(compiled_step, "steps_per_dispatch", lambda *_, count=count: count)
        experiment = smoke_experiment(log_every=5, save_every=10, max_steps=23, max_reinits=0)
        views, rays = experiment.load_split("train"), random_rays(0, (64,))
        experiment = dataclasses.replace(
            experiment,
            model=toy_model(),
            draw=lambda step, positions, _, rays=rays: toy_draw(step, positions, (rays, jnp.array([7]))),
        )
        folder = tmp_path / str(count)
        folder.mkdir()
        assert loop.run_training(experiment, views, folder)
        state = create_state(experiment.model, experiment.optimizer, 0)
        states.append([jax.device_get(Checkpoints(folder).load(step, state)) for step in Checkpoints(folder).steps()])
        timed = ("seconds", "compile_seconds", "rays_per_second")
        rows.append([{k: v for k, v in row.items() if k not in timed} for row in metric_log.read_rows(folder)])
    assert [row["step"] for row in rows[0]] == [5, 10, 15, 20, 23] and [int(s.step) for s in states[0]] == [10, 20, 23]
    assert rows[1] == rows[0]
    assert_same(states[1], states[0], rtol=0, atol=0)
