"""CPU cores: how many a program may use, and calls that run on several at once."""

import itertools
import math
import os
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import jax

from jaxnerf.runtime import memory

JAX_THREADS = "PJRT_NPROC"  # the environment variable by which JAX's programs use fewer threads than there are cores


def usable() -> int:
    """Returns the number of CPU cores that this process may use, at least 1.

    The least of the cores that it may run on (`taskset`, a scheduler of a cluster), of the CPU time that each control
    group of it has, rounded up (a container of two CPUs), and of $PJRT_NPROC.
    """
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    asked = os.environ.get(JAX_THREADS, "")
    return max(min([cores, *_allowed(), *([int(asked)] if asked.isdecimal() else [])]), 1)


def limit_jax() -> None:
    """Gives JAX, which sees no control group, a thread for each usable core, before its devices are first used."""
    os.environ.setdefault(JAX_THREADS, str(usable()))


def num_at_once() -> int:
    """Returns how many of JAX's programs run at once best: on a CPU one on each usable core, on other devices 1."""
    return usable() if jax.default_backend() == "cpu" else 1


def map_on_cores(function: Callable[[Any], Any], items: Iterable[Any], *, compiles: bool = False) -> Iterator[Any]:
    """Yields function(item) for each of the items, in order; on a CPU several at once, each in a thread of its own.

    A program of JAX keeps several cores busy in a part of its operations only, and programs that one thread starts run
    one after the other. On other devices, and on one core, this is `map`. A first call that compiles what the others
    run is made alone.
    """
    count, items = num_at_once(), iter(items)
    if compiles or count == 1:
        yield from map(function, items if count == 1 else itertools.islice(items, 1))
    if count > 1:
        pool = ThreadPoolExecutor(count)
        try:
            yield from pool.map(lambda item: jax.block_until_ready(function(item)), items)
        finally:  # Ctrl-C does not wait for calls that run
            pool.shutdown(wait=False, cancel_futures=True)


def _allowed(system="/"):
    """Returns the number of cores that each control group of the process allows, rounded up."""
    found = []
    for group in memory.control_groups(system):
        try:
            quota, period = (group / "cpu.max").read_text().split()
        except (OSError, ValueError):
            continue
        if quota != "max":
            found.append(math.ceil(int(quota) / int(period)))
    return found
