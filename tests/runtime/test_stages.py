"""What a program says while a stage of its work takes long."""

import re
import time

import pytest

import captures
from jaxnerf.evaluation.evaluate import train_and_evaluate
from jaxnerf.runtime import processes, stages
from runs import PACKED, smoke_config

pytest_plugins = ["run_fixtures"]


@pytest.fixture
def shown(monkeypatch):
    monkeypatch.setattr(stages, "_FIRST", 0.02)
    monkeypatch.setattr(stages, "_EVERY", 0.02)
    stages.show()
    yield
    stages.show(False)


def wait_for(capsys, pattern):
    """Waits until the errors hold a pattern, and returns them."""
    found, deadline = "", time.monotonic() + 60
    while not re.search(pattern, found):
        assert time.monotonic() < deadline, found
        time.sleep(0.01)
        found += capsys.readouterr().err
    return found


def test_a_stage_says_what_it_does_and_how_far_it_is(shown, capsys):
    with stages.stage("reading images", "; 9 s the last time") as stage:
        wait_for(capsys, r"working       reading images for 0 s; 9 s the last time\n")
        stage.update(1200, 3000)
        wait_for(capsys, r"reading images for 0 s, 1,200 of 3,000 done; 9 s the last time\n")
        with stages.stage("compiling"):
            wait_for(capsys, "compiling for")
            capsys.readouterr()
            time.sleep(0.1)
            assert "reading" not in capsys.readouterr().err
        wait_for(capsys, "reading images for")
    capsys.readouterr()
    time.sleep(0.1)
    assert capsys.readouterr().err == ""


def test_a_terminal_shows_one_line_that_disappears(shown, capsys, monkeypatch):
    monkeypatch.setattr("sys.stderr.isatty", lambda: True, raising=False)
    with pytest.raises(KeyError), stages.stage("reading images"):
        found = wait_for(capsys, "reading images for 0 s")
        raise KeyError
    assert "\n" not in found
    assert capsys.readouterr().err.endswith("\r\033[K")


def test_who_imports_the_functions_gets_no_output(monkeypatch, capsys):
    monkeypatch.setattr(stages, "_FIRST", 0.0)
    with stages.stage("reading images"):
        time.sleep(0.05)
    assert capsys.readouterr().err == ""


@pytest.mark.slow
def test_each_long_stage_of_a_run_says_what_it_does(shown, monkeypatch, unoptimized, tmp_path, capsys):
    """Here each stage is long; whoever waits for a large capture sees these lines."""
    monkeypatch.setattr(stages, "_FIRST", 0.0)
    captures.write_colmap(tmp_path / "data", captures.noise(captures.orbit(9)))
    config = smoke_config(max_steps=4, log_every=4, save_every=4)
    config.update_from_flattened_dict({**PACKED, "occupancy.min_views": 1, "scene.contracted": True})
    config.data.format, config.data.dir, config.data.world = "colmap", str(tmp_path / "data"), "around"
    config.data.background = "none"
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    config.eval.at_end = True
    for start in ("first", "second"):
        monkeypatch.setattr(processes, "prints_details", lambda start=start: start == "second")
        assert train_and_evaluate(config, tmp_path / start)
        err = capsys.readouterr().err
        stated = ["reading the dataset", "reading images", "compiling the training step", "rendering an image"]
        cells = ["finding the cells that the cameras see", "finding the cells in front of surfaces"]
        for text in stated + cells * (start == "first"):  # they are cached
            assert f"working       {text}" in err
        assert ("the last time" in err) == (start == "second")
        assert "\nviews " in err and ("values are inferred; --verbosity=1" in err) == (start == "first")
        assert all((f"\n{name} " in err) == (start == "second") for name in ("parameters", "microbatch"))
