"""A cache on disk for arrays that take long to compute. A cache that cannot be used is never an error.

What it holds is believed, and compiled programs are run, so its folders belong to the user alone.
"""

import contextlib
import logging
import os
import time
import zlib
from collections.abc import Callable, Iterable
from pathlib import Path

import numpy as np

from jaxnerf.runtime.atomic_files import open_regular, partial_file

_logger = logging.getLogger(__name__)
_CHECKSUM = "checksum"  # the name of an array in each file
_ABANDONED = 3600  # seconds after which a partial file has no writer any more


def load_or_make(
    folder: str | os.PathLike | None,
    name: str,
    make: Callable[[], dict[str, np.ndarray]],
    *,
    is_valid: Callable[[dict[str, np.ndarray]], bool],
    min_seconds: float = 0.0,
) -> dict[str, np.ndarray]:
    """Reads arrays from a cache file, or computes them and writes the file.

    Problems with the cache are logged as warnings.

    Args:
        folder: the cache's folder; None: `private_folder()`.
        name: of the file, without extension. It must contain a hash of everything that the arrays depend on.
        make: computes the arrays by name.
        is_valid: returns whether arrays from a file have the expected names, shapes and types. A file with
            other arrays is treated as damaged and replaced.
        min_seconds: arrays that are computed in less time are not written.

    Returns:
        The arrays, bit for bit the same whether they are read or computed.
    """
    path = None
    try:
        path = (private_folder() if folder is None else Path(folder)) / f"{name}.npz"
        with open_regular(path, "rb") as file, np.load(file) as content:
            arrays = dict(content)
        checksum = arrays.pop(_CHECKSUM, None)
        if checksum == _checksum(name, arrays) and is_valid(arrays):
            return arrays
        _logger.warning("%s holds unexpected arrays; they are computed again", path)
    except FileNotFoundError:
        _logger.debug("%s does not exist yet; its arrays are computed", path)
    except Exception as error:  # a damaged zip file raises almost any exception
        _logger.warning("%s cannot be read (%s); its arrays are computed again", path or folder or "the cache", error)
    start = time.perf_counter()
    arrays = make()
    if path is not None and time.perf_counter() - start >= min_seconds:
        _store(path, arrays, _checksum(name, arrays))
    return arrays


def private_folder(*names: str) -> Path:
    """Returns `jaxnerf` in $XDG_CACHE_HOME or ~/.cache, or a folder below, made if missing and private to the user.

    Raises:
        OSError: if it cannot be made, belongs to another user, or can be written by others, who may have put
            something there; names the folder.
        RuntimeError: if there is no home.
    """
    folder = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "jaxnerf"
    for name in ("", *names):
        folder = folder / name
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        if not hasattr(os, "geteuid"):  # Windows, where a user's folder is private
            continue
        mode, owners = folder.stat().st_mode, {folder.lstat().st_uid, folder.stat().st_uid}
        if owners != {os.geteuid()}:
            raise PermissionError(f"{folder} belongs to another user; set XDG_CACHE_HOME to a folder of your own")
        if mode & 0o022:
            raise PermissionError(f"{folder} can be written by other users (mode {mode & 0o777:o}); remove it")
        if mode & 0o077:
            folder.chmod(0o700)
    return folder


def prune(files: Iterable[Path], max_bytes: float) -> None:
    """Removes the least recently used of some files until the rest fits into max_bytes, and old partial ones.

    Another process may do the same. One that has a removed file mapped keeps it until it ends.
    """
    found = []
    for path in files:
        with contextlib.suppress(FileNotFoundError):
            status = path.stat()
            found.append((max(status.st_atime, status.st_mtime), status.st_size, path))
    total = 0
    for used, size, path in sorted(found, reverse=True):
        total += size
        if total > max_bytes or (path.suffix == ".tmp" and time.time() - used > _ABANDONED):
            path.unlink(missing_ok=True)


def _checksum(name, arrays):
    """Returns the CRC-32 of a file's name and arrays, so that neither a flipped bit nor another file is believed."""
    total = zlib.crc32(name.encode())
    for key, array in sorted(arrays.items()):
        total = zlib.crc32(np.ascontiguousarray(array), zlib.crc32(key.encode(), total))
    return total


def _store(path, arrays, checksum):
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with partial_file(path, mode=0o600) as partial, partial.open("wb") as file:
            np.savez_compressed(file, **arrays, **{_CHECKSUM: np.uint32(checksum)})
    except OSError as error:
        _logger.warning("%s cannot be written (%s); its arrays will be computed again", path, error)
