"""Folders that appear completely or not at all, even if the writer is interrupted."""

import contextlib
import os
import pathlib
import secrets
import shutil
from collections.abc import Iterator

from jaxnerf.runtime.atomic_files import naming, remove

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None  # type: ignore[assignment]


@contextlib.contextmanager
def partial_folder(target: str | os.PathLike) -> Iterator[pathlib.Path]:
    """Yields a new, empty folder to fill, and then moves it to `target`, where it replaces what is there.

    It lies beside `target`, has a random name, and is locked for as long as the process lives. Such folders that
    killed processes have left beside `target`, and which nobody locks, are removed first.

    Raises:
        OSError: with the path.
    """
    target = pathlib.Path(target)
    for left in target.parent.glob(f"*.{'[0-9a-f]' * 16}.tmp*"):
        if left.is_dir() and not left.is_symlink() and (lock := _lock_folder(left)) is not None:
            shutil.rmtree(left, ignore_errors=True)
            os.close(lock)
    lock = None
    while lock is None:  # another process can have taken it for an abandoned one before it was locked
        partial = target.with_name(f"{target.name}.{secrets.token_hex(8)}.tmp")
        partial.mkdir()
        lock = _lock_folder(partial, missing=-1)
    try:
        with naming(partial):
            yield partial
        replaced = partial.with_name(f"{partial.name}.old")
        if target.exists():
            target.rename(replaced)
        partial.rename(target)
        remove(replaced)
    finally:
        remove(partial)
        if lock >= 0:
            os.close(lock)


def _lock_folder(folder, missing=None):
    """Returns a descriptor that locks a folder until it is closed, or None if another process does or it is gone.

    Where the system has no such locks it returns `missing`.
    """
    if fcntl is None:
        return missing
    try:
        descriptor = os.open(folder, os.O_RDONLY)
    except OSError:
        return None
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError as error:
        os.close(descriptor)
        return None if isinstance(error, BlockingIOError) else missing
    if folder.exists():
        return descriptor
    os.close(descriptor)
    return None
