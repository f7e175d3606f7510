"""How much memory is left, whether a program has room in it, and going on with less where it has not."""

import pathlib
import sys

import jax

_HOST_SHARE = 0.8  # of what a host has left, that a program may take: more, and the system ends processes
_MARGIN = 0.9  # what scales with a size also has a part that does not


class NoRoom(Exception):
    """A program needs more memory than there is, by what its compiler says."""

    def __init__(self, needed, room):
        super().__init__(f"needs {needed / 1e6:,.1f} MB where {max(room, 0) / 1e6:,.1f} MB are left")
        self.share = room / needed


def check(compiled):
    """Raises NoRoom where a compiled program's results and temporaries find none; its arguments are there."""
    stats = compiled.memory_analysis() if hasattr(compiled, "memory_analysis") else None
    room = left()
    if stats is None or room is None:
        return
    needed = stats.temp_size_in_bytes + stats.output_size_in_bytes - stats.alias_size_in_bytes
    if needed > room:
        raise NoRoom(needed, room)


def left():
    """Returns the bytes that one of the local devices may still take; None where nobody tells."""
    device = jax.local_devices()[0]
    stats = device.memory_stats() or {}
    if "bytes_limit" in stats:
        return stats["bytes_limit"] - stats["bytes_in_use"]
    found = _host_left() if device.platform == "cpu" else []
    return _HOST_SHARE * min(found) / jax.local_device_count() if found else None


def _host_left(system="/"):
    """Returns what the host and each limit of the process's control group leave, in bytes."""
    found, system = [], pathlib.Path(system)
    try:
        lines = (system / "proc/meminfo").read_text().splitlines()
        found += [1024 * int(line.split()[1]) for line in lines if line.startswith("MemAvailable:")]
        own = (system / "proc/self/cgroup").read_text().strip().rpartition("::")[2].strip("/")
    except OSError:  # not Linux
        return found
    folder = system / "sys/fs/cgroup"
    for group in {folder, folder / own, *(folder / own).parents} - set(folder.parents):
        try:
            limit, used = ((group / f"memory.{name}").read_text().strip() for name in ("max", "current"))
            stats = dict(line.split() for line in (group / "memory.stat").read_text().splitlines())
        except (OSError, ValueError):
            continue
        if limit != "max":  # pages of files that nobody uses just now are given back when needed
            found.append(int(limit) - int(used) + int(stats.get("inactive_file", 0)))
    return found


def back_off(attempt, size, *, cause, unit, least=1, whole=False):
    """Returns attempt(size), and the size; where memory runs out it says so and goes on with less.

    Args:
        attempt: size -> result. It may raise NoRoom, or what JAX raises when memory runs out.
        size: to begin with.
        cause: what it is that needs the memory, for the line.
        unit: what the size counts, for the line.
        least: below which there is no attempt.
        whole: whether sizes must divide the first one.

    Raises:
        ValueError: if there is no room for the least either.
    """
    while True:
        try:
            return attempt(size), size
        except (NoRoom, jax.errors.JaxRuntimeError) as error:
            if not ran_out(error):
                raise
            why = f"{error}" if isinstance(error, NoRoom) else "the device has no more"
            share = min(_MARGIN * error.share, 0.5) if isinstance(error, NoRoom) else 0.5
        smaller = max(int(size * share), least)
        if whole:
            smaller = max(part for part in range(1, smaller + 1) if size % part == 0)
        if smaller >= size:
            raise ValueError(f"out of memory in the {cause}: {size} {unit}, the least that can be: {why}")
        print(f"out of memory in the {cause}: {size} {unit}: {why}; going on with {smaller}", file=sys.stderr)
        size = smaller


def ran_out(error):
    """Returns whether an error says that memory ran out."""
    return isinstance(error, NoRoom) or "RESOURCE_EXHAUSTED" in str(error)
