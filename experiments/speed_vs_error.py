"""Error against seconds: of training, of rendering, and how near both come to what the machine can do.

    JAXNERF_SCENES=... python experiments/speed_vs_error.py --out=DIR \
        [--parts=training,rendering,limits,cost] [--curves=grid,dense] \
        [--workdir=DIR of a trained run, or none] [--readme=README.md]

Writes DIR/<part>.json, DIR/published.json (what others say, with its source) and DIR/speed_vs_error.png, and
prints the tables. What is in DIR already is kept: the same command after an interruption goes on from there.
rendering and limits take the run of --workdir, else the first of the grid's; with none they do without.
With --readme the tables replace what lies between <!-- speed --> and <!-- end of speed --> in that file.
"""

import json
import pathlib
import sys

sys.path.insert(0, str(pathlib.Path(__file__).resolve().parent.parent))  # configurations import configs

import table  # noqa: E402  which defines --readme
from absl import flags  # noqa: E402

from jaxnerf.runtime import cli  # noqa: E402

PARTS = ("training", "rendering", "limits", "cost")
_OUT = flags.DEFINE_string("out", None, "Folder of what is measured.", required=True)
_PARTS = flags.DEFINE_list("parts", list(PARTS), f"Of {PARTS}; 'report' alone measures nothing.")
_CURVES = flags.DEFINE_list("curves", None, "Names of training curves; all when not given.")
_SEEDS = flags.DEFINE_list("seeds", ["0", "1", "2"], "Of the curve 'grid'; of the others the first.")
_SECONDS = flags.DEFINE_list("seconds", [], "Of training, in place of the curves' own.")
_WORKDIR = flags.DEFINE_string("workdir", None, "Folder of a trained run, or 'none'.")
_VIEWS = flags.DEFINE_integer("views", 3, "Test views to render with each setting.", lower_bound=1)
MARKS = ("<!-- speed -->", "<!-- end of speed -->")


def main(argv):
    """Measures the parts in turn, then reports all that is there."""
    del argv
    import speed_plot
    import speed_published
    import speed_report

    out = pathlib.Path(_OUT.value)
    out.mkdir(parents=True, exist_ok=True)
    others = {"training": speed_published.TRAINING, "rendering": speed_published.RENDERING}
    _write(out / "published.json", others)
    for part in _chosen(_PARTS.value, (*PARTS, "report"), "--parts"):
        try:
            finished = _measure(part, out)
        except KeyboardInterrupt:
            finished = False
        if not finished:
            raise ValueError(f"stopped; what was measured is in {out}, and the same command goes on from there")
    measured = {part: _read(out / f"{part}.json") for part in PARTS}
    lines = speed_report.report(measured)
    print("\n".join([*lines, "", *speed_report.published()]))
    if flags.FLAGS.readme:
        table.replace(pathlib.Path(flags.FLAGS.readme), lines, MARKS)
    speed_plot.draw(measured, out / "speed_vs_error.png")


def _measure(part, out):
    """Measures a part; returns whether it came to its end."""
    import speed_limits
    import speed_rendering
    import speed_step
    import speed_training

    path = out / f"{part}.json"
    kept, save = _read(path), lambda kept: _write(path, kept)
    config = speed_training.configuration(speed_training.SEEDED)
    if part == "training":
        names = _chosen(_CURVES.value or speed_training.CURVES, speed_training.CURVES, "--curves")
        seeds, seconds = [int(seed) for seed in _SEEDS.value], [float(stop) for stop in _SECONDS.value]
        return speed_training.measure(kept, save, out / "runs", names, seeds, seconds)
    if part == "cost":
        speed_step.measure(kept, save, config)
    if part == "rendering":
        if _WORKDIR.value == "none":
            print("rendering is left out: it needs a trained run, see --workdir")
        else:
            speed_rendering.measure(kept, save, _workdir(out), _VIEWS.value)
    if part == "limits":
        folder = None if _WORKDIR.value == "none" else str(_workdir(out))
        if not kept or kept["workdir"] != folder:
            save({"workdir": folder, **speed_limits.measure(config, folder)})
    return True


def _workdir(out):
    """Returns the folder of the trained run to render."""
    import speed_training

    name = speed_training.workdir_name(speed_training.SEEDED, int(_SEEDS.value[0]))
    return pathlib.Path(_WORKDIR.value or out / "runs" / name)


def _chosen(names, known, flag):
    wrong = [name for name in names if name not in known]
    if wrong:
        raise ValueError(f"{flag} has {wrong[0]!r}, wanted some of {', '.join(known)}")
    return names


def _read(path):
    return json.loads(path.read_text()) if path.exists() else {}


def _write(path, content):
    from jaxnerf.training.workdir import write_text

    write_text(path, json.dumps(content, indent=1) + "\n")


if __name__ == "__main__":
    cli.run(main)
