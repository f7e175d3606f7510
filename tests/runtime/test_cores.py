"""How many CPU cores a program uses, and calls that run on several at once."""

import os
import threading

import jax
import jax.numpy as jnp
import pytest

from helpers import control_group
from jaxnerf.runtime import cores


@pytest.fixture
def six_cores(monkeypatch):
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: range(6), raising=False)
    monkeypatch.delenv(cores.JAX_THREADS, raising=False)
    monkeypatch.setattr(cores, "_allowed", lambda: [])


def test_the_least_limit_counts(six_cores, monkeypatch):
    assert cores.usable() == 6
    monkeypatch.setattr(cores, "_allowed", lambda: [3, 5])
    assert cores.usable() == 3
    for asked, expected in {"2": 2, "64": 3, "0": 1, "": 3, "many": 3}.items():
        monkeypatch.setenv(cores.JAX_THREADS, asked)
        assert cores.usable() == expected
    monkeypatch.delattr(os, "sched_getaffinity")
    monkeypatch.setattr(os, "cpu_count", lambda: None)
    assert cores.usable() == 1


def test_control_groups_of_containers_are_read(tmp_path):
    assert cores._allowed(tmp_path) == []  # not Linux
    group = control_group(tmp_path)
    assert cores._allowed(tmp_path) == []
    (group / "cpu.max").write_text("max 100000\n")
    (group.parent / "cpu.max").write_text("250000 100000\n")
    (group.parent.parent / "cpu.max").write_text("broken\n")
    assert cores._allowed(tmp_path) == [3]


def test_jax_uses_as_many_threads_unless_the_user_asks_for_fewer(six_cores, monkeypatch):
    monkeypatch.setenv(cores.JAX_THREADS, "2")
    cores.limit_jax()
    assert os.environ[cores.JAX_THREADS] == "2"
    monkeypatch.delenv(cores.JAX_THREADS)
    monkeypatch.setattr(cores, "_allowed", lambda: [4])
    cores.limit_jax()
    assert os.environ[cores.JAX_THREADS] == "4"


def test_calls_run_at_once_and_stay_in_order(monkeypatch):
    monkeypatch.setattr(cores, "usable", lambda: 3)
    together = threading.Barrier(3, timeout=30)

    def wait(item):
        together.wait()  # fails unless three calls run at once
        return jnp.asarray(item) + 1

    assert [int(value) for value in cores.map_on_cores(wait, range(6))] == [1, 2, 3, 4, 5, 6]


@pytest.mark.parametrize("reason", ["one core", "accelerator"])
def test_calls_run_in_the_thread_of_the_caller_otherwise(monkeypatch, reason):
    monkeypatch.setattr(cores, "usable", lambda: 1 if reason == "one core" else 4)
    if reason == "accelerator":
        monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    assert set(cores.map_on_cores(lambda _: threading.current_thread(), range(3))) == {threading.current_thread()}


def test_an_error_ends_the_calls_that_follow(monkeypatch):
    monkeypatch.setattr(cores, "usable", lambda: 2)
    called = []

    def fail(item):
        called.append(item)
        raise ValueError(f"item {item}")

    with pytest.raises(ValueError, match="item 0"):
        list(cores.map_on_cores(fail, range(10_000)))
    assert len(called) < 10_000


def test_an_error_does_not_wait_for_calls_that_run(monkeypatch):
    monkeypatch.setattr(cores, "usable", lambda: 2)
    running, go_on, finished = threading.Event(), threading.Event(), []

    def call(item):
        if item == 0:
            running.wait(30)
            raise KeyboardInterrupt
        running.set()
        go_on.wait(30)
        finished.append(item)

    with pytest.raises(KeyboardInterrupt):
        list(cores.map_on_cores(call, range(2)))
    assert not finished
    go_on.set()
