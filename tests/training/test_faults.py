"""Faults around a run are reported, and nothing that was saved is lost. tests/slow/faults has more of them."""

import contextlib
import json
import os
import shutil
import signal
import socket
import subprocess
import sys

import jax
import numpy as np
import pytest

from jaxnerf.evaluation import evaluate
from jaxnerf.evaluation.evaluate import train_and_evaluate
from jaxnerf.evaluation.restore import restore_run
from jaxnerf.training import metric_log
from jaxnerf.training.build import build
from jaxnerf.training.checkpoint import Checkpoints
from jaxnerf.training.config import read_config
from jaxnerf.training.state import create_state
from jaxnerf.training.workdir import save_config, workdir_lock
from runs import ROOT, SMOKE_FLAGS, smoke_config
from slow.faults import kill_many

pytest_plugins = ["run_fixtures"]
pytestmark = pytest.mark.usefixtures("unoptimized")


@pytest.fixture
def folder(trained, tmp_path):
    """A copy of a run of 20 steps with checkpoints at 10, 15 and 20."""
    return shutil.copytree(trained, tmp_path / "run")


def variables(folder, step):
    return jax.device_get(restore_run(folder).variables(step))


def load_newest(folder, keep):
    experiment = build(restore_run(folder).experiment.config)
    checkpoints = Checkpoints(folder, max_to_keep=keep)
    like = create_state(experiment.model, experiment.optimizer, experiment.config.seed)
    try:
        return checkpoints.load_newest(like)
    finally:
        checkpoints.close()


def assert_near(a, b, atol):
    jax.tree.map(lambda x, y: np.testing.assert_allclose(x, y, rtol=0, atol=atol), a, b)


def numbers(folder, step):
    """Returns the files that hold the arrays of a checkpoint; orbax may write them in two places."""
    return [path for path in (folder / "checkpoints" / str(step)).rglob("d/*") if path.is_file()]


def remove(paths):
    for path in paths:
        os.remove(path)


def cut(paths):
    for path in paths:
        os.truncate(path, path.stat().st_size // 2)


@pytest.mark.slow
def test_kill_loses_nothing(unoptimized, tmp_path, monkeypatch):
    # A process that is killed while it writes a compiled program would leave half of it to the other tests.
    monkeypatch.setenv("JAX_COMPILATION_CACHE_DIR", str(tmp_path / "compiled"))
    kill_many.main(kills=1, seed=3, out=tmp_path)


@pytest.mark.slow
def test_truncated_checkpoint_is_renamed_and_training_continues_from_the_one_before(folder, trained, capsys):
    cut(numbers(folder, 20))
    assert train_and_evaluate(smoke_config(), folder)
    said = [line for line in capsys.readouterr().err.splitlines() if "cannot be read" in line]
    assert len(said) == 1 and "checkpoints/20: " in said[0]
    assert said[0].endswith("kept as 20.unreadable, continuing from the previous checkpoint")
    assert Checkpoints(folder).steps() == [10, 15, 20]
    assert numbers(folder, "20.unreadable") and not numbers(folder, "20.unreadable-2")
    assert_near(variables(folder, 20), variables(trained, 20), atol=0)
    assert [row["step"] for row in metric_log.read_rows(folder)] == [5, 10, 15, 20]


@pytest.mark.parametrize("damage", [cut, remove])
def test_incomplete_checkpoint_is_an_error(folder, damage):
    damage(numbers(folder, 20))
    with pytest.raises(ValueError, match="checkpoints/20: cannot be read .*remove it"):
        variables(folder, 20)
    variables(folder, 15)


def test_changed_checkpoint_is_an_error(folder):
    """orbax itself does not detect changed arrays."""
    shutil.rmtree(folder / "checkpoints" / "20" / "state")
    shutil.copytree(folder / "checkpoints" / "15" / "state", folder / "checkpoints" / "20" / "state")
    with pytest.raises(ValueError, match="checkpoints/20: .*its numbers are not those that were saved"):
        variables(folder, 20)


def test_checkpoint_of_another_step_is_an_error(folder):
    shutil.copytree(folder / "checkpoints" / "15", folder / "checkpoints" / "25")
    with pytest.raises(ValueError, match="checkpoints/25: .*it holds step 15"):
        variables(folder, 25)
    state, said = load_newest(folder, keep=3)
    assert int(state.step) == 20 and "kept as 25.unreadable" in said[0]


def test_folders_that_are_no_steps_are_ignored(folder):
    for name in ("030", "9" * 20, "²", "٣", "25.unreadable"):
        (folder / "checkpoints" / name).mkdir()
    assert Checkpoints(folder).steps() == [10, 15, 20]
    assert int(load_newest(folder, keep=3)[0].step) == 20


def test_if_no_checkpoint_can_be_read_none_is_renamed(folder):
    for step in (10, 15, 20):
        cut(numbers(folder, step))
    with pytest.raises(ValueError, match="checkpoints/20: cannot be read"):
        load_newest(folder, keep=3)
    assert Checkpoints(folder).steps() == [10, 15, 20]


@pytest.mark.extra
def test_a_signal_while_a_checkpoint_is_read_does_not_rename_it(folder, monkeypatch):
    """orbax reads in a loop of its own and raises an error of its own."""

    class Interrupted:
        def reload(self):
            """Does nothing."""

        def load(self, *_):
            """Raises what orbax does."""
            raise RuntimeError("cannot load") from KeyboardInterrupt(signal.SIGTERM)

    monkeypatch.setattr(Checkpoints, "_open", lambda self: Interrupted())
    with pytest.raises(KeyboardInterrupt) as raised:
        load_newest(folder, keep=3)
    assert raised.value.args == (signal.SIGTERM,) and (folder / "checkpoints" / "20").is_dir()


def test_run_resumes_with_another_number_of_devices(folder, trained, monkeypatch):
    """It was trained on four; only the order in which gradients are summed differs."""
    shutil.rmtree(folder / "checkpoints" / "20")
    one = jax.devices()[:1]
    monkeypatch.setattr(jax, "devices", lambda *_: one)
    monkeypatch.setattr(jax, "device_count", lambda *_: 1)
    assert train_and_evaluate(smoke_config(), folder)
    assert_near(variables(folder, 20), variables(trained, 20), atol=1e-6)


def test_unfinished_checkpoint_of_a_killed_process_is_ignored_and_removed(folder):
    rest = shutil.copytree(folder / "checkpoints" / "15", folder / "checkpoints" / "17.orbax-checkpoint-tmp")
    state, said = load_newest(folder, keep=None)
    assert (int(state.step), said) == (20, []) and rest.exists(), "a reader removes nothing"
    load_newest(folder, keep=3)
    assert not rest.exists()


def test_second_training_is_an_error_that_names_the_first(folder):
    before = {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}
    with workdir_lock(folder):
        with pytest.raises(ValueError, match=f"run: process {os.getpid()} on .* is training there; wait"):
            train_and_evaluate(smoke_config(max_steps=40), folder)
        assert Checkpoints(folder).steps() == [10, 15, 20]
    assert {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()} == before
    with workdir_lock(folder):
        pass


def test_lock_of_a_killed_process_is_released(tmp_path):
    held = (
        f"from jaxnerf.training.workdir import workdir_lock\n"
        f"with workdir_lock({str(tmp_path)!r}): print(1, flush=True); input()"
    )
    process = subprocess.Popen([sys.executable, "-c", held], cwd=ROOT, stdin=subprocess.PIPE, stdout=subprocess.PIPE)
    process.stdout.readline()
    with pytest.raises(ValueError, match=f"process {process.pid} on "):
        workdir_lock(tmp_path).__enter__()
    process.kill()
    process.communicate()
    assert (tmp_path / "running").exists()
    with workdir_lock(tmp_path):
        pass
    assert not list(tmp_path.iterdir())


def test_lock_follows_no_symbolic_link(tmp_path):
    (tmp_path / "run").mkdir()
    (tmp_path / "precious").write_text("content")
    os.symlink(tmp_path / "precious", tmp_path / "run" / "running")
    with pytest.raises(ValueError, match="run: cannot be written"), workdir_lock(tmp_path / "run"):
        pass
    assert (tmp_path / "precious").read_text() == "content"


def test_system_without_locks_prints_a_warning(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr("jaxnerf.training.workdir.fcntl", None)
    with workdir_lock(tmp_path):
        assert "cannot be locked" in capsys.readouterr().err


@contextlib.contextmanager
def mounted(folder, *options):
    folder.mkdir()
    done = subprocess.run(["mount", "-t", "tmpfs", *options, "none", folder], capture_output=True, text=True)
    if done.returncode:
        pytest.skip(f"mounting is not permitted here: {done.stderr.strip()}")
    try:
        yield folder
    finally:
        subprocess.run(["umount", "-l", folder], check=True)


def test_read_only_disk_is_an_error(trained, tmp_path):
    with mounted(tmp_path / "disk", "-o", "size=8m") as disk:
        shutil.copytree(trained, disk / "run")
        subprocess.run(["mount", "-o", "remount,ro", disk], check=True)
        for name in ("run", "new"):
            with pytest.raises(ValueError, match=f"disk/{name}: cannot be written .Read-only file system.; make"):
                train_and_evaluate(smoke_config(), disk / name)
        variables(disk / "run", 20)  # reading works


def test_full_disk_while_writing_metrics_is_an_error(tmp_path, monkeypatch):
    log = metric_log.MetricLog(tmp_path, first_step=0)
    monkeypatch.setattr(metric_log, "open_regular", lambda path, mode: open("/dev/full", mode))
    with pytest.raises(OSError, match="No space left.*metrics.jsonl"):
        log.append({"step": 1, "seconds": 1.0})
    log.close()


def test_full_disk_while_writing_events_does_not_stop_training(tmp_path, monkeypatch, capsys):
    """tensorboardX's SummaryWriter would wait forever from the eleventh row on."""
    folder = tmp_path / "tensorboard"
    folder.mkdir()
    monkeypatch.setattr("tensorboardX.event_file_writer.time.time", lambda: 1.0)
    os.symlink("/dev/full", folder / f"events.out.tfevents.1.0.{socket.gethostname()}")
    log = metric_log.MetricLog(tmp_path, first_step=0)
    for step in range(1, 100):
        log.append({"step": step, "seconds": 1.0})
    log.close()
    said = capsys.readouterr().err.splitlines()
    assert len(said) == 1 and "tensorboard: event files end here (No space left on device)" in said[0]
    assert len(metric_log.read_rows(tmp_path)) == 99


def test_damaged_rows_are_dropped_and_reported(tmp_path, capsys):
    good = [json.dumps({"step": step, "seconds": 1.0 * step}).encode() for step in (1, 2, 3, 4)]
    bad = [b'{"step": 2, "sec', b"\xff\xfe\x00", b"5", b'{"seconds": 1}', b'{"step": "3", "seconds": 1}', b""]
    bad += [b'{"step": 3, "seconds": %s}' % value for value in (b"NaN", b"null", b'"1"', b"-1", b"true", b"1e999")]
    bad += [b'{"step": 3, "seconds": 1, "rays": %s}' % value for value in (b"[]", b"NaN", b"null", b"9" * 99)]
    bad += [b'{"step": -3, "seconds": 1}', b'{"step": 3, "seconds": 1, "lr": "x"}', b"[" * 100_000]
    content = b"\n".join([good[0], *bad, *good[1:], b'{"step": 5'])
    (tmp_path / "metrics.jsonl").write_bytes(content)
    assert [row["step"] for row in metric_log.read_rows(tmp_path)] == [1, 2, 3, 4]
    log = metric_log.MetricLog(tmp_path, first_step=3)
    log.append({"step": 4, "seconds": 9.0})
    log.close()
    said = capsys.readouterr().err.splitlines()
    assert said[0].endswith(
        "dropped 19 lines from line 2 on that are not rows; the file is kept as metrics.jsonl.damaged"
    )
    assert said[1].endswith("metrics.jsonl: dropped an incomplete last line") and len(said) == 2
    assert (tmp_path / "metrics.jsonl.damaged").read_bytes() == content
    assert [row["seconds"] for row in metric_log.read_rows(tmp_path)] == [1.0, 2.0, 3.0, 9.0]
    assert (tmp_path / "metrics.jsonl").read_bytes().count(b"\n") == 4


def test_checkpoint_between_two_rows_has_its_own_row(trained, tmp_path):
    assert train_and_evaluate(smoke_config(log_every=4, save_every=6, max_steps=12), tmp_path / "run")
    assert [row["step"] for row in metric_log.read_rows(tmp_path / "run")] == [4, 6, 8, 12]


def test_signal_during_evaluation_keeps_the_checkpoints(folder, monkeypatch, capsys):
    config = smoke_config()
    config.eval.at_end = True

    def interrupt(run, folder, shard):
        os.kill(os.getpid(), signal.SIGINT)

    monkeypatch.setattr(evaluate, "score_run", interrupt)
    assert not train_and_evaluate(config, folder)
    assert capsys.readouterr().err.splitlines()[-1].startswith("stopped while scoring; the checkpoints are saved")
    (folder / "eval" / "20").mkdir(parents=True)
    assert train_and_evaluate(config, folder), "an evaluated checkpoint is not evaluated again"


@pytest.mark.slow
@pytest.mark.parametrize(
    "how", [pytest.param("SIGHUP", marks=pytest.mark.extra), pytest.param("reader", marks=pytest.mark.extra), "closed"]
)
def test_run_whose_terminal_or_reader_goes_away_is_saved(compiled_once, tmp_path, how):
    steps = 40 if how == "closed" else 1_000_000
    program = "from jaxnerf import train; from jaxnerf.runtime import stages; stages._AGAIN = 1.0; train.run()"
    command = [sys.executable, "-c", program, f"--workdir={tmp_path}/run", *SMOKE_FLAGS]
    command += [f"--config.train.max_steps={steps}", "--config.train.log_every=1", "--config.train.save_every=1000000"]
    close = {"preexec_fn": lambda: os.close(2)} if how == "closed" else {}
    process = subprocess.Popen(command, cwd=ROOT, stderr=subprocess.PIPE, text=True, **close)
    if how != "closed":
        assert any(line.startswith("1/") for line in process.stderr)
    if how == "SIGHUP":
        process.send_signal(signal.SIGHUP)
    process.stderr.close()
    assert process.wait(timeout=100) == 0
    rows = [row["step"] for row in metric_log.read_rows(tmp_path / "run")]
    assert Checkpoints(tmp_path / "run").steps() == [rows[-1]] and rows[-1] <= steps
    assert rows == list(range(1, rows[-1] + 1)) and (how != "closed" or rows[-1] == 40)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_signal_before_training_prints_one_line(number):
    main = f"lambda argv: os.kill(os.getpid(), {int(number)}) or input()"
    program = f"import os\nfrom jaxnerf.runtime import cli\ncli.run({main})"
    done = subprocess.run(
        [sys.executable, "-c", program], cwd=ROOT, capture_output=True, text=True, stdin=subprocess.PIPE
    )
    assert done.returncode == 128 + number
    assert done.stderr.startswith("stopped before ") and len(done.stderr.splitlines()) == 1


def test_partial_files_of_a_killed_run_are_removed_and_no_others(tmp_path):
    for name in ("config.json.0a1b.tmp", "metrics.jsonl.0a1b.tmp", "notes.tmp"):
        (tmp_path / name).write_text("partial")
    for name in ("folder.tmp", "config.json.folder.tmp"):
        (tmp_path / name).mkdir()
    save_config(tmp_path, read_config(smoke_config()))
    assert {path.name for path in tmp_path.iterdir()} == {
        "config.json",
        "notes.tmp",
        "folder.tmp",
        "config.json.folder.tmp",
    }


def test_a_workdir_that_is_not_utf8_is_refused_before_training(tmp_path):
    folder = os.fsdecode(os.fsencode(tmp_path) + b"/\xff")
    for use in (Checkpoints, lambda folder: workdir_lock(folder).__enter__()):
        with pytest.raises(ValueError, match="is not UTF-8 .* rename them"):
            use(folder)
    assert not os.path.exists(folder)


def test_a_clock_that_goes_backwards_changes_nothing(folder, monkeypatch):
    clock = iter(range(2**31, 0, -3600))
    monkeypatch.setattr("time.time", lambda: float(next(clock)))
    train_and_evaluate(smoke_config(max_steps=22), folder)
    rows = metric_log.read_rows(folder)
    seconds = [row["seconds"] for row in rows]
    assert rows[-1]["step"] == 22 and seconds == sorted(seconds) and Checkpoints(folder).steps()[-1] == 22
