"""Four CPU devices, checks of type annotations, and the real scenes, for every test."""

import gc
import importlib.metadata
import os
import pathlib
import signal

# Both are read once, when JAX starts, so they are set before anything imports it.
os.environ["JAX_PLATFORMS"] = "cpu"
flags = [os.environ.get("XLA_FLAGS", ""), "--xla_force_host_platform_device_count=4"]
if importlib.metadata.version("jaxlib").startswith("0.10."):  # one without these flags would crash
    flags.append("--xla_cpu_parallel_codegen_split_count=1")  # compiles faster
    if os.environ.get("JAX_DISABLE_MOST_OPTIMIZATIONS"):
        flags.append("--xla_cpu_use_fusion_emitters=false")
os.environ["XLA_FLAGS"] = " ".join(flags).strip()

# A shell that starts pytest in the background makes it ignore SIGINT, and nohup makes it ignore SIGHUP. So would the
# programs that tests start.
for number, handler in ((signal.SIGINT, signal.default_int_handler), (signal.SIGHUP, signal.SIG_DFL)):
    if signal.getsignal(number) == signal.SIG_IGN:
        signal.signal(number, handler)

import jax  # noqa: E402
import pytest  # noqa: E402

import mlir_context  # noqa: E402
import type_checks  # noqa: E402

jax.config.update("jax_platforms", "cpu")
jax.config.update("jax_numpy_rank_promotion", "raise")
type_checks.install("jaxnerf", "test_scenes")
mlir_context.use_one_context()
# The programs of all tests stay in memory; to search them for garbage at the usual rate is a tenth of the time.
gc.set_threshold(200_000, 20, 100)


def pytest_configure(config):
    config.addinivalue_line(
        "markers", "scenes(*names): needs the real scenes below JAXNERF_SCENES, each name a folder there"
    )


def pytest_runtest_setup(item):
    """Skips when no scenes are offered, but fails when those that were promised are not there."""
    marker = item.get_closest_marker("scenes")
    if marker is None:
        return
    folder = os.environ.get("JAXNERF_SCENES")
    if not folder:
        pytest.skip("JAXNERF_SCENES is unset: it names the folder of the real scenes")
    for path in [pathlib.Path(folder), *(pathlib.Path(folder) / name for name in marker.args)]:
        if not path.is_dir():
            pytest.fail(f"JAXNERF_SCENES is {folder}, but there is no folder {path}", pytrace=False)


@pytest.fixture
def scenes_dir():
    """The folder of the real scenes; for tests marked `scenes`, which end before this when it is missing."""
    return pathlib.Path(os.environ["JAXNERF_SCENES"])


def pytest_sessionfinish():
    """Spares what is still alive the last collections of garbage, which take seconds."""
    gc.freeze()


_finished_files = 0


def pytest_runtest_teardown(item, nextitem):
    """Forgets the compiled programs of every 40 files: JAX itself forgets some of more than about 4000."""
    global _finished_files
    if nextitem is None or nextitem.path != item.path:
        _finished_files += 1
        if _finished_files % 40 == 0:
            jax.clear_caches()
