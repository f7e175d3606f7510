"""Files that appear completely or not at all, even if the writer is interrupted."""

import contextlib
import os
import pathlib
import secrets
from collections.abc import Iterator


@contextlib.contextmanager
def partial_file(path: str | os.PathLike, suffix: str = ".tmp") -> Iterator[pathlib.Path]:
    """Yields a path to write to, and then moves the written file to `path`.

    The partial file lies beside `path` and has a random name, so that any number of processes may write the
    same file: the last one wins. A process that is killed leaves its partial file behind; see `sweep`.

    Args:
        path: of the finished file; its folder exists.
        suffix: of the partial file, for writers that infer a format from it; `sweep` expects ".tmp" in it.

    Raises:
        OSError: with the path, even if the system names none, as on a full disk.
    """
    path = pathlib.Path(path)
    partial = path.with_name(f"{path.name}.{secrets.token_hex(4)}{suffix}")
    try:
        with naming(path):
            yield partial
        try:
            os.replace(partial, path)
        except FileNotFoundError:
            if not path.exists():  # otherwise another process has finished the folder and swept it
                raise
    finally:
        partial.unlink(missing_ok=True)


def write_text(path: str | os.PathLike, text: str) -> None:
    """Writes a text file, also safe against a loss of power; raises OSError with the path."""
    with partial_file(path) as partial, partial.open("w") as file:
        file.write(text)
        file.flush()
        os.fsync(file.fileno())


def write_text_once(path: str | os.PathLike, text: str) -> None:
    """Writes a text file unless it exists; of several processes that try, the first one wins."""
    path = pathlib.Path(path)
    partial = path.with_name(f"{path.name}.{secrets.token_hex(4)}.tmp")
    try:
        partial.write_text(text)
        try:
            os.link(partial, path)  # unlike a rename it replaces nothing
        except FileExistsError:
            pass
        except OSError:  # a file system without links
            os.replace(partial, path)
    finally:
        partial.unlink(missing_ok=True)


def sweep(folder: pathlib.Path, pattern: str = "*.tmp") -> None:
    """Removes the partial files of killed processes below a folder in which everything is finished."""
    for path in folder.rglob(pattern):
        path.unlink(missing_ok=True)


@contextlib.contextmanager
def naming(path: str | os.PathLike) -> Iterator[None]:
    """Adds a path to an OSError that names none, as writing to a full disk raises."""
    try:
        yield
    except OSError as error:
        if error.filename is None:
            error.filename = str(path)
        raise
