"""Finds what a scene needs: jaxnerf-needs --data_dir=DIR --out=DIR [--config=capture] [--budget=10min]

Trains the config's model, and the same with each part of the method removed, reduced or added, for some seconds with
the same seeds, and scores them on views that are held out of training; test views are not read. A part is needed if it
contributes at least --margin dB. The folder --out then holds page.html, a table of all parts; lean.py, a config without
what is not needed; curve.csv and results.json. The same command continues where it was stopped.
"""

import re

from absl import flags

from jaxnerf.evaluation import run_flags
from jaxnerf.runtime import cli

_CONFIG = run_flags.define_config("The config of the complete model: a name, or the path of a file; capture if none.")
_DATA_DIR = flags.DEFINE_string("data_dir", None, "The dataset's folder. It overrides config.data.dir.")
_FORMAT = flags.DEFINE_string("format", None, "The dataset's format, or auto. It overrides config.data.format.")
_OUT = flags.DEFINE_string("out", None, "The folder of all trials and results.", required=True)
_BUDGET = flags.DEFINE_string("budget", "10min", "Time of everything, such as 90s, 10min or 1h.")
_MARGIN = flags.DEFINE_float("margin", 0.1, "dB that a needed part contributes at least.", lower_bound=0.0)
_EQUAL = flags.DEFINE_enum("equal", "seconds", ["seconds", "steps"], "What paired trials have in common.")
_SECONDS = flags.DEFINE_float(
    "seconds", 0.0, "Training time of a trial. 0: as long as the budget allows.", lower_bound=0.0
)
_LEAN = flags.DEFINE_bool("lean", True, "Whether to seek the lean model, too, or verdicts alone.")
_PARTS = flags.DEFINE_list("parts", [], "Parts to try, such as 'view dependence,levels'. Empty: all.")
_SHRINK = flags.DEFINE_integer(
    "shrink",
    0,
    "The factor by which trials shrink images. 0: so that a trial sees each pixel about once.",
    lower_bound=0,
)
_UNITS = {"": 1, "s": 1, "min": 60, "h": 3600}


def main(argv):
    del argv
    # Imported after the flags are parsed, so that a wrong flag is reported at once.
    from jaxnerf.configs import capture
    from jaxnerf.tools.needs.run import Request, find_needs
    from jaxnerf.tools.needs.study import Settings

    config = cli.use_data(_CONFIG.value or capture.get_config(), _DATA_DIR.value, _FORMAT.value)
    settings = Settings(_budget(_BUDGET.value), _MARGIN.value, _EQUAL.value, _SECONDS.value, _LEAN.value)
    find_needs(Request(config, settings, tuple(_PARTS.value), _SHRINK.value), _OUT.value)


def _budget(text):
    """Returns the seconds of a text such as 10min."""
    found = re.fullmatch(r"\s*([0-9.]+)\s*(s|min|h|)\s*", text)
    try:
        seconds = float(found[1]) * _UNITS[found[2]] if found else 0.0
    except ValueError:
        seconds = 0.0
    if not seconds > 0:
        raise ValueError(f"--budget is {text!r}, expected a time such as 90s, 10min or 1h; correct it")
    return seconds


def run():
    """Runs the program."""
    cli.run(main, stopped="after the last finished trial; the same command continues")


if __name__ == "__main__":
    run()
