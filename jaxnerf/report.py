"""Compares runs: jaxnerf-report RUN ... prints a table; a RUN is a workdir, or a folder that contains workdirs.

`python -m jaxnerf.report` is the same program. PSNR and SSIM are those that jaxnerf-eval has written, of the newest
checkpoint that it has scored; "training PSNR" is that of the last batches of rays. Options that differ between the
runs follow. Neither JAX's devices nor the datasets are used.

jaxnerf-report --curve=DATASET --seconds=5,15,60 trains a run of each length and scores it: speed against error.
"""

import pathlib

from absl import flags

from jaxnerf.evaluation import run_flags
from jaxnerf.runtime import cli

_CONFIG = run_flags.define_config("The config of the runs of --curve: a name, or the path of a file; capture if none.")
_CURVE = flags.DEFINE_string("curve", None, "A dataset's folder, or a workdir, whose own curve is then drawn.")
_SECONDS = flags.DEFINE_list("seconds", [], "Seconds of training for --curve; of a workdir, times to read its log at.")
_COMPARE = flags.DEFINE_string("compare", None, "A CSV file with points of other programs, which join the --curve.")
_OUT = flags.DEFINE_string("out", "runs/curve", "The folder of --curve: curve.csv, curve.png and the runs.")
_CSV = flags.DEFINE_string("csv", None, "A file to write: one row for each run, with all options that differ.")
_PLOT = flags.DEFINE_string(
    "plot", None, "A .png or .svg to write: PSNR over time and over steps. It needs matplotlib, the extra `report`."
)
_OVERWRITE = flags.DEFINE_bool("overwrite", False, "Whether to replace existing files.")
_FORMATS = (".png", ".svg")


def main(argv):
    # Imported after the flags are parsed, so that a wrong flag is reported at once.
    if _CURVE.value:
        from jaxnerf.configs import capture
        from jaxnerf.tools.curve.curve import report

        if argv[1:] or _CSV.value or _PLOT.value:
            raise ValueError("--curve takes no RUN, --csv or --plot; see --out, or omit it")
        config = cli.use_data(_CONFIG.value or capture.get_config(), _CURVE.value)
        report(_CURVE.value, config, _SECONDS.value, _OUT.value, compare=_COMPARE.value, plugins=flags.FLAGS.plugins)
        return
    if _SECONDS.value or _COMPARE.value or _CONFIG.value:
        raise ValueError("--seconds, --compare and --config belong to --curve=DATASET; give it, or omit them")
    from jaxnerf.evaluation import run_report
    from jaxnerf.runtime.atomic_files import write_text
    from jaxnerf.tools.curve import run_files

    csv, plot = (_new_file(flag) for flag in (_CSV, _PLOT))
    if plot is not None and plot.suffix.lower() not in _FORMATS:
        raise ValueError(f"--plot is {str(plot)!r}, expected a name that ends in {' or '.join(_FORMATS)}; correct it")
    if plot is not None and csv == plot:
        raise ValueError(f"--csv and --plot both name {plot}; correct one of them")
    if plot is not None:
        run_files.require_matplotlib()
    runs = run_report.read_runs(argv[1:])
    print(run_report.table(runs))
    if csv is not None:
        write_text(csv, run_files.to_csv(runs))
        print(f"csv: {csv}")
    if plot is not None:
        run_files.save_plot(runs, plot)
        print(f"plot: {plot}")


def _new_file(flag):
    """Returns the path that a flag names, or None; ValueError if it cannot be written or would replace a file."""
    if flag.value is None:
        return None
    path = pathlib.Path(flag.value)
    if not path.name:
        raise ValueError(f"--{flag.name} is {flag.value!r}, expected the name of a file; correct it")
    if path.exists() and not (_OVERWRITE.value and path.is_file()):
        advice = "give --overwrite, or another name" if path.is_file() else "it is no file; give another name"
        raise ValueError(f"--{flag.name}: {path} exists already; {advice}")
    if not path.parent.is_dir():
        raise ValueError(f"--{flag.name} is {flag.value!r}, but {path.parent} is not a folder; create it first")
    return path


def run():
    """Runs the program."""
    cli.run(main, positional=True, stopped="within a run or before; the same command continues")


if __name__ == "__main__":
    run()
