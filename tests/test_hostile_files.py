"""Files from strangers: no reader waits for a pipe, reads a device, or starts another program."""

import ast
import io
import os
import shutil
import signal
import subprocess
import sys

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
from runs import ROOT, evaluate, module_of, render_path, run_forked
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


_MODULES = ("multiprocessing", "numpy", "jax", "json", "pickle", "matplotlib", "cv2", "sitecustomize", "PIL", "scipy")


def plant(folder):
    """Puts modules and settings into a folder that a program must not use: they leave the file `used`."""
    for name in _MODULES:
        (folder / f"{name}.py").write_text(
            f"open({str(folder / 'used')!r}, 'a').write('{name} ')\nraise SystemExit(9)\n"
        )
    for name in ("smoke", "default"):  # configs of this package, whose names win
        shutil.copy(folder / "json.py", folder / name)
    (folder / "matplotlibrc").write_text("text.usetex: True\nsavefig.dpi: nonsense\n")
    return folder


def test_python_that_a_program_starts_imports_nothing_of_the_working_folder(tmp_path):
    program = tmp_path / "program" / "program.py"
    program.parent.mkdir()
    call = "subprocess.run([sys.executable, '-c', 'import json, multiprocessing, numpy'], check=True)"
    program.write_text(
        f"import subprocess, sys\nfrom jaxnerf.runtime import cli\ncli.run(lambda argv: {call} and print('done'))\n"
    )
    code, out, err = run_forked(program, folder=plant(tmp_path))
    assert (code, out) == (0, "done\n"), err
    assert not (tmp_path / "used").exists()


@pytest.mark.extra
@pytest.mark.parametrize("by_module", [False, True])
def test_no_program_imports_from_the_working_folder(trained, tmp_path, by_module):
    run = shutil.copytree(trained, tmp_path / "run")
    working = tmp_path / "working"
    working.mkdir()
    plant(working)
    for index in range(3):
        Image.new("RGB", (8, 8)).save(working / f"{index}.png")
    export = ["--num_points=9", "--num_views=1", "--size=16"]
    calls = {
        "train": ["--config=smoke", f"--workdir={run}", "--config.train.save_every=5"],
        "eval": [f"--workdir={run}"],
        "render": [f"--workdir={run}", "--frames=1", "--width=8", "--video=none"],
        "report": [run, "--plot=a.png"],
        "check": [f"--workdir={run}"],
        "export": [f"--workdir={run}", "--kind=points", *export],
        "cameras": ["--images=.", f"--out={tmp_path / 'out'}"],
        "convert": ["--config=smoke", "--weights=none", f"--workdir={tmp_path / 'new'}"],
        "view": ["--workdir=none"],
    }
    for program, flags in calls.items():
        module = module_of(program)
        what = ["-m", module] if by_module else ["-P", "-c", f"import {module}; {module}.run()"]
        # As an installed program, whose folder is not the working folder; a package that is not installed needs a path.
        environment = {**os.environ, "PYTHONPATH": str(ROOT)}
        command = [sys.executable, *what, *map(str, flags)]
        done = subprocess.run(command, cwd=working, capture_output=True, text=True, env=environment)
        assert not (working / "used").exists(), (program, (working / "used").read_text())
        assert done.returncode in (0, 1) and "Traceback" not in done.stderr, (program, done.stderr)


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
