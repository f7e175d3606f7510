"""A cache of compiled programs in the user's cache folder. Failing to write it is never an error."""

import contextlib
import os
import platform
import sys
import zlib
from pathlib import Path

import jax

from jaxnerf.runtime.fingerprint import fingerprint
from jaxnerf.runtime.user_cache import default_folder

MAX_BYTES = 2**30  # a training step takes half a megabyte, so this holds over a thousand programs
_ZSTD = b"\x28\xb5\x2f\xfd"


def use_compilation_cache() -> None:
    """Sets JAX's compilation cache, unless JAX_COMPILATION_CACHE_DIR is set: to a folder, or empty for no cache."""
    if "JAX_COMPILATION_CACHE_DIR" in os.environ or jax.config.jax_compilation_cache_dir:
        return
    folder = None
    try:
        folder = default_folder() / "compiled" / _machine()
        folder.mkdir(parents=True, exist_ok=True)
        prune(folder)
    except (OSError, RuntimeError) as error:  # RuntimeError: no home folder
        place = f"{folder}: " if folder else ""
        print(f"{place}compiled programs cannot be cached ({error}); continuing without", file=sys.stderr)
        return
    jax.config.update("jax_compilation_cache_dir", str(folder))
    if "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS" not in os.environ:
        # JAX's default of 1 s excludes dozens of small programs, which together take as long.
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)


def prune(folder: Path, max_bytes: float = MAX_BYTES) -> None:
    """Removes truncated programs, and the least recently used ones until the rest fits into max_bytes.

    JAX would report a program that a killed process left truncated at every start, and never replace it. JAX
    has a size limit of its own, but a kill at the wrong moment makes that fail forever after.
    """
    stamp = folder / "checked"
    since = stamp.stat().st_mtime if stamp.exists() else 0.0
    stamp.touch()  # first: files that are written meanwhile are checked at the next start
    kept = []
    for path in folder.glob("*-cache"):
        with contextlib.suppress(FileNotFoundError):  # another process may prune, too
            status = path.stat()
            if status.st_mtime >= since - 2 and not _is_complete(path.read_bytes()):  # 2 s: file times are coarse
                path.unlink()
            else:
                kept.append((max(status.st_atime, status.st_mtime), status.st_size, path))
    size = sum(entry[1] for entry in kept)
    for _, bytes_, path in sorted(kept):
        if size <= max_bytes:
            break
        path.unlink(missing_ok=True)
        size -= bytes_


def _is_complete(content):
    """Returns whether a file decompresses."""
    if content.startswith(_ZSTD):
        return _is_complete_zstd(content)
    try:
        zlib.decompress(content)
    except zlib.error:
        return False
    return True


def _is_complete_zstd(content):
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
    """Returns a name for this processor's instruction set; programs compiled for a larger one would crash."""
    with contextlib.suppress(OSError):
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        features = {line for line in lines if line.startswith(("model name", "flags", "Features"))}
        return f"{platform.machine()}-{fingerprint(*sorted(features))[:8]}"
    return platform.machine() or "any"
