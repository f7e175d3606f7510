"""Trains a run: jaxnerf-train --config=lego_fast --data_dir=DIR --workdir=DIR; jaxnerf-train --workdir=DIR resumes it.

`python -m jaxnerf.train` is the same program. --config.train.batch_size=2048 sets a field of the config.
"""

import contextlib
import copy
import os
import sys

from absl import flags

from jaxnerf.evaluation import run_flags
from jaxnerf.runtime import cli


def _describe_options():
    from jaxnerf.tools.options_page.markdown import options_page

    return options_page()


_CONFIG = run_flags.define_config(
    "The config of the run: a name, or the path of a file. When it is not given, the workdir's.",
    describe_options=_describe_options,
)
_WORKDIR = flags.DEFINE_string(
    "workdir", None, "The run's folder. Training resumes if the folder holds a run.", required=True
)
_DATA_DIR = flags.DEFINE_string("data_dir", None, "The dataset's folder. It overrides config.data.dir.")
_FORMAT = flags.DEFINE_string("format", None, "The dataset's format, or auto. It overrides config.data.format.")
_MULTIHOST = flags.DEFINE_bool(
    "multihost",
    None,
    "Whether this is one of several processes that SLURM, Open MPI, Kubernetes or a TPU pod has started. "
    "When it is not given, the program detects srun and mpirun.",
)
_COORDINATOR = flags.DEFINE_string("coordinator", None, "HOST:PORT of process 0, to which all processes connect.")
_NUM_PROCESSES = flags.DEFINE_integer(
    "num_processes", None, "The number of processes; required by --coordinator.", lower_bound=1
)
_PROCESS_ID = flags.DEFINE_integer(
    "process_id", None, "The index of this process, from 0; required by --coordinator.", lower_bound=0
)
_JOIN_SECONDS = flags.DEFINE_float("join_seconds", 300.0, "The time to wait for other processes.", lower_bound=1.0)
_HEARTBEAT_SECONDS = flags.DEFINE_float(
    "heartbeat_seconds", 100.0, "The time without a sign of life after which a process counts as lost.", lower_bound=5.0
)
_STOPPED_CODE = flags.DEFINE_integer(
    "stopped_code",
    0,
    "The exit code after SIGTERM or Ctrl-C. Kubernetes restarts a program that does not exit with 0.",
    upper_bound=255,
)
_SEEDS = flags.DEFINE_list(
    "seeds",
    None,
    "Seeds of runs that train one after the other, such as 0,1,2,3: an ensemble. Each has a workdir of its own, "
    "seed_<seed> in --workdir.",
)
_BATCH = cli.define_value(
    "batch",
    "The rays of a microbatch, or auto: as many as fit into memory. It overrides config.train.microbatch_size.",
    int,
    cli.COUNT,
)
_VIEWER = flags.DEFINE_bool("viewer", False, "Whether to show the scene in a web browser while it trains.")
_VIEWER_HOST = flags.DEFINE_string(
    "viewer_host", "127.0.0.1", "The viewer's address. 0.0.0.0 lets other machines connect, without a password."
)
_VIEWER_PORT = flags.DEFINE_integer("viewer_port", 8080, "The viewer's port; 0: any.", lower_bound=0, upper_bound=65535)


def main(argv):
    del argv
    # Imported after the flags are parsed, so that a wrong flag is reported at once.
    from jaxnerf.evaluation.evaluate import train_and_evaluate, train_many
    from jaxnerf.runtime import processes

    if _CONFIG.value is None:
        raise ValueError(
            f"--workdir={_WORKDIR.value} holds no config.json, so there is no run to resume; give --config=NAME to "
            "start one (--config=help lists the names), or correct --workdir"
        )
    config = cli.use_data(_CONFIG.value, _DATA_DIR.value, _FORMAT.value)
    if _BATCH.value is not None:
        config.train.microbatch_size = _BATCH.value
    with processes.cluster(
        multihost=_MULTIHOST.value,
        coordinator=_COORDINATOR.value,
        num_processes=_NUM_PROCESSES.value,
        process_id=_PROCESS_ID.value,
        seconds=_JOIN_SECONDS.value,
        heartbeat_seconds=_HEARTBEAT_SECONDS.value,
    ):
        with _viewer(processes.is_first()) as observe:
            if _SEEDS.value is None:
                finished = train_and_evaluate(config, _WORKDIR.value, observe=observe)
            else:
                finished = train_many(*_runs_of_seeds(config, _SEEDS.value, _WORKDIR.value))
    if not finished:
        sys.exit(_STOPPED_CODE.value)


def _runs_of_seeds(config, seeds, workdir):
    """Returns the configs and the workdirs of runs that differ in the seed."""
    try:
        numbers = [int(seed) for seed in seeds]
    except ValueError:
        numbers = []
    if not numbers or len(set(numbers)) < len(numbers):
        raise ValueError(f"--seeds={','.join(seeds)}: expected different whole numbers, such as 0,1,2,3")
    if _VIEWER.value:
        raise ValueError("--viewer shows one run, and --seeds trains several; omit one of them")
    configs = [copy.deepcopy(config) for _ in numbers]
    for each, number in zip(configs, numbers, strict=True):
        each.seed = number
    return configs, [os.path.join(workdir, f"seed_{number}") for number in numbers]


@contextlib.contextmanager
def _viewer(is_first):
    """Yields what the training loop calls after each step; None without a viewer."""
    if not (_VIEWER.value and is_first):
        yield None
        return
    from jaxnerf.tools.viewer.live import LiveViewer

    viewer = LiveViewer(_WORKDIR.value, host=_VIEWER_HOST.value, port=_VIEWER_PORT.value)
    try:
        yield viewer.observe
    finally:
        viewer.close()


def run():
    """Runs the program."""
    stopped = "before it could save; the same command resumes from the last checkpoint, if there is one"
    cli.run(main, prepare=cli.with_saved_config, stopped=stopped)


if __name__ == "__main__":
    run()
