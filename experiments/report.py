"""One page of results from the workdirs of runs: a table, PSNR over time, pictures, and what figures mean.

    python experiments/report.py WORKDIR ... --out=DIR [--overwrite]

Writes DIR/report.md, DIR/psnr.png (which needs the extra `experiments`) and DIR/pictures.png from what
jaxnerf.train and jaxnerf.eval have left in the workdirs. A workdir that cannot be read is named, on the page
too.
"""

import json
import pathlib
import sys
from typing import Any, NamedTuple

import imageio.v3 as iio
import numpy as np
import table
from absl import flags
from PIL import Image

from jaxnerf.evaluation import pictures
from jaxnerf.runtime import cli
from jaxnerf.training import metric_log
from jaxnerf.training.workdir import write_text

_OUT = flags.DEFINE_string("out", None, "Folder of the page.", required=True)
_OVERWRITE = flags.DEFINE_bool("overwrite", False, "Replace an earlier page.")
_VIEWS = 3  # of each run in the pictures
_HEIGHT = 128  # px of a picture there
_NO_PLOT = "No plot, which needs matplotlib"


class Run(NamedTuple):
    """What the page needs of a workdir."""

    name: str
    rows: list  # table.row of each scored checkpoint, ascending
    scored: list  # (seconds of training, PSNR) of each
    training: list  # the same of batches
    about: str  # what the newest's figures are of
    strip: Any  # [_HEIGHT, W, 3] uint8, its photographs and renderings


def main(argv):
    """Writes the page of the workdirs named on the command line."""
    write_report(argv[1:], _OUT.value, overwrite=_OVERWRITE.value)


def write_report(folders, out, *, overwrite=False):
    """Writes report.md and its pictures into a folder; each file is there whole or not at all, the page last.

    Raises:
        ValueError: if there is a page already, or no workdir can be read; names them.
    """
    out = pathlib.Path(out)
    page = out / "report.md"
    if page.exists() and not overwrite:
        raise ValueError(f"{page}: is there already; give --overwrite, or another --out")
    runs, unread = [], []
    for folder in folders:
        try:
            runs.append(read_run(pathlib.Path(folder).resolve()))
        except (OSError, ValueError, KeyError, TypeError) as error:
            what = f"lacks {error}" if isinstance(error, KeyError) else " ".join(str(error).split())
            unread.append(f"{folder}: {what}")
            print(f"left out {unread[-1]}", file=sys.stderr)
    if not runs:
        raise ValueError(f"nothing to report: {'; '.join(unread) or 'no workdir given'}")
    widest = max(run.strip.shape[1] for run in runs)
    strips = [np.pad(r.strip, ((0, 0), (0, widest - r.strip.shape[1]), (0, 0)), constant_values=255) for r in runs]
    pictures.write_whole(out / "pictures.png", np.concatenate(strips))
    plotted = _plot(runs, out / "psnr.png")
    write_text(page, "\n".join(_page(runs, unread, plotted)) + "\n")
    print(f"wrote {page}: {len(runs)} runs")


def read_run(folder):
    """Returns the Run in a workdir.

    Raises:
        OSError, ValueError, KeyError, TypeError: if a file is missing, malformed or lacks something.
    """
    found = [path for path in folder.glob("eval/*/results.json") if path.parent.name.split("-")[0].isdigit()]
    if not found:
        raise ValueError("has no eval/*/results.json; run python -m jaxnerf.eval --workdir=... first")
    paths = sorted(found, key=lambda path: (table.int_prefix(path), path.parent.name))
    results = [json.loads(path.read_text()) for path in paths]
    return Run(
        name=folder.name,
        rows=[table.row(path) for path in paths],
        scored=sorted((found["training_seconds"], found["psnr"]) for found in results),
        training=[(row["seconds"], row["psnr_fine"]) for row in metric_log.read_rows(folder)],
        about=_about(results[-1]),
        strip=_strip(paths[-1].parent),
    )


def _strip(folder):
    """Returns some views of an eval folder side by side, photograph and rendering in turn."""
    names = sorted(path.name for path in (folder / "color").glob("*.png"))
    if not names:
        raise ValueError(f"{folder / 'color'}: has no pictures; score again with --overwrite")
    chosen = [names[index] for index in np.linspace(0, len(names) - 1, _VIEWS).astype(int)]
    panels = [iio.imread(folder / kind / name) for name in chosen for kind in ("gt-color", "color")]
    sizes = [(round(panel.shape[1] * _HEIGHT / panel.shape[0]), _HEIGHT) for panel in panels]
    return np.concatenate(
        [np.asarray(Image.fromarray(p).resize(size)) for p, size in zip(panels, sizes, strict=True)], axis=1
    )


def _plot(runs, path):
    """Writes PSNR against seconds of training; returns whether it could."""
    try:
        import matplotlib
    except ImportError:
        print(f"{_NO_PLOT}: pip install 'jaxnerf[experiments]'", file=sys.stderr)
        return False
    matplotlib.use("Agg")
    from matplotlib import pyplot

    figure, axis = pyplot.subplots(figsize=(9, 5), layout="constrained", dpi=100)
    for index, run in enumerate(runs):
        line = {"color": f"C{index % 10}"}
        axis.plot(*np.reshape(run.training, (-1, 2)).T, **line, linewidth=0.7, alpha=0.5)
        axis.plot(*np.transpose(run.scored), "o-", **line, label=run.name)
    axis.set(xscale="log", xlabel="seconds of training", ylabel="PSNR, dB")
    axis.set_title("Dots: scored on held-out views. Thin: on the batches of training", fontsize=9)
    axis.grid(alpha=0.3)
    axis.legend()
    figure.canvas.draw()
    pictures.write_whole(path, np.asarray(figure.canvas.buffer_rgba()))
    pyplot.close(figure)
    return True


def _page(runs, unread, plotted):
    """Returns the lines of the page."""
    lines = ["# Results", "", *table.markdown(table.HEADS, [row for run in runs for row in run.rows]), ""]
    lines += ["![PSNR over time](psnr.png)" if plotted else f"{_NO_PLOT}.", ""]
    lines += ["![Pictures](pictures.png)", ""]
    lines += [
        f"Rows: {', '.join(run.name for run in runs)}. Columns: photograph and rendering, {_VIEWS} views.",
        "",
    ]
    lines += ["## What the figures are of", ""]
    lines += [f"- {run.name}: {run.about}" for run in runs]
    if unread:
        lines += ["", "## Left out", "", *(f"- {text}" for text in unread)]
    return lines


def _about(results):
    """Returns a line: what the figures were taken of, and which published tables they may be set beside."""
    about = results["conventions"]
    names = ("format", "split", "views", "size", "factor", "background", "pixel_offset", "skip")
    parts = [f"{name} {about[name]}" for name in names if name in about]
    if "comparable_with" not in results:
        return f"{', '.join(parts)}. Scored before there was a metric card: score again with --overwrite"
    beside = [row for row in results["comparable_with"] if row["comparable"]]
    tables = "; ".join(f"{row['table']} ({', '.join(row['why'])})" for row in beside)
    return f"{', '.join(parts)}. Published tables to set them beside: {tables or 'none'}"


if __name__ == "__main__":
    cli.run(main, positional=True)
