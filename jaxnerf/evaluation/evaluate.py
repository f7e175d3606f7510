"""Scores of a trained run on held-out views, and the pictures they were taken from.

A view is finished when its pictures and its row of scores are in eval/<step>.tmp/. What is finished is kept
and skipped, whoever made it: a call that was stopped, or another shard. The call after which none is missing
makes results.json of them and moves the folder to eval/<step>/.
"""

import functools
import os
import pathlib
import shutil
import time

import jax
import jax.numpy as jnp
from ml_collections import ConfigDict

from jaxnerf.core.cameras import pixel_grid
from jaxnerf.core.types import Views
from jaxnerf.data.ray_batches import pixel_colors
from jaxnerf.evaluation import aggregate, pictures
from jaxnerf.evaluation.metrics import scores
from jaxnerf.evaluation.restore import newest_step, restore_run
from jaxnerf.runtime import processes, shards
from jaxnerf.training import metric_log, workdir
from jaxnerf.training.checkpoint import Checkpoints
from jaxnerf.training.loop import train

_OTHER = "give --overwrite without --shard, or remove it"


def train_and_evaluate(config: ConfigDict, workdir: str | os.PathLike, *, views: Views | None = None) -> bool:
    """Trains as a config says, from the last checkpoint in a workdir if there is one, and scores the result.

    Args:
        config: see configs/default.py.
        workdir: made if missing.
        views: of the split "train" where they have been read.

    Returns:
        Whether training, and with `eval.at_end` scoring, came to its end. False: stopped by Ctrl-C or SIGTERM
        and saved; the same call goes on.

    Raises:
        ValueError: on bad input, when another process trains in the workdir, or when too many steps in a row
            were not finite.
    """
    return train(config, workdir, views=views, at_end=_score_newest)


def _score_newest(folder):
    """Scores the last checkpoint unless it is scored already; returns whether it is."""
    if (pathlib.Path(folder) / "eval" / str(Checkpoints(folder).steps()[-1])).exists():
        return True
    try:
        evaluate(folder, shard=(jax.process_index(), jax.process_count()))
    except KeyboardInterrupt:
        processes.say("stopped while scoring; the checkpoints are saved, and the same command goes on scoring")
        return False
    return True


def evaluate(
    folder,
    *,
    config=None,
    split=None,
    step=None,
    chunk=None,
    settings=None,
    overwrite=False,
    shard=shards.WHOLE,
):
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
        shard: (index, count): only every count-th view from that index on.

    Returns:
        What results.json holds; None where views of other shards are missing still.

    Raises:
        ValueError: if there is no such run, checkpoint or split, the result is already there, or what is
            finished of it was scored with other settings.
    """
    run = restore_run(folder, config, settings=settings)
    return score_run(run, folder, split=split, step=step, chunk=chunk, overwrite=overwrite, shard=shard)


def score_run(run, folder, *, split=None, step=None, chunk=None, overwrite=False, views=None, shard=shards.WHOLE):
    """As evaluate, for a run that is open already and views that may be read already."""
    step, chunk = newest_step(run, folder, step), run.experiment.eval.chunk if chunk is None else chunk
    target = claim_target(run, folder, split=split, step=step, overwrite=overwrite, shard=shard)
    split = split or run.experiment.eval.split
    views = run.experiment.load_split(split) if views is None else views
    variables = run.variables(step)
    partial, origin = target.with_name(target.name + ".tmp"), _origin(run, variables, views, split, step)
    rest = {"run": run, "folder": folder, "views": views, "variables": variables, "origin": origin}
    if target.exists() and not overwrite:
        return aggregate.read(target, origin, _OTHER)
    shards.claim_folder(partial, origin, overwrite=overwrite, file=aggregate.ORIGIN, other=_OTHER)
    try:
        with workdir.naming(partial):
            for name in aggregate.FOLDERS:
                (partial / name).mkdir(exist_ok=True)
            _score_views(run, functools.partial(run.render_image, variables), views, chunk, partial, shard)
            return aggregate.merge(partial, target, chunk=chunk, **rest)
    except FileNotFoundError:  # another call has finished and moved it all, perhaps while this one began
        if partial.exists() and any((partial / "rows").glob("*")) or not target.exists():
            raise
        shutil.rmtree(partial, ignore_errors=True)
        return aggregate.read(target, origin, _OTHER)


def claim_target(run, folder, *, split=None, step=None, overwrite=False, shard=shards.WHOLE):
    """Returns the folder that a score goes to; ValueError if it is there already and not to be replaced.

    To a shard it may be there: then all shards are finished, and this one has nothing to do.
    """
    step, own = newest_step(run, folder, step), run.experiment.eval.split
    name = str(step) if split in (None, own) else f"{step}-{split}"
    target = pathlib.Path(folder) / "eval" / name
    shards.refuse_overwrite(overwrite, shard, target)
    if target.exists() and not overwrite and shard == shards.WHOLE:
        raise ValueError(f"{target}: is there already; give --overwrite to score again, or another --step")
    return target


def _origin(run, variables, views, split, step):
    """Returns all that the scores depend on, but for the chunk, which they do not show."""
    settings = {
        name: vars(run.experiment.eval).get(name) for name in ("sample_multiplier", "early_stop_eps", "bake_occupancy")
    }
    return {
        "split": split,
        "step": step,
        **settings,
        "configuration": shards.digest(run.identity),
        "parameters": shards.digest(variables[0]),
        "cameras": shards.digest(views.cameras, views.near, views.far, "/".join(views.names)),
        "photographs": shards.digest(views.pixels, sample=4096),
    }


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


def _score_views(run, render, views, chunk, folder, shard):
    """Renders and scores those views that are a shard's and not finished yet."""
    frames = shards.own(range(len(views.names)), shard)
    todo = [index for index in frames if not aggregate.is_finished(folder, index)]
    progress, first = metric_log.Progress(len(frames), show=processes.is_first()), True
    for done, index in enumerate(todo, len(frames) - len(todo) + 1):
        name, (height, width) = views.names[index], (int(value) for value in views.size[index])
        pixels = pixel_grid(height, width, offset=run.experiment.pixel_offset)
        started = time.perf_counter()
        rays = run.experiment.view_rays(views, index, pixels)
        image = jax.block_until_ready(render(rays, chunk=chunk))
        seconds = time.perf_counter() - started
        truth = reference(views, index)
        row = {"name": name, **scores(image.rgb, truth, live_mask(views, index)), "seconds": seconds}
        depth = run.experiment.world_depth(views, index, pixels, image.depth)
        pictures.write_view(folder, f"{index:03d}", image.rgb, truth, depth)
        aggregate.finish(folder, index, row, first, len(views.names), truth, image)
        progress.show(done, f"{name}: {row['psnr']:.2f} dB in {seconds:.2f} s")
        first = False
    progress.close()


def live_mask(views, index):
    """Returns [H, W] bool of one of Views, which pixels count; None where all do."""
    if views.mask is None:
        return None
    (height, width), first = views.size[index], int(views.offset[index])
    return jnp.asarray(views.mask[first : first + height * width]).reshape(height, width)
