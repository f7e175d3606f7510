"""A cache of compiled programs in the user's cache folder. Failing to write it is never an error."""

import contextlib
import hashlib
import os
import platform
import sys
from pathlib import Path

import jax

from jaxnerf.runtime.atomic_files import partial_file, read_bytes
from jaxnerf.runtime.fingerprint import fingerprint
from jaxnerf.runtime.user_cache import private_folder, prune

MAX_BYTES = 2**30  # a training step takes half a megabyte, so this holds over a thousand programs
_HASH_BYTES = 32


def use_compilation_cache() -> None:
    """Sets JAX's compilation cache, unless JAX_COMPILATION_CACHE_DIR is set: to a folder, or empty for no cache."""
    if "JAX_PERSISTENT_CACHE_ENABLE_XLA_CACHES" not in os.environ:
        # With XLA's own cache, of the kernels that it chooses for a GPU, an H200 compiled a training step in 54 s the
        # first time and 16 s later; without it, a step that is not in this cache took 11 s.
        jax.config.update("jax_persistent_cache_enable_xla_caches", "none")
    if "JAX_COMPILATION_CACHE_DIR" in os.environ or jax.config.jax_compilation_cache_dir:
        return
    try:
        folder = private_folder("compiled", _machine())
        # JAX has a size limit of its own, but a kill at the wrong moment makes that fail forever after.
        prune(folder.glob("*-cache*"), MAX_BYTES)
        _use_programs()
    except (OSError, RuntimeError, ImportError) as error:  # RuntimeError: no home folder
        print(f"compiled programs cannot be cached ({error}); continuing without", file=sys.stderr)
        return
    jax.config.update("jax_compilation_cache_dir", str(folder))
    if "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS" not in os.environ:
        # JAX's default of 1 s excludes dozens of small programs, which together take as long.
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)


def _use_programs():
    """Replaces JAX's class that reads and writes files, for which there is no public way; it runs what a file holds."""
    from jax._src import compilation_cache

    if not hasattr(compilation_cache, "get_file_cache"):
        raise ImportError(f"JAX {jax.__version__} has no get_file_cache")
    compilation_cache.get_file_cache = lambda path: (Programs(path), path)


class Programs:
    """The compiled programs in a folder, with the interface that JAX expects of a cache.

    A file begins with a hash of its key and its program. A file that a killed process left truncated, that has a
    flipped bit or that is another program's is as good as absent, and replaced.
    """

    def __init__(self, folder: str | os.PathLike):
        self._path = Path(folder)

    def get(self, key: str) -> bytes | None:
        """Returns the program of a key, or None."""
        try:
            content = read_bytes(self._file(key))
        except FileNotFoundError:
            return None
        found, program = content[:_HASH_BYTES], content[_HASH_BYTES:]
        return program if found == _hash(key, program) else None

    def put(self, key: str, value: bytes) -> None:
        """Writes the program of a key."""
        with partial_file(self._file(key), mode=0o600) as partial:
            partial.write_bytes(_hash(key, value) + value)

    def _file(self, key):
        return self._path / f"{key}-cache"


def _hash(key, program):
    return hashlib.sha256(b"%d:%s%s" % (len(key), key.encode(), program)).digest()


def _machine():
    """Returns a name for this processor's instruction set; programs compiled for a larger one would crash."""
    with contextlib.suppress(OSError):
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        features = {line for line in lines if line.startswith(("model name", "flags", "Features"))}
        return f"{platform.machine()}-{fingerprint(*sorted(features))[:8]}"
    return platform.machine() or "any"
