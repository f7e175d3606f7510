"""Several processes train as one, and report why they cannot connect or what differs between them."""

import os
import re
import subprocess
import sys

import jax
import numpy as np
import pytest

import two_hosts
from helpers import assert_same
from jaxnerf.runtime import processes
from jaxnerf.runtime.fingerprint import fingerprint
from jaxnerf.training import metric_log
from jaxnerf.training.checkpoint import Checkpoints
from jaxnerf.training.state import create_state
from runs import ROOT, free_port, run_forked

SLURM = {"SLURM_JOB_ID": "4711", "SLURM_STEP_NODELIST": "127.0.0.1", "SLURM_NTASKS": "2"}
SLURM["SLURM_STEP_NUM_TASKS"] = "2"


@pytest.fixture(scope="module")
def together(tmp_path_factory):
    """The workdir and the stderr of two processes with two devices each, started as srun does."""
    folder = tmp_path_factory.mktemp("together") / "run"
    folder.mkdir()
    environment = {
        **os.environ,
        **SLURM,
        "JAX_COORDINATOR_PORT": str(free_port()),
        "JAX_NUM_CPU_DEVICES": "2",
    }
    environment["PYTHONPATH"] = os.pathsep.join([str(ROOT), str(ROOT / "tests")])
    command, pipes = [sys.executable, two_hosts.__file__, folder], {"stderr": subprocess.PIPE, "text": True}
    started = [
        subprocess.Popen(command, env={**environment, "SLURM_PROCID": index, "SLURM_LOCALID": index}, **pipes)
        for index in "01"
    ]
    said = [process.communicate(timeout=300)[1] for process in started]
    assert [process.returncode for process in started] == [0, 0], "\n".join(said)
    return folder, said


def last_state(folder):
    experiment = two_hosts.toy_experiment()
    like = create_state(experiment.model, experiment.optimizer, 0)
    return jax.device_get(Checkpoints(folder).load(two_hosts.STEPS, like))


@pytest.mark.slow
def test_two_processes_train_as_one_with_the_same_devices(together, tmp_path):
    folder, said = together
    experiment = two_hosts.toy_experiment()
    assert two_hosts.train(tmp_path / "run", experiment.load_split("train"))
    one, many = last_state(tmp_path / "run"), last_state(folder)
    assert_same(many, one, rtol=0, atol=1e-6)
    start = create_state(experiment.model, experiment.optimizer, 0)
    assert np.abs(one.params["fine"]["w"] - start.params["fine"]["w"]).max() > 1e-3, (
        "the comparison needs parameters that moved"
    )
    assert np.unique(one.grid.density_max).size > 8 and one.counters["rays_dropped"] > 0
    rows, others = metric_log.read_rows(folder), metric_log.read_rows(tmp_path / "run")
    for row, other in zip(rows, others, strict=True):
        for name in ("step", "rays", "rays_dropped", "loss", "grad_norm", "lr"):
            assert row[name] == pytest.approx(other[name], rel=1e-5), name


@pytest.mark.slow
def test_first_process_prints_and_all_have_the_same_state(together):
    folder, (first, second) = together
    assert re.search(r"device        4 x cpu \(cpu\) on \d+ cores?, in 2 processes", first) and "6/6" in first
    assert "device" not in second and "6/6" not in second
    states = [[line for line in text.splitlines() if line.startswith("state")] for text in (first, second)]
    assert len(states[0]) == 2 and states[0] == states[1]
    assert Checkpoints(folder).steps() == [3, 6]


@pytest.mark.slow
def test_each_process_reads_what_it_scores(together):
    folder, said = together
    here = f"rendered {fingerprint(jax.tree.map(np.asarray, two_hosts.rendered(folder)))}"
    assert all(here in text.splitlines() for text in said), "\n".join(said)


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
def test_launched(environ, place):
    assert processes.launched(environ) == place


@pytest.mark.parametrize(
    "given, message",
    [
        ({"coordinator": "localhost"}, "'localhost', expected HOST:PORT of process 0"),
        ({"coordinator": "host:99999", "num_processes": 2, "process_id": 0}, "expected HOST:PORT"),
        ({"coordinator": "host:1", "num_processes": 2}, "num_processes is 2 and --process_id None"),
        ({"coordinator": "host:1", "num_processes": 2, "process_id": 2}, "a different id from 0 to N - 1"),
        ({"process_id": 1}, "need a coordinator"),
        ({"coordinator": "host:1", "multihost": False}, "--nomultihost means one process"),
    ],
)
def test_inconsistent_arguments_are_an_error(given, message):
    with pytest.raises(ValueError, match=message), processes.cluster(**given):
        raise AssertionError("no error")


def test_single_process_joins_nothing(monkeypatch, tmp_path):
    monkeypatch.setenv("SLURM_PROCID", "0")
    monkeypatch.setenv("SLURM_STEP_NUM_TASKS", "1")
    monkeypatch.setattr(jax.distributed, "initialize", lambda *a, **k: pytest.fail("it joined"))
    with processes.cluster():
        assert processes.is_first() and processes.any_of(True, 3) and not processes.any_of(False)
        processes.check_same("data", np.arange(3))
        processes.run_on_first(lambda: (tmp_path / "made").touch(), tmp_path / "made")
    with pytest.raises(ValueError, match="as it is"):  # raised as without cluster
        with processes.cluster():
            raise ValueError("as it is")


def test_missing_coordinator_prints_one_line(tmp_path):
    address = f"127.0.0.1:{free_port()}"
    by_hand = (f"--coordinator={address}", "--num_processes=2", "--process_id=1", "--join_seconds=1")
    code, _, err = run_forked("train", "--config=configs/smoke.py", f"--workdir={tmp_path / 'run'}", *by_hand)
    assert code == 1 and len(err.splitlines()) == 1, err
    assert err.startswith(f"error: waited 1 s for the other processes at {address}: nothing answers there")
    assert not (tmp_path / "run").exists()


def test_difference_between_processes_is_an_error(monkeypatch):
    monkeypatch.setattr(jax, "process_count", lambda: 3)
    others = iter([[1, 0, 0], [0, 0, 0]])
    gather = lambda value: np.array(value, np.int64) + next(others)  # noqa: E731
    monkeypatch.setattr(processes.multihost_utils, "process_allgather", gather)
    with pytest.raises(ValueError, match=r"processes \[1, 2\] have a different scene than process 0"):
        processes.check_same("scene", {"a": np.arange(3)}, "text")
    processes.check_same("scene", None)
