"""Trains and scores one run in a process of its own: python -m jaxnerf.tools.curve.one_run --plan=FILE

The process has its peak memory, compiled programs and cores for itself. `runs.train_and_score` starts it.
"""

import pathlib
import sys
import time

import jax
from absl import flags

from jaxnerf.runtime import cli
from jaxnerf.runtime.atomic_files import read_json, to_json, write_text
from jaxnerf.tools.curve import machine, measure

_PLAN = flags.DEFINE_string("plan", None, "A file that runs.train_and_score has written.", required=True)
_STOPPED = 130  # the exit status of a run that a signal stopped


def main(argv):
    del argv
    plan = read_json(pathlib.Path(_PLAN.value), "start the program again that wrote it")
    folder = pathlib.Path(plan["workdir"])
    try:
        point = measure.run_to(plan["seconds"], plan["config"], folder)
    finally:
        peak = measure.keep_peak(folder)
    if point is None:
        sys.exit(_STOPPED)
    about = {"datetime": time.strftime("%FT%T", time.gmtime()), "cpu": machine.processor()}
    about |= {"machine": machine.describe(), "device": jax.devices()[0].device_kind}
    about |= {"backend": jax.default_backend(), "jax": jax.__version__}
    write_text(folder / measure.SCORE, to_json({**plan["about"], **about, **point, **peak}) + "\n")


if __name__ == "__main__":
    cli.run(main, stopped="within a run; what is finished is saved, and the same command continues")
