"""Fixtures of tests that train, used with pytest_plugins = ["run_fixtures"]."""

import contextlib
import fcntl
import os
import shutil

import jax
import pytest
from jax.experimental.compilation_cache import compilation_cache

from jaxnerf.evaluation.evaluate import train_and_evaluate
from runs import smoke_config


@pytest.fixture(scope="session")
def compiled_once(tmp_path_factory):
    """Caches compiled programs on disk, as many processes of these tests run the same step."""
    folder = os.environ.get("JAX_COMPILATION_CACHE_DIR") or str(_shared(tmp_path_factory) / "compiled")
    with _options(jax_compilation_cache_dir=folder), pytest.MonkeyPatch.context() as patch:
        patch.setenv("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0")
        compilation_cache.reset_cache()
        yield
    compilation_cache.reset_cache()


@pytest.fixture(scope="module")
def unoptimized(compiled_once):
    """Switches most optimizations off, here and in child processes: compiling is faster and runs are short."""
    if jax.config.values["jax_disable_most_optimizations"]:  # as in make test
        yield
        return
    jax.clear_caches()  # JAX would take what it has compiled with the other option
    with _options(jax_disable_most_optimizations=True):
        yield
    jax.clear_caches()


@pytest.fixture(scope="session")
def trained(compiled_once, tmp_path_factory):
    """The workdir of configs/smoke.py: 20 steps, checkpoints of 5, 10, 15 and 20 of which 3 are kept."""
    once = _shared(tmp_path_factory) / "trained"
    with once.with_suffix(".lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)  # one worker trains, the others copy
        if not once.exists():
            with _options(jax_disable_most_optimizations=True):
                assert train_and_evaluate(smoke_config(), once)
    return shutil.copytree(once, tmp_path_factory.mktemp("trained") / "run")


def _shared(tmp_path_factory):
    """Returns a folder that all workers share."""
    folder = tmp_path_factory.getbasetemp()
    return folder.parent if "PYTEST_XDIST_WORKER" in os.environ else folder


@contextlib.contextmanager
def _options(**options):
    """Sets options of JAX here and in child processes."""
    old = {name: jax.config.values[name] for name in options}
    try:
        with pytest.MonkeyPatch.context() as patch:
            for name, value in options.items():
                patch.setenv(name.upper(), str(value))
                jax.config.update(name, value)
            yield
    finally:
        for name, value in old.items():
            jax.config.update(name, value)
