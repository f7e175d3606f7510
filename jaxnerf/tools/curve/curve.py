"""Measures the curve of a dataset, or reads that of a finished run, and writes it."""

import json
import math
import pathlib
import sys
from collections.abc import Sequence
from typing import Any

from jaxnerf.data.dataset import dataset_folder
from jaxnerf.evaluation import aggregate, run_report
from jaxnerf.runtime.atomic_files import write_text
from jaxnerf.tools.curve import drawing, measure, points, runs
from jaxnerf.tools.curve.points import Point
from jaxnerf.training import metric_log
from jaxnerf.training.config import RunConfig, changed, read_config

CSV, PLOT = "curve.csv", "curve.png"
_QUIET = {"train.preview_every": 0.0, "eval.summary_seconds": 0.0}  # images that would count as set-up
_BATCHES = "{}, batches of training"  # the curve of a run's log


def report(
    source: str | pathlib.Path,
    config: Any,
    seconds: Sequence[str],
    folder: str | pathlib.Path,
    *,
    compare: str | None = None,
    plugins: Sequence[str] = (),
) -> list[Point]:
    """Prints the curve of a dataset or of a run, and writes curve.csv and curve.png.

    A dataset is trained for each of the times, a run of each length, as the learning rate of a run ends when its time
    does: what a longer run has reached by then is worse. Of a finished run the curve is its own: the checkpoints that
    were scored, and the batches of its log.

    Args:
        source: the folder of a dataset, or the workdir of a run.
        config: of the runs of a dataset.
        seconds: texts of positive numbers: the lengths of the runs, or the times at which a log is read; none: its
            rows.
        folder: of the files, and of the runs of a dataset.
        compare: a CSV file with points of other programs, see `points.read_csv`.
        plugins: modules that the processes of runs import first.

    Returns:
        All points.

    Raises:
        ValueError: names the folder, file or flag that is wrong; or the runs that failed.
    """
    source, folder = pathlib.Path(source), pathlib.Path(folder)
    others = points.read_csv(compare) if compare else []
    if not source.is_dir():
        dataset_folder(str(source))  # below $JAXNERF_SCENES, or an error
    lengths, failed = _times(seconds), []
    if (source / "config.json").is_file():
        found, batches = of_run(source, lengths)
    else:
        if not lengths:
            raise ValueError("--seconds is missing: the seconds of training of each run, such as --seconds=5,15,60")
        found, failed = of_dataset(changed(read_config(config), _QUIET), lengths, folder, plugins)
        batches = []
    if failed and not found:
        raise ValueError(f"no run succeeded: {', '.join(failed)}; see above")
    everything = [*found, *batches, *others]
    _write(everything, folder, {point.program for point in batches})
    if failed:
        raise ValueError(f"failed: {', '.join(failed)}; see above, and the same command tries again")
    return everything


def _times(texts):
    """Returns the numbers of --seconds, ascending."""
    try:
        times = sorted({float(text) for text in texts})
    except ValueError:
        times = [0.0]
    if times and not 0 < times[0] <= times[-1] < float("inf"):
        raise ValueError(f"--seconds is {','.join(texts)!r}, expected positive numbers such as 5,15,60,300")
    return times


def of_dataset(
    config: RunConfig, seconds: Sequence[float], folder: pathlib.Path, plugins: Sequence[str] = ()
) -> tuple[list[Point], list[str]]:
    """Trains and scores a run of each length, in a process of its own; a scored one is not repeated.

    Args:
        config: of the runs, with the dataset.
        seconds: of training, ascending.
        folder: of the workdirs.
        plugins: modules that the processes import first.

    Returns:
        The points, and the runs that failed.

    Raises:
        ValueError: if the folder holds a run of that length with another config.
    """
    found, failed = [], []
    name = pathlib.Path(config.data.dir or config.data.format).name
    for length in seconds:
        workdir = folder / f"{length:g}s"
        score = runs.read_score(workdir)
        if score is not None:
            _check_same(workdir, score.get("config"), config)
        else:
            print(f"training {length:g} s in {workdir}", file=sys.stderr, flush=True)
            about = {"config": _plain(config)}
            score = runs.train_and_score(config, length, workdir, about=about, plugins=plugins)
        if score is None:
            failed.append(f"{length:g} s")
            continue
        found.append(points.of_score(f"jaxnerf, {name}", score))
        if score["ended"]:  # by its steps: a longer run would be the same
            break
    return found, failed


def _plain(config):
    return json.loads(measure.at_time(config, 0.0).to_json())


def _check_same(workdir, found, config):
    """Raises ValueError if a scored run has another config."""
    if found != _plain(config):
        raise ValueError(
            f"{workdir}: holds a scored run with another config or dataset; give another --out, or remove that folder"
        )


def of_run(workdir: pathlib.Path, seconds: Sequence[float] = ()) -> tuple[list[Point], list[Point]]:
    """Returns the points of a run's scored checkpoints, and those of its batches of training at some times.

    Args:
        workdir: of the run.
        seconds: at which the log is read, its last row until then; none: all rows.
    """
    (run,) = run_report.read_runs([workdir])
    compiling = max((row.get("compile_seconds", 0.0) for row in run.rows), default=None)
    scored = {}
    for score in run.scores:  # of one step those of eval.split are last
        if score.seconds is None:
            continue
        name = str(score.step) if score.split == run.options.get("eval.split") else f"{score.step}-{score.split}"
        path = workdir / "eval" / name
        results = aggregate.read_results(path, "score it again") if path.is_dir() else score._asdict()
        about = {"seconds": score.seconds, "step": score.step, "compile_seconds": compiling, "machine": ""}
        scored[score.step] = points.of_score(run.name, {**results, **about})
    rows = [row for row in run.rows if math.isfinite(metric_log.final_psnr(row) or math.nan) and row["seconds"] > 0]
    if seconds:
        until = [[row for row in rows if row["seconds"] <= time] for time in seconds]
        rows = list({each[-1]["step"]: each[-1] for each in until if each}.values())
    batches = [
        Point(_BATCHES.format(run.name), row["seconds"], metric_log.final_psnr(row), steps=row["step"]) for row in rows
    ]
    if not scored and not batches:
        raise ValueError(f"{workdir}: has no scores and no log yet; let it train, or score it with jaxnerf-eval")
    return list(scored.values()), batches


def _write(everything, folder, logs):
    """Prints the table and the curve, and writes the files; curves of logs are drawn as lines, and not listed."""
    folder.mkdir(parents=True, exist_ok=True)
    listed = [point for point in everything if point.program not in logs] or everything
    print("\n".join(points.table(listed)))
    drawn = {name: [(x.seconds, x.psnr) for x in each] for name, each in points.curves(everything).items()}
    shown = {name: each for name, each in drawn.items() if name not in logs} or drawn
    print("\n".join(["", *drawing.lines(shown, "PSNR after so many seconds of training")]))
    write_text(folder / CSV, points.to_csv(everything))
    print(f"csv: {folder / CSV}")
    if drawing.save(drawn, folder / PLOT, ylabel="PSNR, dB", lines_only=sorted(logs)):
        print(f"plot: {folder / PLOT}")
