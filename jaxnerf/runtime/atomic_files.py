"""Files that appear completely or not at all, even if the writer is interrupted, in folders that may be a stranger's.

Nothing is written through a symbolic link, and only regular files are read: a pipe would be waited for without end,
and a device such as /dev/zero has no end.
"""

import contextlib
import errno
import itertools
import json
import os
import pathlib
import re
import secrets
import shutil
import stat
from collections.abc import Iterator
from typing import IO, Any

_MAX_DEPTH = 100  # of JSON and of folders; functions that call themselves for each level must not fail
_NO_LINK, _NO_WAIT = getattr(os, "O_NOFOLLOW", 0), getattr(os, "O_NONBLOCK", 0)


def open_regular(path: str | os.PathLike, mode: str = "r") -> IO[Any]:
    """Opens a regular file as `open` does. Links are followed to read, and refused to write.

    Raises:
        OSError: with the path, also if it is a pipe, a device or a folder, or to be written and has a second name.
    """

    def opener(path, flags):
        writes = bool(flags & (os.O_WRONLY | os.O_RDWR))
        descriptor = os.open(path, flags | _NO_WAIT | writes * _NO_LINK, 0o666)
        found = os.fstat(descriptor)
        if not stat.S_ISREG(found.st_mode) or (writes and found.st_nlink > 1):
            os.close(descriptor)
            raise OSError(errno.EINVAL, "Not a regular file", str(path))
        return descriptor

    return open(path, mode, opener=opener)


def read_bytes(path: str | os.PathLike) -> bytes:
    """Returns the content of a regular file; see `open_regular`. OSError also if it does not fit into memory."""
    with open_regular(path, "rb") as file:
        try:
            return file.read()
        except MemoryError:  # also a small archive can hold a file of any size that is zero
            raise OSError(errno.ENOMEM, os.strerror(errno.ENOMEM), str(path)) from None


def parse_json(content: str | bytes) -> Any:
    """Returns what JSON of unknown origin holds.

    Raises:
        ValueError: if it is malformed, nested too deeply, or has a whole number of more than 64 bits, which no float
            and no array would hold.
    """
    try:
        found = json.loads(content, parse_int=_parse_int)
    except RecursionError:
        raise ValueError("nested too deeply") from None
    level = [found]
    for _ in range(_MAX_DEPTH):
        containers = [value for value in level if isinstance(value, dict | list)]
        level = [each for value in containers for each in (value.values() if isinstance(value, dict) else value)]
        if not level:
            return found
    raise ValueError(f"nested more than {_MAX_DEPTH} levels deep")


def to_json(content: Any) -> str:
    """Returns JSON, in which an infinite number is 1e999: Infinity is no JSON, and 1e999 is read back as infinite."""
    text = json.dumps(content, indent=2) + "\n"
    return re.sub(r'("(?:\\.|[^"\\])*")|Infinity', lambda found: found[1] or "1e999", text)


def _parse_int(digits):
    if len(digits) > 20 or not -(2**63) <= int(digits) < 2**64:
        raise ValueError(f"a whole number of {len(digits)} digits")
    return int(digits)


def read_json(path: str | os.PathLike, remedy: str) -> Any:
    """Returns what a JSON file of unknown origin holds.

    Raises:
        OSError: with the path, see `open_regular`.
        ValueError: if it is malformed; names the file and ends with the remedy.
    """
    try:
        return parse_json(read_bytes(path))
    except ValueError as error:
        raise ValueError(f"{path}: malformed JSON ({error}); {remedy}") from None


def files_below(folder: str | os.PathLike) -> Iterator[pathlib.Path]:
    """Yields all files and folders below a folder; nothing if it is missing. Links to folders are not followed.

    Raises:
        ValueError: if folders are nested too deeply for the functions that remove or copy them.
    """
    places = [(os.fspath(folder), 0)]
    while places:
        place, depth = places.pop()
        if depth > _MAX_DEPTH:
            raise ValueError(f"{folder}: holds folders that are nested more than {_MAX_DEPTH} levels deep; remove them")
        with contextlib.suppress(FileNotFoundError, NotADirectoryError, PermissionError), os.scandir(place) as entries:
            for entry in entries:
                yield pathlib.Path(entry.path)
                if entry.is_dir(follow_symlinks=False):
                    places.append((entry.path, depth + 1))


def check_tree(folder: str | os.PathLike, *, links: bool = False) -> None:
    """Checks that a folder, if it exists, is no symbolic link, and holds only folders and regular files.

    Args:
        folder: in which something is to be written, or read by a library that opens whatever it finds.
        links: whether the folder and the files in it may be links, which is safe where they are only read.

    Raises:
        ValueError: names the first link, pipe or device.
    """
    for path in itertools.chain(() if links else (folder,), files_below(folder)):
        try:
            mode = os.lstat(path).st_mode
            accepted = stat.S_ISREG(os.stat(path).st_mode) if links and stat.S_ISLNK(mode) else stat.S_ISDIR(mode)
        except FileNotFoundError:  # another process has just removed it
            continue
        if not (accepted or stat.S_ISREG(mode)):
            kind = "a symbolic link" if stat.S_ISLNK(mode) else "a pipe or a device"
            raise ValueError(f"{path}: is {kind}, expected a folder or a regular file; remove it")


def check_utf8(path: str | os.PathLike) -> None:
    """Raises a ValueError if a path is not UTF-8, as the libraries that write checkpoints need it."""
    try:
        os.path.abspath(path).encode()
    except UnicodeEncodeError:
        raise ValueError(f"{path}: is not UTF-8 with the folders that it lies in; rename them, or use others") from None


def remove(path: str | os.PathLike) -> None:
    """Removes a file, or a folder as far as possible, if there is one; a link itself, not what it names."""
    path = pathlib.Path(path)
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path, ignore_errors=True)
    else:
        path.unlink(missing_ok=True)


@contextlib.contextmanager
def partial_file(path: str | os.PathLike, suffix: str = ".tmp", *, mode: int = 0o666) -> Iterator[pathlib.Path]:
    """Yields the path of a new, empty file to write to, and then moves that file to `path`.

    The partial file lies beside `path` and has a random name, so that any number of processes may write the
    same file: the last one wins. A process that is killed leaves its partial file behind; see `sweep`.

    Args:
        path: of the finished file; its folder exists. A link of that name is replaced, not followed.
        suffix: of the partial file, for writers that infer a format from it; `sweep` expects ".tmp" in it.
        mode: of the file, of which the umask is subtracted.

    Raises:
        OSError: with the path, even if the system names none, as on a full disk.
    """
    path = pathlib.Path(path)
    partial = path.with_name(f"{path.name}.{secrets.token_hex(8)}{suffix}")
    try:
        with naming(path):
            os.close(os.open(partial, os.O_WRONLY | os.O_CREAT | os.O_EXCL | _NO_LINK, mode))
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
    partial = path.with_name(f"{path.name}.{secrets.token_hex(8)}.tmp")
    try:
        with partial.open("x") as file:
            file.write(text)
        try:
            os.link(partial, path)  # unlike a rename it replaces nothing
        except FileExistsError:
            pass
        except OSError:  # a file system without links
            os.replace(partial, path)
    finally:
        partial.unlink(missing_ok=True)


def sweep(folder: pathlib.Path, pattern: str = "*.tmp") -> None:
    """Removes the partial files of killed processes below a folder in which everything is finished; folders stay."""
    for path in files_below(folder):
        if path.match(pattern) and (not path.is_dir() or path.is_symlink()):
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
