"""A workdir alone, its dataset gone: what needs the cameras of training works, and what needs images says so."""

import dataclasses
import json
import shutil

import jax
import numpy as np
import pytest

from ball_runs import make_run
from jaxnerf.core.views import Views
from jaxnerf.data.dataset import load_split
from jaxnerf.evaluation.restore import restore_run, restore_with_grid
from jaxnerf.evaluation.supersampling import training_cameras
from jaxnerf.tools.exporters.base import export_run
from jaxnerf.tools.next_images.propose import propose_images
from jaxnerf.tools.uncertainty.base import UncertaintySource
from jaxnerf.tools.uncertainty.laplace import fit_deformation
from jaxnerf.training import stored_cameras
from jaxnerf.training.workdir import load_config
from runs import evaluate, render_path

pytest_plugins = ["run_fixtures"]
pytestmark = pytest.mark.usefixtures("unoptimized")


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """The workdir of a ball, which is of an earlier version: without cameras."""
    return make_run(tmp_path_factory.mktemp("alone") / "run", "packed")


@pytest.fixture
def alone(run, tmp_path):
    """A copy of the workdir whose dataset is gone."""
    stored_cameras.training_views(run)
    folder = tmp_path / "copied"
    shutil.copytree(run, folder)
    content = json.loads((folder / "config.json").read_text())
    content["data"]["dir"] = str(tmp_path / "gone")
    (folder / "config.json").write_text(json.dumps(content))
    return folder


def files_of_images(folder):
    return {path.name: path.read_bytes() for path in sorted(folder.rglob("*")) if path.suffix in (".png", ".tiff")}


@pytest.mark.parametrize("kind", ["packed", "contracted", "ndc"])
def test_the_cameras_are_those_of_the_dataset(tmp_path, kind):
    folder = make_run(tmp_path / "run", kind)
    first, config = stored_cameras.training_views(folder), load_config(folder)  # of an earlier version: written now
    expected = stored_cameras.without_images(load_split(config.data, "train"))
    stored = stored_cameras.training_views(folder)
    for found in (first, stored):
        assert jax.tree.structure(found) == jax.tree.structure(expected)
        for one, other in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
            assert one.dtype == other.dtype
            np.testing.assert_array_equal(one, other)
    assert (folder / stored_cameras.FILE).stat().st_size < 10_000
    with pytest.raises(ValueError, match="give --data_dir"):
        stored.image(0)


def test_masks_lenses_and_times_are_stored(run, tmp_path):
    config, views = load_config(run), load_split(load_config(run).data, "train")
    count, total = len(views.size), len(views.pixels)
    cameras = dataclasses.replace(views.cameras, distortion=np.ones((count, 5), np.float32), lens="opencv")
    more = {"time": np.float32(np.arange(count)), "mask": np.arange(total) % 3 > 0, "box": np.eye(2, 3)}
    more |= {"names": ("a\udcff",) * count, "file_origin": (1e7 + 0.1, 0.0, -3.0), "background": None}
    views = dataclasses.replace(views, cameras=cameras, **more)
    shutil.copy(run / "config.json", tmp_path)
    stored_cameras.save(tmp_path, config, views)
    found, expected = stored_cameras.training_views(tmp_path), stored_cameras.without_images(views)
    for field in dataclasses.fields(Views):
        one, other = (getattr(each, field.name) for each in (found, expected))
        jax.tree.map(np.testing.assert_array_equal, one, other)
    assert found.mask.dtype == bool


@pytest.mark.slow
def test_frames_and_exports_are_the_same_without_the_dataset(run, alone):
    made = {}
    for folder in (run, alone):
        for path in ("turntable", "interpolate"):
            render_path(folder, path=path, num_frames=2, width=12, video="none", overwrite=True)
        export_run(folder, "depth", size=16, overwrite=True, say=lambda line: None)
        export_run(folder, "points", size=16, overwrite=True, say=lambda line: None)
        files = {path.name: path.read_bytes() for path in (folder / "exports").rglob("*.ply")}
        made[folder] = files_of_images(folder / "renders") | files_of_images(folder / "exports") | files
    assert len(made[run]) > 6 and made[run] == made[alone]


def test_splats_say_that_they_are_not_scored(alone):
    lines = []
    export_run(alone, "splats", size=16, fit_steps=1, num_points=20, say=lines.append)
    assert "not scored, as that needs the images of the split 'test'; give --data_dir" in lines[0]
    assert lines[1].endswith(" Gaussians")


@pytest.mark.slow
def test_the_next_images_are_the_same(run, alone):
    reports = [propose_images(folder, 2) for folder in (run, alone)]
    assert reports[0].text() == reports[1].text()


def test_the_viewer_has_the_cameras(alone):
    views = restore_with_grid(alone).experiment.load_split("train", images=None)
    assert len(views.size) == 5 and not len(views.pixels)


def test_what_needs_images_says_so(alone):
    with pytest.raises(ValueError, match=r"this needs the images of the split 'test', and data.dir is .*--data_dir"):
        evaluate(alone)
    found = restore_run(alone)
    source = UncertaintySource.of(found, alone, 20, found.variables(20))
    with pytest.raises(ValueError, match="'laplace', .* needs images, .*--data_dir"):
        fit_deformation(source)


def test_another_folder_of_the_dataset_takes_the_place_of_the_file(run, alone):
    (alone / stored_cameras.FILE).unlink()
    found = restore_run(alone, data_dir=str(run.with_name("run-data")))
    for images in (True, False, None):
        views = found.experiment.load_split("train", images=images)
        assert len(views.size) == 5 and bool(len(views.pixels)) == (images is not False)
    assert len(training_cameras(found, alone, found.variables(20)[0]).size) == 5
    assert not (alone / stored_cameras.FILE).exists()  # which may be that of another scene


def test_cameras_of_an_unwritable_workdir_are_read_from_the_dataset(tmp_path, monkeypatch):
    folder = make_run(tmp_path / "run", "packed")
    monkeypatch.setattr(stored_cameras, "save", lambda *args: (_ for _ in ()).throw(OSError(30, "Read-only")))
    assert len(stored_cameras.training_views(folder).size) == 5
    assert not (folder / stored_cameras.FILE).exists()


@pytest.mark.parametrize("place", [0, 40, 200, 1500, -30])
def test_a_damaged_file_is_one_line(alone, place):
    path = alone / stored_cameras.FILE
    content = bytearray(path.read_bytes())
    content[place] ^= 0x41
    path.write_bytes(content)
    try:
        stored_cameras.training_views(alone)  # a flipped bit of the archive's own dates changes nothing
    except ValueError as error:
        assert str(error).startswith(f"{path}: is damaged (") and "\n" not in str(error)
    path.write_bytes(content[: len(content) // 2])
    with pytest.raises(ValueError, match=r"cameras.npz: is damaged .*; remove it, and it is made again"):
        stored_cameras.training_views(alone)


def changed(path, **values):
    """Writes a file of cameras again, with other arrays or values and a checksum that fits."""
    with np.load(path) as stored:
        arrays = {name: stored[name] for name in stored.files if name != "checksum"}
    about = json.loads(str(arrays.pop("about")))
    arrays |= {name: each for name, each in values.items() if isinstance(each, np.ndarray)}
    about = json.dumps(about | {name: each for name, each in values.items() if name not in arrays})
    np.savez(path, about=about, checksum=stored_cameras._checksum(about, arrays), **arrays)


@pytest.mark.parametrize(
    "wrong",
    [
        {"near": np.zeros(4)},
        {"to_world": np.zeros((5, 4, 4))},
        {"focal": np.full((5, 2), np.nan)},
        {"size": np.zeros((5, 2), int)},
        {"size": np.full((5, 2), 2**31 - 1)},
        {"time": np.array(["x"] * 5)},
        {"names": ["one"]},
        {"names": None},
        {"channels": "many"},
        {"dtype": "object0"},
        {"background": [1, "x"]},
        {"mask": np.zeros(2)},
    ],
    ids=str,
)
def test_files_of_strangers_are_checked(alone, wrong):
    changed(alone / stored_cameras.FILE, **wrong)
    with pytest.raises(ValueError, match=r"cameras.npz: is damaged \("):
        stored_cameras.training_views(alone)


def test_the_file_of_another_run_is_refused(alone):
    changed(alone / stored_cameras.FILE, key="0" * 16)
    with pytest.raises(ValueError, match="is of a run with other data or another scene"):
        restore_run(alone).experiment.load_split("train", images=False)


def test_training_writes_the_cameras(trained):
    assert (trained / stored_cameras.FILE).is_file()
