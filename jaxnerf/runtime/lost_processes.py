"""Reports in one line that another process of a training run hangs, has ended, or was started twice.

JAX's coordination service notices this. It prints many lines from C++ and aborts the process, which Python can
neither prevent nor catch: only a handler of SIGABRT can still say what happened.
"""

import contextlib
import ctypes
import os
import re
import signal
import sys
import tempfile
import threading
import time

from jaxnerf.runtime import signals

_REMEDY = "start all processes again to continue from the last checkpoint"
_COORDINATION = re.compile(
    rb"^([EF].*(coordination_service|client\.h:)|W.*coordination_service.*ConnectAfterBarrierPasses)", re.MULTILINE
)
_INTERVAL = 0.2  # s, after which other messages of libraries are printed
_LAST_WORDS = 1.0  # s that the service of process 0 still answers, so that the others receive the reason


def describe(messages: str) -> str:
    """Returns a line for what the coordination service prints before it aborts the process."""
    if found := re.search(r"(\d+) unexpectedly tried to connect with a different incarnation", messages):
        return (
            f"process {found[1]} has connected twice: --process_id={found[1]} was given to two processes, or one was "
            f"started again alone; {_REMEDY}, each with its own id"
        )
    if "more recent barrier call" in messages:  # while the processes still wait for each other
        return (
            f"a process has connected twice: one --process_id was given to two processes; {_REMEDY}, each with its own"
        )
    if found := re.search(r"stopped sending heartbeats\):\s*((?:\d+\s+)+)", messages):
        names = ", ".join(found[1].split())
        return f"process {names} does not answer any more: it hangs, or its machine or network is down; {_REMEDY}"
    if re.search(r"Failed to send RPC|Deadline Exceeded|Socket closed|failed to connect", messages, re.IGNORECASE):
        return f"process 0 does not answer any more: it has ended or hangs, see its output; {_REMEDY}"
    words = " ".join(re.sub(r"^\s*@ +0x.*$", "", messages, flags=re.MULTILINE).split())  # without the stack
    return f"another process may have ended; {_REMEDY} ({words[-400:]})"


class LostProcesses:
    """Holds back what the coordination service prints, and prints one line when it aborts this process.

    While it is active, file descriptor 2 leads to a temporary file, from which a thread prints all other messages.
    Python's own stderr is not affected.
    """

    def __init__(self):
        self._printed, self._lock = 0, threading.Lock()
        self._stderr, self._messages = os.dup(2), tempfile.TemporaryFile()
        sys.stderr.flush()
        os.dup2(self._messages.fileno(), 2)
        with contextlib.suppress(OSError):  # raised where stderr has no file descriptor
            if sys.stderr.fileno() == 2:
                sys.stderr = signals.output(self._stderr)
        self._handler = ctypes.CFUNCTYPE(None, ctypes.c_int)(self._report)  # kept: C holds no reference
        # A handler of Python's would run in the main thread later, but the process ends when this one returns.
        ctypes.CDLL(None).signal(signal.SIGABRT, self._handler)
        threading.Thread(target=self._print_others, daemon=True).start()

    def flush(self) -> str:
        """Prints the messages of libraries up to the first of the coordination service; returns the rest."""
        with self._lock:
            size = os.fstat(self._messages.fileno()).st_size
            new = os.pread(self._messages.fileno(), size - self._printed, self._printed)
            found = _COORDINATION.search(new)
            shown = new[: found.start()] if found else new
            with contextlib.suppress(OSError):  # nobody reads them
                os.write(self._stderr, shown)
            self._printed += len(shown)
            return new[len(shown) :].decode(errors="replace")

    def _print_others(self):
        while True:
            time.sleep(_INTERVAL)
            self.flush()

    def _report(self, _):
        time.sleep(_LAST_WORDS)
        with contextlib.suppress(OSError):
            os.write(self._stderr, f"error: {describe(self.flush())}\n".encode())
        os._exit(1)
