"""Muon and averaged parameters: which parameters they change, by how much, and how they are saved."""

import dataclasses
import json

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

from helpers import assert_same
from jaxnerf.evaluation.evaluate import train_and_evaluate
from jaxnerf.evaluation.restore import restore_run
from jaxnerf.models.base import Model
from jaxnerf.training import dead_networks
from jaxnerf.training.build import build
from jaxnerf.training.checkpoint import Checkpoints
from jaxnerf.training.optimizer import OptimizerOptions, averaged_params, make_optimizer, with_averaging
from jaxnerf.training.state import TrainState, create_state
from runs import smoke_config

pytest_plugins = ["run_fixtures"]
RATE, SIZE = 0.01, 0.4
ADAM = optax.adam(0.1, 0.9, 0.99)


def optimizer(**train):
    numbers = {"lr_init": RATE, "lr_final": RATE, "beta2": 0.9, "epsilon": 1e-12, "muon": SIZE, **train}
    return make_optimizer(OptimizerOptions(**numbers))[0]


def network(key):
    """Returns parameters of the kinds that fields have: matrices, a bias, thin outputs, and a table."""
    shapes = {"kernel": (24, 16), "bias": (16,), "rgb": {"kernel": (16, 3)}, "deep": {"kernel": (16, 16)}}
    shapes["table"] = (64, 8)
    leaves, structure = jax.tree.flatten(shapes, is_leaf=lambda shape: isinstance(shape, tuple))
    keys = jax.random.split(key, len(leaves))
    return jax.tree.unflatten(structure, map(jax.random.normal, keys, leaves))


def slopes(seed):
    """Returns a gradient whose matrices are steep along one direction and all but flat along the others."""
    grads = network(jax.random.key(seed))
    for part in (grads, grads["deep"]):
        left, sizes, right = jnp.linalg.svd(part["kernel"], full_matrices=False)
        part["kernel"] = left @ jnp.diag(0.4 ** jnp.arange(sizes.size)) @ right
    return {"fine": grads}


def test_muon_moves_a_matrix_equally_far_in_each_direction():
    params = {"fine": network(jax.random.key(0))}
    update = optimizer()
    nothing = jax.tree.map(jnp.zeros_like, params)  # does not decay
    step = jax.jit(update.update)(slopes(1), update.init(params), nothing)[0]["fine"]
    for kernel in (step["kernel"], step["deep"]["kernel"]):
        sizes = np.linalg.svd(kernel, compute_uv=False) / (RATE * SIZE * max(kernel.shape) ** 0.5)
        # The gradient's singular values range from 1 to 1e-6. Muon's five iterations bring those above 0.01
        # into the range from 0.6 to 1.3.
        assert ((sizes[:5] > 0.6) & (sizes[:5] < 1.3)).all(), sizes
        assert np.sqrt(np.mean(kernel**2)) < 1.3 * RATE * SIZE


@pytest.mark.parametrize("power", [0.0, 10.0])
def test_adamw_updates_all_other_parameters(power):
    start = {"fine": network(jax.random.key(0))}
    ends = []
    for update in (optimizer(averaging_power=power), optax.adamw(RATE, 0.9, 0.9, 1e-12, weight_decay=0.05)):
        params, state, move = start, update.init(start), jax.jit(update.update)
        for seed in range(3):
            updates, state = move(slopes(seed), state, params)
            params = optax.apply_updates(params, updates)
        ends.append(params["fine"])
    for name in ("bias", "rgb", "table"):
        assert_same(ends[0][name], ends[1][name], rtol=1e-6, atol=1e-7)
    assert np.abs(ends[0]["kernel"] - ends[1]["kernel"]).max() > RATE / 10


@pytest.mark.parametrize("muon, decay", [(SIZE, 0.05), (0.0, 0.0)])
def test_the_table_may_have_no_first_moment(muon, decay):
    """It is then updated by AdamW with beta1 = 0, and all other parameters as before."""
    start, ends = {"fine": network(jax.random.key(0))}, []
    without = optax.adamw(RATE, 0.0, 0.9, 1e-12, weight_decay=decay)
    updates = optimizer(muon=muon), optimizer(muon=muon, table_momentum=False), without
    for update in updates:
        params, state, move = start, update.init(start), jax.jit(update.update)
        for seed in range(3):
            changes, state = move(slopes(seed), state, params)
            params = optax.apply_updates(params, changes)
        ends.append((params["fine"], state))
    (usual, full), (found, state), (expected, _) = ends
    assert_same(found["table"], expected["table"], rtol=1e-5, atol=1e-6)
    assert np.abs(found["table"] - usual["table"]).max() > RATE / 10
    assert_same({**found, "table": 0}, {**usual, "table": 0}, rtol=0, atol=0)
    tables = [[leaf for leaf in jax.tree.leaves(each) if leaf.shape == (64, 8)] for each in (full, state)]
    assert [len(each) for each in tables] == [2, 1]


def test_muon_of_all_matrices_together_is_that_of_each(monkeypatch):
    start, ends = {"fine": network(jax.random.key(0))}, []
    for backend in ("cpu", "gpu"):
        monkeypatch.setattr(jax, "default_backend", lambda backend=backend: backend)
        update = optimizer()
        params, state = start, update.init(start)
        for seed in range(3):
            grads = {"fine": network(jax.random.key(seed))}
            updates, state = jax.jit(update.update)(grads, state, params)
            params = optax.apply_updates(params, updates)
        ends.append((params, state))
    assert jax.tree.structure(ends[0]) == jax.tree.structure(ends[1])  # so a run goes on, on another device
    assert_same(*ends, rtol=1e-4, atol=1e-6)


@pytest.mark.parametrize("muon, least", [(SIZE, 0.04 * RATE), (0.0, 0.0)])
def test_parameters_decay_with_muon_and_not_with_adam_alone(muon, least):
    params = {"fine": network(jax.random.key(0))}
    update = optimizer(muon=muon)
    step, _ = update.update(jax.tree.map(jnp.zeros_like, params), update.init(params), params)
    for change, start in zip(jax.tree.leaves(step), jax.tree.leaves(params), strict=True):
        decay = -np.asarray(change) / np.asarray(start)
        np.testing.assert_allclose(decay, decay.mean(), rtol=1e-3)
        assert (decay.mean() > least) if muon else not decay.any()


@pytest.mark.parametrize("size", [0.2, 0.6])
def test_a_steady_gradient_moves_matrices_only_to_a_bound(size):
    """The bound is the same for all sizes of the updates."""
    update = optimizer(muon=size)
    grads = slopes(1)
    nothing = jax.tree.map(jnp.zeros_like, grads)
    move = jax.jit(update.update)
    direction = move(grads, update.init(nothing), nothing)[0]["fine"]["kernel"] / (RATE * size)  # RMS about 1
    for scale, grows in ((2.0, True), (4.5, False)):
        params = {"fine": {**nothing["fine"], "kernel": scale * direction}}
        step = move(grads, update.init(params), params)[0]["fine"]["kernel"]
        assert (float(jnp.vdot(step, direction)) > 0) == grows


def test_reinitialization_resets_the_moments():
    def init(key):
        return {"coarse": network(key), "fine": network(jax.random.fold_in(key, 1))}

    model = Model(init, None, view=None, scene=None, samples_per_ray=1.0, image_networks=("coarse", "fine"))
    update = optimizer(averaging_power=10.0)
    start = create_state(model, update, 0)
    used = jax.tree.map(lambda leaf: leaf + 1, start)
    state = dead_networks.make_reinitialize(model, update, 0)(used, ("coarse",))
    old, new = (dict(jax.tree_util.tree_leaves_with_path(tree.opt_state)) for tree in (used, state))
    begun = dict(jax.tree_util.tree_leaves_with_path(update.init(state.params)))
    moments = [path for path in new if "coarse" in str(path)]
    assert len(moments) >= 3 * 5 - 2, "an average and one or two moments of each of five arrays"
    for path, found in new.items():
        assert_same(found, (begun if path in moments else old)[path], rtol=0, atol=0)


def test_state_is_restored_from_a_checkpoint(tmp_path):
    """This includes the masks that stand for parameters of the other optimizer. Rendering reads a part of it."""
    params = {"fine": network(jax.random.key(0))}
    update = optimizer(averaging_power=10.0)
    _, moved = update.update(slopes(1), update.init(params), params)
    counters = {"nonfinite": jnp.zeros((), jnp.int32)}
    state = TrainState(step=jnp.int32(1), params=params, opt_state=moved, grid=None, counters=counters)
    checkpoints = Checkpoints(tmp_path)
    checkpoints.save(state)
    like = jax.tree.map(jnp.zeros_like, state)
    assert_same(checkpoints.load(1, like), state, rtol=0, atol=0)
    read = {"fine": moved.average["fine"]}, None
    rendered = {"fine": like.params["fine"]}, None
    assert_same(checkpoints.load_rendered(1, rendered, averaged=True), read, rtol=0, atol=0)
    for others in ({"fine": like.params["fine"], "coarse": like.params["fine"]}, {"fine": {}}):
        with pytest.raises(ValueError, match="checkpoints/1: cannot be read"):
            checkpoints.load_rendered(1, (others, None), averaged=True)
    others = dataclasses.replace(like, params=jax.tree.map(lambda leaf: jnp.zeros(7), like.params))
    with pytest.raises(ValueError, match="checkpoints/1: cannot be read"):
        checkpoints.load(1, others)
    metadata = tmp_path / "checkpoints" / "1" / "_CHECKPOINT_METADATA"
    content = json.loads(metadata.read_text())
    content["custom_metadata"]["fingerprint_of_rendered"] = content["custom_metadata"]["fingerprint"]
    metadata.write_text(json.dumps(content))
    with pytest.raises(ValueError, match="checkpoints/1: .*its numbers are not those that were saved"):
        checkpoints.load_rendered(1, rendered, averaged=True)


def test_negative_size_is_an_error():
    with pytest.raises(ValueError, match=r"train.muon is -0.2, expected at least 0"):
        build(smoke_config(muon=-0.2))


def descend(optimizer, steps=40):
    """Returns the parameters after each step towards a moving minimum, and the optimizer's last state."""
    params = {"a": jnp.float32([3.0, -2.0]), "b": jnp.float32(1.0)}
    state, params_of_steps = optimizer.init(params), []

    @jax.jit
    def take(step, params, state):
        grads = jax.tree.map(lambda leaf: leaf - jnp.sin(step / 3), params)
        updates, state = optimizer.update(grads, state, params)
        return optax.apply_updates(params, updates), state

    for step in range(steps):
        params, state = take(step, params, state)
        params_of_steps.append(params)
    return params_of_steps, state


@pytest.mark.parametrize("power", [1.0, 10.0])
def test_average_has_the_weights_of_polynomial_decay(power):
    params_of_steps, state = descend(with_averaging(ADAM, power))
    fractions = [(power + 1) / (power + count) for count in range(1, len(params_of_steps) + 1)]
    weights = np.float64(
        [fraction * np.prod(1 - np.float64(fractions[i + 1 :])) for i, fraction in enumerate(fractions)]
    )
    assert abs(weights.sum() - 1) < 1e-12
    # About (s / t)^power, from the step on at which the two differ by no more than rounding in power / s.
    rough = (np.arange(1, len(params_of_steps) + 1) + power / 2) ** power
    assert np.abs(weights - rough / rough.sum()).max() < 0.1 * weights.max()
    expected = jax.tree.map(lambda *leaves: np.tensordot(weights, np.float64(leaves), 1), *params_of_steps)
    assert_same(state.average, expected, rtol=0, atol=1e-6)


@pytest.mark.parametrize("dtype", ["bfloat16", "float16"])
def test_the_average_has_the_type_of_the_parameters(dtype):
    params = {"a": jnp.ones(3, dtype)}
    optimizer = with_averaging(ADAM, 10.0)
    _, state = jax.jit(optimizer.update)(params, optimizer.init(params), params)
    assert state.average["a"].dtype == dtype and jnp.isfinite(state.average["a"]).all()


def test_later_every_eighth_step_counts_for_eight():
    _, state = descend(with_averaging(ADAM, 10.0), steps=261)
    assert_same(state.average, descend(with_averaging(ADAM, 10.0), steps=256)[1].average, rtol=0, atol=0)
    params_of_steps, state = descend(with_averaging(ADAM, 10.0), steps=270)
    expected = params_of_steps[0]
    for count in range(1, 265):
        new = params_of_steps[count - 1 if count <= 256 else 263]
        expected = jax.tree.map(lambda old, new, count=count: old + 11 / (10 + count) * (new - old), expected, new)
    assert_same(state.average, expected, rtol=0, atol=1e-6)


def test_first_average_equals_the_parameters():
    params_of_steps, state = descend(with_averaging(ADAM, 10.0), steps=1)
    assert_same(state.average, params_of_steps[0], rtol=0, atol=1e-7)


def test_averaging_does_not_change_the_updates():
    (averaging, state), (plain, expected) = descend(with_averaging(ADAM, 10.0)), descend(ADAM)
    assert_same(averaging, plain, rtol=0, atol=0)
    assert_same(state.inner, expected, rtol=0, atol=0)


def last_state(params_of_steps, opt_state):
    step = jnp.int32(len(params_of_steps))
    return TrainState(step=step, params=params_of_steps[-1], opt_state=opt_state, grid=None, counters={})


def test_averaged_params_returns_the_average_or_the_last_parameters():
    params_of_steps, state = descend(with_averaging(ADAM, 10.0))
    _, plain = descend(ADAM)
    assert averaged_params(last_state(params_of_steps, state)) is state.average
    assert averaged_params(last_state(params_of_steps, plain)) is params_of_steps[-1]


@pytest.mark.slow
def test_run_renders_its_average(unoptimized, tmp_path):
    config = smoke_config(averaging_power=10.0, max_steps=8)
    config.sampling.num_fine = 0  # one network compiles faster
    config.fine.depth = 1
    assert train_and_evaluate(config, tmp_path)
    run = restore_run(tmp_path)
    experiment = build(run.experiment.config)
    like = create_state(experiment.model, experiment.optimizer, experiment.config.seed)
    state = Checkpoints(tmp_path).load(8, like)
    params, _ = run.variables(8)
    assert_same(params, state.opt_state.average, rtol=0, atol=0)
    moved = jax.tree.map(lambda a, b: np.abs(a - b).max(), params, state.params)
    assert max(jax.tree.leaves(moved)) > 1e-4


def test_negative_power_is_an_error():
    config = smoke_config()
    config.train.averaging_power = -1.0
    with pytest.raises(ValueError, match=r"train.averaging_power is -1.0, expected at least 0"):
        build(config)
