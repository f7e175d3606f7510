"""The processes of one training run: how they connect, agree, and let the first one write files."""

import contextlib
import ctypes
import logging
import math
import os
import re
import signal
import socket
import sys
import tempfile
import threading
import time
import traceback
from collections.abc import Callable, Iterator, Mapping
from typing import Any

import jax
import numpy as np
from jax.experimental import multihost_utils

from jaxnerf.runtime import signals, stages
from jaxnerf.runtime.fingerprint import fingerprint

AGREE_EVERY = 10  # steps; agreeing takes some ms, as it waits for the step before it
_SAMPLE = 2**16  # rows
_LAUNCHERS = (("SLURM_PROCID", "SLURM_STEP_NUM_TASKS"), ("OMPI_COMM_WORLD_RANK", "OMPI_COMM_WORLD_SIZE"))
_BY_HAND = "--coordinator=HOST:PORT --num_processes=N --process_id=I"


_REMEDY = "start all processes again to continue from the last checkpoint"
_COORDINATION = re.compile(
    rb"^([EF].*(coordination_service|client\.h:)|W.*coordination_service.*ConnectAfterBarrierPasses)", re.MULTILINE
)
_INTERVAL = 0.2  # s, after which other messages of libraries are printed
_LAST_WORDS = 1.0  # s that the service of process 0 still answers, so that the others receive the reason


def launched(environ: Mapping[str, str] = os.environ) -> tuple[int, int] | None:
    """Returns (index, count) of this process among those that srun or mpirun started; None without them.

    SLURM_NTASKS is no evidence: it is also set in batch scripts and interactive shells, which are one process.
    """
    for index, count in _LAUNCHERS:
        if index in environ and count in environ:
            return int(environ[index]), int(environ[count])
    return None


@contextlib.contextmanager
def cluster(
    *,
    multihost: bool | None = None,
    coordinator: str | None = None,
    num_processes: int | None = None,
    process_id: int | None = None,
    seconds: float = 300.0,
    heartbeat_seconds: float = 100.0,
) -> Iterator[None]:
    """Joins the processes of one training run, if there are several; call it before any other use of JAX.

    An error inside ends this process at once with one line, as a regular exit would wait for the other
    processes, which may be waiting for this one. The line also reports if another process is the cause.

    Args:
        multihost: True joins the cluster that JAX detects (SLURM, Open MPI 4, Kubernetes, Cloud TPU); None
            does so where srun or mpirun started several processes; False never does.
        coordinator: HOST:PORT of process 0, to which all connect; None: JAX finds it.
        num_processes, process_id: None: those of srun or mpirun.
        seconds: how long to wait for the other processes.
        heartbeat_seconds: how long a process may give no sign of life before the others end.

    Raises:
        ValueError: if the arguments do not describe a process of a cluster. Inside a cluster no error is
            raised; the process ends.
    """
    place = launched()
    given = (coordinator, num_processes, process_id)
    if multihost is False and given != (None, None, None):
        raise ValueError("--nomultihost means one process and --coordinator several; drop one of them")
    if not multihost and coordinator is None and given[1:] != (None, None):
        raise ValueError(f"--num_processes and --process_id need a coordinator; give {_BY_HAND}")
    if multihost is False or (not multihost and coordinator is None and (place or (0, 1))[1] == 1):
        yield
        return
    if coordinator is not None:
        num_processes = num_processes if num_processes is not None or not place else place[1]
        process_id = process_id if process_id is not None or not place else place[0]
        _check(coordinator, num_processes, process_id)
    watch = LostProcesses()
    try:
        _join(coordinator, num_processes, process_id, seconds, heartbeat_seconds)
        if not is_first():
            stages.show(False)
        yield
        watch.flush()
    except BaseException as error:
        watch.flush()
        _leave(error)


def _check(coordinator, num_processes, process_id):
    host, _, port = coordinator.rpartition(":")
    if not host or not port.isdecimal() or not 0 < int(port) < 65536:
        raise ValueError(f"--coordinator is {coordinator!r}, expected HOST:PORT of process 0")
    if num_processes is None or process_id is None or not 0 <= process_id < num_processes:
        raise ValueError(
            f"--num_processes is {num_processes} and --process_id {process_id}, expected a "
            f"different id from 0 to N - 1 for each process; give {_BY_HAND}"
        )


def _join(coordinator, num_processes, process_id, seconds, heartbeat_seconds):
    # The preemption service would catch SIGTERM.
    jax.config.update("jax_enable_preemption_service", False)
    failed = []

    def connect():
        try:
            # JAX would end a process that times out with a stack trace, so the time is limited below.
            options = {"initialization_timeout": int(seconds) + 3600}
            options["heartbeat_timeout_seconds"] = math.ceil(heartbeat_seconds)
            if coordinator is not None and launched() is None:  # otherwise JAX assigns one GPU to each process
                options["cluster_detection_method"] = "deactivate"
            jax.distributed.initialize(coordinator, num_processes, process_id, **options)
        except Exception as error:
            failed.append(error)

    thread = threading.Thread(target=connect, daemon=True)
    thread.start()
    deadline, answered = time.monotonic() + seconds, False
    while thread.is_alive() and time.monotonic() < deadline:
        thread.join(1.0)
        answers = coordinator is not None and _listens(coordinator)
        if thread.is_alive() and answered and not answers:  # JAX would go on trying
            raise ValueError(f"--coordinator={coordinator}: process 0 ended while it waited for others; see its output")
        answered = answers
    if failed and coordinator is None:
        raise ValueError(f"no cluster to join ({_line(failed[0])}); start with srun, or give {_BY_HAND}")
    if failed:
        raise ValueError(f"--coordinator={coordinator}: {_line(failed[0])}; give another port")
    if thread.is_alive():
        what = "; start all of them, and give --coordinator if they do not find each other"
        if coordinator is not None:
            found = "not all processes connected" if _listens(coordinator) else "nothing answers there"
            what = f" at {coordinator}: {found}; check the address and their output"
        raise ValueError(f"waited {seconds:g} s for the other processes{what}")


def _listens(address):
    host, _, port = str(address).rpartition(":")
    try:
        socket.create_connection((host, int(port)), timeout=5).close()
    except (OSError, ValueError):
        return False
    return True


def _leave(error):
    """Ends this process with one line; see cluster."""
    if isinstance(error, SystemExit) and not error.code:
        raise error
    code, line = 1, _line(error)
    if isinstance(error, KeyboardInterrupt):
        code, line = 130, "stopped; the same command continues from the last checkpoint"
    elif isinstance(error, jax.errors.JaxRuntimeError):
        line = f"another process may have ended; start all again to continue from the last checkpoint ({_line(error)})"
    elif not isinstance(error, ValueError | OSError):
        traceback.print_exception(error)
    print(f"error: {line}", file=sys.stderr, flush=True)
    sys.stdout.flush()
    os._exit(code)


def _line(error):
    return " ".join(str(error).split())[:400]


def describe_loss(messages: str) -> str:
    """Returns a line for what the coordination service prints before it aborts the process."""
    found = re.search(r"(\d+) unexpectedly tried to connect with a different incarnation", messages)
    if found or "more recent barrier call" in messages:  # the latter while the processes still wait for each other
        which, given = "a process", "one --process_id"
        if found:
            which, given = f"process {found[1]}", f"--process_id={found[1]}"
        why = f"{given} was given to two processes, or one was started again alone"
        return f"{which} has connected twice: {why}; {_REMEDY}, each with its own id"
    if found := re.search(r"stopped sending heartbeats\):\s*((?:\d+\s+)+)", messages):
        names = ", ".join(found[1].split())
        return f"process {names} does not answer any more: it hangs, or its machine or network is down; {_REMEDY}"
    if re.search(r"Failed to send RPC|Deadline Exceeded|Socket closed|failed to connect", messages, re.IGNORECASE):
        return f"process 0 does not answer any more: it has ended or hangs, see its output; {_REMEDY}"
    words = " ".join(re.sub(r"^\s*@ +0x.*$", "", messages, flags=re.MULTILINE).split())  # without the stack
    return f"another process may have ended; {_REMEDY} ({words[-400:]})"


class LostProcesses:
    """Holds back what the coordination service prints, and prints one line when it aborts this process.

    JAX's coordination service notices that another process hangs, has ended, or was started twice. It prints many lines
    from C++ and aborts the process, which Python can neither prevent nor catch: only a handler of SIGABRT can still say
    what happened.

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
            os.write(self._stderr, f"error: {describe_loss(self.flush())}\n".encode())
        os._exit(1)


def is_first() -> bool:
    """Returns whether this is the process that writes files and prints."""
    return jax.process_index() == 0


class Detail(str):
    """A line that `print_once` prints only if the flag --verbosity asks for it."""


def prints_details() -> bool:
    """Returns whether `print_once` prints a Detail."""
    return logging.getLogger("jaxnerf").isEnabledFor(logging.INFO)


def print_once(*lines: str) -> None:
    """Prints lines to stderr, in the first process only."""
    chosen = [line for line in lines if not isinstance(line, Detail) or prints_details()]
    if chosen and is_first():
        with stages.room():
            print(*chosen, sep="\n", file=sys.stderr)


def any_of(flag: bool, step: int = 0) -> bool:
    """Returns whether the flag is set in any process; with a step, only every AGREE_EVERY steps, otherwise False."""
    if jax.process_count() == 1:
        return bool(flag)
    return not step % AGREE_EVERY and bool(multihost_utils.process_allgather(np.asarray(bool(flag))).any())


def broadcast(tree: Any) -> Any:
    """Returns the first process's arrays, in numpy where there are several processes."""
    return tree if jax.process_count() == 1 else multihost_utils.broadcast_one_to_all(tree)


def check_same(what: str, *values: Any) -> None:
    """Raises a ValueError in all processes unless all have the same text and trees of arrays.

    For large arrays it compares a sample of the rows, as they may be on a disk.
    """
    if jax.process_count() == 1:
        return
    digest = np.uint32(int(fingerprint(*values, sample=_SAMPLE)[:8], 16))
    found = multihost_utils.process_allgather(digest)
    others = [index for index, value in enumerate(found) if value != found[0]]
    if others:
        raise ValueError(f"processes {others} have a different {what} than process 0; give all processes the same")


def run_on_first(action: Callable[[], Any], path: str | os.PathLike, seconds: float = 30.0) -> None:
    """Runs an action in the first process; all continue when it is done and they see the path that it makes.

    Raises:
        ValueError: in all processes, if the action raises one or an OSError, or one does not see the path.
    """
    problem = None
    if is_first():
        try:
            action()
        except (ValueError, OSError) as error:
            problem = error
    if any_of(problem is not None):
        raise problem or ValueError("process 0 cannot start; see its output")
    deadline = time.monotonic() + seconds  # network file systems cache that a file is missing
    while not os.path.exists(path) and time.monotonic() < deadline:
        time.sleep(0.1)
    if not os.path.exists(path):
        problem = ValueError(f"{path}: process {jax.process_index()} does not see it; give a folder that all share")
    if any_of(problem is not None):
        raise problem or ValueError(f"{path}: some process does not see it; give a folder that all share")


def barrier() -> None:
    """Returns when all processes have called it."""
    if jax.process_count() > 1:
        multihost_utils.sync_global_devices("jaxnerf")
