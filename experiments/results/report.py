"""Writes one page of results from the workdirs of runs: a table, PSNR over time, images, and their protocol.

    python experiments/results/report.py WORKDIR ... --out=DIR [--overwrite]

Writes DIR/report.md, DIR/pictures.png and, with the extra `experiments`, DIR/psnr.png from what jaxnerf.train and
jaxnerf.eval wrote into the workdirs. A workdir that cannot be read is reported, also on the page.
"""

import pathlib
import sys
from typing import Any, NamedTuple

import numpy as np
from absl import flags
from PIL import Image

sys.path.append(str(pathlib.Path(__file__).resolve().parents[1]))
import common
from results import table

from jaxnerf.data.images.image_files import read_stored
from jaxnerf.evaluation import output_images
from jaxnerf.runtime import cli
from jaxnerf.runtime.atomic_files import read_json, write_text
from jaxnerf.training import metric_log

_OUT = flags.DEFINE_string("out", None, "Folder of the page.", required=True)
_OVERWRITE = flags.DEFINE_bool("overwrite", False, "Replace an existing page.")
_VIEWS = 3  # of each run in the contact sheet
_HEIGHT = 128  # px of an image there


class Run(NamedTuple):
    """What the page shows of a workdir.

    Attributes:
        name: of the workdir.
        rows: table.row of each scored checkpoint, ascending.
        scored: (seconds of training, PSNR) of each.
        training: the same of training batches.
        protocol: how the newest checkpoint was scored.
        strip: [_HEIGHT, W, 3] uint8, truths and renderings.
    """

    name: str
    rows: list[tuple[str, ...]]
    scored: list[tuple[float, float]]
    training: list[tuple[float, float]]
    protocol: str
    strip: Any


def main(argv: list[str]) -> None:
    """Writes the page of the workdirs named on the command line."""
    write_report(argv[1:], pathlib.Path(_OUT.value), overwrite=_OVERWRITE.value)


def write_report(folders: list[str], out: pathlib.Path, *, overwrite: bool = False) -> None:
    """Writes report.md and its images into a folder; each file appears whole or not at all, the page last.

    Raises:
        ValueError: if there is a page already, or no workdir can be read; names them.
    """
    page = out / "report.md"
    if page.exists() and not overwrite:
        raise ValueError(f"{page}: exists already; give --overwrite, or another --out")
    runs, unread = [], []
    for folder in folders:
        try:
            runs.append(read_run(pathlib.Path(folder).resolve()))
        except (OSError, ValueError, KeyError, TypeError) as error:
            what = f"lacks {error}" if isinstance(error, KeyError) else " ".join(str(error).split())
            unread.append(f"{folder}: {what}")
            print(f"skipped {unread[-1]}", file=sys.stderr)
    if not runs:
        raise ValueError(f"nothing to report: {'; '.join(unread) or 'no workdir given'}")
    out.mkdir(parents=True, exist_ok=True)
    output_images.write_contact_sheet(out / "pictures.png", [run.strip for run in runs])
    plotted = _plot(runs, out / "psnr.png")
    write_text(page, "\n".join(_page(runs, unread, plotted)) + "\n")
    print(f"wrote {page}: {len(runs)} runs")


def read_run(folder: pathlib.Path) -> Run:
    """Reads the Run in a workdir.

    Raises:
        OSError, ValueError, KeyError, TypeError: if a file is missing or malformed, or lacks a field.
    """
    paths = table.scored(folder)
    if not paths:
        raise ValueError("has no eval/*/results.json; run python -m jaxnerf.eval --workdir=... first")
    results = [read_json(path, "score it again") for path in paths]
    return Run(
        name=folder.name,
        rows=[table.row(path) for path in paths],
        scored=sorted((found["training_seconds"], found["psnr"]) for found in results),
        training=[(row["seconds"], row["psnr_fine"]) for row in metric_log.read_rows(folder)],
        protocol=_protocol(results[-1]),
        strip=_strip(paths[-1].parent),
    )


def _strip(folder):
    """Returns some views of an evaluation side by side, truth and rendering in turn."""
    names = sorted(path.name for path in (folder / "color").glob("*.png"))
    if not names:
        raise ValueError(f"{folder / 'color'}: has no images; score again with --overwrite")
    chosen = [names[index] for index in np.linspace(0, len(names) - 1, _VIEWS).astype(int)]
    panels = [read_stored(folder / kind / name) for name in chosen for kind in ("gt-color", "color")]
    sizes = [(round(panel.shape[1] * _HEIGHT / panel.shape[0]), _HEIGHT) for panel in panels]
    return np.concatenate(
        [np.asarray(Image.fromarray(p).resize(size)) for p, size in zip(panels, sizes, strict=True)], axis=1
    )


def _plot(runs, path):
    """Writes PSNR against seconds of training; returns whether matplotlib is there."""
    pyplot = common.pyplot()
    if pyplot is None:
        return False
    figure, axis = pyplot.subplots(figsize=(9, 5), layout="constrained")
    for index, run in enumerate(runs):
        line = {"color": f"C{index % 10}"}
        axis.plot(*np.reshape(run.training, (-1, 2)).T, **line, linewidth=0.7, alpha=0.5)
        axis.plot(*np.transpose(run.scored), "o-", **line, label=run.name)
    axis.set(xscale="log", xlabel="seconds of training", ylabel="PSNR, dB")
    axis.set_title("Dots: scored on held-out views. Thin: on the batches of training", fontsize=9)
    axis.grid(alpha=0.3)
    axis.legend()
    common.save_figure(figure, path)
    return True


def _page(runs, unread, plotted):
    """Returns the lines of the page."""
    lines = [
        "# Runs side by side",
        "",
        *common.provenance(),
        "",
        *common.markdown(table.HEADS, [row for run in runs for row in run.rows]),
        "",
    ]
    lines += ["![PSNR over time](psnr.png)" if plotted else "No plot, which needs matplotlib.", ""]
    lines += ["![Images](pictures.png)", ""]
    lines += [f"Rows: {', '.join(run.name for run in runs)}. Columns: truth and rendering of {_VIEWS} views.", ""]
    lines += ["## Protocol", ""]
    lines += [f"- {run.name}: {run.protocol}" for run in runs]
    if unread:
        lines += ["", "## Skipped", "", *(f"- {text}" for text in unread)]
    return lines


def _protocol(results):
    """Returns a line: how the views were read, and with which published tables the metrics are comparable."""
    conventions = results["conventions"]
    names = ("format", "split", "views", "size", "factor", "background", "pixel_offset", "selection")
    parts = [f"{name} {conventions[name]}" for name in names if name in conventions]
    comparable = [row for row in results["comparable_with"] if row["comparable"]]
    tables = "; ".join(f"{row['table']} ({', '.join(row['why'])})" for row in comparable)
    return f"{', '.join(parts)}. Comparable with published tables: {tables or 'none'}"


if __name__ == "__main__":
    cli.run(main, positional=True)
