"""Where memory runs out it is said in what, less is taken, and the results stay what they are."""

import dataclasses
import types

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from test_step import OPTIMIZER, toy_draw, toy_model

from helpers import assert_same, random_rays
from jaxnerf.core.types import Rendering
from jaxnerf.evaluation import metrics
from jaxnerf.runtime import chunking, cli, devices, memory
from jaxnerf.training import loop
from jaxnerf.training.build import build
from jaxnerf.training.checkpoint import Checkpoints
from jaxnerf.training.state import create_state
from jaxnerf.training.step import make_train_step
from runs import run as run_program
from runs import smoke_config

pytest_plugins = ["run_fixtures"]
pytestmark = pytest.mark.usefixtures("unoptimized")


def out_of_memory():
    return jax.errors.JaxRuntimeError("RESOURCE_EXHAUSTED: Out of memory while trying to allocate 9 bytes.")


def test_the_host_tells_the_least_that_it_and_its_groups_leave(tmp_path):
    assert memory._host_left(tmp_path) == []  # not Linux
    group = tmp_path / "sys/fs/cgroup/pod/job"
    group.mkdir(parents=True)
    (tmp_path / "proc/self").mkdir(parents=True)
    (tmp_path / "proc/meminfo").write_text("MemTotal: 90 kB\nMemAvailable:    50 kB\n")
    (tmp_path / "proc/self/cgroup").write_text("0::/pod/job\n")
    assert memory._host_left(tmp_path) == [51_200]
    for folder, limit in ((group, "max"), (group.parent, "9000")):
        (folder / "memory.max").write_text(f"{limit}\n")
        (folder / "memory.current").write_text("5000\n")
        (folder / "memory.stat").write_text("anon 3000\ninactive_file 1500\n")
    assert sorted(memory._host_left(tmp_path)) == [5500, 51_200]
    assert memory.left() > 0


def test_a_program_without_room_is_not_run(monkeypatch):
    compiled = jax.jit(lambda x: jnp.outer(x, x)).lower(jnp.ones(500)).compile()
    memory.check(compiled)
    monkeypatch.setattr(memory, "left", lambda: 500_000)
    with pytest.raises(memory.NoRoom, match="needs 1.0 MB where 0.5 MB are left"):  # a million bytes
        memory.check(compiled)
    monkeypatch.setattr(memory, "left", lambda: None)
    memory.check(compiled)


def test_less_is_taken_until_there_is_room_and_each_time_it_is_said(capsys):
    tried = []

    def attempt(size, most):
        tried.append(size)
        if size > most:
            raise memory.NoRoom(size, most) if size > 60 else out_of_memory()
        return size

    options = {"cause": "train batch", "unit": "rays"}
    assert memory.back_off(lambda size: attempt(size, 20), 120, whole=True, **options) == (15, 15)
    assert tried == [120, 15]  # nearly as many as there is room for
    tried.clear()
    assert memory.back_off(lambda size: attempt(size, 20), 60, whole=True, **options) == (15, 15)
    assert tried == [60, 30, 15]
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 3 and all(line.startswith("out of memory in the train batch: ") for line in lines)
    with pytest.raises(ValueError, match="out of memory in the train batch: 1 rays, the least that can be"):
        memory.back_off(lambda size: attempt(size, 0), 7, **options)


@pytest.mark.parametrize("error", [ValueError("RESOURCE_EXHAUSTED"), jax.errors.JaxRuntimeError("INTERNAL")])
def test_other_errors_are_what_they_were(error):
    def attempt(size):
        raise error

    with pytest.raises(type(error), match=str(error)):
        memory.back_off(attempt, 8, cause="x", unit="y")


@pytest.mark.parametrize("when", ["compiling", "running"])
def test_a_train_batch_that_does_not_fit_is_taken_in_smaller_blocks(when, capsys):
    """The state is lost to the step that fails, as a device's is."""
    data = random_rays(0, (16,)), jnp.array([-1])
    step = make_train_step(toy_model(), OPTIMIZER, toy_draw)
    sizes = []

    def compile_step(state, data, block):
        sizes.append(block)
        run, state, data = devices.compile_step(step, state, data, batch_size=16, microbatch_size=block, mode="jit")
        if block <= 4:
            return run, state, data
        if when == "compiling":
            raise out_of_memory()

        def fail(state, data):
            jax.tree.map(lambda leaf: leaf.delete(), state)
            raise out_of_memory()

        return fail, state, data

    run, state, data = chunking.fit_step(compile_step, create_state(toy_model(), OPTIMIZER, 0), data, 16)
    whole, wanted, same = devices.compile_step(
        step, create_state(toy_model(), OPTIMIZER, 0), data, batch_size=16, microbatch_size=4, mode="jit"
    )
    for _ in range(3):
        (state, _), (wanted, _) = run(state, data), whole(wanted, same)
    assert sizes == [16, 8, 4]
    assert_same(state, wanted, rtol=0, atol=0)
    err = capsys.readouterr().err.splitlines()
    assert len(err) == 2 and "train batch: 8 rays at once (--batch)" in err[1]


def test_a_chunk_that_does_not_fit_is_halved_and_the_picture_is_the_same(monkeypatch, capsys):
    rays, tried = jax.tree.map(jnp.asarray, random_rays(0, (6, 7))), []

    @jax.jit
    def colours(scale, rays):
        values = scale * rays.viewdirs
        zero = jnp.zeros(rays.near.shape)
        names = [field.name for field in dataclasses.fields(Rendering) if field.name not in ("rgb", "weights")]
        return Rendering(rgb=values, weights=None, **dict.fromkeys(names, zero))

    def render(scale, rays):
        tried.append(rays.near.size)
        if rays.near.size > 16:
            raise out_of_memory()
        return colours(scale, rays)

    render.lower = colours.lower
    image = chunking.image_renderer(render, 40)
    wanted = 2 * np.asarray(rays.viewdirs)
    np.testing.assert_allclose(image(jnp.float32(2), rays).rgb, wanted, rtol=1e-6)
    assert tried[:2] == [40, 20] and set(tried[2:]) == {10}
    assert "out of memory in the render chunk: 40 rays at once (--chunk)" in capsys.readouterr().err
    image(jnp.float32(3), rays)
    assert set(tried[2:]) == {10} and not capsys.readouterr().err, "found once"
    np.testing.assert_allclose(image(jnp.float32(2), rays, chunk=0).rgb, wanted, rtol=1e-6)
    chunking.image_renderer(render, 0)(jnp.float32(2), rays)
    assert 64 in tried  # auto: all of them, in one padded shape
    monkeypatch.setattr(memory, "left", lambda: 12 * 16 + 100)
    tried.clear()
    chunking.image_renderer(colours, 40)(jnp.float32(2), rays)
    assert "render chunk: 40 rays at once (--chunk): needs 0.0 MB where" in capsys.readouterr().err


@pytest.mark.parametrize("masked", [False, True])
def test_metrics_that_do_not_fit_are_taken_from_strips(monkeypatch, capsys, masked):
    rng = np.random.default_rng(0)
    truth = rng.random((37, 20, 3)).astype(np.float32)
    image = np.float32(truth + 0.1 * rng.normal(size=truth.shape))
    mask = np.arange(37 * 20).reshape(37, 20) > 400 if masked else None
    wanted = metrics.scores(image, truth, mask)
    monkeypatch.setattr(metrics, "_pair_scores", lambda *_: (_ for _ in ()).throw(out_of_memory()))
    found = metrics.scores(image, truth, mask)
    assert found == pytest.approx(wanted, rel=1e-5)
    assert "out of memory in the metrics: 37 rows of an image of 20 x 37 at once" in capsys.readouterr().err
    if masked:  # strips without a pixel that counts
        assert metrics._in_strips(*map(jnp.asarray, (image, truth, mask)), 5)["ssim"] == pytest.approx(
            wanted["ssim"], rel=1e-5
        )


def test_pixels_that_stay_on_the_host_train_the_same(compiled_once, tmp_path, monkeypatch):
    """Bit for bit, from the start and resumed."""
    states = []
    for kind, ends in (("device", (4,)), ("host", (2, 4))):
        monkeypatch.setattr(chunking, "has_no_room", lambda pixels, kind=kind: kind == "host")
        (tmp_path / kind).mkdir()
        for steps in ends:
            experiment = build(smoke_config(max_steps=steps, parallel="jit"))._replace(model=toy_model())
            views = experiment.load_views("train")
            views = dataclasses.replace(views, mask=np.arange(len(views.pixels)) % 3 > 0)
            assert loop.train(experiment, views, tmp_path / kind)
        template = create_state(experiment.model, experiment.optimizer, 0)
        states.append(Checkpoints(tmp_path / kind).load(4, template))
    assert_same(*states, rtol=0, atol=0)


def test_pixels_stay_on_the_host_where_a_device_is_small(monkeypatch):
    pixels = np.zeros((100, 4), np.uint8)
    assert not chunking.has_no_room(pixels)  # a CPU maps them
    device = types.SimpleNamespace(platform="gpu", memory_stats=lambda: {"bytes_limit": 900, "bytes_in_use": 150})
    monkeypatch.setattr(jax, "local_devices", lambda: [device])
    assert chunking.has_no_room(pixels) and not chunking.has_no_room(pixels[:90])
    device.memory_stats = lambda: None
    assert not chunking.has_no_room(pixels)


def test_the_programs_know_auto():
    assert [cli._Count().parse(value) for value in ("auto", "512", 3)] == [0, 512, 3]
    code, _, err = run_program("eval", "--workdir=nowhere", "--chunk=0")
    assert code == 2 and "auto, or a whole number of at least 1" in err
