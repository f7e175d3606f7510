"""python -m jaxnerf.train --config=configs/quickstart.py --workdir=DIR: trains, or goes on with, a run."""

from absl import flags
from ml_collections import config_flags

from jaxnerf import app

_CONFIG = config_flags.DEFINE_config_file("config", None, "The run's configuration file.", lock_config=True)
_WORKDIR = flags.DEFINE_string("workdir", None, "Folder of the run; the same one again resumes it.")
_DATA_DIR = flags.DEFINE_string("data_dir", None, "The scene's folder, in place of config.data.dir.")
_FORMAT = flags.DEFINE_enum(
    "format", None, ["auto", *app.FORMATS], "Of the scene, in place of config.data.format."
)
flags.mark_flags_as_required(["config", "workdir"])


def main(argv):
    del argv
    from jaxnerf.engine.loop import train_and_evaluate  # after the flags: a wrong one is said at once

    train_and_evaluate(app.use_data(_CONFIG.value, _DATA_DIR.value, _FORMAT.value), _WORKDIR.value)


if __name__ == "__main__":
    app.run(main, stopped="before it could save; the same command goes on from the last checkpoint, if any")
