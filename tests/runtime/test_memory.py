"""Where memory runs out the cause is reported, smaller parts are used, and the results stay the same."""

import dataclasses
import types

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from helpers import assert_same, control_group, out_of_memory, random_rays
from jaxnerf.core.metrics import psnr
from jaxnerf.evaluation import metrics
from jaxnerf.runtime import devices, memory
from jaxnerf.training import compiled_step, loop
from jaxnerf.training.checkpoint import Checkpoints
from jaxnerf.training.state import create_state
from jaxnerf.training.step import make_train_step
from runs import smoke_experiment
from toys import LOSSES, OPTIMIZER, toy_draw, toy_model

pytest_plugins = ["run_fixtures"]
pytestmark = pytest.mark.usefixtures("unoptimized")


def test_host_and_control_group_limits_are_read(tmp_path):
    assert memory._host_available(tmp_path) == []  # not Linux
    group = control_group(tmp_path)
    (tmp_path / "proc/meminfo").write_text("MemTotal: 90 kB\nMemAvailable:    50 kB\n")
    assert memory._host_available(tmp_path) == [51_200]
    for folder, limit in ((group, "max"), (group.parent, "9000")):
        (folder / "memory.max").write_text(f"{limit}\n")
        (folder / "memory.current").write_text("5000\n")
        (folder / "memory.stat").write_text("anon 3000\ninactive_file 1500\n")
    assert sorted(memory._host_available(tmp_path)) == [5500, 51_200]
    assert memory.available() > 0


def test_program_that_does_not_fit_is_an_error(monkeypatch):
    compiled = jax.jit(lambda x: jnp.outer(x, x)).lower(jnp.ones(500)).compile()
    memory.check(compiled)
    monkeypatch.setattr(memory, "available", lambda: 1_500_000)
    memory.check(compiled)
    with pytest.raises(memory.OutOfMemory, match="needs 2.0 MB, 1.5 MB are free"):
        memory.check(compiled, 2)
    monkeypatch.setattr(memory, "available", lambda: 500_000)
    with pytest.raises(memory.OutOfMemory, match="needs 1.0 MB, 0.5 MB are free"):  # a million bytes
        memory.check(compiled)
    monkeypatch.setattr(memory, "available", lambda: None)
    memory.check(compiled)


def test_back_off_retries_with_smaller_sizes_and_prints_each(capsys):
    tried = []

    def attempt(size, most):
        tried.append(size)
        if size > most:
            raise memory.OutOfMemory(size, most) if size > 60 else out_of_memory()
        return size

    options = {"cause": "training step", "unit": "rays"}
    assert memory.back_off(lambda size: attempt(size, 20), 120, divisors=True, **options) == (15, 15)
    assert tried == [120, 15]  # nearly as many as fit
    tried.clear()
    assert memory.back_off(lambda size: attempt(size, 20), 60, divisors=True, **options) == (15, 15)
    assert tried == [60, 30, 15]
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 3 and all(line.startswith("out of memory in the training step with ") for line in lines)
    with pytest.raises(ValueError, match="out of memory in the training step with 1 rays, which is the minimum"):
        memory.back_off(lambda size: attempt(size, 0), 7, **options)


@pytest.mark.parametrize("error", [ValueError("RESOURCE_EXHAUSTED"), jax.errors.JaxRuntimeError("INTERNAL")])
def test_other_errors_are_not_caught(error):
    def attempt(size):
        raise error

    with pytest.raises(type(error), match=str(error)):
        memory.back_off(attempt, 8, cause="x", unit="y")


@pytest.mark.parametrize("when", ["compiling", "running"])
def test_step_that_does_not_fit_runs_in_smaller_microbatches(when, capsys):
    """The step that fails has consumed its state, as on a device."""
    data = random_rays(0, (16,)), jnp.array([-1])
    step = make_train_step(toy_model(), OPTIMIZER, toy_draw, LOSSES)
    sizes, options = [], {"batch_size": 16, "devices": jax.devices()[:1]}

    def compile_step(state, data, size):
        sizes.append(size)
        run, state, data = devices.compile_step(step, state, data, **options, microbatch_size=size)
        if size <= 4:
            return run, state, data
        if when == "compiling":
            raise out_of_memory()

        def fail(state, data):
            jax.tree.map(lambda leaf: leaf.delete(), state)
            raise out_of_memory()

        return fail, state, data

    run, state, data = memory.fit_step(compile_step, create_state(toy_model(), OPTIMIZER, 0), data, 16)
    whole, expected, same = devices.compile_step(
        step, create_state(toy_model(), OPTIMIZER, 0), data, **options, microbatch_size=4
    )
    for _ in range(3):
        (state, _), (expected, _) = run(state, data), whole(expected, same)
    assert sizes == [16, 8, 4]
    assert_same(state, expected, rtol=0, atol=0)
    err = capsys.readouterr().err.splitlines()
    assert len(err) == 2 and "training step with 8 rays per microbatch (--batch)" in err[1]


@pytest.mark.parametrize("scale", [1.9, 2.1])
def test_a_copy_of_the_state_is_kept_only_for_a_step_that_needs_over_half_of_the_memory(monkeypatch, scale):
    stats = types.SimpleNamespace(temp_size_in_bytes=60, output_size_in_bytes=50, alias_size_in_bytes=10)
    run = lambda *given: given  # noqa: E731
    run.compiled = types.SimpleNamespace(memory_analysis=lambda: stats)
    monkeypatch.setattr(memory, "available", lambda: 100 * scale)
    found, _, _ = memory.fit_step(lambda *given: (run, None, None), None, None, 16)
    assert (found is run) == (scale > 2)


@pytest.mark.slow
@pytest.mark.parametrize("masked", [False, True])
def test_metrics_of_strips_are_those_of_the_whole_image(monkeypatch, masked):
    rng = np.random.default_rng(0)
    truth = rng.random((37, 20, 3)).astype(np.float32)
    image = np.float32(truth + 0.1 * rng.normal(size=truth.shape))
    mask = jnp.arange(37 * 20).reshape(37, 20) > 400 if masked else None  # some strips have no pixel within it
    expected = metrics.image_metrics(image, truth, mask)
    assert expected["psnr_float"] == pytest.approx(float(psnr(image, truth, mask=mask)), rel=1e-6)
    monkeypatch.setattr(metrics, "_STRIP", 20 * 12)
    assert metrics.image_metrics(image, truth, mask) == pytest.approx(expected, rel=1e-5)
    assert np.isnan(metrics.image_metrics(image, truth, jnp.zeros((37, 20), bool))["psnr"])


def test_training_with_pixels_on_the_host_is_bit_exact(compiled_once, tmp_path, monkeypatch):
    """It is, from the start and resumed."""
    states = []
    for kind, ends in (("device", (4,)), ("host", (2, 4))):
        monkeypatch.setattr(compiled_step, "_stay_on_host", lambda pixels, kind=kind: kind == "host")
        (tmp_path / kind).mkdir()
        for steps in ends:
            experiment = dataclasses.replace(smoke_experiment(max_steps=steps), model=toy_model())
            views = experiment.load_split("train")
            views = dataclasses.replace(views, mask=np.arange(len(views.pixels)) % 3 > 0)
            assert loop.run_training(experiment, views, tmp_path / kind)
        template = create_state(experiment.model, experiment.optimizer, 0)
        states.append(Checkpoints(tmp_path / kind).load(4, template))
    assert_same(*states, rtol=0, atol=0)


def test_pixels_stay_on_the_host_if_the_device_is_small(monkeypatch):
    pixels = np.zeros((100, 4), np.uint8)
    assert not compiled_step._stay_on_host(pixels)  # a CPU maps them
    device = types.SimpleNamespace(platform="gpu", memory_stats=lambda: {"bytes_limit": 900, "bytes_in_use": 150})
    monkeypatch.setattr(jax, "local_devices", lambda: [device])
    assert compiled_step._stay_on_host(pixels) and not compiled_step._stay_on_host(pixels[:90])
    device.memory_stats = lambda: None
    assert not compiled_step._stay_on_host(pixels)
