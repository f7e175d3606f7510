"""python -m jaxnerf.convert --weights=FILE --config=FILE --workdir=DIR: published weights as a run.

Reads what the original TensorFlow code, nerf-pytorch and JaxNeRF save; the run evaluates and renders
like any other.
"""

from absl import flags
from ml_collections import config_flags

from jaxnerf.runtime import cli

_WEIGHTS = flags.DEFINE_list(
    "weights",
    None,
    "A .tar of nerf-pytorch, a checkpoint of JaxNeRF, or model_N.npy,model_fine_N.npy of the original code.",
)
_CONFIG = config_flags.DEFINE_config_file("config", None, "Of the networks and the scene.", lock_config=True)
_WORKDIR = flags.DEFINE_string("workdir", None, "Folder to make.")
_DATA_DIR = flags.DEFINE_string("data_dir", None, "The scene's folder, in place of config.data.dir.")
_LEGACY = flags.DEFINE_bool(
    "legacy_posenc_order", False, "JaxNeRF's flag of that name when it trained, and its code of 2020."
)
flags.mark_flags_as_required(["weights", "config", "workdir"])


def main(argv):
    del argv
    from jaxnerf.interop.convert import convert  # after the flags: a wrong one is said at once

    config = cli.use_data(_CONFIG.value, _DATA_DIR.value)
    print(convert(_WEIGHTS.value, config, _WORKDIR.value, legacy_posenc_order=_LEGACY.value))


if __name__ == "__main__":
    cli.run(main, stopped="before anything was written; the same command starts again")
