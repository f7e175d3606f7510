"""A cache on disk for decoded pixels, which maps large arrays into memory.

A mapped file takes no memory of the process's own: the operating system reads the pages that are accessed and
drops them when it needs the memory.
"""

import inspect
import logging
import os
import shutil
import threading
import time
import zlib
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np
from jaxtyping import UInt

from jaxnerf.data.images import image_files
from jaxnerf.runtime import cores, stages
from jaxnerf.runtime.atomic_files import open_regular, partial_file
from jaxnerf.runtime.fingerprint import file_sha256, fingerprint
from jaxnerf.runtime.user_cache import private_folder, prune

_logger = logging.getLogger(__name__)
_LARGE = 2**28  # bytes from which pixels are mapped
_SLOW = 0.5  # seconds of decoding from which smaller arrays are cached, too
_MAX_SIZE = 2**35  # bytes of all cached files; the least recently used are deleted first
_PART = 2**24  # bytes that have a checksum of their own, so that several are computed at a time
_SPARE = 2**28  # bytes of the disk that stay free


def fill_pixels(
    paths: Sequence[str | os.PathLike],
    read: Sequence[Callable[[], UInt[np.ndarray, "..."]]],
    *,
    shape: tuple[int, int],
    dtype: Any,
    offsets: Sequence[int] | np.ndarray,
    depends: tuple = (),
) -> UInt[np.ndarray, "P C"]:
    """Reads the pixels of many images, several images at a time.

    Args:
        paths: all files that the pixels depend on. The cache notices any change of their content.
        read: N functions without arguments; each returns one image [..., C].
        shape: (P, C) of the result.
        dtype: of the result.
        offsets: [N] index of each image's first pixel.
        depends: everything else that the pixels depend on.

    Returns:
        An array in memory, or a mapped file of the user's cache if the array is large. Large arrays and arrays
        that take long to decode are cached for the next call with the same files. If the cache cannot be used,
        a warning is logged and the array is in memory.
    """

    def fill(put):
        def one(task):
            offset, read_one = task
            image = read_one()
            put(offset, image.reshape(-1, image.shape[-1]).astype(dtype, copy=False))

        with ThreadPoolExecutor(num_workers()) as pool, stages.stage("reading images") as stage:
            for done, _ in enumerate(pool.map(one, zip(offsets, read, strict=True)), 1):
                stage.update(done, len(read))

    mapped = np.dtype(dtype).itemsize * shape[0] * shape[1] >= _LARGE
    path = pixels = None
    try:
        path = private_folder() / f"pixels_{_fingerprint(paths, shape, dtype, depends)}.npy"
        found = _open(path, shape, dtype, mapped)
        if found is not None:
            return found
        if mapped:
            _write(path, fill, shape, dtype)
            pixels = _open(path, shape, dtype, mapped)
        else:
            start, pixels = time.perf_counter(), _in_memory(fill, shape, dtype)
            if time.perf_counter() - start > _SLOW:
                _write(path, lambda put: put(0, pixels), shape, dtype)
    except (OSError, RuntimeError) as error:  # RuntimeError: the user has no home
        _logger.warning("pixels cannot be cached in %s (%s); they are held in memory", path, error)
    return _in_memory(fill, shape, dtype) if pixels is None else pixels


def num_workers() -> int:
    """Returns how many files are read at a time; Pillow and zlib release Python's lock."""
    return min(max(cores.usable(), 2), 8)


def _in_memory(fill, shape, dtype):
    pixels = np.empty(shape, dtype)

    def put(first, part):
        pixels[first : first + len(part)] = part

    fill(put)
    return pixels


def _open(path, shape, dtype, mapped):
    """Opens the pixels of a cached file; returns None if it is missing or damaged."""
    try:
        with open_regular(path, "rb"):  # np.load would wait for a pipe
            pixels = np.load(path, mmap_mode="r" if mapped else None)
    except FileNotFoundError:
        return None
    except OSError:
        raise
    except Exception as error:  # numpy parses the header as Python, so a damaged one raises almost any exception
        _logger.warning("%s cannot be read (%s); it is written again", path, error)
        return None
    if pixels.shape != tuple(shape) or pixels.dtype != dtype:
        _logger.warning("%s holds an unexpected array; it is written again", path)
        return None
    checksums = _checksums(path.name, pixels)
    with path.open("rb") as file:
        file.seek(-len(checksums), os.SEEK_END)
        if file.read() != checksums:
            _logger.warning("%s is damaged; it is written again", path)
            return None
    os.utime(path)  # marks it as used, for _free_space
    return pixels


def _checksums(name, pixels):
    """Returns the CRC-32 of a file's name and of each part of its pixels, as the last bytes of the file.

    CRC-32 is the fastest hash of the standard library, and no flipped bit escapes it.
    """
    content = pixels.reshape(-1).view(np.uint8)
    parts = [content[start : start + _PART] for start in range(0, content.size, _PART)]
    with ThreadPoolExecutor(num_workers()) as pool:
        return np.array([zlib.crc32(name.encode()), *pool.map(zlib.crc32, parts)], "<u4").tobytes()


def _write(path, fill, shape, dtype):
    row = shape[1] * np.dtype(dtype).itemsize
    _free_space(path.parent, shape[0] * row)
    header = {"descr": np.lib.format.dtype_to_descr(np.dtype(dtype)), "fortran_order": False, "shape": shape}
    with partial_file(path, mode=0o600) as partial, partial.open("wb") as file:
        np.lib.format.write_array_header_1_0(file, header)
        start, lock = file.tell(), threading.Lock()

        def put(first, part):
            with lock:
                file.seek(start + int(first) * row)
                file.write(np.ascontiguousarray(part))

        fill(put)
        file.flush()
        checksums = _checksums(path.name, np.load(partial, mmap_mode="r"))
        file.seek(0, os.SEEK_END)
        file.write(checksums)


def _free_space(folder, size):
    """Deletes old files, so that so many bytes more may be cached; raises OSError if the disk is still too full."""
    prune((*folder.glob("pixels_*"), *folder.glob("active_*")), _MAX_SIZE - size)
    free = shutil.disk_usage(folder).free
    if free < size + _SPARE:
        raise OSError(f"{folder} has {free / 1e9:.1f} GB free, expected at least {(size + _SPARE) / 1e9:.1f}")


def _fingerprint(paths, shape, dtype, depends):
    """Returns a hash of everything that the pixels depend on, the decoding code included."""
    with ThreadPoolExecutor(num_workers()) as pool:
        files = list(pool.map(file_sha256, paths))
    form = repr((tuple(shape), np.dtype(dtype).str, depends))
    return fingerprint(inspect.getsource(image_files), form, *files)
