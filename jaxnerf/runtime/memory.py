"""Memory: how much is free, whether a program fits, and retrying with smaller parts when it does not."""

import ctypes
import pathlib
import sys
from collections.abc import Callable, Iterator
from typing import Any

import jax

_HOST_FRACTION = 0.8  # of the host's free memory that a program may take; if it takes more, the system kills processes
_AMPLE = 0.5  # of the free memory: a program that needs less will not fail for want of it
_MARGIN = 0.9  # part of what a program needs does not scale with the size of its parts


class OutOfMemory(Exception):
    """A program needs more memory than is free, as its compiler computes.

    Attributes:
        fraction: what is free over what it needs.
    """

    def __init__(self, needed: float, free: float):
        super().__init__(f"needs {needed / 1e6:,.1f} MB, {max(free, 0) / 1e6:,.1f} MB are free")
        self.fraction = free / needed


def check(compiled: Any, count: int = 1) -> None:
    """Raises OutOfMemory if the results and temporaries of so many calls at once of a compiled program do not fit."""
    needed, free = _needed(compiled), available()
    if needed is not None and free is not None and count * needed > free:
        raise OutOfMemory(count * needed, free)


def _needed(compiled):
    """Returns the bytes of a compiled program's results and temporaries; None where they are not known."""
    stats = compiled.memory_analysis() if hasattr(compiled, "memory_analysis") else None
    return stats and stats.temp_size_in_bytes + stats.output_size_in_bytes - stats.alias_size_in_bytes


def release() -> None:
    """Returns memory that is free to the system, where the C library is glibc.

    The programs keep it otherwise, see `cli.run`. It is called where a phase ends that needed much more than the next
    one, such as compiling: it takes milliseconds, and what is used again is cleared by the system first.
    """
    trim = getattr(ctypes.CDLL(None), "malloc_trim", None) if sys.platform == "linux" else None
    if trim:
        trim(0)


def available() -> float | None:
    """Returns the bytes that are free on one of the local devices; None where the device does not report them."""
    device = jax.local_devices()[0]
    stats = device.memory_stats() or {}
    if "bytes_limit" in stats:
        return stats["bytes_limit"] - stats["bytes_in_use"]
    found = _host_available() if device.platform == "cpu" else []
    return _HOST_FRACTION * min(found) / jax.local_device_count() if found else None


def control_groups(system: str | pathlib.Path = "/") -> Iterator[pathlib.Path]:
    """Yields the folders that limit what a process uses: of its control group and those that hold it, on Linux."""
    system = pathlib.Path(system)
    try:
        group_path = (system / "proc/self/cgroup").read_text().strip().rpartition("::")[2].strip("/")
    except OSError:
        return
    folder = system / "sys/fs/cgroup"
    yield from {folder, folder / group_path, *(folder / group_path).parents} - set(folder.parents)


def _host_available(system="/"):
    """Returns the bytes that the host and each limit of the process's control group allow."""
    found, system = [], pathlib.Path(system)
    try:
        lines = (system / "proc/meminfo").read_text().splitlines()
    except OSError:  # not Linux
        return found
    found += [1024 * int(line.split()[1]) for line in lines if line.startswith("MemAvailable:")]
    for group in control_groups(system):
        try:
            limit, used = ((group / f"memory.{name}").read_text().strip() for name in ("max", "current"))
            stats = dict(line.split() for line in (group / "memory.stat").read_text().splitlines())
        except (OSError, ValueError):
            continue
        if limit != "max":  # the system frees cached pages of files when it needs them
            found.append(int(limit) - int(used) + int(stats.get("inactive_file", 0)))
    return found


def back_off(
    attempt: Callable[[int], Any], size: int, *, cause: str, unit: str, least: int = 1, divisors: bool = False
) -> tuple[Any, int]:
    """Returns attempt(size) and the size; where memory runs out, prints a line and retries with a smaller size.

    Args:
        attempt: size -> result. It may raise OutOfMemory, or what JAX raises when memory runs out.
        size: of the first attempt.
        cause: what needs the memory, for the message.
        unit: what the size counts, for the message.
        least: the smallest size to try.
        divisors: whether sizes must divide the first one.

    Raises:
        ValueError: if the least does not fit either.
    """
    while True:
        try:
            return attempt(size), size
        except (OutOfMemory, jax.errors.JaxRuntimeError) as error:
            if isinstance(error, OutOfMemory):
                why, fraction = str(error), min(_MARGIN * error.fraction, 0.5)
            elif "RESOURCE_EXHAUSTED" in str(error):
                why, fraction = "the device has no more memory", 0.5
            else:
                raise
        smaller = max(int(size * fraction), least)
        if divisors:
            smaller = max(part for part in range(1, smaller + 1) if size % part == 0)
        if smaller >= size:
            raise ValueError(f"out of memory in the {cause} with {size} {unit}, which is the minimum: {why}")
        print(f"out of memory in the {cause} with {size} {unit}: {why}; continuing with {smaller}", file=sys.stderr)
        size = smaller


def fit_step(
    compile_step: Callable[..., tuple], state: Any, data: Any, microbatch_size: int
) -> tuple[Callable[..., tuple], Any, Any]:
    """Returns what compile_step(state, data, microbatch_size) returns, with smaller microbatches if necessary.

    Whether a size fits is checked when the step is compiled. Unless it needs less than half of the free memory, it is
    checked again by the first step, which is repeated with a smaller size if memory runs out; a copy of the state is
    kept for that. Later steps need no more than the first. The batch stays the same, so the step's result does, too,
    except for rounding.

    Args:
        compile_step: (state, data, microbatch size) -> step, state, data; see `devices.compile_step`.
        state, data: see `devices.compile_step`.
        microbatch_size: rays.
    """
    options = {"cause": "training step", "unit": "rays per microbatch (--batch)", "divisors": True}
    if jax.process_count() > 1:
        options["least"] = microbatch_size  # all processes run the same program, so one cannot change it
    (step, state, data), size = back_off(lambda size: compile_step(state, data, size), microbatch_size, **options)
    needed, free = _needed(getattr(step, "compiled", None)), available()
    if needed is not None and free is not None and needed < _AMPLE * free:
        return step, state, data
    tried = False

    def step_or_retry(state, data):
        nonlocal step, size, tried
        if tried:
            return step(state, data)
        kept = jax.device_get(state)  # a step consumes its state, even if it fails

        def attempt(new_size):
            nonlocal step
            given = state, data
            if new_size != size:
                step, *given = compile_step(kept, data, new_size)
            return jax.block_until_ready(step(*given))

        result, size = back_off(attempt, size, **options)
        tried = True
        return result

    return step_or_retry, state, data
