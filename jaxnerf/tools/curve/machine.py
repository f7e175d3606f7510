"""The machine that a run was measured on: its speed now, its name, and the memory that processes used."""

import os
import pathlib
import platform
import re
import resource
import statistics
import sys
import time
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

REFERENCE_GFLOPS = 93.0  # matrix product of the machine that the project's limits in seconds refer to
_MATRIX_SIDE = 1024
_REPEATS = 12


def describe() -> str:
    """Returns what timings depend on."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    return f"{jax.devices()[0].device_kind}, {cores} core(s), XLA_FLAGS={os.environ.get('XLA_FLAGS', '')!r}"


def processor() -> str:
    """Returns the name of the processor, where Linux reports it."""
    path = pathlib.Path("/proc/cpuinfo")
    found = re.search(r"^model name\s*: (.*)$", path.read_text() if path.exists() else "", re.MULTILINE)
    return found.group(1).strip() if found else platform.processor() or platform.machine()


def matrix_gflops(repeats: int = _REPEATS) -> float:
    """Returns the median GFLOP/s of the product of two float32 matrices on this machine now."""
    matrix = jnp.full((_MATRIX_SIDE, _MATRIX_SIDE), 1 / _MATRIX_SIDE)
    product = jax.jit(lambda a, b: jnp.dot(a, b, precision="highest"))
    return 2 * _MATRIX_SIDE**3 / 1e9 / statistics.median(times(lambda: product(matrix, matrix), repeats))


def comparable(seconds: float, gflops: float) -> float:
    """Returns the seconds that the machine of REFERENCE_GFLOPS would take."""
    return seconds * gflops / REFERENCE_GFLOPS


def times(call: Callable[[], Any], repeats: int) -> list[float]:
    """Returns the seconds of repeated calls, after one that may compile and that warms the caches."""
    jax.block_until_ready(call())
    return [seconds(call) for _ in range(repeats)]


def seconds(call: Callable[[], Any]) -> float:
    """Returns the seconds until the result of a call is ready."""
    started = time.perf_counter()
    jax.block_until_ready(call())
    return time.perf_counter() - started


def peak_memory() -> dict[str, float | None]:
    """Returns the most memory in MB that this process has used, and that of its first device, if it reports that."""
    units_per_mb = 1e6 if sys.platform == "darwin" else 1e6 / 1024  # Linux counts KiB
    on_device = (jax.local_devices()[0].memory_stats() or {}).get("peak_bytes_in_use")
    return {
        "peak_memory_mb": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / units_per_mb,
        "peak_device_memory_mb": on_device and on_device / 1e6,
    }
