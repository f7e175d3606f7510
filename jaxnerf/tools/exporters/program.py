"""Exports a trained run for other programs: jaxnerf-export --workdir=DIR --kind=mesh.

It writes DIR/exports/KIND-STEP/, in the units and axes of the dataset's files: a mesh with colours or a texture, points
with normals, depth images with cameras, Gaussian splats, a web page, or refined cameras. All but these two need
scikit-image, scipy and trimesh: pip install 'jaxnerf[export]'.
"""

import sys

from absl import flags

from jaxnerf.evaluation import run_flags
from jaxnerf.options import declarations
from jaxnerf.runtime import cli
from jaxnerf.tools.exporters.registration import EXPORTERS

_WORKDIR = flags.DEFINE_string("workdir", None, "The run's folder.", required=True)
_KIND = flags.DEFINE_string(
    "kind", None, f"What to export: {', '.join(EXPORTERS.names())}, or a registered exporter.", required=True
)
_DATA_DIR = flags.DEFINE_string("data_dir", None, "The dataset's folder. It overrides config.data.dir.")
_STEP = cli.define_step("The checkpoint's step. When it is not given, the newest is exported.")
_MAX_UNCERTAINTY = cli.define_value("max_uncertainty", run_flags.MAX_UNCERTAINTY, float, cli.PART)
_TIME = flags.DEFINE_float(
    "time",
    None,
    "The instant of a scene that moves, from 0 to 1. When it is not given, it is 0.",
    lower_bound=0.0,
    upper_bound=1.0,
)
_NAME = flags.DEFINE_string("name", None, "The name of the folder. It overrides KIND-STEP or KIND-STEP-timeTIME.")
_OVERWRITE = flags.DEFINE_bool("overwrite", False, "Whether to replace an existing folder of that name.")


def main(argv):
    del argv
    # Imported after the flags are parsed, so that a wrong flag is reported at once.
    from jaxnerf.tools.exporters.base import export_run

    EXPORTERS.get(_KIND.value)
    kinds = {name: list(declared) for name, declared in _declared().items() if flags.FLAGS[name].present}
    for name, reading in kinds.items():
        if _KIND.value not in reading:
            raise ValueError(
                f"--{name} is given and --kind={_KIND.value}, expected --kind={' or --kind='.join(reading)}; drop it"
            )
    try:
        folder = export_run(
            _WORKDIR.value,
            _KIND.value,
            step=_STEP.value,
            data_dir=_DATA_DIR.value,
            max_uncertainty=_MAX_UNCERTAINTY.value,
            time=_TIME.value,
            name=_NAME.value,
            overwrite=_OVERWRITE.value,
            say=lambda line: print(line, file=sys.stderr),
            **{name: flags.FLAGS[name].value for name in kinds},
        )
    except ImportError as error:
        if error.name is None or error.name.partition(".")[0] == "jaxnerf":
            raise
        raise ValueError(f"the export needs {error.name}; run pip install 'jaxnerf[export]'") from error
    print(*sorted(path for path in folder.iterdir()), sep="\n")


def _declared():
    """Returns, by the name of an option and the kinds of exports that have it, its declaration, type and default."""
    found = {}
    for kind in EXPORTERS.names():
        options = EXPORTERS.get(kind).options
        for name, (option, type_) in declarations(options).items():
            found.setdefault(name, {})[kind] = option, type_, getattr(options(), name)
    return found


def _define_flags(argv):
    """Defines the flags of all exporters, those of plug-ins included; returns the command line as it is."""
    chosen = cli.given_flag("kind", argv)  # whose types count, if others have an option of the same name
    for name, declared in _declared().items():
        if name in flags.FLAGS:
            kind = next(iter(declared))
            raise ValueError(f"the exporter {kind!r} has an option {name!r}, as all exports have; rename the option")
        helps = {}
        for kind, (option, _, default) in declared.items():
            helps.setdefault(f"{option.help}. Default: {default}.", []).append(kind)
        help = " ".join(f"{', '.join(kinds)}: {text}" for text, kinds in helps.items())
        option, type_, _ = declared.get(chosen) or next(iter(declared.values()))
        cli.define_value(name, help, type_, option.range, auto=option.auto)
    return argv


def run():
    """Runs the program."""
    cli.run(main, prepare=_define_flags, stopped="before anything was written; the same command starts again")


if __name__ == "__main__":
    run()
