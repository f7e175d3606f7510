"""The viewer of a training in the same process, and that of a workdir whose checkpoints change."""

import socket
import threading
import time

import jax
import numpy as np
import pytest

import ball_runs
from jaxnerf.evaluation.evaluate import train_observed
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
        assert train_observed(config, tmp_path / "run", observe=observe)
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
    page, end = None, time.monotonic() + 120
    while page is None:
        assert time.monotonic() < end and thread.is_alive()
        try:
            page = FakeBrowser(port)
        except OSError:
            time.sleep(0.2)
    page.open()
    before = page.wait_for_quality()
    (tmp_path / "40").rename(folder / "checkpoints" / "40")
    page.wait(lambda: "step 40" in page.status, seconds=60)
    assert difference(page.wait_for_quality(), before) > 3
    page.close()
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
    write_text(tmp_path / "eval" / "20" / "results.json", "{")
    assert live.score_of(tmp_path, 20) == "20.50 dB in training"


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
