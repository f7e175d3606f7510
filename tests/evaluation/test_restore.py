"""Restored runs: where their dataset is found."""

import gc
import json
import shutil

import jax
import pytest

import captures
from jaxnerf.evaluation.restore import restore_run
from jaxnerf.training import auto_config, workdir
from runs import smoke_config

pytest_plugins = ["run_fixtures"]


@pytest.fixture
def scene(tmp_path):
    """The parent of a dataset "scene" of noise, which holds nothing else."""
    folder = tmp_path / "data" / "scene"
    folder.mkdir(parents=True)
    captures.write_transforms(folder, captures.noise(captures.orbit(9)))
    return folder.parent


def start_run(folder):
    """Makes a workdir as training does, and returns its config."""
    config = smoke_config()
    config.data.update({"dir": "scene", "format": "auto"})
    resolved = auto_config.resolve(config).config
    workdir.save_config(folder, resolved)
    return workdir.load_config(folder)


def test_a_run_finds_a_dataset_of_a_relative_path_from_any_current_folder(scene, tmp_path, monkeypatch):
    monkeypatch.chdir(scene)
    assert start_run(tmp_path / "run").data.dir == str(scene / "scene")
    monkeypatch.chdir(tmp_path)
    assert len(restore_run(tmp_path / "run").experiment.load_split("train").offset) == 7


def test_a_name_below_jaxnerf_scenes_stays_a_name(scene, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("JAXNERF_SCENES", str(scene))
    assert start_run(tmp_path / "run").data.dir == "scene"
    monkeypatch.setenv("JAXNERF_SCENES", str(scene.rename(tmp_path / "moved")))
    assert len(restore_run(tmp_path / "run").experiment.load_split("train").offset) == 7


def test_another_folder_of_the_same_dataset_replaces_that_of_the_run(scene, tmp_path, monkeypatch):
    monkeypatch.chdir(scene)
    start_run(tmp_path / "run")
    moved = scene.rename(tmp_path / "moved")
    with pytest.raises(ValueError, match="scene"):
        restore_run(tmp_path / "run").experiment.load_split("train")
    run = restore_run(tmp_path / "run", data_dir=str(moved / "scene"))
    assert len(run.experiment.load_split("train").offset) == 7


def test_a_restored_run_keeps_only_what_it_renders_with(trained):
    """The rest of the training state, several times as large, is freed, and so is any copy of it."""
    run = restore_run(trained)
    before = jax.live_arrays()  # kept alive, so that no new array gets the id of an old one
    known = {id(array) for array in before}
    kept = run.variables(20)
    gc.collect()
    new = [array for array in jax.live_arrays() if id(array) not in known]
    assert 0 < sum(array.nbytes for array in new) <= sum(leaf.nbytes for leaf in jax.tree.leaves(kept))


@pytest.mark.slow
def test_a_run_without_resolved_sizes_is_baked(trained, tmp_path):
    """A run that was converted without its dataset keeps "auto" fields, which are inferred when they are used."""
    folder = shutil.copytree(trained, tmp_path / "run")
    content = json.loads((folder / "config.json").read_text())
    content["occupancy"].update(dict.fromkeys(("lower", "upper", "step_size", "resolution", "contracted"), "auto"))
    content["data"]["ndc"] = "auto"
    (folder / "config.json").write_text(json.dumps(content))
    run = restore_run(folder, settings={"bake_occupancy": True})
    assert run.experiment.model.grid_schedule is None and run.variables(20)[1].valid.ndim == 3
