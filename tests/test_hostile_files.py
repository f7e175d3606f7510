"""Files from strangers: no reader waits for a pipe, reads a device, or starts another program."""

import ast
import io
import os
import shutil
import signal

import pytest
from PIL import EpsImagePlugin, Image

from jaxnerf.data.images import image_files
from jaxnerf.data.readers import colmap_model, ply, validation
from jaxnerf.evaluation.paths.camera_path import read_path_file
from jaxnerf.evaluation.restore import restore_run
from jaxnerf.runtime import shards
from jaxnerf.tools.capture_check import camera_plot
from jaxnerf.tools.exporters.base import export_run
from jaxnerf.tools.interop.published_weights import read_weights
from jaxnerf.tools.structure_from_motion.estimate import estimate_cameras
from jaxnerf.tools.structure_from_motion.images import is_rotated_jpeg
from jaxnerf.training.metric_log import MetricLog, read_rows
from jaxnerf.training.workdir import load_config, workdir_lock
from runs import ROOT, evaluate, render_path
from test_scenes.synthetic_capture import GROUND_TRUTH, read_ground_truth

pytest_plugins = ["run_fixtures"]
pytestmark = pytest.mark.usefixtures("unoptimized")

READERS = {
    "transforms.json": validation.read_json,
    "poses_bounds.npy": lambda path: validation.read_npy(path, "poses"),
    "sparse_pc.ply": ply.read_points,
    "points3D.bin": lambda path: list(colmap_model._binary_points(path)),
    "points3D.txt": lambda path: list(colmap_model._text_points(path)),
    "0.png": image_files.read_image,
    "1.png": image_files.image_size,
    "2.jpg": is_rotated_jpeg,
    "3.png": image_files.read_stored,
    "path.json": read_path_file,
    "model_000010.npy": lambda path: read_weights([path]),
    "config.json": lambda path: load_config(path.parent),
    "metrics.jsonl": lambda path: read_rows(path.parent),
    "provenance.json": lambda path: shards.check_provenance(path.parent, {}, file=path.name, remedy="remove it"),
    GROUND_TRUTH: lambda path: read_ground_truth(path.parent),
}


@pytest.fixture
def no_waiting():
    """Fails a test that takes 20 s; no error handler catches this."""
    old = signal.signal(signal.SIGALRM, lambda *_: pytest.fail("waits without end"))
    signal.alarm(20)
    yield
    signal.alarm(0)
    signal.signal(signal.SIGALRM, old)


@pytest.mark.parametrize("kind", ["pipe", "device"])
@pytest.mark.parametrize("name", READERS)
def test_only_regular_files_are_read(tmp_path, no_waiting, name, kind):
    path = tmp_path / name
    os.mkfifo(path) if kind == "pipe" else os.symlink("/dev/zero", path)
    with pytest.raises((ValueError, OSError), match=name):
        READERS[name](path)


@pytest.mark.extra
def test_a_pipe_in_a_checkpoint_is_an_error(trained, tmp_path, no_waiting):
    folder = shutil.copytree(trained, tmp_path / "run")
    metadata = folder / "checkpoints" / "20" / "_CHECKPOINT_METADATA"
    metadata.unlink()
    os.mkfifo(metadata)
    with pytest.raises(ValueError, match="_CHECKPOINT_METADATA: is a pipe or a device"):
        restore_run(folder).variables(20)


@pytest.mark.parametrize("name", ["checkpoints", "eval/20.tmp", "previews", "tensorboard"])
def test_training_writes_to_no_linked_folder(tmp_path, name):
    (tmp_path / "precious").mkdir()
    (tmp_path / "run" / name).parent.mkdir(parents=True)
    os.symlink(tmp_path / "precious", tmp_path / "run" / name)
    with pytest.raises(ValueError, match=f"{name}: is a symbolic link"), workdir_lock(tmp_path / "run"):
        pass


def test_the_copy_of_a_damaged_file_replaces_a_link(tmp_path):
    (tmp_path / "precious").write_text("content")
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "metrics.jsonl").write_text("echo a stranger's words\n")
    os.symlink(tmp_path / "precious", tmp_path / "run" / "metrics.jsonl.damaged")
    MetricLog(tmp_path / "run", first_step=0).close()
    assert (tmp_path / "precious").read_text() == "content"
    assert (tmp_path / "run" / "metrics.jsonl.damaged").read_text() == "echo a stranger's words\n"


@pytest.mark.parametrize(
    "folder, program",
    [("eval", evaluate), ("renders", render_path), ("exports", lambda run: export_run(run, "points"))],
)
def test_evaluation_writes_to_no_linked_folder(trained, tmp_path, folder, program):
    run = shutil.copytree(trained, tmp_path / "run")
    (tmp_path / "precious").mkdir()
    os.symlink(tmp_path / "precious", run / folder)
    with pytest.raises(ValueError, match=f"run/{folder}: is a symbolic link"):
        program(run)
    assert not list((tmp_path / "precious").iterdir())


@pytest.mark.parametrize("name", ["cameras", "cameras/log.txt", "sparse", "images"])
def test_cameras_are_written_through_no_link(tmp_path, name):
    for folder in ("precious", "photographs"):
        (tmp_path / folder).mkdir()
    for index in range(3):
        Image.new("RGB", (8, 8)).save(tmp_path / "photographs" / f"{index}.png")
    path = tmp_path / "out" / name
    path.parent.mkdir(parents=True)
    os.symlink(tmp_path / "precious", path)
    with pytest.raises(ValueError, match=f"out/{name}: is a symbolic link"):
        estimate_cameras(tmp_path / "photographs", tmp_path / "out", overwrite=True)
    assert not any((tmp_path / "precious").iterdir())


def test_no_image_starts_ghostscript(tmp_path, monkeypatch):
    started = []
    monkeypatch.setattr(EpsImagePlugin, "Ghostscript", lambda *_: started.append(1) or Image.new("RGB", (8, 8)).im)
    content = io.BytesIO()
    Image.new("RGB", (8, 8)).save(content, format="EPS")
    path = tmp_path / "1.png"
    path.write_bytes(content.getvalue())
    Image.open(path).load()
    assert started.pop(), "Pillow alone starts it"
    for read in (image_files.read_image, image_files.read_mask, image_files.read_stored, image_files.image_form):
        with pytest.raises(ValueError, match="1.png: unreadable .it is no PNG/JPEG"):
            read(path)
    assert not camera_plot.is_plot_of(path, tmp_path)
    assert not started


def test_images_are_opened_in_one_place_only():
    """Every other call of Pillow or imageio would let a file's content choose the decoder."""
    calls = []
    for path in [*(ROOT / "jaxnerf").rglob("*.py"), *(ROOT / "experiments").rglob("*.py")]:
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.Call) and ast.unparse(node.func).endswith(("Image.open", "imread", "get_reader")):
                calls.append(str(path.relative_to(ROOT)))
    assert calls == ["jaxnerf/data/images/image_files.py"]
