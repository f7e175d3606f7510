"""The flags of programs that render a run, and the run and the predicted errors that they ask for."""

from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any

from absl import flags

from jaxnerf.runtime import cli

if TYPE_CHECKING:
    from jaxnerf.evaluation.restore import TrainedRun

MAX_UNCERTAINTY = (  # the help of --max_uncertainty
    "Cells of the occupancy grid that are more uncertain are empty, so that floaters go; auto: as low as training rays "
    "allow; 1, or not given: all cells stay."
)

flags.disclaim_key_flags()  # a flag defined here belongs to the program that calls


class RunFlags:
    """Flags that say which checkpoint is rendered, how, and which errors are predicted."""

    def __init__(self, done: str, written: str, *, required: bool = False):
        """Defines the flags.

        Args:
            done: what the program does with a checkpoint, for the help.
            written: what it writes of predicted errors, for the help.
            required: whether --workdir must be given.
        """
        self.workdir = flags.DEFINE_string("workdir", None, "The run's folder.", required=required)
        self.data_dir = flags.DEFINE_string("data_dir", None, "The dataset's folder. It overrides config.data.dir.")
        self.step = cli.define_step(f"The checkpoint's step. When it is not given, the newest is {done}.")
        self.chunk = cli.define_value(
            "chunk",
            "The rays rendered at once, or auto: as many as suit the device. It overrides config.eval.chunk.",
            int,
            cli.COUNT,
        )
        self.bake_occupancy = flags.DEFINE_bool(
            "bake_occupancy",
            None,
            "Whether to render a hierarchical model through a grid of its visible matter. It overrides "
            "config.eval.bake_occupancy.",
        )
        self.max_uncertainty = cli.define_value("max_uncertainty", MAX_UNCERTAINTY, float, cli.PART)
        self.uncertainty = flags.DEFINE_string(
            "uncertainty",
            None,
            "An estimator of the error of each pixel: laplace, of one run, ensemble, of several, or a registered one. "
            f"The program writes {written}.",
        )
        self.members = flags.DEFINE_list("members", None, "ensemble: workdirs of the other runs, which differ in seed.")
        self.coverage = flags.DEFINE_float(
            "coverage",
            0.9,
            "The fraction of true errors that the intervals of --uncertainty are to hold. They are calibrated on the "
            "views that config.data.hold_out has kept from training.",
        )

    def restore(self, config: Any = None, settings: Mapping[str, Any] | None = None) -> "TrainedRun":
        """Restores the run as the flags say; config, settings: see `restore_run`; settings win over the flags."""
        from jaxnerf.evaluation.restore import restore_run

        given = {"bake_occupancy": self.bake_occupancy.value, "chunk": self.chunk.value}
        given = {name: value for name, value in given.items() if value is not None} | dict(settings or {})
        run = restore_run(self.workdir.value, config, data_dir=self.data_dir.value, settings=given)
        if self.max_uncertainty.value is None:
            return run
        from jaxnerf.tools.uncertainty.cleaning import cleaned

        return cleaned(run, self.workdir.value, self.max_uncertainty.value)

    def predictor(self) -> Callable[["TrainedRun"], Any] | None:
        """Returns the function that makes the Predictor of a restored run; None without --uncertainty.

        Raises:
            ValueError: on a wrong flag, before anything is read.
        """
        from jaxnerf.tools.uncertainty.predict import requested

        options = {"step": self.step.value, "members": self.members.value, "coverage": self.coverage.value}
        return requested(self.uncertainty.value, self.workdir.value, **options)


def define_config(help: str, **options: Any) -> flags.FlagHolder:
    """Defines --config of a run, which takes the config.json of one, too; options: of `cli.define_config`."""

    def load_saved(path):
        from jaxnerf.training.workdir import load_config_dict

        return load_config_dict(path)

    def option_names():
        from jaxnerf.training.config import option_names

        return option_names()

    return cli.define_config(help, load_saved=load_saved, option_names=option_names, **options)
