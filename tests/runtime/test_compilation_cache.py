"""The cache of compiled programs: hits, equal results, a bounded size, and removal of truncated files."""

import os
import subprocess
import sys
import time
import types
import zlib

import jax
import numpy as np
import pytest

from jaxnerf.evaluation.evaluate import train_and_evaluate
from jaxnerf.evaluation.restore import restore_run
from jaxnerf.runtime import compilation_cache
from runs import ROOT, smoke_config

pytest_plugins = ["run_fixtures"]

PROGRAM = """
import jax, jax.numpy as jnp
from jaxnerf.runtime import cli

def main(argv):
    jax.jit(lambda x: jnp.linalg.svd(x @ x.T))(jnp.ones((9, 9)))

cli.run(main)
"""


def start(**variables):
    """Runs a program that compiles something; returns its stderr."""
    environment = {name: value for name, value in os.environ.items() if not name.startswith("JAX_")}
    environment |= {"JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0", **variables}
    done = subprocess.run([sys.executable, "-c", PROGRAM], cwd=ROOT, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return done.stderr


def entries(folder):
    return sorted(folder.rglob("*-cache"))


def test_cached_program_computes_the_same(trained, unoptimized, tmp_path):
    hits = []
    listen = lambda name, **_: hits.append(name) if name.endswith("/cache_hits") else None  # noqa: E731
    jax.monitoring.register_event_listener(listen)
    try:
        assert train_and_evaluate(smoke_config(), tmp_path / "run")
    finally:
        jax.monitoring.unregister_event_listener(listen)
    assert hits
    again, first = (jax.device_get(restore_run(folder).variables(20)) for folder in (tmp_path / "run", trained))
    jax.tree.map(np.testing.assert_array_equal, again, first)


def test_programs_are_cached_by_default_and_truncated_files_replaced(tmp_path):
    assert start(XDG_CACHE_HOME=str(tmp_path)) == ""
    kept = entries(tmp_path / "jaxnerf" / "compiled")
    assert any("lambda" in path.name for path in kept)
    before = {path: path.read_bytes() for path in kept}
    largest = max(kept, key=lambda path: path.stat().st_size)
    os.truncate(largest, 100)  # as a process killed while writing leaves it
    assert start(XDG_CACHE_HOME=str(tmp_path)) == "", "JAX alone would warn at every start, and never replace the file"
    assert set(entries(tmp_path)) == set(kept)
    zlib.decompress(largest.read_bytes())
    assert all(path.read_bytes() == before[path] for path in kept if path != largest)


@pytest.fixture
def chosen(monkeypatch, tmp_path):
    """Returns a function: environment variables -> the folder that JAX was given, or None."""
    given = {}
    config = types.SimpleNamespace(jax_compilation_cache_dir=None)
    config.update = lambda name, value: given.update({name: value})
    monkeypatch.setattr(compilation_cache, "jax", types.SimpleNamespace(config=config))

    def choose(**variables):
        monkeypatch.delenv("JAX_COMPILATION_CACHE_DIR", raising=False)
        for name, value in variables.items():
            monkeypatch.setenv(name, str(value))
        compilation_cache.use_compilation_cache()
        return given.get("jax_compilation_cache_dir")

    return choose


def test_own_cache_folder_is_used(chosen, tmp_path):
    for own in ("", tmp_path / "own"):
        assert chosen(XDG_CACHE_HOME=tmp_path, JAX_COMPILATION_CACHE_DIR=own) is None
    assert not list(tmp_path.iterdir())
    assert chosen(XDG_CACHE_HOME=tmp_path).startswith(f"{tmp_path}/jaxnerf/compiled/")


def test_unusable_cache_folder_prints_one_line(chosen, tmp_path, capsys):
    (tmp_path / "file").write_text("")
    assert chosen(XDG_CACHE_HOME=tmp_path / "file") is None
    said = capsys.readouterr().err
    assert "compiled programs cannot be cached" in said and len(said.splitlines()) == 1


def test_least_recently_used_are_removed_first(tmp_path):
    for age in range(6):
        path = tmp_path / f"{age}-cache"
        path.write_bytes(zlib.compress(os.urandom(1000)))
        os.utime(path, (time.time() - 100 * age,) * 2)
    size = path.stat().st_size
    compilation_cache.prune(tmp_path, max_bytes=3.5 * size)
    assert [path.name for path in entries(tmp_path)] == ["0-cache", "1-cache", "2-cache"]
