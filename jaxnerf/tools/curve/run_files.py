"""Files about several runs: a CSV of all of them, and their curves over time and over steps."""

import csv
import io
import math
import os
import pathlib
from collections.abc import Sequence

from jaxnerf.evaluation.run_report import Run, Score, differing_options, option_text
from jaxnerf.runtime.atomic_files import partial_file
from jaxnerf.tools.curve.drawing import add_legend, label_of
from jaxnerf.tools.curve.points import spreadsheet_cell
from jaxnerf.training import metric_log


def to_csv(runs: Sequence[Run]) -> str:
    """Returns the runs as CSV: one row for each, with all options that differ; what is not known is empty."""
    differing = differing_options(runs)
    heads = ("run", "workdir", "steps", "seconds", "training_psnr")
    file = io.StringIO()
    writer = csv.writer(file, lineterminator="\n")
    rows = [(*heads, *(f"scored_{name}" for name in Score._fields), *differing)]
    for run in runs:
        score = run.scores[-1] if run.scores else (None,) * len(Score._fields)
        options = ("" if run.options.get(name) is None else option_text(run.options[name]) for name in differing)
        rows.append((run.name, str(run.folder), run.steps, run.seconds, run.training_psnr, *score, *options))
    writer.writerows(map(spreadsheet_cell, row) for row in rows)
    return file.getvalue()


def require_matplotlib() -> None:
    """Raises a ValueError that says how to install matplotlib, if it is missing."""
    try:
        from jaxnerf.tools.curve import plotting  # noqa: F401
    except ImportError as error:
        raise ValueError(
            f"--plot draws with matplotlib, which is unavailable ({error}); install it with `pip install matplotlib`"
        ) from None


def save_plot(runs: Sequence[Run], path: str | os.PathLike) -> None:
    """Writes a PNG or SVG: PSNR over the time of training and over steps, of batches (lines) and scored views (dots).

    Args:
        runs: to draw.
        path: its suffix is the format.

    Raises:
        ValueError: if matplotlib is missing.
    """
    require_matplotlib()
    from jaxnerf.tools.curve.plotting import Figure

    path = pathlib.Path(path)
    figure = Figure(figsize=(13, 5), dpi=100, layout="constrained")
    axes = figure.subplots(1, 2, sharey=True)
    for index, run in enumerate(runs):
        curve = [(row["seconds"], row["step"], metric_log.final_psnr(row)) for row in run.rows]
        curve = [point for point in curve if point[2] is not None and math.isfinite(point[2])]
        dots = [(score.seconds, score.step, score.psnr) for score in run.scores if score.seconds is not None]
        for column, axis in enumerate(axes):
            style = {"color": f"C{index % 10}", "label": label_of(run.name)}
            axis.plot([point[column] for point in curve], [point[2] for point in curve], linewidth=0.9, **style)
            style["label"] = None
            axis.plot([point[column] for point in dots], [point[2] for point in dots], "o", **style)
    for axis, unit in zip(axes, ("seconds of training", "steps"), strict=True):
        axis.set(xlabel=unit)
        axis.grid(alpha=0.3)
    axes[0].set(ylabel="PSNR, dB")
    add_legend(axes[1])
    figure.suptitle("Lines: batches of training. Dots: scored views", fontsize="medium")
    with partial_file(path) as partial:
        figure.savefig(partial, format=path.suffix.lower().removeprefix("."))
