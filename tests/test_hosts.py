"""Several processes train as one; how they find each other, and what is said when they do not."""

import json
import threading

import jax
import numpy as np
import pytest

from device_matrix import difference
from jaxnerf.engine import hosts, parallel
from jaxnerf.engine.checkpoint import Checkpoints
from jaxnerf.engine.load import open_run
from runs import free_port, packed_flags, run, start

pytest_plugins = ["engine_fixtures"]

STEPS = 6
FLAGS = [
    "--config=configs/smoke.py",
    *packed_flags(),
    "--config.train.save_every=3",
    "--config.eval.at_end=True",
]
FLAGS += [f"--config.train.max_steps={STEPS}", "--config.train.lr_steps=20", "--config.train.log_every=3"]
SLURM = {"SLURM_JOB_ID": "4711", "SLURM_STEP_NODELIST": "127.0.0.1", "SLURM_NTASKS": "2"}
SLURM["SLURM_STEP_NUM_TASKS"] = "2"


@pytest.fixture(scope="module")
def together(compiled_once, tmp_path_factory):
    """A workdir, and what two processes of two devices each said that a faked srun has started."""
    folder = tmp_path_factory.mktemp("together") / "run"
    environment = {**SLURM, "JAX_COORDINATOR_PORT": str(free_port()), "JAX_NUM_CPU_DEVICES": "2"}
    started = [
        start("train", *FLAGS, f"--workdir={folder}", **environment, SLURM_PROCID=index, SLURM_LOCALID=index)
        for index in "01"
    ]
    said = [process.communicate(timeout=300)[1] for process in started]
    assert [process.returncode for process in started] == [0, 0], "\n".join(said)
    return folder, said


@pytest.fixture(scope="module")
def alone(compiled_once, tmp_path_factory):
    """The workdir of one process with one device."""
    folder = tmp_path_factory.mktemp("alone") / "run"
    result = start("train", *FLAGS, f"--workdir={folder}", JAX_NUM_CPU_DEVICES="1")
    _, err = result.communicate(timeout=300)
    assert result.returncode == 0, err
    return folder


def outcome(folder):
    rows = [json.loads(line) for line in (folder / "metrics.jsonl").read_text().splitlines()]
    results = json.loads((folder / "eval" / str(STEPS) / "results.json").read_text())
    weights = jax.device_get(open_run(folder).weights(STEPS))
    return {"weights": weights, "rows": results["images"], "metrics": rows, "results": results}


def test_two_processes_of_two_devices_train_and_score_as_one_device_does(together, alone):
    one, many = outcome(alone), outcome(together[0])
    assert [row["left_out"] for row in many["metrics"]] == [0, 0], "a full pool would be another run"
    params, grid = many["weights"]
    assert 0.05 < grid.occupied.mean() < 0.95, "the grid found nothing out, so nothing is proved"
    apart, scores = difference(one, many)
    assert apart <= 1e-6 and scores <= 1e-5
    for row, other in zip(many["metrics"], one["metrics"], strict=True):
        for name in ("step", "rays", "loss", "grad_norm", "lr"):
            assert row[name] == pytest.approx(other[name], rel=1e-4), name
    for name in ("psnr", "ssim", "psnr_float", "psnr_truncated"):
        assert many["results"][name] == pytest.approx(one["results"][name], abs=1e-5), name
    assert [row["name"] for row in many["rows"]] == [row["name"] for row in one["rows"]]


def test_the_first_process_speaks_and_all_take_part(together):
    folder, (first, second) = together
    assert "device      4 x cpu (cpu), in 2 processes" in first and "6/6" in first
    assert "device" not in second and "6/6" not in second
    assert Checkpoints(folder).steps() == [3, 6]
    assert sorted(path.name for path in (folder / "eval").iterdir()) == [str(STEPS)]


@pytest.mark.parametrize(
    "environ, place",
    [
        ({}, None),
        ({"SLURM_PROCID": "0", "SLURM_NTASKS": "16"}, None),  # a batch script, not a step
        ({"SLURM_PROCID": "3", "SLURM_STEP_NUM_TASKS": "16"}, (3, 16)),
        ({"OMPI_COMM_WORLD_RANK": "1", "OMPI_COMM_WORLD_SIZE": "2"}, (1, 2)),
        ({"SLURM_PROCID": "0", "SLURM_STEP_NUM_TASKS": "1"}, (0, 1)),
    ],
)
def test_who_was_started_with_others(environ, place):
    assert hosts.launched(environ) == place


@pytest.mark.parametrize(
    "given, message",
    [
        ({"coordinator": "localhost"}, "'localhost', wanted HOST:PORT of process 0"),
        ({"coordinator": "host:99999", "num_processes": 2, "process_id": 0}, "wanted HOST:PORT"),
        ({"coordinator": "host:1", "num_processes": 2}, "num_processes is 2 and --process_id None"),
        ({"coordinator": "host:1", "num_processes": 2, "process_id": 2}, "an id from 0 below the number"),
        ({"process_id": 1}, "need a coordinator"),
        ({"coordinator": "host:1", "multihost": False}, "--nomultihost keeps to one process"),
    ],
)
def test_what_names_no_process_is_an_error(given, message):
    with pytest.raises(ValueError, match=message), hosts.cluster(**given):
        raise AssertionError("it went on")


def test_alone_nothing_is_joined_and_everything_agrees(monkeypatch, tmp_path):
    monkeypatch.setenv("SLURM_PROCID", "0")
    monkeypatch.setenv("SLURM_STEP_NUM_TASKS", "1")
    monkeypatch.setattr(jax.distributed, "initialize", lambda *a, **k: pytest.fail("it joined"))
    with hosts.cluster():
        assert hosts.is_first() and hosts.any_of(True, 3) and not hosts.any_of(False)
        hosts.check_same("data", np.arange(3))
        hosts.first_does(lambda: (tmp_path / "made").touch(), tmp_path / "made")
    with pytest.raises(ValueError, match="as it is"):  # goes on as it would without
        with hosts.cluster():
            raise ValueError("as it is")


def test_a_coordinator_that_is_not_there_takes_one_line(tmp_path):
    """Both at once: to the first the second is missing, which has another port."""
    found, options = {}, (*FLAGS, f"--workdir={tmp_path / 'run'}", "--num_processes=2", "--join_seconds=1")

    def join(index):
        address = f"--coordinator=127.0.0.1:{free_port()}"
        found[index] = run("train", *options, address, f"--process_id={index}")

    threads = [threading.Thread(target=join, args=[index]) for index in (0, 1)]
    [thread.start() for thread in threads]
    [thread.join() for thread in threads]
    for index, what in enumerate(("not all of the others came", "nothing answers there")):
        code, out, err = found[index]
        assert code == 1 and len(err.splitlines()) == 1, err
        assert err.startswith("error: waited 1 s for the other processes at 127.0.0.1:") and what in err
    assert not (tmp_path / "run").exists()


def test_one_device_in_many_processes_is_refused(monkeypatch):
    monkeypatch.setattr(jax, "process_count", lambda: 2)
    with pytest.raises(ValueError, match="parallel is 'jit' in 2 processes; set it to 'auto'"):
        parallel.devices_of("jit")


def test_what_differs_between_processes_is_named(monkeypatch):
    monkeypatch.setattr(jax, "process_count", lambda: 3)
    others = iter([[1, 0, 0], [0, 0, 0]])
    gather = lambda value: np.array(value, np.int64) + next(others)  # noqa: E731
    monkeypatch.setattr(hosts.multihost_utils, "process_allgather", gather)
    with pytest.raises(ValueError, match=r"processes \[1, 2\] have another scene than process 0"):
        hosts.check_same("scene", {"a": np.arange(3)}, "text")
    hosts.check_same("scene", None)
