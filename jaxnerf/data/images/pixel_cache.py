"""The pixels of a scene, decoded once into a file of the user's cache: read from it, or mapped if many.

A mapped file costs no memory of the process's own: the system reads the parts that are asked for, and takes
them out again when something else needs the room.
"""

import contextlib
import hashlib
import inspect
import logging
import os
import shutil
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np

from jaxnerf.data.images import image_files
from jaxnerf.runtime.user_cache import default_folder

_LARGE = 2**28  # bytes, from which pixels are mapped
_SLOW = 0.5  # seconds that decoding takes, from which fewer pixels are kept, too
_KEPT = 2**35  # bytes of such files that stay in the cache; those used longest ago go first
_ABANDONED = 3600  # seconds after which nobody writes to a file any more
_SPARE = 2**28  # bytes that the disk keeps free


def fill_pixels(paths, read, *, shape, dtype, place, depends=()):
    """Returns pixels [P, C] read from files, several at a time.

    Args:
        paths: of all files that the pixels depend on, with their sizes and times of change.
        read: the tasks: [() -> image [..., C]].
        shape, dtype: of the pixels.
        place: first pixel of each task's image [N].
        depends: what else the pixels depend on.

    Returns:
        An array in memory, or where that would be large a mapped file in the user's cache. What is large or
        took a while to decode is kept there, and the next call with the same files finds it again. Where it
        cannot be kept the array is in memory, with a warning.
    """

    def fill(put):
        def one(task):
            image = task[1]()
            put(task[0], image.reshape(-1, image.shape[-1]).astype(dtype, copy=False))

        with ThreadPoolExecutor(workers()) as pool:
            for _ in pool.map(one, zip(place, read, strict=True)):
                pass

    mapped = np.dtype(dtype).itemsize * shape[0] * shape[1] >= _LARGE
    path = pixels = None
    try:
        folder = default_folder()
        folder.mkdir(parents=True, exist_ok=True)
        path = folder / f"pixels_{_fingerprint(paths, shape, dtype, depends)}.npy"
        found = _open(path, shape, dtype, mapped)
        if found is not None:
            return found
        if mapped:
            _make(path, fill, shape, dtype)
            return _open(path, shape, dtype, mapped)
        started, pixels = time.perf_counter(), _in_memory(fill, shape, dtype)
        if time.perf_counter() - started > _SLOW:
            _make(path, lambda put: put(0, pixels), shape, dtype)
    except (OSError, RuntimeError) as error:  # RuntimeError: the user has no home
        logging.warning("pixels cannot be kept in %s (%s), so they are held in memory", path, error)
    return _in_memory(fill, shape, dtype) if pixels is None else pixels


def workers():
    """Returns how many files are read at a time: Pillow and zlib work outside Python's lock."""
    return min(max(os.cpu_count() or 1, 2), 8)


def _in_memory(fill, shape, dtype):
    pixels = np.empty(shape, dtype)

    def put(first, part):
        pixels[first : first + len(part)] = part

    fill(put)
    return pixels


def _open(path, shape, dtype, mapped):
    """Returns the pixels of a file, mapped or read; None where it is missing or broken."""
    try:
        pixels = np.load(path, mmap_mode="r" if mapped else None)
    except FileNotFoundError:
        return None
    except (ValueError, EOFError) as error:
        logging.warning("%s is of no use (%s), making it again", path, error)
        return None
    if pixels.shape != tuple(shape) or pixels.dtype != dtype:
        logging.warning("%s holds another array, making it again", path)
        return None
    os.utime(path)  # used now
    return pixels


def _make(path, fill, shape, dtype):
    """Writes the file beside its place first, so that nobody meets half of it."""
    row = shape[1] * np.dtype(dtype).itemsize
    _make_room(path.parent, shape[0] * row)
    partial, lock = path.with_name(f"{path.stem}.{os.getpid()}.tmp"), threading.Lock()
    header = {"descr": np.lib.format.dtype_to_descr(np.dtype(dtype)), "fortran_order": False, "shape": shape}
    try:
        with open(partial, "wb") as file:
            np.lib.format.write_array_header_1_0(file, header)
            start = file.tell()

            def put(first, part):
                with lock:
                    file.seek(start + int(first) * row)
                    file.write(np.ascontiguousarray(part))

            fill(put)
        os.replace(partial, path)
    finally:
        partial.unlink(missing_ok=True)


def _make_room(folder, size):
    """Deletes what was used longest ago and what was never finished; OSError if the disk is full even so."""
    files, kept = [], size
    for file in (*folder.glob("pixels_*"), *folder.glob("survey_*")):
        with contextlib.suppress(FileNotFoundError):  # another process may tidy up, too
            files.append((file.stat().st_mtime, file.stat().st_size, file))
    for used, length, file in sorted(files, reverse=True):
        kept += length
        if kept > _KEPT or (file.suffix == ".tmp" and time.time() - used > _ABANDONED):
            file.unlink(missing_ok=True)  # who has it mapped keeps it until then
    free = shutil.disk_usage(folder).free
    if free < size + _SPARE:
        raise OSError(f"{folder} has {free / 1e9:.1f} GB free, wanted {(size + _SPARE) / 1e9:.1f}")


def _fingerprint(paths, shape, dtype, depends):
    """Returns a hash of all that pixels depend on; the code that decodes them is part of it."""
    digest = hashlib.sha256(inspect.getsource(image_files).encode())
    digest.update(repr((tuple(shape), np.dtype(dtype).str, depends)).encode())
    for path in paths:
        stat = Path(path).stat()
        digest.update(f"{Path(path).absolute()}\0{stat.st_size}\0{stat.st_mtime_ns}\n".encode())
    return digest.hexdigest()[:24]
