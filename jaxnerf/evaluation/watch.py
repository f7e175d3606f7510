"""Scores the checkpoints of a training run while it runs."""

import os
import pathlib
import sys
import time
from typing import Any

from jaxnerf.evaluation.evaluate import score_run, summary
from jaxnerf.evaluation.restore import restore_run
from jaxnerf.training import metric_log
from jaxnerf.training.config import Config


def watch(
    workdir: str | os.PathLike,
    *,
    poll_seconds: float = 10.0,
    config: Config | None = None,
    data_dir: str | None = None,
    split: str | None = None,
    settings: dict[str, Any] | None = None,
) -> None:
    """Scores every new checkpoint of a training run until the last one, and prints a line when it waits.

    Args:
        workdir: the folder that training writes; it may not exist yet.
        poll_seconds: time between searches for a new checkpoint.
        config, data_dir, split, settings: see `evaluate`.

    Raises:
        ValueError: as `evaluate`.
    """
    workdir, said = pathlib.Path(workdir), None
    while not (workdir / "config.json").exists():
        said = _wait(f"{workdir}: no run yet", said, poll_seconds)
    run = restore_run(workdir, config, data_dir=data_dir, settings=settings)
    split = split or run.experiment.config.eval.split
    suffix = "" if split == run.experiment.config.eval.split else f"-{split}"
    views = run.experiment.load_split(split)
    while True:
        new = [step for step in run.steps() if not (workdir / "eval" / f"{step}{suffix}").exists()]
        if new:
            try:
                results = score_run(run, workdir, split=split, step=new[0], views=views)
                print(summary(results), flush=True)
            except ValueError:
                if new[0] in run.steps():  # otherwise training has deleted it as too old, which is no error
                    raise
        elif _has_ended(run, workdir):
            return
        else:
            said = _wait(f"{workdir}: no new checkpoint", said, poll_seconds)


def _has_ended(run, workdir):
    """Returns whether the training has written its last checkpoint, by its steps or by its clock."""
    options, steps, rows = run.experiment.config.train, run.steps(), metric_log.read_rows(workdir)
    if not steps:
        return False
    late = rows and rows[-1]["step"] == steps[-1] and 0 < options.max_seconds <= rows[-1]["seconds"]
    return steps[-1] >= options.max_steps or bool(late)


def _wait(text, said, seconds):
    """Sleeps, after printing the text unless it was printed last; returns the text."""
    if text != said:
        print(f"{text}; checking again every {seconds:g} s", file=sys.stderr, flush=True)
    time.sleep(seconds)
    return text
