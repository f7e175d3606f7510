"""Finished views of an evaluation, and the results.json that is made from them; see `evaluate`."""

import math
import os
import pathlib
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import jax
import numpy as np
from jax.typing import ArrayLike

from jaxnerf.core.types import Rendering
from jaxnerf.core.views import Views
from jaxnerf.data import dataset
from jaxnerf.data.images.image_files import read_stored
from jaxnerf.evaluation import output_images, protocol
from jaxnerf.evaluation.restore import TrainedRun
from jaxnerf.options import short_repr
from jaxnerf.runtime import atomic_files, shards
from jaxnerf.training import metric_log

PROVENANCE = "provenance.json"
_AGAIN = "remove it, and the same command scores that view again"
_KEPT, _WORKING = ("color", "gt-color", "depth"), ("rows", "contact_sheet")
_MEANS = ("psnr", "ssim", "psnr_float", "psnr_truncated", "psnr_aligned", "ssim_aligned")  # over the images
_SOME = ("lpips", "psnr_one_ray", "ssim_one_ray")
FOLDERS = _KEPT + _WORKING


def mark_finished(
    folder: pathlib.Path,
    index: int,
    row: Mapping[str, Any],
    truth: ArrayLike,
    image: Rendering,
    *,
    count: int,
    first: bool,
) -> None:
    """Finishes a view whose images are written: writes its other files, the row of metrics last.

    Args:
        folder: of the evaluation.
        index: of the view.
        row: of results.json.
        truth: [H, W, 3].
        image: Rendering [H, W].
        count: of all views.
        first: whether it is the first view that its process rendered, so that its time includes compilation.
    """
    if index in _on_contact_sheet(count):
        output_images.write_image(_contact_sheet_file(folder, index), output_images.contact_sheet_row(truth, image))
    height, width = np.shape(truth)[:2]
    content = {"row": row, "first": first, "rays": height * width}
    with atomic_files.partial_file(_row_file(folder, index)) as partial:
        partial.write_text(atomic_files.to_json(content))


def view_files(folder: pathlib.Path, index: int, *, count: int, errors: bool) -> list[pathlib.Path]:
    """Returns the files of a finished view, one of `count`: its images, with `errors` predicted ones, and its row."""
    files = output_images.view_files(folder, f"{index:03d}", errors=errors)
    files += [_contact_sheet_file(folder, index)] if index in _on_contact_sheet(count) else []
    return [*files, _row_file(folder, index)]


def is_finished(content: Any) -> bool:
    """Returns whether a row's file holds what `mark_finished` writes: metrics that are numbers, and finite times."""
    row = content.get("row") if isinstance(content, dict) else None
    values = [row.get(key) for key in (*_MEANS, "seconds")] + [content.get("rays")] if isinstance(row, dict) else [None]
    named = isinstance(row, dict) and isinstance(row.get("name"), str) and isinstance(content.get("first"), bool)
    numbers = named and all(type(value) in (int, float) for value in values)
    return numbers and 0 < row["seconds"] < math.inf and 0 < content["rays"] < math.inf


def read(target: pathlib.Path, provenance: Mapping[str, Any], remedy: str) -> dict[str, Any]:
    """Reads the results.json of a finished evaluation; raises ValueError if it is damaged or has another provenance."""
    shards.check_provenance(target, provenance, file=PROVENANCE, remedy=remedy)
    return read_results(target, remedy)


def read_results(target: pathlib.Path, remedy: str) -> dict[str, Any]:
    """Reads the results.json in a folder, of whatever provenance; raises ValueError if it is damaged."""
    results = atomic_files.read_json(target / "results.json", remedy)
    found = {"lpips": 0.0, "seconds_per_frame": 0.0, **results} if isinstance(results, dict) else {}
    # The mean PSNR of images that are exactly equal is infinite.
    wrong = [key for key in (*_MEANS, "lpips", "seconds_per_frame") if type(found.get(key)) not in (int, float)]
    wrong += ["views"] if type(found.get("views")) is not int or found["views"] < 1 else []
    wrong += [key for key in ("conventions", "uncertainty") if not isinstance(found.get(key, {}), dict)]
    if wrong:
        raise ValueError(
            f"{target / 'results.json'}: lacks metrics, as {wrong[0]} is {short_repr(found.get(wrong[0]))}, expected "
            f"the result of an evaluation; {remedy}"
        )
    return results


def merge(
    partial: pathlib.Path,
    target: pathlib.Path,
    summarize: Callable[[list[dict[str, Any]]], dict[str, Any]],
    *,
    count: int,
    errors: bool,
    overwrite: bool,
) -> dict[str, Any] | None:
    """Writes results.json and moves the folder `partial` to `target`.

    Args:
        partial, target: folders.
        summarize: what `mark_finished` wrote of all views -> what results.json holds.
        count, errors: see `view_files`.
        overwrite: whether target is replaced.

    Returns:
        What results.json holds; None if a view is missing.

    Raises:
        OSError: if another process does the same and was faster.
    """
    options = {"count": count, "errors": errors}
    if not all(file.is_file() for index in range(count) for file in view_files(partial, index, **options)):
        return None
    finished = [atomic_files.read_json(_row_file(partial, index), _AGAIN) for index in range(count)]
    results = summarize(finished)
    rows = [read_stored(_contact_sheet_file(partial, index)) for index in _on_contact_sheet(count)]
    output_images.write_contact_sheet(partial / "contact_sheet.png", rows)
    with atomic_files.partial_file(partial / "results.json") as file:
        file.write_text(atomic_files.to_json(results))
    old = target.with_name(target.name + ".old")
    if overwrite and target.exists():  # a process killed between the two moves loses neither result
        atomic_files.remove(old)  # left by such a process
        os.replace(target, old)
    os.replace(partial, target)
    for name in _WORKING:
        atomic_files.remove(target / name)
    atomic_files.sweep(target)
    atomic_files.remove(old)
    return results


def results_of(
    run: TrainedRun,
    workdir: str | os.PathLike,
    views: Views,
    variables: tuple,
    finished: Sequence[Mapping[str, Any]],
    provenance: Mapping[str, Any],
) -> dict[str, Any]:
    """Returns what results.json holds about a checkpoint, from what `mark_finished` wrote of all views."""
    rows = [view["row"] for view in finished]
    timed = [view["row"] for view in finished if not view["first"]] or rows
    seconds = sum(row["seconds"] for row in timed) / len(timed)
    trained = [row for row in metric_log.read_rows(workdir) if row["step"] <= provenance["step"]]
    conventions = {**dataset.conventions(run.experiment.config.data), "chunk": run.experiment.config.eval.chunk}
    usual = run.experiment.config.train.rays_per_side**2
    rays = sum(view["rays"] * view["row"].get("rays_per_pixel", usual) for view in finished)
    return {
        **means(rows),
        "views": len(rows),
        # The rate of one process, averaged over all processes that rendered.
        "rays_per_second": rays / len(rows) / seconds,
        "seconds_per_frame": seconds,
        "step": provenance["step"],
        "rays_seen": trained[-1].get("rays") if trained else None,
        "training_seconds": trained[-1]["seconds"] if trained else None,
        "compile_seconds": trained[-1].get("compile_seconds") if trained else None,
        "parameters": sum(leaf.size for leaf in jax.tree.leaves(variables[0])),
        "settings": dict(run.settings),
        "exposure": run.experiment.cameras is not None and run.experiment.cameras.exposure,
        **protocol.of_views(conventions, views, split=provenance["split"]),
        "images": rows,
    }


def means(rows: Sequence[Mapping[str, Any]]) -> dict[str, float]:
    """Returns the mean over the images of each metric; those of `_SOME` where all have them."""
    names = [*_MEANS, *(name for name in _SOME if all(name in row for row in rows))]
    return {key: float(np.mean([row[key] for row in rows])) for key in names}


def _on_contact_sheet(count):
    """Returns the indices of the views that the contact sheet shows."""
    return range(0, count, -(-count // output_images.CONTACT_SHEET_ROWS))


def _contact_sheet_file(folder, index):
    return folder / "contact_sheet" / f"{index:03d}.png"


def _row_file(folder, index):
    return folder / "rows" / f"{index:03d}.json"
