"""The cache of compiled programs: hits, equal results, a bounded size, and removal of truncated files."""

import os
import subprocess
import sys
import types

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
    for factor in (2, 3):
        print(jax.jit(lambda x: factor * x)(jnp.ones(1)))
    jax.jit(lambda x: jnp.linalg.svd(x @ x.T))(jnp.ones((9, 9)))

cli.run(main)
"""


def start(**variables):
    """Runs a program that compiles something; returns what it prints and its stderr."""
    environment = {name: value for name, value in os.environ.items() if not name.startswith("JAX_")}
    environment |= {"JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0", **variables}
    done = subprocess.run([sys.executable, "-c", PROGRAM], cwd=ROOT, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return done.stdout, done.stderr


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


def test_programs_are_cached_by_default_and_damaged_files_replaced(tmp_path):
    out, err = start(XDG_CACHE_HOME=str(tmp_path))
    assert out.split() == ["[2.]", "[3.]"] and err == ""
    kept = entries(tmp_path / "jaxnerf" / "compiled")
    assert any("lambda" in path.name for path in kept)
    assert {path.stat().st_mode & 0o777 for path in (tmp_path / "jaxnerf").rglob("*")} == {0o700, 0o600}
    largest = max(kept, key=lambda path: path.stat().st_size)
    os.truncate(largest, 100)  # as a process killed while writing leaves it
    one, other = [path for path in kept if "lambda" in path.name and path != largest][:2]
    contents = one.read_bytes(), other.read_bytes()
    other.write_bytes(contents[0])
    one.write_bytes(contents[1])
    assert start(XDG_CACHE_HOME=str(tmp_path)) == (out, ""), "JAX alone would print wrong numbers, and a warning"
    assert set(entries(tmp_path)) == set(kept)
    programs = compilation_cache.Programs(one.parent)
    assert all(programs.get(path.name.removesuffix("-cache")) for path in kept), "the damaged files are replaced"


def test_only_the_program_of_a_key_is_returned(tmp_path):
    programs = compilation_cache.Programs(tmp_path)
    programs.put("a", b"program")
    content = (tmp_path / "a-cache").read_bytes()
    assert programs.get("a") == b"program" and programs.get("b") is None
    for key, wrong in [("b", content), ("a", content[:-1]), ("a", content[:-1] + b"n"), ("a", b"")]:
        (tmp_path / f"{key}-cache").write_bytes(wrong)
        assert programs.get(key) is None
    programs.put("a", b"program")
    assert programs.get("a") == b"program"


@pytest.fixture
def chosen(monkeypatch, tmp_path):
    """Returns a function: environment variables -> the folder that JAX was given, or None."""
    from jax._src import compilation_cache as jax_cache

    monkeypatch.setattr(jax_cache, "get_file_cache", jax_cache.get_file_cache)  # restores it
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
    (tmp_path / "shared" / "jaxnerf").mkdir(parents=True)
    (tmp_path / "shared" / "jaxnerf").chmod(0o777)
    for folder in ("file", "shared"):
        assert chosen(XDG_CACHE_HOME=tmp_path / folder) is None
        said = capsys.readouterr().err
        assert "compiled programs cannot be cached" in said and len(said.splitlines()) == 1
    assert "shared/jaxnerf can be written by other users (mode 777); remove it" in said
