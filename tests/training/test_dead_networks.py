"""Dead networks are detected and reinitialized; healthy runs do not change."""

import dataclasses
import functools
import shutil
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

from helpers import assert_same, random_rays
from jaxnerf import Batch
from jaxnerf.fields.base import Field
from jaxnerf.models.base import Model
from jaxnerf.runtime import devices, stages
from jaxnerf.training import dead_networks, loop, metric_log
from jaxnerf.training.build import build_model
from jaxnerf.training.checkpoint import Checkpoints
from jaxnerf.training.optimizer import with_averaging
from jaxnerf.training.state import create_state
from jaxnerf.training.step import make_train_step
from runs import smoke_config, smoke_experiment
from toys import LOSSES, toy_draw, toy_model, toy_rendering

pytest_plugins = ["run_fixtures"]
pytestmark = pytest.mark.usefixtures("unoptimized")

OPTIMIZER = optax.adam(1e-3)
RAYS = 64
EMPTY, WALL = -1e6, 1e6  # biases of the density


@functools.cache
def network(detect_color=True):
    """Returns (the model of one small network, the state at step 0, the step on a Batch)."""
    config = smoke_config()
    config.sampling.num_fine = 0
    config.fine.use_viewdirs = False
    model = build_model(config)
    if not detect_color:
        model = model._replace(fields={name: field._replace(color_layers=()) for name, field in model.fields.items()})

    def draw(step, positions, batch):
        keys = jax.vmap(functools.partial(jax.random.fold_in, jax.random.key(step)))(positions)
        return keys, jax.tree.map(lambda leaf: leaf[positions], batch)

    step = jax.jit(make_train_step(model, OPTIMIZER, draw, LOSSES))
    state = create_state(model, OPTIMIZER, 1)
    return model, state, lambda state, batch: step(state, batch, jnp.arange(RAYS)[None])


def images(matter=RAYS, noise=0.0):
    """Returns a Batch whose first `matter` rays are grey and the others white with noise."""
    rng = np.random.default_rng(0)
    rgb = np.where(np.arange(RAYS)[:, None] < matter, 0.3, 1.0 - noise * rng.uniform(size=(RAYS, 3)))
    return jax.tree.map(jnp.asarray, Batch(rays=random_rays(0, (RAYS,)), rgb=np.float32(rgb)))


def with_biases(state, **biases):
    """Returns the state with these biases in the layers of its network."""
    fine = dict(state.params["fine"])
    for layer, value in biases.items():
        fine[layer] = {**fine[layer], "bias": jnp.full_like(fine[layer]["bias"], value)}
    return dataclasses.replace(state, params={"fine": fine})


def follow(state, batch, steps=3):
    """Returns the state after some steps, and "dead_fine" of each."""
    counts = []
    for _ in range(steps):
        state, metrics = network()[2](state, batch)
        counts.append(int(metrics["dead_fine"]))
    return state, counts


@pytest.mark.parametrize(
    "biases",
    [{"density": EMPTY}, {"density": WALL, "rgb": 1e4}, {"trunk_1": EMPTY, "density": 1.0}],
    ids=str,
)
def test_empty_image_wall_and_uniform_fog_are_dead(biases):
    assert follow(with_biases(network()[1], **biases), images())[1] == [1, 2, 3]


def test_saturated_color_is_dead_while_density_learns():
    """Black fog in front of white."""
    state = with_biases(network()[1], density=1.0, rgb=-100.0)
    later, counts = follow(state, images())
    assert counts == [1, 2, 3]
    moved = jax.tree.map(lambda a, b: bool((a != b).any()), later.params["fine"], state.params["fine"])
    assert moved["trunk_0"]["kernel"] and not moved["rgb"]["kernel"] and not moved["rgb"]["bias"]


@pytest.mark.slow
def test_detection_of_saturated_color_changes_no_bit():
    states = []
    for detect_color in (True, False):
        _, state, run = network(detect_color)
        for _ in range(30):
            state, metrics = run(state, images())
        states.append(state)
    assert int(metrics["dead_fine"]) == 0
    assert_same(*states, rtol=0, atol=0)


@pytest.mark.parametrize("matter, noise", [(RAYS, 0.0), (2, 0.0), (2, 0.05), (0, 0.5)])
def test_learning_network_is_not_dead(matter, noise):
    """Where few rays show matter, momentum makes the network empty before it finds what is there."""
    counts = follow(network()[1], images(matter, noise), 150)[1]
    assert max(counts) <= (2 if matter == 2 else 0)


@pytest.mark.parametrize("noise", [0.0, 0.05])
def test_batch_without_error_keeps_the_count(noise):
    """An empty network is right about an empty scene."""
    state, counts = follow(with_biases(network()[1], density=EMPTY), images(0, noise), 2)
    assert counts == [0, 0]
    state, counts = follow(state, images(1), 2)
    assert counts == [1, 2]
    assert follow(state, images(0, noise))[1] == [2, 2, 2]


def test_recovered_network_is_not_dead():
    state, counts = follow(with_biases(network()[1], density=EMPTY), images())
    assert counts[-1] == 3
    assert follow(with_biases(state, density=1.0), images())[1] == [0, 0, 0]


def mortal_model():
    """Returns the toy model with a ReLU on its parameters."""
    model = toy_model()

    def render(keys, params, grid, rays, step):
        return model.render(keys, jax.tree.map(jax.nn.relu, params), grid, rays, step)

    return model._replace(render=render)


def killed(state):
    """Returns the state with a dead coarse network, as new arrays."""
    dead = {"w": jnp.full((3, 3), -1.0)}
    return jax.tree.map(jnp.array, dataclasses.replace(state, params={**state.params, "coarse": dead}))


@pytest.mark.parametrize("optimizer", [OPTIMIZER, with_averaging(OPTIMIZER, 10.0)], ids=["last", "averaged"])
def test_reinitialize_replaces_only_the_dead_network(optimizer):
    start = create_state(mortal_model(), optimizer, 0)
    used = jax.tree.map(lambda leaf: leaf + 1, start)
    state = dead_networks.make_reinitialize(mortal_model(), optimizer, 0)(used, ("coarse",))
    assert_same(state.params["fine"], used.params["fine"], rtol=0, atol=0)
    assert np.abs(state.params["coarse"]["w"] - start.params["coarse"]["w"]).max() > 0.1, "drawn from the same key"
    old, new = (jax.tree_util.tree_leaves_with_path(tree.opt_state) for tree in (used, state))
    for (path, before), (_, after) in zip(old, new, strict=True):
        begun = state.params["coarse"]["w"] if "average" in str(path) else jnp.zeros_like(before)
        assert_same(after, begun if "coarse" in str(path) else before, rtol=0, atol=0)
    changed = {name: int(state.counters[name] - used.counters[name]) for name in state.counters}
    assert changed == {**dict.fromkeys(used.counters, 0), "dead_coarse": -1, "num_reinits": 1}


def test_reinitialized_parameters_depend_on_the_step():
    reinitialize = dead_networks.make_reinitialize(mortal_model(), OPTIMIZER, 0)
    start = create_state(mortal_model(), OPTIMIZER, 0)
    draws = [
        reinitialize(dataclasses.replace(start, step=jnp.int32(step)), ("fine",)).params["fine"]["w"]
        for step in (100, 100, 150)
    ]
    assert_same(draws[0], draws[1], rtol=0, atol=0)
    assert np.abs(draws[0] - draws[2]).max() > 0.1


@pytest.mark.parametrize("num_devices", [1, 4])
def test_reinitialization_is_the_same_on_all_devices(num_devices):
    model = mortal_model()
    step = make_train_step(model, OPTIMIZER, toy_draw, LOSSES)
    data = random_rays(0, (16,)), jnp.array([-1])
    run, state, data = devices.compile_step(
        step, killed(create_state(model, OPTIMIZER, 0)), data, batch_size=16, devices=jax.devices()[:num_devices]
    )
    for count in (1, 2):
        state, metrics = run(state, data)
        assert (int(metrics["dead_coarse"]), int(metrics["dead_fine"])) == (count, 0)
    state = dead_networks.make_reinitialize(model, OPTIMIZER, 0)(state, ("coarse",))
    state, metrics = run(state, data)
    assert (int(metrics["dead_coarse"]), int(metrics["num_reinits"])) == (0, 1)
    fresh = model.init(jax.random.fold_in(jax.random.fold_in(jax.random.key(0), 2), 2**32 - 3))["coarse"]["w"]
    assert np.abs(state.params["coarse"]["w"] - fresh).max() < 0.01, "more than one step away from the new parameters"


def train_toy(folder, **options):
    """Trains or resumes the mortal toy in a folder; returns its rows."""
    options = {"max_steps": 240, "lr_steps": 240, "log_every": 20, "save_every": 60, "max_to_keep": 9, **options}
    experiment = smoke_experiment(lr_init=5e-2, **{"batch_size": 16, **options})
    views = experiment.load_split("train")
    data = random_rays(0, (16,)), jnp.array([-1])
    experiment = dataclasses.replace(
        experiment, model=mortal_model(), draw=lambda step, positions, _: toy_draw(step, positions, data)
    )
    if not folder.exists():
        checkpoints = Checkpoints(folder)
        checkpoints.save(killed(toy_state()))
        checkpoints.close()
    assert loop.run_training(experiment, views, folder)
    return metric_log.read_rows(folder)


def toy_state():
    return create_state(mortal_model(), smoke_experiment().optimizer, 0)


@pytest.fixture(scope="module")
def reinitialized(tmp_path_factory):
    folder = tmp_path_factory.mktemp("reinitialized") / "run"
    train_toy(folder)
    return folder


def from_step_60(run, tmp_path):
    """Returns a copy of the run as of step 60, when its network was dead but not yet detected."""
    folder = shutil.copytree(run, tmp_path / "run")
    for step in (120, 180, 240):
        shutil.rmtree(folder / "checkpoints" / str(step))
    return folder


def test_dead_run_is_reinitialized_and_learns(reinitialized):
    rows = metric_log.read_rows(reinitialized)
    assert [row["num_reinits"] for row in rows] == [0] * 4 + [1] * 8
    assert [row["dead_coarse"] for row in rows] == [20, 40, 60, 80] + [0] * 8
    scores = [row["psnr_coarse"] for row in rows]
    assert len(set(scores[:4])) == 1 and scores[5:] == sorted(set(scores[5:]))


@pytest.mark.extra
def test_reinitialized_network_learns():
    model, start, _ = network()
    dead = with_biases(start, density=EMPTY)
    _, metrics = network()[2](dead, images())
    state, counts = follow(dead_networks.make_reinitialize(model, OPTIMIZER, 0)(dead, ("fine",)), images(), 100)
    assert max(counts) == 0
    assert network()[2](state, images())[1]["mse_fine"] < 0.1 * metrics["mse_fine"]


def test_run_resumed_before_the_detection_is_bit_exact(reinitialized, tmp_path):
    folder = from_step_60(reinitialized, tmp_path)
    train_toy(folder, log_every=15)
    whole, parts = (Checkpoints(run).load(240, toy_state()) for run in (reinitialized, folder))
    assert_same(parts, whole, rtol=0, atol=0)


def test_without_reinitialization_a_dead_run_stays_dead_and_reports_it(reinitialized, tmp_path, monkeypatch):
    shown = []
    monkeypatch.setattr(stages.Progress, "show", lambda self, step, text, _: shown.append((step, text)))
    rows = train_toy(from_step_60(reinitialized, tmp_path), max_reinits=0)
    assert (rows[-1]["dead_coarse"], rows[-1]["num_reinits"]) == (240, 0)
    said = [step for step, text in shown if text.endswith("  coarse network dead")]
    assert said == list(range(100, 241, 20))
    assert not any("reinitialized" in text for _, text in shown)


@pytest.mark.slow
def test_healthy_run_is_the_same_with_and_without_reinitialization(tmp_path):
    folders = [tmp_path / "never", tmp_path / "always"]
    for folder, allowed in zip(folders, (0, 10), strict=True):
        checkpoints = Checkpoints(folder)
        checkpoints.save(toy_state())
        checkpoints.close()
        train_toy(folder, max_reinits=allowed)
    never, always = (Checkpoints(folder).load(240, toy_state()) for folder in folders)
    assert int(always.counters["num_reinits"]) == 0
    assert_same(always, never, rtol=0, atol=0)


def test_run_that_keeps_dying_stops_with_advice(tmp_path):
    experiment = smoke_experiment(max_reinits=3)
    check = dead_networks.make_reinitializer(experiment, tmp_path)
    state = SimpleNamespace(counters={"dead_coarse": 100, "dead_fine": 130, "num_reinits": 2})
    assert check(149, state, {}) == (state, {})
    with pytest.raises(ValueError, match="step 150 the coarse and the fine network .* after 2 .*lower train.lr_init"):
        check(150, state, {})


def test_networks_of_any_structure_and_number_are_counted_by_name():
    """Parameters may be any pytree, and the order of the names says nothing about the order of the renderings."""
    grads = {"fine": [jnp.zeros(3)], "coarse": jnp.ones(2), "warp": {"a": jnp.zeros(1)}, "proposal": jnp.zeros(1)}
    counters = {f"dead_{name}": jnp.int32(4) for name in grads}
    errors = {"fine": jnp.float32(0.1), "coarse": jnp.float32(0.1), "warp": jnp.float32(0.0)}
    got = dead_networks.count_dead_steps(counters, grads, errors, {"fine": Field(init=None, apply=None)})
    assert jax.tree.map(int, got) == {"dead_fine": 5, "dead_coarse": 0, "dead_warp": 4}


@pytest.mark.parametrize("num_rays", [16, 4096])
@pytest.mark.parametrize("slope, is_dead", [(1e-6, True), (1e-2, False)])
def test_a_small_gradient_counts_alike_for_any_number_of_rays(num_rays, slope, is_dead):
    def render(keys, params, grid, rays, step):
        return {"fine": toy_rendering(rays.viewdirs + slope * params["fine"]["w"][None])}

    model = Model(lambda key: {"fine": {"w": jnp.zeros(3)}}, render, view=None, scene=None, samples_per_ray=1.0)
    step = jax.jit(make_train_step(model, OPTIMIZER, toy_draw, LOSSES))
    rays, positions = random_rays(0, (num_rays,)), jnp.arange(num_rays)[None]
    state, _ = step(create_state(model, OPTIMIZER, 0), (rays, jnp.array([-1])), positions)
    assert int(state.counters["dead_fine"]) == is_dead
