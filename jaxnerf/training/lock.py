"""One training at a time in a workdir."""

import contextlib
import os
import pathlib
import socket
import sys
import time

from jaxnerf.training.workdir import naming

try:
    import fcntl
except ImportError:  # not on this system
    fcntl = None


@contextlib.contextmanager
def workdir_lock(workdir):
    """Holds a workdir, made if missing, for one training; the system lets go of it however that ends.

    Raises:
        ValueError: if another one holds it, or nothing can be written there; names the folder.
    """
    path = pathlib.Path(workdir) / "running"
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        file = _locked(path)
        with naming(path):
            file.truncate(0)
            file.write(f"process {os.getpid()} on {socket.gethostname()} since {time.strftime('%F %T')}\n")
            file.flush()
    except OSError as error:
        raise ValueError(
            f"{workdir}: cannot be written ({error.strerror}); make it writable, make room, or give another --workdir"
        ) from error
    try:
        yield
    finally:
        with contextlib.suppress(OSError):  # what is left of it holds nobody up
            path.unlink()
        file.close()


def _locked(path):
    """Returns the file, opened and locked; ValueError if another process has locked it."""
    while True:
        file = path.open("a+")
        try:
            if fcntl is None:
                raise OSError(None, "this system has no flock")
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            file.seek(0)
            holder = file.read().strip() or "another process"
            file.close()
            raise ValueError(
                f"{path.parent}: {holder} is training in it; wait for it, stop it, or give another --workdir"
            ) from None
        except OSError as error:  # as on some network file systems
            why = f"cannot be locked ({error.strerror}): a second training in it would not be noticed"
            print(f"{path.parent}: {why}", file=sys.stderr)
            return file
        with contextlib.suppress(FileNotFoundError):
            if os.fstat(file.fileno()).st_ino == path.stat().st_ino:
                return file
        file.close()  # whoever held it has just removed it
