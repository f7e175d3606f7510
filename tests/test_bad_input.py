"""Tests that bad input ends with a one-line message and a nonzero exit code, and leaves files as they were."""

import errno
import json
import os
import shutil
import subprocess

import numpy as np
import pytest
from PIL import Image

from jaxnerf.evaluation import output_images
from jaxnerf.evaluation.evaluate import train_and_evaluate
from jaxnerf.runtime import atomic_files
from jaxnerf.training.checkpoint import Checkpoints
from jaxnerf.training.metric_log import read_rows
from runs import SMOKE_FLAGS, evaluate, run_forked, smoke_config

pytest_plugins = ["run_fixtures"]
pytestmark = pytest.mark.usefixtures("unoptimized")

DATASET = ("--config.data.format=blender", "--config.data.dir=nowhere")


def files(folder):
    """Returns the content of every file below a folder."""
    return {path: path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()}


def assert_one_line(result, *parts):
    found, out, err = result
    lines = err.splitlines()
    assert found != 0, err
    assert len(lines) == 1 and lines[0].startswith("error: "), err
    for part in parts:
        assert part in lines[0]


@pytest.mark.parametrize(
    "flags, part",
    [
        (["--config=configs/nothing.py"], "nothing.py"),
        ([SMOKE_FLAGS[0], "--colour=red"], "colour"),
        ([SMOKE_FLAGS[0], "--config.train.batchsize=2"], "batchsize"),
        ([SMOKE_FLAGS[0], "--config.train.batch_size=1.5"], "batch_size"),
        ([SMOKE_FLAGS[0], *DATASET], "nowhere"),
        ([SMOKE_FLAGS[0], "more"], "more"),
        ([], "config"),
    ],
)
def test_a_wrong_command_line_makes_no_workdir(tmp_path, flags, part):
    assert_one_line(run_forked("train", f"--workdir={tmp_path / 'run'}", *flags), part)
    assert not (tmp_path / "run").exists()


def test_a_syntax_error_in_a_config_is_reported(tmp_path):
    (tmp_path / "wrong.py").write_text("def get_config(:\n")
    assert_one_line(run_forked("train", f"--workdir={tmp_path}/run", f"--config={tmp_path}/wrong.py"), "wrong.py")


def test_evaluating_an_empty_folder_leaves_it_empty(tmp_path):
    with pytest.raises(ValueError, match="config.json: no such file"):
        evaluate(tmp_path)
    assert files(tmp_path) == {}


@pytest.mark.parametrize("text", ['{"seed": 0, "data": {"for', "[1]", "{}", '"text"', '{"seed": 0, "data": 3}'])
def test_a_corrupt_config_is_reported(trained, tmp_path, text):
    folder = shutil.copytree(trained, tmp_path / "run")
    (folder / "config.json").write_text(text)
    before = files(folder)
    for program in (evaluate, lambda folder: train_and_evaluate(smoke_config(), folder)):
        with pytest.raises(ValueError, match="config.json"):
            program(folder)
    assert files(folder) == before


def test_a_workdir_with_another_config_stays_as_it_is(trained):
    before = files(trained)
    config = smoke_config(batch_size=32)
    config.fine.width = 32
    with pytest.raises(ValueError, match="fine.width 16 -> 32.*batch_size 64 -> 32"):
        train_and_evaluate(config, trained)
    assert files(trained) == before


def blender_dataset(folder, frames=1):
    pose = np.eye(4)
    pose[2, 3] = 4
    for split, count in (("train", frames), ("test", 0)):
        entries = [{"file_path": f"./{split}_{i}", "transform_matrix": pose.tolist()} for i in range(count)]
        (folder / f"transforms_{split}.json").write_text(json.dumps({"camera_angle_x": 0.7, "frames": entries}))
        for i in range(count):
            Image.new("RGBA", (12, 12), (200, 100, 0, 128)).save(folder / f"{split}_{i}.png")
    return folder


def dataset_config(folder, **data):
    config = smoke_config(max_steps=1)
    config.data.update({"format": "blender", "dir": str(folder), **data})
    return config


@pytest.mark.parametrize(
    "data, message",
    [
        ({"near": 6.0, "far": 2.0}, "near"),
        ({"near": 2.0, "far": 2.0}, "near"),
        ({"factor": 5}, "factor 5 does not divide"),
        ({"format": "nerf"}, "no dataset format 'nerf'"),
        ({"dir": ""}, "data.dir is ''"),
    ],
)
def test_a_wrong_dataset_makes_no_workdir(tmp_path, data, message):
    blender_dataset(tmp_path)
    with pytest.raises(ValueError, match=message):
        train_and_evaluate(dataset_config(tmp_path, **data), tmp_path / "run")
    assert not (tmp_path / "run").exists()


def test_an_empty_split_is_reported(tmp_path):
    with pytest.raises(ValueError, match="transforms_train.json"):
        train_and_evaluate(dataset_config(blender_dataset(tmp_path, frames=0)), tmp_path / "run")
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize(
    "batch_size, message", [(-64, "expected at least 1"), (62, "batch_size 62 .*change train.batch_size")]
)
def test_a_wrong_batch_size_makes_no_workdir(tmp_path, batch_size, message):
    with pytest.raises(ValueError, match=message):
        train_and_evaluate(smoke_config(batch_size=batch_size), tmp_path / "run")
    assert not (tmp_path / "run").exists()


def full(*args, **options):
    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


def test_a_full_disk_keeps_the_old_text_file(tmp_path, monkeypatch):
    (tmp_path / "config.json").write_text("old")
    monkeypatch.setattr(atomic_files.os, "fsync", full)
    with pytest.raises(OSError, match="No space left"):
        atomic_files.write_text(tmp_path / "config.json", "new")
    assert [path.name for path in tmp_path.iterdir()] == ["config.json"]
    assert (tmp_path / "config.json").read_text() == "old"


@pytest.mark.slow
def test_a_full_disk_keeps_the_old_results(trained, tmp_path, monkeypatch):
    folder = shutil.copytree(trained, tmp_path / "run")
    (folder / "eval" / "20").mkdir(parents=True)
    (folder / "eval" / "20" / "results.json").write_text("{}")
    before = files(folder)
    monkeypatch.setattr(output_images, "write_contact_sheet", full)
    for options in ({"step": 15}, {"overwrite": True}):
        with pytest.raises(OSError, match="No space left"):
            evaluate(folder, **options)
    for step in ("15.tmp", "20.tmp"):  # the finished views stay for the next call
        assert len(list((folder / "eval" / step / "rows").iterdir())) == 8
        shutil.rmtree(folder / "eval" / step)
    assert files(folder) == before


@pytest.mark.slow
def test_a_full_disk_keeps_complete_checkpoints(trained, tmp_path):
    """Trains on a small tmpfs until it is full, if the process may mount one."""
    disk = tmp_path / "disk"
    disk.mkdir()
    mounted = subprocess.run(["mount", "-t", "tmpfs", "-o", "size=320k", "none", disk], capture_output=True)
    if mounted.returncode:
        pytest.skip(f"cannot mount a disk: {mounted.stderr.decode().strip()}")
    try:
        result = run_forked(
            "train",
            f"--workdir={disk}/run",
            *SMOKE_FLAGS,
            "--config.train.max_to_keep=100",
            "--config.train.max_steps=1000",
        )
        assert result[0] == 1
        assert "Traceback" not in result[2]
        assert result[2].splitlines()[-1].startswith("error: ") and "space" in result[2].splitlines()[-1].lower()
        steps = Checkpoints(disk / "run").steps()
        assert steps and steps == list(range(5, steps[-1] + 1, 5))
        kept = shutil.copytree(disk / "run", tmp_path / "kept")
    finally:
        subprocess.run(["umount", "-l", disk], check=True)
    assert train_and_evaluate(smoke_config(max_to_keep=100, max_steps=steps[-1] + 5), kept)
    assert [row["step"] for row in read_rows(kept)] == list(range(5, steps[-1] + 6, 5))
