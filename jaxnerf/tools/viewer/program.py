"""Shows a run in a web browser, while it trains or afterwards: jaxnerf-view --workdir=DIR.

It serves http://127.0.0.1:8080 until it is stopped.
"""

from absl import flags

from jaxnerf.evaluation import run_flags
from jaxnerf.runtime import cli

_WORKDIR = flags.DEFINE_string("workdir", None, "The run's folder.", required=True)
_DATA_DIR = flags.DEFINE_string("data_dir", None, "The dataset's folder. It overrides config.data.dir.")
_STEP = cli.define_step("The checkpoint's step. When it is not given, the newest is shown.")
_MAX_UNCERTAINTY = cli.define_value("max_uncertainty", run_flags.MAX_UNCERTAINTY, float, cli.PART)
_HOST = flags.DEFINE_string(
    "host", "127.0.0.1", "The address to listen on. 0.0.0.0 lets other machines connect, without a password."
)
_PORT = flags.DEFINE_integer("port", 8080, "The port to listen on; 0: any.", lower_bound=0, upper_bound=65535)


def main(argv):
    del argv
    # Imported after the flags are parsed, so that a wrong flag is reported at once.
    from jaxnerf.tools.viewer.live import view_run

    view_run(
        _WORKDIR.value,
        data_dir=_DATA_DIR.value,
        step=_STEP.value,
        max_uncertainty=_MAX_UNCERTAINTY.value,
        host=_HOST.value,
        port=_PORT.value,
    )


def run():
    """Runs the program."""
    cli.run(main, stopped="serving")


if __name__ == "__main__":
    run()
