"""What runs on an accelerator, checked without one: it lowers for CUDA, TPU and ROCm, and never visits the host."""

import functools
import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import export

from jaxnerf import create_grid, pixel_grid
from jaxnerf.core.occupancy.ray_culling import rays_may_hit
from jaxnerf.data import synthetic
from jaxnerf.models.occupancy import render_with_grid
from jaxnerf.runtime import devices
from jaxnerf.training import auto_config, build, optimizer
from jaxnerf.training.state import create_state
from jaxnerf.training.step import make_train_step, repeat_step
from runs import PACKED, smoke_config

PLATFORMS = ("cuda", "rocm", "tpu")
# Threefry has kernels of its own on GPUs.
ALLOWED_CALLS = {"cu_threefry2x32", "cu_threefry2x32_ffi", "hip_threefry2x32", "hip_threefry2x32_ffi"}
NUM_STEPS = 2
CELL = (0.25, 0.25, 0.25)


@pytest.fixture(scope="module")
def views():
    return synthetic.load_synthetic(size=24)


def experiment_of(views, sampler, platform="gpu", **fields):
    """Returns the Experiment of a small run with the sizes that do not depend on its images as on an accelerator."""
    config = smoke_config()
    if sampler == "occupancy":
        config.update_from_flattened_dict(PACKED)
    config.update_from_flattened_dict(fields)
    resolved = auto_config.resolve(config, views).config
    return build.build(auto_config.resolve_for_device(resolved, platform)[0])


def train_step(views, platform="gpu", **fields):
    """Returns the training step with an occupancy grid, and its arguments: state, data and positions."""
    experiment = experiment_of(views, "occupancy", platform, **fields)
    cells, data = experiment.prepare(views)
    state = create_state(experiment.model, experiment.optimizer, experiment.config.seed, cells)
    step = make_train_step(experiment.model, experiment.optimizer, experiment.draw, experiment.losses)
    return step, (state, data, jnp.arange(experiment.config.train.batch_size)[None])


def image(views, sampler):
    """Returns the function that renders rays for evaluation, and its arguments."""
    experiment = experiment_of(views, sampler)
    state = jax.eval_shape(lambda: create_state(experiment.model, experiment.optimizer, experiment.config.seed))
    rays = experiment.view_rays(views, 0, pixel_grid(4, 4, offset=0.5))
    return experiment.model.view, (state.params, state.grid, rays)


def sphere(x, viewdirs):
    density = jnp.where(jnp.linalg.norm(x, axis=-1) < 1, 5.0, 0.0)
    return density, jnp.broadcast_to(0.5 + 0.5 * viewdirs, x.shape)


def packed(views):
    """Returns the packed renderer of a closed form, and its arguments."""
    grid = create_grid(np.full(3, -1.0), np.full(3, 1.0), np.ones((8, 8, 8), bool), initial_density=1.0)
    options = {"step_size": 0.1, "cell": CELL, "early_stop_eps": 1e-3, "max_samples": 64}
    rays = experiment_of(views, "hierarchical").view_rays(views, 0, pixel_grid(4, 4, offset=0.5))
    return functools.partial(render_with_grid, sphere, **options), (grid, rays)


def culling(views):
    """Returns ray culling, and its arguments."""
    _, arguments = packed(views)
    return functools.partial(rays_may_hit, cell=CELL), arguments


def training(views):
    step, arguments = train_step(views)
    return repeat_step(step, NUM_STEPS), arguments


PROGRAMS = {
    "training step": training,
    "evaluation": functools.partial(image, sampler="occupancy"),
    "evaluation of the paper": functools.partial(image, sampler="hierarchical"),
    "packed renderer": packed,
    "ray culling": culling,
}
FAST = ("packed renderer", "ray culling")


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=() if name in FAST else pytest.mark.slow) for name in PROGRAMS]
)
def test_it_lowers_for_every_accelerator_without_calls_to_the_host(views, name):
    function, arguments = PROGRAMS[name](views)
    text = lowered(function, arguments)
    assert custom_calls(text) <= ALLOWED_CALLS
    for operation in ("infeed", "outfeed", "send", "recv"):
        assert f"stablehlo.{operation}" not in text


def lowered(function, arguments):
    """Returns the StableHLO of a function for all accelerators."""
    checks = [export.DisabledSafetyCheck.custom_call(name) for name in ALLOWED_CALLS]
    return export.export(jax.jit(function), platforms=PLATFORMS, disabled_checks=checks)(*arguments).mlir_module()


def custom_calls(text):
    """Returns the targets of the custom calls of a module."""
    return set(re.findall(r"stablehlo\.custom_call @([\w.]+)", text))


def test_a_callback_would_be_found():
    def visits_the_host(x):
        return jax.pure_callback(np.sin, jax.ShapeDtypeStruct((), jnp.float32), x)

    with pytest.raises((ValueError, NotImplementedError)):
        lowered(visits_the_host, (jnp.float32(1),))


@pytest.mark.slow
def test_steps_of_one_dispatch_transfer_nothing_and_are_the_same_bit_for_bit(views, monkeypatch):
    monkeypatch.setattr(optimizer, "_AVERAGE_ALL", 3)  # so that an eighth step is averaged, too
    step, (state, data, _) = train_step(views, "cpu", **{"train.averaging_power": 10.0})
    results = []
    for count in (1, 4):
        run, current, placed = devices.compile_step(
            repeat_step(step, count), jax.device_get(state), data, batch_size=64, devices=jax.devices()[:1]
        )
        with jax.transfer_guard("disallow"):
            for _ in range(8 // count):
                current, metrics = run(current, placed)
        assert int(current.step) == 8
        results.append(jax.device_get((current, jax.tree.map(lambda value: np.ravel(value)[-1], metrics))))
    jax.tree.map(np.testing.assert_array_equal, *results)


@pytest.mark.slow
def test_what_only_accelerators_compile_gives_the_same_step(views, monkeypatch):
    """Values differ from those of a CPU by rounding alone.

    Loops are unrolled there, the average and the update have no branch, the levels of the hash grid are read together,
    and sums may have a fixed order.
    """
    monkeypatch.setattr(optimizer, "_AVERAGE_ALL", 3)
    results = []
    for branch, backend, deterministic in (("cpu", "cpu", False), ("default", "gpu", False), ("default", "gpu", True)):
        with monkeypatch.context() as patch:
            patch.setattr(jax.lax, "platform_dependent", lambda *args, branch=branch, **of: of[branch](*args))
            fields = {"train.averaging_power": 10.0, "train.deterministic": deterministic}
            step, (state, data, positions) = train_step(views, "cpu", **fields)
            patch.setattr(jax, "default_backend", lambda backend=backend: backend)
            run = jax.jit(step)
            for _ in range(6):
                state, metrics = run(state, data, positions)
        results.append(jax.device_get((state.params, state.opt_state.average, metrics)))
    for other in results[1:]:
        jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-4, atol=1e-6), results[0], other)
