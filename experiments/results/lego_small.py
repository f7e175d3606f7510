"""Measures PSNR against minutes of training, for configs/lego_small.py on the real lego scene.

    JAXNERF_SCENES=... python experiments/results/lego_small.py --workdir=runs/lego_small [--minutes=2,5,10]

Trains to each time in turn, resuming from the one before, scores the test views there, and prints the table.
Seconds are of training; compilation is listed beside them.
"""

import pathlib
import sys

from absl import flags

sys.path.append(str(pathlib.Path(__file__).resolve().parents[1]))
import common
from results import table

from jaxnerf.runtime import cli

_CONFIG = cli.define_config("Config of the run: a name, or the path of a file.")
_WORKDIR = flags.DEFINE_string("workdir", None, "Folder of the run.", required=True)
_MINUTES = flags.DEFINE_list("minutes", ["2", "5", "10"], "Minutes of training at which to score, ascending.")
flags.FLAGS.set_default("config", "lego_small")


def main(argv: list[str]) -> None:
    """Trains and scores at each of the times."""
    del argv
    from jaxnerf.evaluation.evaluate import score_run, train_and_evaluate
    from jaxnerf.evaluation.restore import restore_run

    config = _CONFIG.value
    for minutes in map(float, _MINUTES.value):
        config.train.max_seconds = 60 * minutes
        if not train_and_evaluate(config, _WORKDIR.value):
            return
        score_run(restore_run(_WORKDIR.value), _WORKDIR.value, overwrite=True)
    rows = [table.row(path) for path in table.scored(pathlib.Path(_WORKDIR.value))]
    print("\n".join(common.markdown(table.HEADS, rows)))


if __name__ == "__main__":
    cli.run(main)
