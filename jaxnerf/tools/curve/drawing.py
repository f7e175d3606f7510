"""Curves of PSNR against seconds, in a terminal and as an image, with their knees."""

import pathlib
import sys
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from jaxnerf.runtime.atomic_files import partial_file
from jaxnerf.runtime.printed_text import printable

Curves = Mapping[str, Sequence[tuple[float, float]]]  # {name: (seconds, PSNR), by ascending seconds}
_BAR = 40  # characters of a curve in a terminal


def knee(points: Sequence[tuple[float, float]]) -> int:
    """Returns the index of the point of a curve that lies highest above the chord from its first to its last one.

    The abscissa is the time itself (Kneedle, Satopaa et al., ICDCS workshops 2011).
    """
    seconds, scores = (np.asarray(each, float) for each in zip(*points, strict=True))
    spans = np.ptp(seconds) or 1.0, np.ptp(scores) or 1.0
    above = (scores - scores[0]) / spans[1] - (seconds - seconds[0]) / spans[0]
    return int(np.argmax(above))


def lines(curves: Curves, title: str) -> list[str]:
    """Returns the lines of curves in a terminal, under a title; * marks the knee of a curve of three points or more."""
    everything = [score for points in curves.values() for _, score in points]
    low, high = min(everything), max(everything)
    width = max(9, *(len(printable(name)) for name in curves))
    found = [f"{title}; * marks the knee"]
    for name, points in curves.items():
        marked = knee(points) if len(points) > 2 else -1
        for index, (seconds, score) in enumerate(points):
            bar = "#" * round(1 + (_BAR - 1) * (score - low) / max(high - low, 1e-9))
            row = f"{printable(name):{width}} {seconds:7.1f} s  {score:6.2f} dB  {bar}"
            found.append(f"{row}{' *' if index == marked else ''}")
    return found


def save(curves: Curves, path: pathlib.Path, *, ylabel: str, lines_only: Sequence[str] = ()) -> pathlib.Path | None:
    """Writes curves as PNG: seconds on a logarithmic axis, knees marked.

    Args:
        curves: to draw, of seconds above 0.
        path: of the image.
        ylabel: of the other axis.
        lines_only: names of curves that are drawn as thin lines, without points and knees.

    Returns:
        The path; None without matplotlib, which is reported on stderr.
    """
    try:
        from jaxnerf.tools.curve.plotting import Figure
    except ImportError as error:
        print(f"no {path.name}: matplotlib is unavailable ({error}); `pip install matplotlib`", file=sys.stderr)
        return None
    figure = Figure(figsize=(7, 4), dpi=100, layout="constrained")
    axes = figure.subplots()
    for name, points in curves.items():
        label, thin = label_of(name), name in lines_only
        (line,) = axes.plot(
            *zip(*points, strict=True), "-" if thin else "o-", label=label, **({"linewidth": 0.8} if thin else {})
        )
        if len(points) > 2 and not thin:
            marked = points[knee(points)]
            axes.plot(*marked, "D", markersize=11, fillstyle="none", color=line.get_color(), label=f"knee of {label}")
    axes.set(xlabel="seconds of training", ylabel=ylabel, xscale="log")
    times = [seconds for points in curves.values() for seconds, _ in points]
    ticks = [step * 10.0**power for power in range(-3, 7) for step in (1, 2, 5)]
    ticks = [tick for tick in ticks if min(times) / 2 < tick < 2 * max(times)]
    axes.set_xticks(ticks, [f"{tick:g}" for tick in ticks])
    axes.minorticks_off()
    axes.grid(alpha=0.3)
    add_legend(axes)
    with partial_file(path) as partial:
        figure.savefig(partial, format="png")
    return path


def label_of(name: str) -> str:
    """Returns the label of a curve with a name of unknown origin; matplotlib hides one that begins with _."""
    return f" {printable(name)}" if name.startswith("_") else printable(name)


def add_legend(axes: Any) -> None:
    """Adds the legend to axes of matplotlib; names are not read as formulas."""
    for label in axes.legend(fontsize="small").get_texts():
        label.set_parse_math(False)
