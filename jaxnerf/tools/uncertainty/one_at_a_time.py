"""A lock that lets one process at a time estimate the errors of a run."""

import contextlib
import os
import pathlib
from collections.abc import Callable, Iterator

from jaxnerf.runtime.atomic_files import open_regular

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None  # type: ignore[assignment]


@contextlib.contextmanager
def one_at_a_time(path: str | os.PathLike, waiting: Callable[[], None]) -> Iterator[None]:
    """Lets one process at a time do something; the others wait.

    Where the system has no flock, as on some network file systems, no process waits.

    Args:
        path: of a file, made if missing, with its folder. It stays and locks nobody out, as the system releases the
            lock however the process ends.
        waiting: called once if this process has to wait.

    Raises:
        OSError: with the path, if nothing can be written there.
    """
    path = pathlib.Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    with open_regular(path, "a") as file:
        if fcntl is not None:
            with contextlib.suppress(OSError):
                try:
                    fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
                except BlockingIOError:
                    waiting()
                    fcntl.flock(file, fcntl.LOCK_EX)
        yield
