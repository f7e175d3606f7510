"""Several runs side by side: what each has reached after how long, and which options differ between them."""

import json
import math
import os
import pathlib
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, NamedTuple

from jaxnerf.data.geometry.path_poses import natural_key
from jaxnerf.evaluation import aggregate
from jaxnerf.runtime.printed_text import printable
from jaxnerf.training import metric_log, workdir

_MAX_COLUMNS, _MAX_WIDTH = 6, 60  # of options that differ, in the table of a terminal
_MAX_DEPTH = 100  # of folders in folders
_HEADS = ("run", "steps", "seconds", "PSNR", "SSIM", "scored", "training PSNR")


class Score(NamedTuple):
    """The mean metrics of a scored checkpoint, from its results.json.

    Attributes:
        step: of the checkpoint.
        seconds: of training until then; None: not known.
        split: that was scored.
        views: their number.
        psnr: dB.
        ssim: in [-1, 1].
    """

    step: int
    seconds: float | None
    split: str
    views: int
    psnr: float
    ssim: float


class Run(NamedTuple):
    """What a report states about a run.

    Attributes:
        name: of its workdir; the path where several have that name.
        folder: the workdir.
        rows: of metrics.jsonl, see `metric_log.row`; empty before the first one is written.
        scores: ascending in step, those of training views first; of one step those of `eval.split` last.
        options: {"section.option": value} of its config.json.
    """

    name: str
    folder: pathlib.Path
    rows: list[dict[str, Any]]
    scores: list[Score]
    options: dict[str, Any]

    @property
    def steps(self) -> int:
        """The number of training steps so far."""
        return self.rows[-1]["step"] if self.rows else 0

    @property
    def seconds(self) -> float:
        """The time of training so far, without compilation."""
        return self.rows[-1]["seconds"] if self.rows else 0.0

    @property
    def training_psnr(self) -> float | None:
        """The PSNR of the last batches of training, dB."""
        return metric_log.final_psnr(self.rows[-1]) if self.rows else None


def read_runs(folders: Iterable[str | os.PathLike]) -> list[Run]:
    """Reads the runs in some folders, each a workdir or a folder that contains workdirs, at any depth.

    Args:
        folders: of which one that is named twice counts once. The workdirs in one come in natural order of their names.

    Raises:
        ValueError: if no folder is named, or one contains no run or a damaged file; names it.
    """
    found: dict[pathlib.Path, pathlib.Path] = {}
    for folder in map(pathlib.Path, folders):
        if not folder.is_dir():
            what = "is no folder" if folder.exists() else "no such folder"
            raise ValueError(f"{folder}: {what}, expected the workdir of a run, or a folder of workdirs; correct it")
        inside = _find(folder)
        if not inside:
            raise ValueError(
                f"{folder}: contains no run, expected config.json and metrics.jsonl as jaxnerf-train writes them, "
                "here or in folders below; correct the path"
            )
        for each in inside:
            found.setdefault(each.resolve(), each)
    if not found:
        raise ValueError("no run is named; give workdirs, or folders of workdirs, as in jaxnerf-report runs/")
    counts = Counter(folder.name for folder in found)
    return [_read(folder, folder.name if counts[folder.name] == 1 else str(given)) for folder, given in found.items()]


def _find(folder, depth=0):
    """Returns the workdirs in a folder, or the folder itself if it is one; links are followed to workdirs only."""
    if (folder / "config.json").is_file():
        return [folder]
    if depth > _MAX_DEPTH:
        raise ValueError(f"{folder}: lies more than {_MAX_DEPTH} folders deep; name the folder of the runs")
    inside = [child for child in folder.iterdir() if child.is_dir() and not child.name.startswith(".")]
    inside.sort(key=lambda child: natural_key(child.name))
    inside = [child for child in inside if not child.is_symlink() or (child / "config.json").is_file()]
    return [run for child in inside for run in _find(child, depth + 1)]


def _read(folder, name):
    options = workdir.saved_options(folder)
    remedy = "score it again with --overwrite"
    paths = [path.parent for path in (folder / "eval").glob("*/results.json") if not path.parent.suffix]
    scores = [_score(aggregate.read_results(path, remedy), path / "results.json", remedy) for path in paths]
    scores.sort(key=lambda score: (score.split != "train", score.step, score.split == options.get("eval.split")))
    return Run(name, folder, metric_log.read_rows(folder), scores, options)


def _score(results, path, remedy):
    step, seconds, views = (results.get(name) for name in ("step", "training_seconds", "views"))
    timed = type(seconds) in (int, float) and 0 <= seconds < math.inf
    if type(step) is not int or step < 0 or not (seconds is None or timed):
        raise ValueError(f"{path}: lacks step and training_seconds, expected the result of an evaluation; {remedy}")
    conventions = results.get("conventions")
    split = conventions.get("split") if isinstance(conventions, Mapping) else None
    return Score(step, seconds, str(split or "?"), views, float(results["psnr"]), float(results["ssim"]))


def differing_options(runs: Sequence[Run]) -> list[str]:
    """Returns the names of the options whose values differ between the runs, "section.option"."""
    names = dict.fromkeys(name for run in runs for name in run.options)
    return [name for name in names if len({json.dumps(run.options.get(name)) for run in runs}) > 1]


def table(runs: Sequence[Run]) -> str:
    """Returns the runs as lines of text in columns."""
    differing = differing_options(runs)
    shown = differing[:_MAX_COLUMNS]
    values = ([option_text(run.options.get(name))[:_MAX_WIDTH] for name in shown] for run in runs)
    rows = [(*_HEADS, *shown), *((*_cells(run), *row) for run, row in zip(runs, values, strict=True))]
    rows = [[printable(cell) for cell in row] for row in rows]
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    lines = ["  ".join(f"{cell:{width}}" for cell, width in zip(row, widths, strict=True)).rstrip() for row in rows]
    if len(differing) > len(shown):
        lines.append(f"{len(differing) - len(shown)} more options differ; --csv=FILE writes all")
    return "\n".join(lines)


def _cells(run):
    score = run.scores[-1] if run.scores else None
    training = "-" if run.training_psnr is None else f"{run.training_psnr:.2f} dB"
    scored = ("-", "-", "not yet")
    if score is not None:
        scored = (f"{score.psnr:.2f} dB", f"{score.ssim:.3f}", f"{score.views} {score.split}, step {score.step:,}")
    return (run.name, f"{run.steps:,}", f"{run.seconds:,.1f}", *scored, training)


def option_text(value: Any) -> str:
    """Returns the value of an option for a table; "-" for None."""
    return "-" if value is None else value if isinstance(value, str) else json.dumps(value)
