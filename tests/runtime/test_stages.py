"""What a program says while a stage of its work takes long."""

import io
import sys
import threading

import pytest

import captures
from jaxnerf.evaluation.evaluate import train_and_evaluate
from jaxnerf.runtime import processes, signals, stages
from runs import PACKED, smoke_config

pytest_plugins = ["run_fixtures"]


class Terminal(io.StringIO):
    def isatty(self):
        return True


@pytest.fixture
def clock(monkeypatch):
    """Lets seconds pass and CPU time be spent by hand, and does then what the thread does."""
    now = [0.0]
    spent = [0.0]
    values = {"_shown": True, "_now": lambda: now[0], "_cpu": lambda: spent[0], "running": [], "_said": {}, "_spent": 0}
    for name, value in values.items():
        monkeypatch.setattr(stages, name, value)
    monkeypatch.setattr(stages._between, "started", 0.0)

    def pass_seconds(seconds, cpu=1):
        for _ in range(seconds):
            now[0] += 1
            spent[0] += cpu
            stages.tick()

    return pass_seconds


def test_a_log_file_gets_a_line_for_each_stage_that_lasts_and_one_for_each_further_minute(clock, capsys):
    with stages.stage("reading the dataset"), stages.stage("reading images") as stage:
        clock(3)
        assert capsys.readouterr().err == ""
        clock(1)
        stage.update(1200, 3000)
        clock(120)
    with stages.stage("compiling"):
        clock(3)
    shown = "working       reading the dataset for %d s: reading images%s\n"
    done = ", 1,200 of 3,000 done"
    assert capsys.readouterr().err == shown % (4, "") + shown % (64, done) + shown % (124, done)
    clock(59)
    clock(300, cpu=0)  # it waits
    assert capsys.readouterr().err == ""
    clock(60)
    assert capsys.readouterr().err == "working       preparing for 60 s\n"


def test_a_log_file_gets_the_first_result_one_a_minute_and_the_last(clock, capsys):
    with stages.Progress("scoring", 200) as progress, stages.stage("rendering an image"):
        clock(4)
        for done in range(1, 131):
            clock(1)
            progress.show(done, f"view {done}")
    found = capsys.readouterr().err.splitlines()
    assert found == ["0/200  scoring", "59/200  view 59", "119/200  view 119", "130/200  view 130"]


def test_a_terminal_has_one_line_that_is_rewritten_each_second(clock, monkeypatch):
    monkeypatch.setattr("sys.stderr", signals._Output(stream := Terminal()))
    monkeypatch.setenv("COLUMNS", "60")
    with stages.Progress("training", 200) as progress:
        progress.done = 9
        clock(1)
        progress.show(100, "20 dB\x07")
        with stages.stage("saving the checkpoint"):
            clock(2)
            print("a line of its own", file=sys.stderr)
        with pytest.raises(KeyError), stages.stage("reading " + 60 * "x"):
            raise KeyError
    bars = [f"[{marks:<24}] {percent:3d} %  " for marks, percent in (("", 0), (12 * "#", 50))]
    saving = f"{bars[1]}100/200  20 dB\\x07: saving the checkpoint"[:59]
    lines = [f"{bars[0]}9/200  training", f"{bars[1]}100/200  20 dB\\x07", saving, saving, "a line of its own\n"]
    assert stream.getvalue().split("\r\033[K") == [*lines[:-1], f"{lines[-1]}{bars[1]}100/200  20 dB\\x07\n"]


def test_a_line_of_a_stage_does_not_end_up_in_text_that_is_being_written(clock, monkeypatch):
    monkeypatch.setattr("sys.stderr", signals._Output(stream := Terminal()))
    sys.stderr.write("half")
    clock(1)
    sys.stderr.write(" a line\n")
    clock(1)
    stages.show(False)
    assert stream.getvalue() == "half a line\nworking       preparing for 2 s\r\033[K"


def test_a_program_starts_a_thread_that_writes_until_it_ends(monkeypatch):
    monkeypatch.setattr(stages, "_shown", False)
    monkeypatch.setattr(stages, "_EVERY", 0.0)
    monkeypatch.setattr(stages, "tick", (ticked := threading.Event()).set)
    stages.show()
    (thread,) = (each for each in threading.enumerate() if each.name == "stages")
    assert ticked.wait(60)
    stages.show(False)
    thread.join(60)
    assert not thread.is_alive()


def test_who_imports_the_functions_gets_no_output(monkeypatch, capsys):
    monkeypatch.setattr(stages.threading, "Thread", None)  # nothing would start one
    with stages.stage("reading images"):
        assert not stages._shown
    assert capsys.readouterr().err == ""


@pytest.mark.slow
def test_each_long_stage_of_a_run_says_what_it_does(monkeypatch, unoptimized, tmp_path, capsys):
    """Whoever waits for a large capture sees the lines of these stages."""

    class Running(list):
        def append(self, stage):
            super().append(stage)
            heads.append(stage.head())

    monkeypatch.setattr(stages, "running", Running())
    captures.write_colmap(tmp_path / "data", captures.noise(captures.orbit(9)))
    config = smoke_config(max_steps=4, log_every=4, save_every=4)
    config.update_from_flattened_dict({**PACKED, "occupancy.min_views": 1, "scene.contracted": True})
    config.data.format, config.data.dir, config.data.world = "colmap", str(tmp_path / "data"), "around"
    config.data.background = "none"
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    config.eval.at_end = True
    for start in ("first", "second"):
        monkeypatch.setattr(processes, "prints_details", lambda start=start: start == "second")
        heads = []
        assert train_and_evaluate(config, tmp_path / start)
        said = "\n".join(heads)
        err = capsys.readouterr().err
        stated = ["reading the dataset", "reading images", "compiling the training step", "rendering an image"]
        cells = ["finding the cells that the cameras see", "finding the cells in front of surfaces"]
        for text in stated + cells * (start == "first"):  # they are cached
            assert f"working       {text}" in said
        assert "\nviews " in err and ("values are inferred; --verbosity=1" in err) == (start == "first")
        assert all((f"\n{name} " in err) == (start == "second") for name in ("parameters", "microbatch"))
