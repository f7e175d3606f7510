"""jit on one device, sharded jit and pmap on four: the same run."""

import dataclasses
import functools
import re

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

from helpers import assert_same, random_rays
from jaxnerf.runtime import cores, devices, memory
from jaxnerf.training.build import build
from jaxnerf.training.state import create_state
from jaxnerf.training.step import TrainData, make_train_step
from runs import smoke_config, smoke_experiment
from toys import LOSSES, OPTIMIZER, run_steps, toy_draw, toy_model

pytest_plugins = ["run_fixtures"]


@pytest.fixture(scope="module")
def experiment():
    assert jax.local_device_count() == 4
    return smoke_experiment()


@pytest.fixture(scope="module")
def views(experiment):
    return experiment.load_split("train")


@pytest.fixture(scope="module")
def runs(unoptimized, experiment, views):
    """Ten steps of configs/smoke.py on one device and on four."""
    model, optimizer = experiment.model, experiment.optimizer
    step = make_train_step(model, optimizer, experiment.draw, experiment.losses)
    return {
        count: run_steps(
            step,
            create_state(model, optimizer, 0),
            TrainData(np.uint32(0), views, None, None),
            10,
            count,
            batch_size=64,
        )
        for count in (1, 4)
    }


def test_ten_steps_end_in_the_same_parameters(runs):
    (one, one_rows), (many, many_rows) = runs[1], runs[4]
    start = create_state(smoke_experiment().model, optax.adam(1e-3), 0).params
    moved = jax.tree.map(lambda a, b: np.abs(a - b).max(), one.params, start)
    assert min(jax.tree.leaves(moved)) > 1e-4, "the comparison needs parameters that moved"
    assert_same(many.params, one.params, rtol=0, atol=1e-6)
    assert int(many.step) == 10
    for row, many_row in zip(one_rows, many_rows, strict=True):
        assert_same(many_row, row, rtol=1e-4)


@pytest.mark.slow
@pytest.mark.parametrize("microbatch_size", [4, 2])
def test_gradient_is_a_mean_over_devices(microbatch_size):
    """SGD's update is proportional to the gradient, which Adam would hide."""
    optimizer = optax.sgd(0.1)
    step = make_train_step(toy_model(), optimizer, toy_draw, LOSSES)
    data = random_rays(0, (16,)), jnp.array([-1])
    states = {}
    for count in (1, 4):
        state = create_state(toy_model(), optimizer, 0)
        states[count], rows = run_steps(step, state, data, 3, count, batch_size=16, microbatch_size=microbatch_size)
    assert rows[0]["loss"] > 2 * rows[2]["loss"] or rows[0]["grad_norm"] > 0.1
    assert_same(states[4], states[1], rtol=1e-6, atol=1e-6)


def test_the_step_runs_under_pmap():
    """Its sums run over the axis of any transformation that names one."""
    optimizer, data = optax.sgd(0.1), (random_rays(0, (16,)), jnp.array([-1]))
    step = make_train_step(toy_model(), optimizer, toy_draw, LOSSES)
    pmapped = jax.pmap(functools.partial(step, axis_name="batch"), "batch", in_axes=(None, None, 0), out_axes=None)
    state, metrics = pmapped(create_state(toy_model(), optimizer, 0), data, devices.split_positions(16, 4))
    start = create_state(toy_model(), optimizer, 0)
    expected, (row,) = run_steps(step, start, data, 1, 4, batch_size=16)
    assert_same((state, metrics), (expected, row), rtol=1e-6, atol=1e-6)


def test_batch_is_the_same_on_any_number_of_devices(experiment, views):
    def probe(state, data, positions, *, axis_name=None):
        keys, batch = experiment.draw(state["step"], positions.reshape(-1), data)
        seen = {"key": jax.random.key_data(keys), "rgb": batch.rgb, "rays": batch.rays}
        gather = lambda leaf: jax.lax.all_gather(leaf, axis_name, tiled=True)  # noqa: E731
        return state, jax.tree.map(gather, seen) if axis_name else seen

    state = {"step": jnp.int32(3)}
    data = TrainData(np.uint32(0), views, None, None)
    _, (seen,) = run_steps(probe, state, data, 1, 4, batch_size=64, microbatch_size=8)
    keys, batch = jax.jit(experiment.draw)(3, jnp.arange(64), data)
    np.testing.assert_array_equal(seen["key"], jax.random.key_data(keys))
    assert_same((seen["rgb"], seen["rays"]), (batch.rgb, batch.rays))


@pytest.mark.parametrize(
    "batch_size, num_devices, microbatch_size",
    [(10, 4, None), (3, 4, None), (0, 1, None), (16, 4, 3), (64, 1, 48), (-4, 4, None), (16, 4, 0)],
)
def test_uneven_split_is_an_error(batch_size, num_devices, microbatch_size):
    with pytest.raises(
        ValueError, match=f"batch_size {batch_size} does not split evenly over {num_devices} .*change train.batch_size"
    ):
        devices.split_positions(batch_size, num_devices, microbatch_size)


def test_every_position_in_the_batch_occurs_once():
    positions = devices.split_positions(48, 4, 6)
    assert positions.shape == (4, 2, 6)
    np.testing.assert_array_equal(positions.ravel(), np.arange(48))


def test_uneven_batch_is_an_error():
    step = make_train_step(toy_model(), optax.sgd(0.1), toy_draw, LOSSES)
    state = create_state(toy_model(), optax.sgd(0.1), 0)
    with pytest.raises(ValueError, match="batch_size 30 does not split evenly over 4 device"):
        devices.compile_step(step, state, None, batch_size=30)


def test_the_compiled_step_sums_the_gradient_and_four_numbers():
    model = toy_model()
    step = make_train_step(model, optax.sgd(0.1), toy_draw, LOSSES)
    state = create_state(model, optax.sgd(0.1), 0)
    data = random_rays(0, (16,)), jnp.array([-1])
    run, _, _ = devices.compile_step(step, state, data, batch_size=16)
    sums = re.findall(r"= (.*?) all-reduce(?:-start)?\(", run.compiled.as_text())
    shapes = [shape for each in sums for shape in re.findall(r"\w+\[([\d,]*)\]", each)]
    assert sum(np.prod([int(side) for side in shape.split(",") if side]) for shape in shapes) == 2 * 9 + 4


@pytest.mark.parametrize("count", [2, 3])  # in one program, and by threads of the host
def test_threads_have_a_part_of_the_rays_each(count):
    model, data = toy_model(), (random_rays(0, (24,)), jnp.array([2]))
    step = make_train_step(model, OPTIMIZER, toy_draw, LOSSES)
    options = {"batch_size": 24, "microbatch_size": 12}
    one, one_rows = run_steps(step, create_state(model, OPTIMIZER, 0), data, 4, 1, **options)
    options["num_threads"] = count
    runs = [run_steps(step, create_state(model, OPTIMIZER, 0), data, 4, 1, **options) for _ in range(2)]
    assert_same(runs[0], runs[1], rtol=0, atol=0)
    several, rows = runs[0]
    assert_same(several, one, rtol=1e-5, atol=1e-6)
    for row, one_row in zip(rows, one_rows, strict=True):
        assert_same(row, one_row, rtol=1e-5)
    assert int(several.counters["nonfinite"]) == 1


def test_memory_of_a_step_on_threads_is_that_of_all(monkeypatch):
    model, data = toy_model(), (random_rays(0, (24,)), jnp.array([2]))
    step, state = make_train_step(model, OPTIMIZER, toy_draw, LOSSES), create_state(model, OPTIMIZER, 0)
    few, many = (
        devices.compile_step(step, state, data, batch_size=24, devices=jax.devices()[:1], num_threads=count)[0].compiled
        for count in (2, 6)
    )
    assert few.memory_analysis().output_size_in_bytes < many.memory_analysis().output_size_in_bytes
    monkeypatch.setattr(memory, "available", lambda: 100)
    with pytest.raises(memory.OutOfMemory):
        memory.check(many)


def test_threads_of_a_step_are_cores_that_split_its_pixels(monkeypatch):
    monkeypatch.setattr(cores, "usable", lambda: 6)
    assert devices.threads_of_step(1024) == 1  # there are several devices
    monkeypatch.setattr(jax, "device_count", lambda: 1)
    assert [devices.threads_of_step(count) for count in (1, 7, 64, 1020)] == [1, 1, 4, 6]
    monkeypatch.setattr(cores, "usable", lambda: 64)
    assert devices.threads_of_step(1024) == 8
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    assert devices.threads_of_step(1024) == 1


def test_seed_does_not_change_the_program():
    texts, drawn = [], []
    for seed in (0, 1):
        config = smoke_config()
        config.seed = seed
        experiment = dataclasses.replace(build(config), model=toy_model())
        _, data = experiment.prepare(experiment.load_split("train"))
        state = jax.eval_shape(lambda: create_state(experiment.model, experiment.optimizer, 0))  # noqa: B023
        step = make_train_step(experiment.model, experiment.optimizer, experiment.draw, LOSSES)
        texts.append(jax.jit(step).lower(state, data, np.arange(64)[None]).as_text())
        drawn.append(np.asarray(jax.jit(experiment.pixel_ids)(0, np.arange(64), data)))
    assert texts[0] == texts[1] and (drawn[0] != drawn[1]).mean() > 0.9
