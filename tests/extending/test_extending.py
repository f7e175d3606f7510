"""The examples of this folder: each adds a part from one file outside the package, and trains with it by name."""

import dataclasses
import functools
import os
import pathlib
import shutil
import subprocess
import sys

import cell_sampler  # noqa: F401
import density_exporter
import gabor_field  # noqa: F401
import jax.numpy as jnp
import mask_loss  # noqa: F401
import novelty_estimator
import numpy as np
import pytest
import tum_reader
import uniform_sampler  # noqa: F401
from ml_collections import ConfigDict
from PIL import Image
from scipy.spatial.transform import Rotation

import captures
import export_sources
import jaxnerf
from jaxnerf.extend import Field
from jaxnerf.options import Options, option
from jaxnerf.registry import FIELDS, SAMPLERS, Part
from jaxnerf.runtime import cli
from jaxnerf.tools.exporters.registration import EXPORTERS
from jaxnerf.tools.uncertainty.base import UncertaintySource
from jaxnerf.tools.uncertainty.registration import ESTIMATORS
from jaxnerf.training import auto_config
from jaxnerf.training.build import build_model
from jaxnerf.training.config import typed
from jaxnerf.training.metric_log import read_rows
from jaxnerf.training.state import rendered_shapes
from jaxnerf.training.step import StepLoss, _value
from runs import ROOT, SMOKE_FLAGS, run_forked, smoke_config, start

pytest_plugins = ["run_fixtures"]
pytestmark = pytest.mark.usefixtures("unoptimized")
STEPS = 6


def train(workdir, change):
    """Trains a few steps of configs/smoke.py with a single network and a change; returns the metrics."""
    config = smoke_config(max_steps=STEPS, log_every=1)
    config.sampling.num_fine = 0
    change(config)
    assert jaxnerf.train_and_evaluate(config, workdir)
    rows = read_rows(workdir)
    assert [row["step"] for row in rows] == list(range(1, STEPS + 1))
    assert all(np.isfinite(row["loss"]) and row["nonfinite"] == 0 for row in rows)
    return rows


def test_a_field(tmp_path):
    def use_gabor(config):
        config.field = "gabor"
        config.gabor.num_features = 16

    train(tmp_path / "run", use_gabor)
    params, _ = jaxnerf.restore_run(tmp_path / "run").variables(STEPS)
    assert params["fine"]["center"].shape == (16, 3)
    x = np.zeros((2, 3, 3), np.float32)
    density, rgb = jaxnerf.load_scene(tmp_path / "run")[0](x, x[:, :1])
    assert density.shape == (2, 3) and rgb.shape == (2, 3, 3)


def test_a_field_imports_no_tool():
    code = "import sys, gabor_field; print([name for name in sys.modules if name.startswith('jaxnerf.tools')])"
    folders = os.pathsep.join([str(pathlib.Path(__file__).parent), str(ROOT)])
    environment = {**os.environ, "PYTHONPATH": folders}
    result = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=True)
    assert result.stdout == "[]\n"


def test_a_sampler(tmp_path):
    def use_uniform(config):
        config.sampler = "uniform"
        config.uniform.num_samples = 8

    train(tmp_path / "run", use_uniform)
    params, _ = jaxnerf.restore_run(tmp_path / "run").variables(STEPS)
    assert set(params) == {"fine"}


def use_cells_and_gabor(config):
    config.field, config.sampler, config.gabor.num_features = "gabor", "cells", 16


def test_a_sampler_and_a_field_are_resolved_like_built_in_ones():
    """The sampler's cells, the field's frequencies and the box are inferred, and rays start close to the cameras."""
    config = smoke_config(batch_size="auto")
    use_cells_and_gabor(config)
    config.scene.contracted, config.data.near = True, "auto"
    resolved = auto_config.resolve(config).config
    assert resolved.train.batch_size == resolved.train.cpu_batch_size // 2
    assert 0 < resolved.data.near < 0.2 and len(resolved.scene.background) == 0 and resolved.scene.box is not None
    assert resolved.cells.resolution > 8 and resolved.gabor.max_frequency > 0


@pytest.mark.slow
def test_a_run_of_a_sampler_and_a_field_is_trained_and_exported_like_built_in_ones(tmp_path):
    workdir = tmp_path / "run"
    train(workdir, use_cells_and_gabor)
    run = jaxnerf.restore_run(workdir)
    schedule, (_, grid) = run.experiment.model.grid_schedule, run.variables(STEPS)
    assert schedule.shape == grid.valid.shape and not grid.valid.all()  # the visual hull leaves some cells out
    assert np.allclose([schedule.lower, schedule.upper], run.experiment.config.scene.box)
    plugins = "--plugins=cell_sampler,gabor_field"
    flags = [plugins, f"--workdir={workdir}", "--kind=points", "--num_views=4", "--size=16", "--num_points=50"]
    process = start("export", *flags, PYTHONPATH=f"{ROOT / 'tests' / 'extending'}:{ROOT}")
    out, err = process.communicate(timeout=240)
    assert process.returncode == 0 and "points.ply" in out, err


def test_losses(tmp_path):
    def use_losses(config):
        config.losses.mask = 0.1
        config.losses.weight_decay = ((0, 1e-4), (4, 0.0))

    rows = train(tmp_path / "run", use_losses)
    for row, weight in zip(rows, 1e-4 * np.array([4, 3, 2, 1, 0, 0]) / 4, strict=True):
        want = row["loss_mse"] + 0.1 * row["loss_mask"] + weight * row["loss_weight_decay"]
        assert row["loss"] == pytest.approx(want, rel=1e-4)


@pytest.fixture(scope="module")
def tum_folder(tmp_path_factory):
    """Returns a folder of the format, and the shots that it holds."""
    folder, shots = tmp_path_factory.mktemp("tum"), captures.shoot(captures.orbit(8))
    lines = ["# file x y z qx qy qz qw"]
    for shot in shots:
        Image.fromarray((shot.pixels // 257).astype(np.uint8)).save(folder / f"{shot.name}.png")
        rotation = shot.camera.to_world[:, :3] * tum_reader.DOWN_FORWARD_TO_UP_BACKWARD
        numbers = [*shot.camera.to_world[:, 3], *Rotation.from_matrix(rotation).as_quat()]
        lines.append(" ".join([f"{shot.name}.png", *map(repr, map(float, numbers))]))
    (folder / "trajectory.txt").write_text("\n".join(lines))
    camera = shots[0].camera
    (folder / "camera.txt").write_text(" ".join(map(repr, map(float, [*camera.focal, *camera.center]))))
    return folder, shots


def test_a_dataset_reader(tum_folder, tmp_path):
    folder, shots = tum_folder
    views = jaxnerf.load_dataset(folder, world="file", background="white")
    kept = [shot for shot in shots if shot.name in views.names]
    assert len(kept) == 7  # every eighth image is in the split "test"
    for name in ("to_world", "focal", "center"):
        want = [getattr(shot.camera, name) for shot in kept]
        np.testing.assert_allclose(getattr(views.cameras, name), want, atol=1e-5)

    def use_tum(config):
        config.data.format, config.data.dir = "tum", str(folder)

    train(tmp_path / "run", use_tum)


def test_a_wrong_line_is_named(tum_folder, tmp_path):
    (tmp_path / "camera.txt").write_text("9 9 5 5")
    (tmp_path / "trajectory.txt").write_text("# file x y z qx qy qz qw\n000.png 1 2 3\n")
    with pytest.raises(ValueError, match="trajectory.txt: line 2 has 3 numbers, expected 7"):
        jaxnerf.load_dataset(tmp_path)


def test_an_exporter(tmp_path):
    assert EXPORTERS.get("density").export is density_exporter.export_density
    source = export_sources.source_of()._replace(settings=density_exporter.DensityOptions(num_cells=16))
    density_exporter.export_density(source, tmp_path)
    content = np.load(tmp_path / "density.npz")
    center = (content["upper"] + content["lower"]) / 2
    assert content["density"].shape == (16, 16, 16) and content["density"][8, 8, 8] > 100
    assert content["density"][0, 0, 0] < 1 and (center == 0).all()


def test_an_exporter_has_flags_help_and_checks(trained, tmp_path, monkeypatch):
    workdir = shutil.copytree(trained, tmp_path / "run")
    monkeypatch.setenv("PYTHONPATH", str(pathlib.Path(__file__).parent))
    call = functools.partial(run_forked, "export", "--plugins=density_exporter", f"--workdir={workdir}")
    help = " ".join(call("--help")[1].split())
    assert "--num_cells: density: cells along each side of the box. Default: 128." in help
    code, _, err = call("--kind=density", "--num_cells=0")
    assert code == 2 and "flag --num_cells=0: expected an integer (from 1 to 1,024)" in err
    code, out, err = call("--kind=density", "--num_cells=8", "--name=cells")
    assert code == 0 and np.load(out.strip())["density"].shape == (8, 8, 8), err


def test_an_estimator(tmp_path):
    assert ESTIMATORS.get("novelty") is novelty_estimator.estimate_novelty
    run, _, variables, views, *_ = export_sources.source_of(num_samples=32)
    source = UncertaintySource.of(run, tmp_path, 7, variables)
    estimate = ESTIMATORS.get("novelty")(source)
    known = views.rays(3)
    # The pixels of a training view are known. Seen from the other side, the ball's middle is at least 0.2 rad away.
    np.testing.assert_allclose(estimate.score(known), 0, atol=1e-3)
    turned = {name: -getattr(known, name) for name in ("origins", "directions", "viewdirs")}
    opposite = dataclasses.replace(known, **turned)
    middle = np.asarray(estimate.score(opposite))[23:25, 23:25]
    to_world = np.asarray(views.cameras.to_world)
    nearest = np.arccos((to_world[:, :, 3] @ -to_world[3, :, 3] / 9).max()) / np.pi
    assert (middle > 0.5 * nearest).all() and nearest > 0.05


@pytest.mark.extra
def test_the_export_program_restores_a_run_without_a_grid(trained, tmp_path):
    """Its grid is extracted; the second call finds the folder."""
    folder = shutil.copytree(trained, tmp_path / "run")
    flags = ["--plugins=density_exporter", "--kind=density", "--num_cells=16", f"--workdir={folder}"]
    path = f"{ROOT / 'tests' / 'extending'}:{ROOT}"
    for code, want in ((0, "exports/density-20/density.npz"), (1, "exists already; give --overwrite")):
        process = start("export", *flags, PYTHONPATH=path)
        out, err = process.communicate(timeout=240)
        assert process.returncode == code and want in out + err
        assert "Traceback" not in err


def test_a_plugins_options_are_checked_and_inferred_like_all_others(tmp_path):
    config = smoke_config(max_steps=1)
    config.field, config.sampling.num_fine, config.gabor.num_features = "gabor", 0, 0
    with pytest.raises(ValueError, match="--config.gabor.num_features is 0, expected at least 1; correct it"):
        jaxnerf.train_and_evaluate(config, tmp_path / "run")
    with pytest.raises(TypeError):
        config.gabor.num_features = "many"
    config.gabor.num_features = 4
    resolved = auto_config.resolve(config)
    assert resolved.config.parts["gabor"].max_frequency > 0 and "uniform" not in resolved.config.parts
    assert any(line.startswith("gabor ") for line in resolved.lines)


@pytest.mark.slow
def test_the_programs_import_plugins(compiled_once, tmp_path):
    """Training with the sampler and the loss works by --plugins, and without it the message names the flag."""
    changes = ("sampler=uniform", "losses.mask=0.1", "train.max_steps=2")
    flags = [*SMOKE_FLAGS, *(f"--config.{change}" for change in changes), f"--workdir={tmp_path / 'run'}"]
    path = f"{ROOT / 'tests' / 'extending'}:{ROOT}"
    for some in (flags, [flag for flag in flags if "losses.mask" not in flag]):
        failed = start("train", *some, PYTHONPATH=path)
        _, err = failed.communicate(timeout=120)
        assert failed.returncode != 0 and "with --plugins=MODULE" in err and err.count("\n") == 1
    trained = start("train", "--plugins=uniform_sampler,mask_loss", *flags, PYTHONPATH=path)
    _, err = trained.communicate(timeout=120)
    assert trained.returncode == 0, err
    assert "loss_mask" in read_rows(tmp_path / "run")[-1]


def test_registrations_that_cannot_work_are_refused(monkeypatch):
    class NoDataclass(Options):
        num = option(1, "a number")

    with pytest.raises(ValueError, match="register_field: options is .*NoDataclass.*, expected a frozen dataclass"):
        jaxnerf.register_field("wrong", lambda options, box: None, options=NoDataclass)
    monkeypatch.setitem(FIELDS._parts, "train", Part(lambda options, box: None))
    with pytest.raises(ValueError, match="registered as 'train', which every config has for something else"):
        smoke_config()


def of_integers(options, box):
    return Field(lambda key: {"w": jnp.ones(3, int)}, lambda params, x, viewdirs: (x[..., 0], x))


@pytest.mark.parametrize(
    "registry, make, message",
    [
        (FIELDS, lambda options, box: None, "'wrong': its function returned NoneType, expected a Field"),
        (SAMPLERS, lambda context: {}, "'wrong': its function returned dict, expected a Model"),
        (FIELDS, of_integers, r"params\['fine'\]\['w'\] has type int32, expected floats"),
    ],
)
def test_what_a_part_makes_is_checked(monkeypatch, registry, make, message):
    monkeypatch.setitem(registry._parts, "wrong", Part(make))
    config = smoke_config()
    config["field" if registry is FIELDS else "sampler"] = "wrong"
    with pytest.raises(ValueError, match=message):
        rendered_shapes(build_model(auto_config.resolve_for_device(config)[0]))


@pytest.mark.parametrize(
    "value, found", [(0.0, r"\(\)"), (jnp.ones((4, 3)), r"\(4, 3\)"), (None, "NoneType"), (jnp.ones(3), r"\(3,\)")]
)
def test_what_a_loss_returns_is_checked(value, found):
    loss = StepLoss("wrong", lambda *_: value, "renderings", lambda step: 1.0, ())
    with pytest.raises(ValueError, match=rf"losses.wrong: the function returned {found}, expected the shape \(4,\)"):
        _value(loss, (4,), None, None)


def test_a_section_that_no_part_has_is_refused(tmp_path):
    config = smoke_config(max_steps=1)
    config.trian = {"batch_size": 64}
    with pytest.raises(ValueError, match="--config.trian is no field, did you mean train.*"):
        jaxnerf.train_and_evaluate(config, tmp_path / "run")


def test_a_number_of_type_float_takes_fractions_whatever_its_default():
    config = ConfigDict({"number": typed(2, float, auto=False)})
    config.number = 2.5
    assert config.number == 2.5


def test_plugins_in_a_file_of_flags_are_imported(tmp_path):
    (tmp_path / "flags.txt").write_text("--plugins=uniform_sampler,mask_loss\n")
    argv = ["train", f"--flagfile={tmp_path / 'flags.txt'}", "--workdir=run"]
    assert cli.given_flag("plugins", argv) == "uniform_sampler,mask_loss" and cli.given_flag("workdir", argv) == "run"
    assert cli.given_flag("workdir", ["train", "--flagfile=missing.txt", "--workdir=run"]) == "run"
