"""Averaged parameters are those of polynomial decay, leave training as it is, and are what is rendered."""

import types

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

from helpers import assert_same
from jaxnerf.evaluation.evaluate import train_and_evaluate
from jaxnerf.evaluation.restore import restore_run
from jaxnerf.training.averaging import averaged_params, with_averaging
from jaxnerf.training.build import build
from jaxnerf.training.checkpoint import Checkpoints
from jaxnerf.training.state import create_state
from runs import smoke_config

pytest_plugins = ["run_fixtures"]
pytestmark = pytest.mark.usefixtures("unoptimized")
ADAM = optax.adam(0.1, 0.9, 0.99)


def descend(optimizer, steps=40):
    """Returns the parameters after each step down a valley that moves, and the optimiser's last state."""
    params = {"a": jnp.float32([3.0, -2.0]), "b": jnp.float32(1.0)}
    state, passed = optimizer.init(params), []
    for step in range(steps):
        grads = jax.tree.map(lambda leaf, step=step: leaf - jnp.sin(step / 3), params)
        updates, state = optimizer.update(grads, state, params)
        params = optax.apply_updates(params, updates)
        passed.append(params)
    return passed, state


@pytest.mark.parametrize("power", [1.0, 10.0])
def test_the_average_has_the_weights_of_polynomial_decay(power):
    passed, state = descend(with_averaging(ADAM, power))
    shares = [(power + 1) / (power + count) for count in range(1, len(passed) + 1)]
    weights = np.float64([share * np.prod(1 - np.float64(shares[i + 1 :])) for i, share in enumerate(shares)])
    assert abs(weights.sum() - 1) < 1e-12
    # About (s / t)^power, from the step on at which the two differ by no more than rounding in power / s.
    rough = (np.arange(1, len(passed) + 1) + power / 2) ** power
    assert np.abs(weights - rough / rough.sum()).max() < 0.1 * weights.max()
    wanted = jax.tree.map(lambda *leaves: np.tensordot(weights, np.float64(leaves), 1), *passed)
    assert_same(state.average, wanted, rtol=0, atol=1e-6)


def test_the_first_average_is_the_parameters():
    passed, state = descend(with_averaging(ADAM, 10.0), steps=1)
    assert_same(state.average, passed[0], rtol=0, atol=1e-7)


def test_descent_is_as_without():
    (averaging, state), (plain, wanted) = descend(with_averaging(ADAM, 10.0)), descend(ADAM)
    assert_same(averaging, plain, rtol=0, atol=0)
    assert_same(state.inner, wanted, rtol=0, atol=0)


def test_averaged_parameters_are_rendered_where_there_are_such():
    passed, state = descend(with_averaging(ADAM, 10.0))
    _, plain = descend(ADAM)
    assert averaged_params(types.SimpleNamespace(params=passed[-1], opt_state=state)) is state.average
    assert averaged_params(types.SimpleNamespace(params=passed[-1], opt_state=plain)) is passed[-1]


def test_a_run_renders_its_average(compiled_once, tmp_path):
    config = smoke_config(averaging_power=10.0)
    config.sampling.num_fine = 0  # one network is soon compiled
    assert train_and_evaluate(config, tmp_path)
    run = restore_run(tmp_path)
    like = create_state(run.experiment.model, run.experiment.optimizer, run.experiment.seed)
    state = Checkpoints(tmp_path).load(20, like)
    params, _ = run.weights(20)
    assert_same(params, state.opt_state.average, rtol=0, atol=0)
    moved = jax.tree.map(lambda a, b: np.abs(a - b).max(), params, state.params)
    assert max(jax.tree.leaves(moved)) > 1e-4


def test_a_power_below_0_is_refused():
    config = smoke_config()
    config.train.averaging_power = -1.0
    with pytest.raises(ValueError, match=r"train.averaging_power is -1.0, wanted more than 0"):
        build(config)
