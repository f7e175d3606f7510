"""The viewer of a training in the same process, and that of a workdir whose checkpoints change."""

import shutil
import socket
import threading
import time

import jax
import numpy as np
import pytest

import ball_runs
from jaxnerf.evaluation.evaluate import train_and_evaluate
from jaxnerf.evaluation.restore import restore_run
from jaxnerf.runtime.atomic_files import write_text
from jaxnerf.tools.viewer import live
from runs import free_port, smoke_config
from viewer_client import FakeBrowser, difference

pytest_plugins = ["run_fixtures"]
pytestmark = pytest.mark.usefixtures("unoptimized")


@pytest.mark.slow
def test_a_training_is_shown_and_not_changed(trained, tmp_path):
    shown, viewer = [], live.LiveViewer(tmp_path / "run", port=0)

    def observe(state, views):
        viewer.observe(state, views)
        if int(state.step) == 10:
            end = time.monotonic() + 120
            while viewer.port is None:
                assert time.monotonic() < end
                time.sleep(0.1)
            page = FakeBrowser(viewer.port)
            page.move()
            while f"step {int(state.step)}" not in page.status:
                assert time.monotonic() < end
                viewer.observe(state, views)
                page.receive(0.05)
            shown.append(page.image)
            page.close()

    config = smoke_config()
    config.occupancy.resolution, config.occupancy.step_size = 16, 0.1  # of the grid that the viewer extracts
    try:
        assert train_and_evaluate(config, tmp_path / "run", observe=observe)
    finally:
        viewer.close()
    assert len(shown) == 1 and shown[0]
    same, without = (restore_run(folder).variables(20) for folder in (tmp_path / "run", trained))
    assert jax.tree.all(jax.tree.map(np.array_equal, same, without)), "training does not depend on its viewer"


def test_nothing_is_copied_without_a_browser(monkeypatch, tmp_path):
    viewer = live.LiveViewer(tmp_path, port=0)
    started = threading.Event()
    monkeypatch.setattr(viewer, "_run", started.set)
    monkeypatch.setattr(live, "image_params", lambda state: pytest.fail("copied"))
    for _ in range(3):
        viewer.observe(None, None)
    assert started.wait(10)
    viewer.close()


@pytest.mark.slow
def test_new_checkpoints_replace_the_image(tmp_path):
    folder, port, ended = tmp_path / "run", free_port(), threading.Event()
    ball_runs.make_run(folder, "packed", radii=((20, 0.7), (40, 0.3)))
    (folder / "checkpoints" / "40").rename(tmp_path / "40")
    thread = threading.Thread(target=live.view_run, args=(folder,), kwargs={"port": port, "ended": ended}, daemon=True)
    thread.start()
    page = page_of(port, thread)
    before = page.wait_for_quality()
    (tmp_path / "40").rename(folder / "checkpoints" / "40")
    page.wait(lambda: "step 40" in page.status, seconds=60)
    assert difference(page.wait_for_quality(), before) > 3
    page.close()
    ended.set()
    thread.join(30)
    assert not thread.is_alive()


def page_of(port, thread):
    """Returns an open page of a viewer that is starting in a thread."""
    end = time.monotonic() + 120
    while True:
        assert time.monotonic() < end and thread.is_alive()
        try:
            page = FakeBrowser(port)
        except OSError:
            time.sleep(0.2)
            continue
        page.open()
        return page


def largest_file(folder):
    return max((path for path in folder.rglob("*") if path.is_file()), key=lambda path: path.stat().st_size)


def truncate(run, step):
    path = largest_file(run / "checkpoints" / str(step))
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


def empty(run, step):
    shutil.rmtree(run / "checkpoints" / str(step))
    (run / "checkpoints" / str(step)).mkdir()


def write(name, content):
    """Returns a function that writes a file of a run; "STEP" in the name is the step."""

    def act(run, step):
        path = run / name.replace("STEP", str(step))
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(content)

    return act


def replace_by(kind):
    """Returns a function that replaces the run by another."""

    def act(run, step):
        shutil.rmtree(run, ignore_errors=True)
        ball_runs.make_run(run.with_name(f"{kind}{step}"), kind, radii=((step, 0.5),)).rename(run)

    return act


def remove_checkpoints(run, step):
    shutil.rmtree(run / "checkpoints")


def remove(run, step):
    shutil.rmtree(run)


# What happens to the run together with a new checkpoint, and what is reported; "": the checkpoint is shown.
CHANGES = {
    "a truncated checkpoint": (truncate, "cannot be read as this model's state"),
    "a checkpoint that is empty": (empty, "cannot be read as this model's state"),
    "an endless number of views": (write("eval/STEP/results.json", b'{"psnr": 30, "views": Infinity}'), ""),
    "results that are none": (write("eval/STEP/results.json", b"[1]"), ""),
    "metrics that are none": (write("metrics.jsonl", b'\xff{"step": "x"}\n[]\n{"step": 1, "psnr_fine": "y"}\n'), ""),
    "uncertainty that is none": (write("uncertainty/STEP/laplace.npz", b"x"), ""),
    "no checkpoint": (remove_checkpoints, "has no checkpoint any more; step 80 stays"),
    "the same config again": (replace_by("packed"), ""),
    "no workdir": (remove, "has no checkpoint any more; step 100 stays"),
    "another config": (replace_by("contracted"), "holds another run than that which is shown; start again"),
    "the same config once more": (replace_by("packed"), ""),
    "another model": (replace_by("dense"), "holds another run than that which is shown; start again"),
    "a config that is none": (write("config.json", b"{"), "config.json"),
}


@pytest.mark.slow
def test_a_run_that_vanishes_or_is_replaced_leaves_its_viewer_alive(tmp_path, monkeypatch, capfd):
    monkeypatch.setattr(live, "_POLL_SECONDS", 0.1)
    folder, port, ended = tmp_path / "run", free_port(), threading.Event()
    steps = [20, *range(30, 30 + 10 * len(CHANGES), 10)]
    ball_runs.make_run(folder, "packed", radii=tuple((step, 0.7) for step in steps))
    (folder / "checkpoints").rename(tmp_path / "kept")
    shutil.copytree(tmp_path / "kept" / "20", folder / "checkpoints" / "20")
    thread = threading.Thread(target=live.view_run, args=(folder,), kwargs={"port": port, "ended": ended}, daemon=True)
    thread.start()
    page = page_of(port, thread)
    capfd.readouterr()
    for step, (name, (act, expected)) in zip(steps[1:], CHANGES.items(), strict=True):
        staged = folder.with_name(f"run-{step}")
        if folder.is_dir():
            shutil.copytree(folder, staged)
        shutil.copytree(tmp_path / "kept" / str(step), staged / "checkpoints" / str(step))
        act(staged, step)
        if folder.is_dir():
            folder.rename(tmp_path / f"before-{step}")
        if staged.is_dir():
            staged.rename(folder)  # the checkpoint and the change appear together
        said, end = "", time.monotonic() + 20
        while (expected not in said) if expected else (f"**step {step}**" not in page.status):
            assert time.monotonic() < end, (name, said)
            page.receive(0.1)
            said += capfd.readouterr().err
        assert thread.is_alive() and "Traceback" not in said and len(said.splitlines()) <= 2, (name, said)
    ended.set()
    thread.join(30)
    assert not thread.is_alive()


def test_the_score_of_a_checkpoint(tmp_path):
    assert live.score_of(tmp_path, 20) == ""
    rows = [f'{{"step": {step}, "seconds": 1.0, "psnr_fine": {step}.5}}\n' for step in (10, 20, 30)]
    (tmp_path / "metrics.jsonl").write_text("".join(rows))
    assert live.score_of(tmp_path, 20) == "20.50 dB in training"
    (tmp_path / "eval" / "20").mkdir(parents=True)
    write_text(tmp_path / "eval" / "20" / "results.json", '{"psnr": 31.456, "views": 8}')
    assert live.score_of(tmp_path, 20) == "PSNR 31.46 dB over 8 views"
    for wrong in ("{", "[1]", '{"psnr": 30, "views": Infinity}', '{"psnr": {}, "views": 8}', '{"views": 8}'):
        write_text(tmp_path / "eval" / "20" / "results.json", wrong)
        assert live.score_of(tmp_path, 20) == "20.50 dB in training", wrong
    (tmp_path / "metrics.jsonl").write_text('{"step": 10, "seconds": 1.0, "psnr_fine": "x"}\n')
    assert live.score_of(tmp_path, 20) == ""
    (tmp_path / "metrics.jsonl").unlink()
    (tmp_path / "metrics.jsonl").mkdir()
    assert live.score_of(tmp_path, 20) == ""


def test_a_taken_port_is_refused_before_training(tmp_path):
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        with pytest.raises(ValueError, match=f"^port {port} of 127.0.0.1: the viewer cannot listen there"):
            live.LiveViewer(tmp_path / "run", port=port)
        with pytest.raises(ValueError, match=f"^port {port} of 127.0.0.1: the viewer cannot listen there"):
            live.view_run(tmp_path / "no-run", port=port)
    assert not (tmp_path / "run").exists()
