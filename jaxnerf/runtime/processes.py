"""The processes of one training: how they find each other, agree, and leave files to the first of them."""

import contextlib
import os
import socket
import sys
import threading
import time
import traceback
import zlib

import jax
import numpy as np
from jax.experimental import multihost_utils

AGREE_EVERY = 10  # steps; an answer takes some ms, as it waits for the step before it
_SAMPLE = 2**16  # rows
_LAUNCHERS = (("SLURM_PROCID", "SLURM_STEP_NUM_TASKS"), ("OMPI_COMM_WORLD_RANK", "OMPI_COMM_WORLD_SIZE"))
_BY_HAND = "--coordinator=HOST:PORT --num_processes=N --process_id=I"


def launched(environ=os.environ):
    """Returns (index, count) of this process among those that srun or mpirun has started; None without them.

    SLURM_NTASKS would not do: a batch script and an interactive shell have it too, and are one process.
    """
    for index, count in _LAUNCHERS:
        if index in environ and count in environ:
            return int(environ[index]), int(environ[count])
    return None


@contextlib.contextmanager
def cluster(*, multihost=None, coordinator=None, num_processes=None, process_id=None, seconds=300.0):
    """Joins the processes of one training, if there are several; comes before any other use of JAX.

    What goes wrong inside ends this process with one line at once, as the usual way out would wait for the
    others, which may be waiting for this one. What another process's end breaks is said to be that.

    Args:
        multihost: True joins the cluster that JAX detects (SLURM, Open MPI 4, Kubernetes, Cloud TPU); None
            does so where srun or mpirun has started several processes; False never does.
        coordinator: HOST:PORT of process 0, to which all connect; None leaves it to JAX.
        num_processes, process_id: None takes those of srun or mpirun.
        seconds: how long to wait for the other processes.

    Raises:
        ValueError: if what is given does not name a process of a cluster; not when there is one.
    """
    place = launched()
    given = (coordinator, num_processes, process_id)
    if multihost is False and given != (None, None, None):
        raise ValueError("--nomultihost keeps to one process, not to those of --coordinator; drop one")
    if not multihost and coordinator is None and given[1:] != (None, None):
        raise ValueError(f"--num_processes and --process_id need a coordinator; give {_BY_HAND}")
    if multihost is False or (not multihost and coordinator is None and (place or (0, 1))[1] == 1):
        yield
        return
    if coordinator is not None:
        num_processes = num_processes if num_processes is not None or not place else place[1]
        process_id = process_id if process_id is not None or not place else place[0]
        _check(coordinator, num_processes, process_id)
    try:
        _join(coordinator, num_processes, process_id, seconds)
        yield
    except BaseException as error:
        _leave(error)


def _check(coordinator, num_processes, process_id):
    host, _, port = coordinator.rpartition(":")
    if not host or not port.isdigit() or not 0 < int(port) < 65536:
        raise ValueError(f"--coordinator is {coordinator!r}, wanted HOST:PORT of process 0")
    if num_processes is None or process_id is None or not 0 <= process_id < num_processes:
        raise ValueError(
            f"--num_processes is {num_processes} and --process_id {process_id}, wanted an id from 0 "
            f"below the number, another for each process; give {_BY_HAND}"
        )


def _join(coordinator, num_processes, process_id, seconds):
    # It would take SIGTERM for itself.
    jax.config.update("jax_enable_preemption_service", False)
    failed = []

    def connect():
        try:
            # JAX ends a process that has waited for long enough with a stack trace: that is left to us.
            options = {"initialization_timeout": int(seconds) + 3600}
            if coordinator is not None and launched() is None:  # else JAX gives each process on a machine a GPU
                options["cluster_detection_method"] = "deactivate"
            jax.distributed.initialize(coordinator, num_processes, process_id, **options)
        except Exception as error:
            failed.append(error)

    thread = threading.Thread(target=connect, daemon=True)
    thread.start()
    thread.join(seconds)
    if failed and coordinator is None:
        raise ValueError(f"no cluster to join ({_line(failed[0])}); start with srun, or give {_BY_HAND}")
    if failed:
        raise ValueError(f"--coordinator={coordinator}: {_line(failed[0])}; give another port")
    if thread.is_alive():
        what = "; start all of them, and give --coordinator if they do not find each other"
        if coordinator is not None:
            found = "not all of the others came" if _listens(coordinator) else "nothing answers there"
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
    code = 1
    if isinstance(error, KeyboardInterrupt):
        code, line = 130, "stopped; the same command starts again"
    elif isinstance(error, jax.errors.JaxRuntimeError):
        line = f"another process may be gone; start all again to go on where it was saved ({_line(error)})"
    elif isinstance(error, ValueError | OSError):
        line = _line(error)
    else:
        line = _line(error)
        traceback.print_exception(error)
    print(f"error: {line}", file=sys.stderr, flush=True)
    sys.stdout.flush()
    os._exit(code)


def _line(error):
    return " ".join(str(error).split())[:400]


def is_first():
    """Returns whether this process writes what all have in common."""
    return jax.process_index() == 0


def say(*lines):
    """Prints lines to stderr, once for all processes."""
    if lines and is_first():
        print(*lines, sep="\n", file=sys.stderr)


def any_of(flag, step=0):
    """Returns whether any process says so; with a step, all are asked every AGREE_EVERY steps, else False."""
    if jax.process_count() == 1:
        return bool(flag)
    return not step % AGREE_EVERY and bool(multihost_utils.process_allgather(np.asarray(bool(flag))).any())


def from_first(tree):
    """Returns the first process's arrays, in numpy where there are several processes."""
    return tree if jax.process_count() == 1 else multihost_utils.broadcast_one_to_all(tree)


def check_same(what, *values):
    """Raises a ValueError in all processes unless each has the same text and trees of arrays.

    Of an array of many rows it looks at some, as it may lie on a disk.
    """
    if jax.process_count() == 1:
        return
    digest = 0
    for leaf in jax.tree.leaves(values):
        if isinstance(leaf, str):
            content = leaf.encode()
        else:
            rows = np.atleast_1d(leaf)
            content = np.ascontiguousarray(rows[:: len(rows) // _SAMPLE + 1])
        digest = zlib.crc32(content, digest)
    found = multihost_utils.process_allgather(np.uint32(digest))
    others = [index for index, value in enumerate(found) if value != found[0]]
    if others:
        raise ValueError(f"processes {others} have another {what} than process 0; give all the same")


def first_does(action, path, seconds=30.0):
    """Runs an action in the first process; all go on when it is done and they see the path that it makes.

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
        raise problem or ValueError("process 0 cannot start; it says why")
    deadline = time.monotonic() + seconds  # for what a network file system keeps in mind
    while not os.path.exists(path) and time.monotonic() < deadline:
        time.sleep(0.1)
    if not os.path.exists(path):
        problem = ValueError(f"{path}: process {jax.process_index()} does not see it; give one that all share")
    if any_of(problem is not None):
        raise problem or ValueError(f"{path}: some process does not see it; give one that all share")


def wait():
    """Returns when all processes are here."""
    if jax.process_count() > 1:
        multihost_utils.sync_global_devices("jaxnerf")
