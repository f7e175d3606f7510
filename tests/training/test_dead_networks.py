"""Networks that die are found and begun anew; all others train as if nobody had looked."""

import dataclasses
import functools
import shutil
import types

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from test_step import toy_draw, toy_model

from helpers import assert_same, random_rays
from jaxnerf import Batch
from jaxnerf.runtime import devices
from jaxnerf.training import dead_networks, loop, metric_log
from jaxnerf.training.averaging import with_averaging
from jaxnerf.training.build import build, build_model
from jaxnerf.training.checkpoint import Checkpoints
from jaxnerf.training.state import create_state
from jaxnerf.training.step import make_train_step
from runs import smoke_config
from studies import study

OPTIMIZER = optax.adam(1e-3)
RAYS = 64
EMPTY, WALL = -1e6, 1e6  # biases of the density


@functools.cache
def network():
    """Returns (the model of one small network, the state at step 0, the step on a Batch)."""
    config = smoke_config()
    config.sampling.num_fine = 0
    config.fine.use_viewdirs = False
    model = build_model(config)

    def draw(step, positions, batch):
        keys = jax.vmap(functools.partial(jax.random.fold_in, jax.random.key(step)))(positions)
        return keys, jax.tree.map(lambda leaf: leaf[positions], batch)

    step = jax.jit(make_train_step(model, OPTIMIZER, draw))
    state = create_state(model, OPTIMIZER, 1)
    return model, state, lambda state, batch: step(state, batch, jnp.arange(RAYS)[None])


def photographs(matter=RAYS, noise=0.0):
    """Returns a Batch of grey rays, as many as given, before white; the rest is white, with noise."""
    rng = np.random.default_rng(0)
    rgb = np.where(np.arange(RAYS)[:, None] < matter, 0.3, 1.0 - noise * rng.uniform(size=(RAYS, 3)))
    return jax.tree.map(jnp.asarray, Batch(rays=random_rays(0, (RAYS,)), rgb=np.float32(rgb)))


def with_biases(state, **biases):
    """Returns the state whose network's layers have these biases."""
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
def test_an_empty_image_a_wall_and_a_fog_of_one_colour_are_dead(biases):
    assert follow(with_biases(network()[1], **biases), photographs())[1] == [1, 2, 3]


@pytest.mark.parametrize("matter, noise", [(RAYS, 0.0), (2, 0.0), (2, 0.05), (0, 0.5)])
def test_a_network_that_learns_is_not(matter, noise):
    """Where few rays show matter, momentum makes the network empty before it finds what is there."""
    counts = follow(network()[1], photographs(matter, noise), 150)[1]
    assert max(counts) <= (2 if matter == 2 else 0)


@pytest.mark.parametrize("noise", [0.0, 0.05])
def test_a_batch_of_background_says_nothing(noise):
    """An empty network before an empty scene is right; what was counted before stays."""
    state, counts = follow(with_biases(network()[1], density=EMPTY), photographs(0, noise), 2)
    assert counts == [0, 0]
    state, counts = follow(state, photographs(1), 2)
    assert counts == [1, 2]
    assert follow(state, photographs(0, noise))[1] == [2, 2, 2]


def test_what_comes_back_is_not_dead():
    state, counts = follow(with_biases(network()[1], density=EMPTY), photographs())
    assert counts[-1] == 3
    assert follow(with_biases(state, density=1.0), photographs())[1] == [0, 0, 0]


def mortal_model():
    """The toy of test_step, whose networks have weights of which only those above 0 count."""
    model = toy_model()

    def render(keys, params, grid, rays, step):
        return model.render(keys, jax.tree.map(jax.nn.relu, params), grid, rays, step)

    return types.SimpleNamespace(**{**vars(model), "render": render})


def killed(state):
    """Returns the state with a coarse network of which nothing counts, as new arrays."""
    dead = {"w": jnp.full((3, 3), -1.0)}
    return jax.tree.map(jnp.array, dataclasses.replace(state, params={**state.params, "coarse": dead}))


@pytest.mark.parametrize("optimizer", [OPTIMIZER, with_averaging(OPTIMIZER, 10.0)], ids=["last", "averaged"])
def test_what_begins_anew_is_new_and_the_rest_stays(optimizer):
    start = create_state(mortal_model(), optimizer, 0)
    used = jax.tree.map(lambda leaf: leaf + 1, start)
    state = dead_networks.make_reinitialize(mortal_model(), optimizer, 0)(used, ("coarse",))
    assert_same(state.params["fine"], used.params["fine"], rtol=0, atol=0)
    assert np.abs(state.params["coarse"]["w"] - start.params["coarse"]["w"]).max() > 0.1, "it would die again"
    old, new = (jax.tree_util.tree_leaves_with_path(tree.opt_state) for tree in (used, state))
    for (path, before), (_, after) in zip(old, new, strict=True):
        begun = state.params["coarse"]["w"] if "average" in str(path) else jnp.zeros_like(before)
        assert_same(after, begun if "coarse" in str(path) else before, rtol=0, atol=0)
    changed = {name: int(state.counters[name] - used.counters[name]) for name in state.counters}
    assert changed == {**dict.fromkeys(used.counters, 0), "dead_coarse": -1, "num_reinits": 1}


def test_it_begins_anew_at_another_place_at_another_step():
    revive = dead_networks.make_reinitialize(mortal_model(), OPTIMIZER, 0)
    start = create_state(mortal_model(), OPTIMIZER, 0)
    draws = [
        revive(dataclasses.replace(start, step=jnp.int32(step)), ("fine",)).params["fine"]["w"]
        for step in (100, 100, 150)
    ]
    assert_same(draws[0], draws[1], rtol=0, atol=0)
    assert np.abs(draws[0] - draws[2]).max() > 0.1


@pytest.mark.parametrize("mode", ["jit", "sharded", "pmap"])
def test_it_is_found_and_begins_anew_on_all_devices_alike(mode):
    model = mortal_model()
    step = make_train_step(model, OPTIMIZER, toy_draw)
    data = random_rays(0, (16,)), jnp.array([-1])
    run, state, data = devices.compile_step(
        step, killed(create_state(model, OPTIMIZER, 0)), data, batch_size=16, mode=mode
    )
    for count in (1, 2):
        state, metrics = run(state, data)
        assert (int(metrics["dead_coarse"]), int(metrics["dead_fine"])) == (count, 0)
    state = dead_networks.make_reinitialize(model, OPTIMIZER, 0)(state, ("coarse",))
    state, metrics = run(state, data)
    assert (int(metrics["dead_coarse"]), int(metrics["num_reinits"])) == (0, 1)
    fresh = model.init(jax.random.fold_in(jax.random.fold_in(jax.random.key(0), 2), 2**32 - 3))["coarse"]["w"]
    assert np.abs(state.params["coarse"]["w"] - fresh).max() < 0.01, "further than a step from where it begins"


def train_toy(folder, **options):
    """Trains the mortal toy in the loop, from where folder is; returns its rows."""
    options = {"max_steps": 240, "lr_steps": 240, "log_every": 20, "save_every": 60, "keep": 9, **options}
    experiment = build(smoke_config(lr_init=5e-2, **{"batch_size": 16, **options}))
    views = experiment.load_views("train")
    data = random_rays(0, (16,)), jnp.array([-1])
    experiment = experiment._replace(
        model=mortal_model(), draw=lambda step, positions, _: toy_draw(step, positions, data)
    )
    if not folder.exists():
        checkpoints = Checkpoints(folder)
        checkpoints.save(killed(toy_state()))
        checkpoints.close()
    assert loop.train(experiment, views, folder)
    return metric_log.read_rows(folder)


def toy_state():
    return create_state(mortal_model(), build(smoke_config()).optimizer, 0)


@pytest.fixture(scope="module")
def num_reinits(tmp_path_factory):
    folder = tmp_path_factory.mktemp("num_reinits") / "run"
    train_toy(folder)
    return folder


def from_step_60(num_reinits, tmp_path):
    """Returns a copy of the run as it was at step 60, when its network was dead but not found yet."""
    folder = shutil.copytree(num_reinits, tmp_path / "run")
    for step in (120, 180, 240):
        shutil.rmtree(folder / "checkpoints" / str(step))
    return folder


def columns(folder, *names):
    return [tuple(row[name] for name in names) for row in metric_log.read_rows(folder)]


def test_a_dead_run_is_found_and_learns(num_reinits):
    rows = metric_log.read_rows(num_reinits)
    assert [row["num_reinits"] for row in rows] == [0] * 4 + [1] * 8
    assert [row["dead_coarse"] for row in rows] == [20, 40, 60, 80] + [0] * 8
    scores = [row["psnr_coarse"] for row in rows]
    assert len(set(scores[:4])) == 1 and scores[5:] == sorted(set(scores[5:]))


def test_what_begins_anew_learns():
    model, start, _ = network()
    dead = with_biases(start, density=EMPTY)
    _, metrics = network()[2](dead, photographs())
    state, counts = follow(dead_networks.make_reinitialize(model, OPTIMIZER, 0)(dead, ("fine",)), photographs(), 100)
    assert max(counts) == 0
    assert network()[2](state, photographs())[1]["mse"] < 0.1 * metrics["mse"]


def test_a_run_stopped_before_it_was_found_goes_on_bit_for_bit(num_reinits, tmp_path):
    folder = from_step_60(num_reinits, tmp_path)
    train_toy(folder, log_every=15)
    whole, parts = (Checkpoints(run).load(240, toy_state()) for run in (num_reinits, folder))
    assert_same(parts, whole, rtol=0, atol=0)


def test_without_it_a_dead_run_stays_dead_and_says_so(num_reinits, tmp_path, monkeypatch):
    shown = []
    monkeypatch.setattr(metric_log.Progress, "show", lambda self, step, text: shown.append((step, text)))
    rows = train_toy(from_step_60(num_reinits, tmp_path), revive=0)
    assert (rows[-1]["dead_coarse"], rows[-1]["num_reinits"]) == (240, 0)
    said = [step for step, text in shown if text.endswith("  coarse network dead")]
    assert said == list(range(100, 241, 20))
    assert not any("begun anew" in text for _, text in shown)


def test_a_healthy_run_is_the_same_with_and_without_it(tmp_path):
    folders = [tmp_path / "never", tmp_path / "always"]
    for folder, allowed in zip(folders, (0, 10), strict=True):
        checkpoints = Checkpoints(folder)
        checkpoints.save(toy_state())
        checkpoints.close()
        train_toy(folder, revive=allowed)
    never, always = (Checkpoints(folder).load(240, toy_state()) for folder in folders)
    assert int(always.counters["num_reinits"]) == 0
    assert_same(always, never, rtol=0, atol=0)


def test_a_run_that_keeps_dying_stops_and_says_what_to_do(tmp_path):
    experiment = build(smoke_config(revive=3))
    look = dead_networks.make_reinitializer(experiment, tmp_path)
    metrics = {"dead_coarse": 100, "dead_fine": 130, "num_reinits": 2}
    assert look(149, None, metrics) == (None, metrics)
    with pytest.raises(ValueError, match="coarse and the fine network .* up to 150, after 2 .*lower train.lr_init"):
        look(150, None, metrics)


def test_checkpoints_from_before_the_counters_are_read(tmp_path):
    state = toy_state()
    old = {name: state.counters[name] + 1 for name in ("nonfinite", "nonfinite_in_a_row")}
    checkpoints = Checkpoints(tmp_path)
    checkpoints.save(dataclasses.replace(state, counters=old))
    read = checkpoints.load(0, state)
    checkpoints.close()
    assert {name: int(value) for name, value in read.counters.items()} == {
        "nonfinite": 1,
        "nonfinite_in_a_row": 1,
        "num_reinits": 0,
        "dead_coarse": 0,
        "dead_fine": 0,
    }
    assert_same(read.params, state.params, rtol=0, atol=0)


def test_the_study_counts_what_died_what_was_saved_and_what_stayed_the_same():
    collapse = study("collapse")
    row = {"dead": (), "num_reinits": 0, "found": [], "psnr": 20.0, "parameters": "a"}
    rows = [row | {"revive": allowed, "seed": seed} for seed in range(3) for allowed in (0, 10)]
    rows[0] |= {"dead": ("fine",), "psnr": 8.0}
    rows[1] |= {"num_reinits": 2, "found": [100, 150], "psnr": 17.0, "parameters": "b"}
    without, num_reinits = map(collapse.summary, collapse.both(rows))
    assert without == ("0", "3", "1", "0 times in 0 runs", "-", "20.00 dB", "8.00 dB")
    assert num_reinits == (
        "10",
        "3",
        "0",
        "2 times in 1 runs",
        "125 (first 100, last 150)",
        "20.00 dB",
        "17.00 dB",
    )
    assert collapse.same(rows).startswith("Of 2 runs in which no network died, 2 end with the same")
    rows[3]["parameters"] = "c"
    assert collapse.same(rows).startswith("Of 2 runs in which no network died, 1 end with the same")
