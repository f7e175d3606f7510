"""Scores of a trained run on held-out views, and the pictures they were taken from."""

import functools
import json
import os
import pathlib
import shutil
import time

import jax
import jax.numpy as jnp
import numpy as np

from jaxnerf.core.cameras import pixel_grid
from jaxnerf.data.batches import pixel_colors
from jaxnerf.engine import card, pictures, records, workdir
from jaxnerf.engine.load import newest_step, open_run
from jaxnerf.engine.scores import scores


def evaluate(folder, *, config=None, split=None, step=None, chunk=None, settings=None, overwrite=False):
    """Scores one checkpoint and writes <workdir>/eval/<step>/.

    Args:
        folder: the workdir.
        config: ConfigDict in place of the workdir's own.
        split: of the data; the configuration's eval.split when None. Another split than that one
            is written to eval/<step>-<split>.
        step: of the checkpoint; the newest when None.
        chunk: rays rendered at once; the configuration's eval.chunk when None; 0: see image_renderer.
        settings: see open_run.
        overwrite: whether an earlier result of the same step and split is replaced.

    Returns:
        What results.json holds.

    Raises:
        ValueError: if there is no such run, checkpoint or split, or the result is already there.
    """
    run = open_run(folder, config, settings=settings)
    return score_run(run, folder, split=split, step=step, chunk=chunk, overwrite=overwrite)


def score_run(run, folder, *, split=None, step=None, chunk=None, overwrite=False, views=None):
    """As evaluate, for a run that is open already and views that may be read already."""
    step, chunk = newest_step(run, folder, step), run.experiment.eval.chunk if chunk is None else chunk
    target = claim_target(run, folder, split=split, step=step, overwrite=overwrite)
    split, name = split or run.experiment.eval.split, target.name
    views = run.experiment.load_views(split) if views is None else views
    weights = run.weights(step)
    partial = target.with_name(name + ".tmp")
    shutil.rmtree(partial, ignore_errors=True)
    try:
        results = _write_scores(
            run, folder, views, weights, split=split, step=step, chunk=chunk, partial=partial
        )
    except BaseException:  # a full disk, Ctrl-C
        shutil.rmtree(partial, ignore_errors=True)
        raise
    if target.exists():  # a kill between the two moves loses neither result
        shutil.rmtree(target.with_name(name + ".old"), ignore_errors=True)  # of such a kill
        os.replace(target, target.with_name(name + ".old"))
    os.replace(partial, target)
    shutil.rmtree(target.with_name(name + ".old"), ignore_errors=True)
    return results


def claim_target(run, folder, *, split=None, step=None, overwrite=False):
    """Returns the folder that a score goes to; ValueError if it is there already and not to be replaced."""
    step, own = newest_step(run, folder, step), run.experiment.eval.split
    name = str(step) if split in (None, own) else f"{step}-{split}"
    target = pathlib.Path(folder) / "eval" / name
    if target.exists() and not overwrite:
        raise ValueError(f"{target}: is there already; give --overwrite to score again, or another --step")
    return target


def _write_scores(run, folder, views, weights, *, split, step, chunk, partial):
    rows = _render_views(run, functools.partial(run.image, weights), views, chunk, partial)
    rays = sum(row.pop("rays") for row in rows)
    # The first view's time would hold the compilation too.
    timed = rows[1:] or rows
    seconds = sum(row["seconds"] for row in timed) / len(timed)
    trained = [row for row in records.read_rows(folder) if row["step"] <= step]
    results = {
        **means(rows),
        "views": len(rows),
        "rays_per_second": rays / len(rows) / seconds,
        "seconds_per_frame": seconds,
        "step": step,
        "rays_seen": trained[-1]["rays"] if trained else None,
        "training_seconds": trained[-1]["seconds"] if trained else None,
        "compile_seconds": trained[-1]["compile_seconds"] if trained else None,
        "parameters": sum(leaf.size for leaf in jax.tree.leaves(weights[0])),
        "settings": {name: vars(run.experiment.eval).get(name) for name in ("samples", "stop", "skip_empty")},
        **card.metric_card({**run.experiment.conventions, "chunk": chunk or "auto"}, views, split=split),
        "images": rows,
    }
    workdir.write_text(partial / "results.json", json.dumps(results, indent=2) + "\n")
    return results


def summary(results):
    """Returns one line that sums up results.json."""
    step = f"step {results['step']}: " if "step" in results else ""
    speed = f", {results['seconds_per_frame']:.2f} s a frame" if "seconds_per_frame" in results else ""
    scores = f"PSNR {results['psnr']:.2f} dB, SSIM {results['ssim']:.4f}"
    return f"{step}{scores} over {results['views']} views{speed}"


def reference(views, index):
    """Returns the colours [H, W, 3] of one of Views, over its background."""
    height, width = (int(value) for value in views.size[index])
    first = int(views.offset[index])
    pixels = jnp.asarray(views.pixels[first : first + height * width])
    return pixel_colors(pixels, views.background).reshape(height, width, 3)


def _render_views(run, render, views, chunk, folder):
    rows, shown, progress = [], [], records.Progress(len(views.names))
    for index, name in enumerate(views.names):
        height, width = (int(value) for value in views.size[index])
        pixels = pixel_grid(height, width, offset=run.experiment.pixel_offset)
        started = time.perf_counter()
        rays = run.experiment.view_rays(views, index, pixels)
        image = jax.block_until_ready(render(rays, chunk=chunk))
        seconds = time.perf_counter() - started
        truth = reference(views, index)
        row = scores(image.rgb, truth, live_mask(views, index))
        rows.append({"name": name, **row, "seconds": seconds, "rays": height * width})
        depth = run.experiment.world_depth(views, index, pixels, image.depth)
        pictures.write_view(folder, f"{index:03d}", image.rgb, truth, depth)
        if index % -(-len(views.names) // pictures.SHEET_ROWS) == 0:
            shown.append((truth, image))
        progress.show(index + 1, f"{name}: {rows[-1]['psnr']:.2f} dB in {seconds:.2f} s")
    progress.close()
    pictures.write_sheet(folder / "sheet.png", shown)
    return rows


def live_mask(views, index):
    """Returns [H, W] bool of one of Views, which pixels count; None where all do."""
    if views.mask is None:
        return None
    (height, width), first = views.size[index], int(views.offset[index])
    return jnp.asarray(views.mask[first : first + height * width]).reshape(height, width)


def means(rows):
    """Returns the means of the rows' metrics, each over the images."""
    keys = ("psnr", "ssim", "psnr_float", "psnr_truncated")
    return {key: float(np.mean([row[key] for row in rows])) for key in keys}
