"""python -m jaxnerf.train --config=configs/quickstart.py --workdir=DIR: trains, or goes on with, a run."""

import sys

from absl import flags
from ml_collections import config_flags

from jaxnerf.runtime import cli

_CONFIG = config_flags.DEFINE_config_file("config", None, "The run's configuration file.", lock_config=True)
_WORKDIR = flags.DEFINE_string("workdir", None, "Folder of the run; the same one again resumes it.")
_DATA_DIR = flags.DEFINE_string("data_dir", None, "The scene's folder, in place of config.data.dir.")
_FORMAT = flags.DEFINE_enum("format", None, ["auto", *cli.FORMATS], "Of the scene, in place of config.data.format.")
_MULTIHOST = flags.DEFINE_bool(
    "multihost",
    None,
    "Train as one of several processes, that SLURM, Open MPI, Kubernetes or a TPU pod has started. When not "
    "given: if srun or mpirun has started several.",
)
_COORDINATOR = flags.DEFINE_string("coordinator", None, "HOST:PORT of process 0, where all meet.")
_NUM_PROCESSES = flags.DEFINE_integer("num_processes", None, "With --coordinator: of all.", lower_bound=1)
_PROCESS_ID = flags.DEFINE_integer("process_id", None, "With --coordinator: this one, from 0.", lower_bound=0)
_JOIN_SECONDS = flags.DEFINE_float("join_seconds", 300.0, "How long to wait for the other processes.", lower_bound=1.0)
_STOPPED_CODE = flags.DEFINE_integer(
    "stopped_code", 0, "What to exit with after SIGTERM or Ctrl-C; Kubernetes starts again unless it is 0."
)
_BATCH = cli.define_count(
    "batch", "Rays of the batch at once, or auto: what fits; config.train.microbatch_size when not given."
)
flags.mark_flags_as_required(["config", "workdir"])


def main(argv):
    del argv
    from jaxnerf.evaluation.evaluate import train_and_evaluate
    from jaxnerf.runtime import processes  # after the flags: a wrong one is said at once

    config = cli.use_data(_CONFIG.value, _DATA_DIR.value, _FORMAT.value)
    if _BATCH.value is not None:
        config.train.microbatch_size = _BATCH.value
    with processes.cluster(
        multihost=_MULTIHOST.value,
        coordinator=_COORDINATOR.value,
        num_processes=_NUM_PROCESSES.value,
        process_id=_PROCESS_ID.value,
        seconds=_JOIN_SECONDS.value,
    ):
        finished = train_and_evaluate(config, _WORKDIR.value)
    if not finished:
        sys.exit(_STOPPED_CODE.value)


if __name__ == "__main__":
    cli.run(main, stopped="before it could save; the same command goes on from the last checkpoint, if any")
