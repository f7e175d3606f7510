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
_BATCH = app.define_count(
    "batch", "Rays of the batch at once, or auto: what fits; config.train.block_size when not given."
)
flags.mark_flags_as_required(["config", "workdir"])


def main(argv):
    del argv
    from jaxnerf.engine.loop import train_and_evaluate  # after the flags: a wrong one is said at once

    config = app.use_data(_CONFIG.value, _DATA_DIR.value, _FORMAT.value)
    if _BATCH.value is not None:
        config.train.block_size = _BATCH.value
    train_and_evaluate(config, _WORKDIR.value)


if __name__ == "__main__":
    app.run(main)
