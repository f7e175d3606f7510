"""With train.muon a matrix moves as far in each of its directions, and everything else as Adam moves it."""

import types

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

from helpers import assert_same
from jaxnerf.training import dead_networks
from jaxnerf.training.build import build
from jaxnerf.training.checkpoint import Checkpoints
from jaxnerf.training.optimizer import make_optimizer
from jaxnerf.training.state import TrainState, create_state
from runs import smoke_config

RATE, SIZE = 0.01, 0.4


def optimizer(**train):
    numbers = {"lr_init": RATE, "lr_final": RATE, "beta2": 0.9, "epsilon": 1e-12, "muon": SIZE, **train}
    return make_optimizer(smoke_config(**numbers).train)[0]


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


def test_a_matrix_moves_as_far_in_each_direction_however_steep():
    params = {"fine": network(jax.random.key(0))}
    update = optimizer()
    step = jax.jit(update.update)(slopes(1), update.init(params), params)[0]["fine"]
    for kernel in (step["kernel"], step["deep"]["kernel"]):
        sizes = np.linalg.svd(kernel, compute_uv=False) / (RATE * SIZE * max(kernel.shape) ** 0.5)
        # The gradient's own go from 1 to 1e-6. Muon's five iterations, which are made to be few, bring those
        # that are not below a hundredth to between 0.6 and 1.3.
        assert ((sizes[:5] > 0.6) & (sizes[:5] < 1.3)).all(), sizes
        assert np.sqrt(np.mean(kernel**2)) < 1.3 * RATE * SIZE


@pytest.mark.parametrize("power", [0.0, 10.0])
def test_all_else_is_left_to_adam(power):
    start = {"fine": network(jax.random.key(0))}
    ends = []
    for update in (optimizer(averaging_power=power), optimizer(muon=0.0)):
        params, state, move = start, update.init(start), jax.jit(update.update)
        for seed in range(3):
            updates, state = move(slopes(seed), state, params)
            params = optax.apply_updates(params, updates)
        ends.append(params["fine"])
    for name in ("bias", "rgb", "table"):
        assert_same(ends[0][name], ends[1][name], rtol=0, atol=0)
    assert np.abs(ends[0]["kernel"] - ends[1]["kernel"]).max() > RATE / 10


def test_a_matrix_without_a_gradient_stays():
    params = {"fine": network(jax.random.key(0))}
    update = optimizer()
    step, _ = update.update(jax.tree.map(jnp.zeros_like, params), update.init(params), params)
    assert_same(step, jax.tree.map(jnp.zeros_like, params), rtol=0, atol=0)


def test_it_forgets_what_begins_anew():
    model = types.SimpleNamespace(
        init=lambda key: {"coarse": network(key), "fine": network(jax.random.fold_in(key, 1))},
        schedule=None,
        input_layers={},
    )
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


def test_its_state_comes_back_from_a_checkpoint(tmp_path):
    """Also what stands for parameters that the other part moves."""
    params = {"fine": network(jax.random.key(0))}
    update = optimizer(averaging_power=10.0)
    _, moved = update.update(slopes(1), update.init(params), params)
    counters = {"nonfinite": jnp.zeros((), jnp.int32)}
    state = TrainState(step=jnp.int32(1), params=params, opt_state=moved, grid=None, counters=counters)
    checkpoints = Checkpoints(tmp_path)
    checkpoints.save(state)
    like = jax.tree.map(jnp.zeros_like, state)
    assert_same(checkpoints.load(1, like), state, rtol=0, atol=0)


def test_a_size_below_0_is_refused():
    with pytest.raises(ValueError, match=r"train.muon is -0.2, wanted more than 0, or 0 for none"):
        build(smoke_config(muon=-0.2))
