"""Scores of a training while it runs."""

import pathlib
import sys
import time

from jaxnerf.evaluation.evaluate import score_run, summary
from jaxnerf.evaluation.restore import restore_run
from jaxnerf.training import metric_log


def watch(folder, *, poll_seconds=10.0, config=None, data_dir=None, split=None, chunk=None):
    """Scores every new checkpoint of a running training until its last one; says when it waits.

    Args:
        folder: the workdir, which training may not have made yet.
        poll_seconds: how often it looks.
        config, data_dir, split, chunk: see evaluate.

    Raises:
        ValueError: as evaluate.
    """
    folder, said = pathlib.Path(folder), None
    while not (folder / "config.json").exists():
        said = _wait(f"{folder}: no run yet", said, poll_seconds)
    run = restore_run(folder, config, data_dir=data_dir)
    split = split or run.experiment.eval.split
    suffix = "" if split == run.experiment.eval.split else f"-{split}"
    views = run.experiment.load_split(split)
    while True:
        new = [step for step in run.steps() if not (folder / "eval" / f"{step}{suffix}").exists()]
        if new:
            try:
                print(
                    summary(score_run(run, folder, split=split, step=new[0], chunk=chunk, views=views)),
                    flush=True,
                )
            except ValueError:
                if new[0] in run.steps():  # else training has removed it as too old, which is no error
                    raise
        elif _ended(run, folder):
            return
        else:
            said = _wait(f"{folder}: no new checkpoint", said, poll_seconds)


def _ended(run, folder):
    """Returns whether the training has written its last checkpoint, by its steps or by its clock."""
    options, steps, rows = run.experiment.train, run.steps(), metric_log.read_rows(folder)
    if not steps:
        return False
    late = rows and rows[-1]["step"] == steps[-1] and 0 < options.max_seconds <= rows[-1]["seconds"]
    return steps[-1] >= options.max_steps or bool(late)


def _wait(text, said, seconds):
    """Sleeps, and says so where it was not the last thing said; returns what was."""
    if text != said:
        print(f"{text}; looking again every {seconds:g} s", file=sys.stderr, flush=True)
    time.sleep(seconds)
    return text
