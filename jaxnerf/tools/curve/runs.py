"""Runs in processes of their own."""

import os
import pathlib
import signal
import subprocess
import sys
from collections.abc import Mapping, Sequence
from typing import Any

from jaxnerf.runtime.atomic_files import read_json, to_json, write_text
from jaxnerf.tools.curve.measure import SCORE
from jaxnerf.training.config import RunConfig


def train_and_score(
    config: RunConfig,
    seconds: float,
    workdir: pathlib.Path,
    *,
    about: Mapping[str, Any] | None = None,
    plugins: Sequence[str] = (),
    environment: Mapping[str, str] | None = None,
) -> dict[str, Any] | None:
    """Trains and scores a run for so many seconds in a process of its own; continues one that was interrupted.

    Args:
        config: of the run.
        seconds: of training.
        workdir: of the run. The process writes score.json there, which `read_score` reads.
        about: what score.json holds beside the scores.
        plugins: modules that the process imports first.
        environment: of the process, in place of this one's.

    Returns:
        The content of score.json; None if the run failed, which it reported on stderr.
    """
    plan = {"config": config.to_dict(), "seconds": float(seconds), "workdir": str(workdir), "about": dict(about or {})}
    path = workdir.with_name(f"{workdir.name}.plan.json")
    path.parent.mkdir(parents=True, exist_ok=True)
    write_text(path, to_json(plan) + "\n")
    command = [sys.executable, "-m", "jaxnerf.tools.curve.one_run", f"--plan={path}"]
    command += [f"--plugins={','.join(plugins)}"] if plugins else []
    status = run_to_end(command, os.environ if environment is None else environment)
    path.unlink(missing_ok=True)
    return None if status else read_score(workdir)


def read_score(workdir: pathlib.Path) -> dict[str, Any] | None:
    """Returns the content of a run's score.json; None if it has none."""
    path = workdir / SCORE
    return read_json(path, "remove it, and the run is scored again") if path.exists() else None


def run_to_end(command: Sequence[str], environment: Mapping[str, str]) -> int:
    """Runs a program and returns its exit status; a signal that stops this program stops that one, which may save."""
    # In a session of its own it receives a signal once, from here: a second one would end it before it has saved.
    process = subprocess.Popen(command, env=environment, start_new_session=True)
    try:
        return process.wait()
    except KeyboardInterrupt:
        process.send_signal(signal.SIGTERM)
        process.wait()
        raise
