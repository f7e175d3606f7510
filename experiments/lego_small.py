"""PSNR against minutes of training: the table for configs/lego_small.py on the real lego scene.

    JAXNERF_SCENES=... python experiments/lego_small.py --workdir=runs/lego_small [--minutes=2,5,10]

Trains to each time in turn, resuming from the one before, scores the 25 test views there, and prints
the table. Seconds are of training; compilation stands beside them.
"""

import pathlib
import sys

import table
from absl import flags
from ml_collections import config_flags

from jaxnerf.runtime import cli

sys.path.insert(0, str(pathlib.Path(__file__).resolve().parent.parent))  # configurations import configs

_CONFIG = config_flags.DEFINE_config_file("config", "configs/lego_small.py", "The run.", lock_config=True)
_WORKDIR = flags.DEFINE_string("workdir", None, "Folder of the run.", required=True)
_MINUTES = flags.DEFINE_list("minutes", ["2", "5", "10"], "Of training, ascending.")


def main(argv):
    """Trains and scores at each of the times."""
    del argv
    from jaxnerf.evaluation.evaluate import evaluate, train_and_evaluate

    config = _CONFIG.value
    for minutes in map(float, _MINUTES.value):
        config.train.max_seconds = 60 * minutes
        if not train_and_evaluate(config, _WORKDIR.value):
            return
        evaluate(_WORKDIR.value, overwrite=True)
    table.main(["", _WORKDIR.value])


if __name__ == "__main__":
    cli.run(main)
