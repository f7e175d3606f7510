"""Converts published weights into a run: jaxnerf-convert --weights=FILE --config=NAME --workdir=DIR.

It reads the files of the original TensorFlow code, nerf-pytorch and JaxNeRF. The run can be scored, rendered and
trained further as any other.
"""

from absl import flags

from jaxnerf.runtime import cli

_WEIGHTS = flags.DEFINE_list(
    "weights",
    None,
    "A .tar of nerf-pytorch, a checkpoint of JaxNeRF, or model_N.npy,model_fine_N.npy of the original code.",
    required=True,
)


def _option_names():
    from jaxnerf.training.config import option_names

    return option_names()


_CONFIG = cli.define_config(
    "The config of the networks and the dataset: a name, or the path of a file.",
    required=True,
    option_names=_option_names,
)
_WORKDIR = flags.DEFINE_string("workdir", None, "The run's folder, which the program creates.", required=True)
_DATA_DIR = flags.DEFINE_string("data_dir", None, "The dataset's folder. It overrides config.data.dir.")
_LEGACY = flags.DEFINE_bool(
    "legacy_posenc_order",
    False,
    "Whether JaxNeRF trained with its flag of this name, or before the flag existed (2020).",
)


def main(argv):
    del argv
    # Imported after the flags are parsed, so that a wrong flag is reported at once.
    from jaxnerf.tools.interop.convert import convert

    config = cli.use_data(_CONFIG.value, _DATA_DIR.value)
    print(convert(_WEIGHTS.value, config, _WORKDIR.value, legacy_posenc_order=_LEGACY.value))


def run():
    """Runs the program."""
    cli.run(main, stopped="before anything was written; the same command starts again")


if __name__ == "__main__":
    run()
