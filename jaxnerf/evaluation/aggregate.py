"""Finished views of an evaluation, and one result of them all; see evaluate."""

import json
import os
import shutil

import imageio.v3 as iio
import jax
import numpy as np

from jaxnerf.evaluation import pictures, protocol
from jaxnerf.runtime import shards
from jaxnerf.training import metric_log

ORIGIN = "origin.json"
FOLDERS = ("color", "gt-color", "depth", "rows", "sheet")
_WORKING = FOLDERS[3:]  # which the result needs no more


def finish(folder, index, row, first, count, truth, image):
    """Writes what is left of a view whose pictures are there, its row of scores last.

    Args:
        folder: of the evaluation.
        index: of the view, of count.
        row: of results.json.
        first: whether its process rendered it before any other, so that its time holds the compilation too.
        truth, image: see sheet_row.
    """
    if index in _on_sheet(count):
        pictures.write_whole(folder / "sheet" / f"{index:03d}.png", pictures.sheet_row(truth, image), make_folder=False)
    height, width = np.shape(truth)[:2]
    content = {"row": row, "first": first, "rays": height * width}
    with shards.partial_of(_row_file(folder, index)) as partial:
        partial.write_text(json.dumps(content))


def is_finished(folder, index):
    """Returns whether a view's pictures and its row are there."""
    files = [*pictures.view_files(folder, f"{index:03d}"), _row_file(folder, index)]
    return all(file.is_file() for file in files)


def read(target, origin, other):
    """Returns what a finished evaluation's results.json holds; ValueError if it has another origin."""
    shards.check_origin(target, origin, file=ORIGIN, other=other)
    return json.loads((target / "results.json").read_text())


def merge(partial, target, *, run, folder, views, variables, chunk, origin):
    """Makes partial the target with results.json and returns what that holds; None if a view is missing.

    Raises:
        FileNotFoundError: if another call does the same and was faster.
    """
    count = len(views.names)
    if not all(is_finished(partial, index) for index in range(count)):
        return None
    finished = [json.loads(_row_file(partial, index).read_text()) for index in range(count)]
    results = _results(run, folder, views, variables, finished, origin=origin, chunk=chunk)
    rows = [iio.imread(partial / "sheet" / f"{index:03d}.png") for index in _on_sheet(count)]
    pictures.write_sheet(partial / "sheet.png", rows)
    with shards.partial_of(partial / "results.json") as file:
        file.write_text(json.dumps(results, indent=2) + "\n")
    old = target.with_name(target.name + ".old")
    if target.exists():  # a kill between the two moves loses neither result
        shutil.rmtree(old, ignore_errors=True)  # of such a kill
        os.replace(target, old)
    os.replace(partial, target)
    for name in _WORKING:
        shutil.rmtree(target / name, ignore_errors=True)
    shards.sweep(target)
    shutil.rmtree(old, ignore_errors=True)
    return results


def _results(run, folder, views, variables, finished, *, origin, chunk):
    rows = [view["row"] for view in finished]
    timed = [view["row"] for view in finished if not view["first"]] or rows
    seconds = sum(row["seconds"] for row in timed) / len(timed)
    trained = [row for row in metric_log.read_rows(folder) if row["step"] <= origin["step"]]
    conventions = {**run.experiment.conventions, "chunk": chunk or "auto"}
    return {
        **means(rows),
        "views": len(rows),
        # Of the machines that rendered, one frame at a time each, however many there were.
        "rays_per_second": sum(view["rays"] for view in finished) / len(rows) / seconds,
        "seconds_per_frame": seconds,
        "step": origin["step"],
        "rays_seen": trained[-1]["rays"] if trained else None,
        "training_seconds": trained[-1]["seconds"] if trained else None,
        "compile_seconds": trained[-1]["compile_seconds"] if trained else None,
        "parameters": sum(leaf.size for leaf in jax.tree.leaves(variables[0])),
        "settings": {name: origin[name] for name in ("sample_multiplier", "early_stop_eps", "bake_occupancy")},
        **protocol.metric_card(conventions, views, split=origin["split"]),
        "images": rows,
    }


def means(rows):
    """Returns the means of the rows' metrics, each over the images."""
    keys = ("psnr", "ssim", "psnr_float", "psnr_truncated")
    return {key: float(np.mean([row[key] for row in rows])) for key in keys}


def _on_sheet(count):
    """Returns the indices of the views that the sheet shows."""
    return range(0, count, -(-count // pictures.SHEET_ROWS))


def _row_file(folder, index):
    return folder / "rows" / f"{index:03d}.json"
