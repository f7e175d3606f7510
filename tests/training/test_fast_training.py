"""Training with an occupancy grid: it learns, occlusion does no harm, and it resumes bit for bit."""

import dataclasses
import functools
import inspect

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

from helpers import all_finite, assert_same, compiled, rays_past_origin
from jaxnerf import Batch, load_scene, render_samples
from jaxnerf.configs import default
from jaxnerf.core.occupancy.ray_marching import march_rays
from jaxnerf.data import synthetic
from jaxnerf.evaluation.evaluate import train_and_evaluate
from jaxnerf.fields.base import Field
from jaxnerf.fields.hash_grid import from_options
from jaxnerf.models import occupancy as occupancy_module
from jaxnerf.models.base import ViewOptions
from jaxnerf.models.grid_schedule import InitialCells, make_grid_schedule
from jaxnerf.models.occupancy import OccupancyOptions, occupancy_model
from jaxnerf.runtime import processes
from jaxnerf.training import loop
from jaxnerf.training.auto_config import device_fields, resolve, resolve_for_device
from jaxnerf.training.build import build
from jaxnerf.training.checkpoint import Checkpoints
from jaxnerf.training.config import auto_fields, changed
from jaxnerf.training.state import create_state
from jaxnerf.training.step import TrainData, make_train_step
from jaxnerf.training.workdir import load_config
from runs import smoke_config
from toys import run_steps

pytest_plugins = ["run_fixtures"]

BATCH, STEPS, SIZE = 192, 250, 24
NEVER, EARLY = 10**9, 20  # training steps from which samples that the grid estimates to be occluded are masked
SEEDS, COMPARED = range(10), range(3)


def tiny_config():
    """Returns a hash grid of one small level on the embedded scene."""
    config = default.get_config()
    config.data.size, config.field, config.sampler = SIZE, "hash_grid", "occupancy"
    config.occupancy.update({"step_size": 0.1, "update_every": 16})
    config.hash_grid.update({"resolutions": (16,), "table_size": 2**12, "view_width": 16})
    train = config.train
    train.batch_size, train.lr_steps, train.warmup_steps = BATCH, STEPS, 10
    train.lr_init, train.lr_final, train.beta2, train.epsilon = 2e-2, 2e-3, 0.99, 1e-15
    train.muon = 0.15  # times this learning rate it is as large as in lego_fast.py
    config.eval.summary_seconds = 0.0
    return config


class Tiny:
    """Runs of tiny_config that differ in their seed and occlusion, by one compiled function."""

    def __init__(self):
        views, test = (synthetic.load_synthetic(size=SIZE, split=split) for split in ("train", "test"))
        config = resolve_for_device(resolve(tiny_config(), views).config)[0]
        self.experiment = experiment = build(config)
        self.field = from_options(config.hash_grid, (config.scene.lower, config.scene.upper))
        self.cells, data = experiment.prepare(views)
        self.data = jax.tree.map(jnp.asarray, data)
        self.train = jax.jit(self._train)
        pixels = np.moveaxis(np.indices((SIZE, SIZE)), 0, -1)[..., ::-1] + np.float32(0.5)

        @compiled
        def error(params, grid):
            """Returns the mean squared error of three test views."""
            rays, truth = [], []
            for index in (0, 3, 6):
                rays.append(experiment.view_rays(test, index, pixels))
                truth.append(test.image(index))
            rendering = experiment.model.view(params, grid, jax.tree.map(lambda *x: jnp.stack(x), *rays))
            return ((rendering.rgb - jnp.stack(truth)) ** 2).mean()

        self.error = error

    def _train(self, data, seed, occlusion_start_step, treated):
        """Trains; treated: whether occluded rays show no background, as in _over_background."""
        experiment = self.experiment
        # Without the check of its types: a traced occlusion_start_step lets all runs share one compiled function.
        model = inspect.unwrap(occupancy_model)(
            self.field,
            experiment.model.grid_schedule,
            OccupancyOptions(
                pool_samples_per_ray=16,
                uniform_fraction=1.0,
                max_optical_depth=3.0,  # a transmittance of 5 %
                occlusion_start_step=occlusion_start_step,
            ),
            ViewOptions(early_stop_eps=0.0, max_samples=1),
            background=(1.0, 1.0, 1.0),
        )
        over_background = occupancy_module._over_background

        def draw(step, positions, data):
            return experiment.draw(step + 1000 * seed, positions, data)

        def maybe_treated(rendering, occluded, background):
            return over_background(rendering, occluded & treated, background)

        state = create_state(model, experiment.optimizer, seed, self.cells)
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(occupancy_module, "_over_background", maybe_treated)
            step = make_train_step(model, experiment.optimizer, draw, experiment.losses)
            positions = jnp.arange(BATCH)[None]
            return jax.lax.scan(lambda state, _: step(state, data, positions), state, length=STEPS)

    @functools.cache  # noqa: B019
    def run(self, seed, occlusion_start_step, treated=True):
        """Returns the last state, and metrics [STEPS]."""
        return self.train(self.data, seed, occlusion_start_step, treated)

    def score(self, state):
        """Returns the PSNR of test views."""
        return -10 * np.log10(self.error(state.params, state.grid))

    def scores(self, seeds, *how):
        return np.array([self.score(self.run(seed, *how)[0]) for seed in seeds])


@pytest.fixture(scope="module")
def tiny():
    return Tiny()


@pytest.mark.slow
def test_it_learns(tiny):
    state, metrics = tiny.run(0, NEVER)
    mse = np.asarray(metrics["mse_fine"])
    assert mse[:5].mean() > 0.06 and mse[-30:].mean() < 0.0075
    assert tiny.score(state) > 21.5
    assert all_finite((state.params, metrics)) and int(state.counters["nonfinite"]) == 0
    rays_dropped = BATCH - np.asarray(metrics["rays"])
    np.testing.assert_array_equal(metrics["rays_dropped"], rays_dropped.cumsum())
    assert rays_dropped.mean() < 0.05 * BATCH


@pytest.mark.slow
def test_empty_cells_hold_no_matter(tiny):
    """Images with all valid cells occupied are no better."""
    state, _ = tiny.run(0, NEVER)
    occupied, valid = np.asarray(state.grid.occupied), np.asarray(state.grid.valid)
    np.testing.assert_array_equal(valid, tiny.cells.valid)
    assert not (occupied & ~valid).any() and occupied.sum() < 0.98 * valid.sum()
    everywhere = dataclasses.replace(state, grid=dataclasses.replace(state.grid, occupied=state.grid.valid))
    assert abs(tiny.score(everywhere) - tiny.score(state)) < 0.1


@pytest.mark.extra
def test_early_occlusion_costs_little_as_occluded_rays_do_not_show_the_background(tiny):
    """An estimate that hides matter which has not formed yet must not prevent it from forming.

    If occluded rays showed the background, everything in front of the first masked sample would have to become
    opaque at once, and the estimate would then hide more. This costs several decibels.
    """
    expected = tiny.scores(COMPARED, NEVER)
    ours = tiny.scores(COMPARED, EARLY)
    untreated = tiny.scores(COMPARED, EARLY, False)
    assert (expected - ours).mean() < 1.2
    assert (expected - untreated).mean() > 1.5
    assert (ours - untreated > 0.8).all()


@pytest.mark.extra
def test_no_seed_collapses(tiny):
    scores = tiny.scores(SEEDS, EARLY)
    assert scores.min() > 20.5 and np.ptp(scores) < 3, scores


def test_without_a_grid_the_step_has_no_state_for_it():
    experiment = build(smoke_config())
    state = jax.eval_shape(functools.partial(create_state, experiment.model, experiment.optimizer, 0))
    assert experiment.model.grid_schedule is None and state.grid is None
    assert set(state.counters) == {
        "nonfinite",
        "nonfinite_in_a_row",
        "num_reinits",
        "dead_coarse",
        "dead_fine",
    }
    views = experiment.load_split("train")
    cells, data = experiment.prepare(views)
    assert cells is None and data.active_pixels is None and data.cells is None
    step = make_train_step(experiment.model, experiment.optimizer, experiment.draw, experiment.losses)
    after, metrics = jax.eval_shape(step, state, data, jnp.arange(64)[None])
    assert jax.tree.structure(after) == jax.tree.structure(state)
    assert "rays_dropped" not in metrics and after.grid is None


def toy_field():
    """Returns a Gaussian ball with a colour gradient, which compiles fast."""

    def init(key):
        return {"size": jnp.full(3, 2.0), "rgb": 0.1 * jax.random.normal(key, (3, 3))}

    def apply(params, x, viewdirs):
        parts = [x[..., axis] for axis in range(3)]
        distance = sum((part * params["size"][axis]) ** 2 for axis, part in enumerate(parts))
        rgb = [sum(part * params["rgb"][axis, c] for axis, part in enumerate(parts)) for c in range(3)]
        return 4 * jnp.exp(-distance), jax.nn.sigmoid(jnp.stack(rgb, axis=-1))

    return Field(init, apply)


@pytest.fixture(scope="module")
def toy():
    """An Experiment of the toy field, 64 rays per step in microbatches of 16, whose sample buffer is far too small."""
    config = tiny_config()
    config.occupancy.update({"lower": (-1.5,) * 3, "upper": (1.5,) * 3, "resolution": 8})
    train = config.train
    train.batch_size, train.microbatch_size = 64, 16
    train.log_every, train.save_every, train.max_steps = 3, 6, 12
    views = synthetic.load_synthetic(size=SIZE)
    experiment, field = build(resolve_for_device(resolve(config, views).config)[0]), toy_field()
    schedule = make_grid_schedule(
        config.scene.lower,
        config.scene.upper,
        resolution=8,
        step_size=0.5,
        field=field,
        threshold=0.01,
        update_every=2,
        cells_per_update=300,
        initial_passes=4,
    )
    model = occupancy_model(
        field,
        schedule,
        OccupancyOptions(pool_samples_per_ray=1, uniform_fraction=1.0, max_optical_depth=1.0, occlusion_start_step=8),
        ViewOptions(early_stop_eps=0.0, max_samples=1),
        background=(1.0, 1.0, 1.0),
    )
    rays = jax.tree.map(jnp.asarray, rays_past_origin(0, 64))

    def draw(step, positions, data):
        order = jax.random.permutation(jax.random.fold_in(jax.random.key(1), step), 64)
        keys = jax.vmap(lambda place: jax.random.fold_in(jax.random.key(2), 64 * step + place))(positions)
        drawn = jax.tree.map(lambda leaf: leaf[order[positions]], data.active_pixels)
        return keys, Batch(rays=drawn, rgb=0.5 + 0.5 * drawn.viewdirs)

    cells = np.arange(512, dtype=np.int32)
    return dataclasses.replace(
        experiment,
        model=model,
        optimizer=optax.adam(1e-2),
        draw=draw,
        prepare=lambda views: (
            InitialCells(np.ones(schedule.shape, bool)),
            TrainData(np.uint32(0), views, rays, cells),
        ),
    )


@pytest.fixture(scope="module")
def toy_runs(unoptimized, toy):
    """Twelve steps on one device and on four."""
    views = toy.load_split("train")
    cells, data = toy.prepare(views)
    step = make_train_step(toy.model, toy.optimizer, toy.draw, toy.losses)
    return {
        count: run_steps(
            step,
            create_state(toy.model, toy.optimizer, 0, cells),
            data,
            12,
            count,
            batch_size=64,
            microbatch_size=16,
        )
        for count in (1, 4)
    }


@pytest.mark.slow
def test_devices_give_the_same_update_grid_and_counts(toy_runs, toy):
    (one, one_rows), (many, many_rows) = toy_runs[1], toy_runs[4]
    start = create_state(toy.model, toy.optimizer, 0)
    moved = jax.tree.map(lambda a, b: np.abs(a - b).max(), one.params, start.params)
    assert min(jax.tree.leaves(moved)) > 1e-3, "the comparison needs parameters that moved"
    assert 0 < one.grid.occupied.mean() < 1
    assert_same(many.params, one.params, rtol=0, atol=1e-5)
    assert_same(many.grid, one.grid, rtol=1e-4, atol=1e-5)
    for name in ("rays_dropped", "rays", "nonfinite"):
        assert [int(row[name]) for row in many_rows] == [int(row[name]) for row in one_rows], name
    for row, many_row in zip(one_rows, many_rows, strict=True):
        assert_same(many_row, row, rtol=1e-3)


@pytest.mark.slow
def test_small_sample_buffer_drops_no_ray(toy_runs):
    state, rows = toy_runs[1]
    assert all_finite((state.params, rows)) and int(state.counters["nonfinite"]) == 0
    assert [row["rays"] for row in rows] == [64] * len(rows)
    assert int(state.counters["rays_dropped"]) == 0


def test_resumed_run_is_bit_exact_with_its_grid(toy, unoptimized, tmp_path):
    """Steps 6 to 12 include updates of the grid and the first step with occlusion."""
    views, template = toy.load_split("train"), create_state(toy.model, toy.optimizer, 0)

    def train(folder, max_steps):
        folder.mkdir(exist_ok=True)
        config = changed(toy.config, {"train.max_steps": max_steps})
        assert loop.run_training(dataclasses.replace(toy, config=config), views, folder)
        return jax.device_get(Checkpoints(folder).load(max_steps, template))

    whole = train(tmp_path / "whole", 12)
    half = train(tmp_path / "parts", 6)
    parts = train(tmp_path / "parts", 12)
    jax.tree.map(np.testing.assert_array_equal, parts, whole)
    assert (half.grid.density_mean != whole.grid.density_mean).any() and (
        half.grid.occupied != whole.grid.occupied
    ).any()


@pytest.mark.extra
def test_workdir_restores_the_scene_and_its_images(unoptimized, tmp_path, capsys, monkeypatch):
    """The config has "auto" sizes, and only the workdir is known afterwards."""
    monkeypatch.setattr(processes, "prints_details", lambda: True)
    config = tiny_config()
    config.field, config.occupancy.step_size = "mlp", "auto"
    config.fine.update({"depth": 1, "width": 8, "num_freqs": "auto", "view_width": 8})
    config.fine.update({"density_activation": "softplus", "density_bias": 1.0})
    config.train.update({"batch_size": 64, "max_steps": 20, "log_every": 10})
    assert train_and_evaluate(config, tmp_path)
    said = capsys.readouterr().err
    assert all(word in said for word in ("box ", "step size ", "grid ", "octaves ", "valid"))
    recorded = load_config(tmp_path)
    assert set(auto_fields(recorded)) <= set(device_fields(recorded)) and recorded.fine.num_freqs > 0
    scene, render = load_scene(tmp_path)
    schedule, rays = build(resolve_for_device(recorded)[0]).model.grid_schedule, rays_past_origin(0, 256)

    @compiled
    def reference_images(rays):
        box = schedule.create(jnp.ones(schedule.shape, bool))
        samples = march_rays(None, box, rays, step_size=schedule.step_size, cell=schedule.cell)
        return render_samples(scene, rays, samples, background=(1.0, 1.0, 1.0))

    found, expected = render(rays), reference_images(rays)
    assert 0.05 < expected.opacity.mean() < 0.95 and expected.opacity.min() == 0
    np.testing.assert_allclose(found.rgb, expected.rgb, atol=1.1e-3)  # eval.early_stop_eps is 1e-3
    np.testing.assert_allclose(jax.jit(render)(rays).rgb, found.rgb, atol=1e-6)  # traced, so without chunks
