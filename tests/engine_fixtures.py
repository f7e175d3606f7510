"""Fixtures that the tests of the engine share, by pytest_plugins = ["engine_fixtures"]."""

import os

import jax
import pytest
from jax.experimental.compilation_cache import compilation_cache

from jaxnerf.engine.loop import train_and_evaluate
from runs import smoke_config

_OPTIONS = {"jax_persistent_cache_min_compile_time_secs": 0.5}


@pytest.fixture(scope="session")
def compiled_once(tmp_path_factory):
    """Keeps what takes long to compile on disk: many processes of these tests run the same step."""
    folder = tmp_path_factory.getbasetemp()
    if "PYTEST_XDIST_WORKER" in os.environ:  # whose parent is what all of its workers share
        folder = folder.parent
    options = {**_OPTIONS, "jax_compilation_cache_dir": str(folder / "compiled")}
    old = {name: getattr(jax.config, name) for name in options}
    with pytest.MonkeyPatch.context() as patch:
        for name, value in options.items():
            patch.setenv(name.upper(), str(value))
            jax.config.update(name, value)
        compilation_cache.reset_cache()
        yield
    for name, value in old.items():
        jax.config.update(name, value)
    compilation_cache.reset_cache()


@pytest.fixture(scope="session")
def trained(compiled_once, tmp_path_factory):
    """The workdir of configs/smoke.py: 20 steps, checkpoints of 5, 10, 15 and 20 of which 3 are kept."""
    folder = tmp_path_factory.mktemp("trained") / "run"
    assert train_and_evaluate(smoke_config(), folder)
    return folder
