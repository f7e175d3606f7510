"""Compiled programs, kept between runs in the user's cache folder. Failing to keep them is never an error."""

import contextlib
import os
import platform
import sys
import zlib
from pathlib import Path

import jax

from jaxnerf.runtime.user_cache import default_folder

LARGEST = 2**30  # bytes of programs: a training step takes half a megabyte, so a thousand and more of them
_ZSTD = b"\x28\xb5\x2f\xfd"


def use_compilation_cache():
    """Lets JAX keep what it compiles, unless JAX_COMPILATION_CACHE_DIR says where, or, if empty, nowhere."""
    if "JAX_COMPILATION_CACHE_DIR" in os.environ or jax.config.jax_compilation_cache_dir:
        return
    folder = None
    try:
        folder = default_folder() / "compiled" / _machine()
        folder.mkdir(parents=True, exist_ok=True)
        tidy(folder)
    except (OSError, RuntimeError) as error:  # RuntimeError: no home folder
        place = f"{folder}: " if folder else ""
        print(f"{place}what is compiled cannot be kept ({error}); training goes on", file=sys.stderr)
        return
    jax.config.update("jax_compilation_cache_dir", str(folder))
    if "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS" not in os.environ:
        # JAX's own limit of 1 s leaves out dozens of small programs, which take as long together.
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)


def tidy(folder, largest=LARGEST):
    """Removes programs cut short by a kill, which JAX would find broken at every start and never write anew,
    and the longest unused ones where all together are too large.

    JAX has a limit of its own, but a kill at the wrong moment makes it fail forever after.
    """
    stamp = folder / "checked"
    since = stamp.stat().st_mtime if stamp.exists() else 0.0
    stamp.touch()  # before the look: what is written meanwhile is looked at the next time
    kept = []
    for path in folder.glob("*-cache"):
        with contextlib.suppress(FileNotFoundError):  # another start may tidy too
            status = path.stat()
            if status.st_mtime >= since - 2 and not _whole(path.read_bytes()):  # 2 s: coarse clocks of files
                path.unlink()
            else:
                kept.append((max(status.st_atime, status.st_mtime), status.st_size, path))
    size = sum(entry[1] for entry in kept)
    for _, bytes_, path in sorted(kept):
        if size <= largest:
            break
        path.unlink(missing_ok=True)
        size -= bytes_


def _whole(content):
    """Returns whether a file holds all of what was compressed into it."""
    if content.startswith(_ZSTD):
        return _whole_zstd(content)
    try:
        zlib.decompress(content)
    except zlib.error:
        return False
    return True


def _whole_zstd(content):
    try:
        import zstandard
    except ImportError:  # then JAX wrote it with another library, or for another Python
        return True
    try:
        zstandard.ZstdDecompressor().decompress(content)
    except zstandard.ZstdError:
        return False
    return True


def _machine():
    """Returns a name for what this processor can do: a program for more than that would end in a crash."""
    with contextlib.suppress(OSError):
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        said = {line for line in lines if line.startswith(("model name", "flags", "Features"))}
        return f"{platform.machine()}-{zlib.crc32(repr(sorted(said)).encode()):08x}"
    return platform.machine() or "any"
