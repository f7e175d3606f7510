"""Trains, resumes and evaluates again and again in one process, and checks that nothing grows.

    python experiments/stability/soak.py [--minutes=6]

A cycle trains a new run of configs/smoke.py, resumes it, evaluates it, and evaluates it again. After each cycle it
prints the resident memory, the open files, the threads, and the sizes of the workdir and of the user's cache. The
program fails if the second half of the cycles has more of one than the first half, beyond a tolerance.
"""

import argparse
import contextlib
import ctypes
import gc
import os
import pathlib
import shutil
import sys
import tempfile
import threading
import time

import jax
import numpy as np

from jaxnerf.configs import smoke
from jaxnerf.evaluation.evaluate import score_run, train_and_evaluate
from jaxnerf.evaluation.restore import restore_run
from jaxnerf.runtime.user_cache import private_folder

# Column -> what it may grow by from the first half of the cycles to the second: a fraction, and an absolute number.
TOLERANCES = {"memory MB": (0.03, 10), "files": (0, 1), "threads": (0, 2), "workdir kB": (0.01, 4), "cache kB": (0, 64)}


def main(minutes: float) -> None:
    """Runs cycles for some minutes; exits with 1 if something has grown."""
    started, rows = time.time(), []
    print("cycle  seconds  " + "  ".join(f"{name:>10}" for name in TOLERANCES), flush=True)
    with tempfile.TemporaryDirectory() as temporary:
        os.environ["XDG_CACHE_HOME"] = temporary  # that of the user may be in use by other programs
        while time.time() - started < 60 * minutes or len(rows) < 4:
            folder = pathlib.Path(temporary) / "run"
            _cycle(folder)
            rows.append(_measure(folder))
            shutil.rmtree(folder)
            numbers = "  ".join(f"{value:10.0f}" for value in rows[-1])
            print(f"{len(rows):5}  {time.time() - started:7.0f}  {numbers}", flush=True)
    rows = np.array(rows[1:])  # the first one also imports and compiles
    first, second = (np.median(half, axis=0) for half in np.array_split(rows, 2))
    grown = False
    for (name, (fraction, absolute)), before, after in zip(TOLERANCES.items(), first, second, strict=True):
        grows = bool(after - before > fraction * before + absolute)
        grown |= grows
        print(f"{name}: {before:.0f} in the first half, {after:.0f} in the second{', IT GROWS' * grows}")
    sys.exit(int(grown))


def _cycle(folder):
    config = smoke.get_config()
    with open(os.devnull, "w") as nowhere, contextlib.redirect_stderr(nowhere):
        for steps in (20, 40):
            config.train.max_steps = steps
            assert train_and_evaluate(config, folder)
        for step in (20, 40, 40):
            score_run(restore_run(folder), folder, step=step, overwrite=True)
    jax.clear_caches()  # JAX keeps every compiled program of a process


def _measure(folder):
    gc.collect()
    if sys.platform == "linux":
        ctypes.CDLL(None).malloc_trim(0)  # memory that is free but not yet returned is no leak
    status = dict(line.split(":", 1) for line in pathlib.Path("/proc/self/status").read_text().splitlines())
    memory = int(status["VmRSS"].split()[0]) / 1024
    files = len(os.listdir("/proc/self/fd"))
    return memory, files, threading.active_count(), _size(folder), _size(private_folder())


def _size(folder):
    return sum(path.stat().st_size for path in folder.rglob("*") if path.is_file()) / 1024


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--minutes", type=float, default=6.0)
    main(parser.parse_args().minutes)
