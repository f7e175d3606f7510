"""Compares runs: jaxnerf-report RUN ... prints a table; a RUN is a workdir, or a folder that contains workdirs.

`python -m jaxnerf.report` is the same program. PSNR and SSIM are those that jaxnerf-eval has written, of the newest
checkpoint that it has scored; "training PSNR" is that of the last batches of rays. Options that differ between the
runs follow. Neither JAX's devices nor the datasets are used.
"""

import pathlib

from absl import flags

from jaxnerf.runtime import cli

_CSV = flags.DEFINE_string("csv", None, "A file to write: one row for each run, with all options that differ.")
_PLOT = flags.DEFINE_string(
    "plot", None, "A .png or .svg to write: PSNR over time and over steps. It needs matplotlib, the extra `report`."
)
_OVERWRITE = flags.DEFINE_bool("overwrite", False, "Whether to replace existing files.")
_FORMATS = (".png", ".svg")


def main(argv):
    # Imported after the flags are parsed, so that a wrong flag is reported at once.
    from jaxnerf.evaluation import run_report
    from jaxnerf.runtime.atomic_files import write_text

    csv, plot = (_new_file(flag) for flag in (_CSV, _PLOT))
    if plot is not None and plot.suffix.lower() not in _FORMATS:
        raise ValueError(f"--plot is {str(plot)!r}, expected a name that ends in {' or '.join(_FORMATS)}; correct it")
    if plot is not None and csv == plot:
        raise ValueError(f"--csv and --plot both name {plot}; correct one of them")
    if plot is not None:
        run_report.require_matplotlib()
    runs = run_report.read_runs(argv[1:])
    print(run_report.table(runs))
    if csv is not None:
        write_text(csv, run_report.to_csv(runs))
        print(f"csv: {csv}")
    if plot is not None:
        run_report.save_plot(runs, plot)
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
    cli.run(main, positional=True)


if __name__ == "__main__":
    run()
