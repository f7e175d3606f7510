"""Scores a trained run on held-out views, and writes the images that the metrics are computed from.

A view is finished when its images and its row of metrics are in eval/<step>.tmp/. Finished views are kept and
skipped, whichever process made them: an interrupted one, or another shard. The process that finds all views
finished writes results.json and moves the folder to eval/<step>/.
"""

import errno
import functools
import math
import os
import pathlib
import shutil
import sys
import time
from collections.abc import Callable, Sequence
from typing import Any

import jax

from jaxnerf.core.cameras import pixel_grid
from jaxnerf.core.views import Views
from jaxnerf.evaluation import aggregate, output_images
from jaxnerf.evaluation.metrics import image_metrics, pixel_mask
from jaxnerf.evaluation.previews import Previews
from jaxnerf.evaluation.restore import TrainedRun, newest_step, refined_views, restore_run
from jaxnerf.evaluation.supersampling import rays_per_side_of_views, render_pixels, training_cameras
from jaxnerf.runtime import atomic_files, devices, memory, processes, shards, stages
from jaxnerf.runtime.fingerprint import fingerprint
from jaxnerf.training import metric_log
from jaxnerf.training.auto_config import with_registered_parts
from jaxnerf.training.build import load_split
from jaxnerf.training.checkpoint import Checkpoints
from jaxnerf.training.config import Config, read_config
from jaxnerf.training.loop import train
from jaxnerf.training.state import TrainState

_REMEDY = "give --overwrite without --shard, or remove it"


def train_and_evaluate(
    config: Config,
    workdir: str | os.PathLike,
    *,
    views: Views | None = None,
    observe: Callable[[TrainState, Views], None] | None = None,
) -> bool:
    """Trains as a config says, from the last checkpoint in a workdir if there is one, and scores the result.

    Args:
        config: as a config file returns it, such as `jaxnerf.configs.default.get_config()`.
        workdir: made if missing.
        views: of the split "train" where they have been read.
        observe: called after each step, see `loop.train`.

    Returns:
        Whether training, and with `eval.at_end` the evaluation, are complete. False: stopped by Ctrl-C or
        SIGTERM and saved; the same call continues.

    Raises:
        ValueError: on bad input, when another process trains in the workdir, or when too many steps in a row
            were not finite.
    """
    previews = Previews(workdir)
    at_end = functools.partial(_finish, config, workdir, previews=previews)
    return train(config, workdir, views=views, preview=previews.write, at_end=at_end, observe=observe)


def train_many(configs: Sequence[Config], workdirs: Sequence[str | os.PathLike]) -> bool:
    """Trains and scores several runs one after the other; each workdir then is that of an ordinary run.

    Runs whose compiled step is the same share it: those that differ in `seed`, which makes an ensemble, and those of
    datasets with the same shapes whose inferred options agree. Runs of the same dataset read it once. There are no
    previews and no summaries.

    Args:
        configs: of the runs, see `train_and_evaluate`.
        workdirs: one for each run, made if missing.

    Returns:
        Whether all are complete. False: stopped and saved; the same call continues.

    Raises:
        ValueError: as `train_and_evaluate` does, and if there is not one workdir for each config.
    """
    if len(configs) != len(workdirs) or not configs:
        raise ValueError(f"{len(configs)} configs and {len(workdirs)} workdirs, expected a workdir for each run")
    if len({pathlib.Path(folder).resolve() for folder in workdirs}) < len(workdirs):
        raise ValueError(f"workdirs {', '.join(map(str, workdirs))}: two are the same, expected one for each run")
    configs, data, views = [with_registered_parts(read_config(config)) for config in configs], None, None
    with devices.shared_steps():
        for config, workdir in zip(configs, workdirs, strict=True):
            if config.data != data:
                data, views = config.data, load_split(config, "train")[0]
            if not train(config, workdir, views=views, at_end=functools.partial(_finish, config, workdir)):
                return False
    return True


def _finish(config, workdir, views, previews=None):
    """Scores a run if its config asks for it, and prints the summary of its previews; returns whether it was done."""
    started = time.perf_counter()
    try:
        if config.eval.at_end:
            _score_newest(workdir, previews and previews.evaluated_run)
        scored = time.perf_counter()
        if previews is not None:
            lines = previews.summary(views)
            took = f"{scored - started:.1f} s for scoring, " if config.eval.at_end else ""
            processes.print_once(f"afterwards    {took}{time.perf_counter() - scored:.1f} s for this summary", *lines)
    except KeyboardInterrupt:
        processes.print_once("stopped while scoring; the checkpoints are saved, and the same command continues")
        return False
    return True


def _score_newest(workdir, restore=None):
    """Scores the last checkpoint unless it has been scored; restore() returns its TrainedRun, restored here if None."""
    if not (pathlib.Path(workdir) / "eval" / str(Checkpoints(workdir).steps()[-1])).exists():
        run = restore_run(workdir) if restore is None else restore()
        score_run(run, workdir, shard=(jax.process_index(), jax.process_count()))


def score_run(
    run: TrainedRun,
    workdir: str | os.PathLike,
    *,
    split: str | None = None,
    step: int | None = None,
    overwrite: bool = False,
    views: Views | None = None,
    shard: tuple[int, int] = shards.WHOLE,
    predictor: Any = None,
    aligner: Any = None,
) -> dict[str, Any] | None:
    """Scores one checkpoint and writes <workdir>/eval/<step>/.

    Args:
        run: restored from the workdir.
        workdir: the folder that training wrote.
        split: of the dataset; the config's eval.split when None. The results of any other split are written
            to eval/<step>-<split>/.
        step: of the checkpoint; the newest when None.
        overwrite: whether an earlier result of the same step and split is replaced.
        views: of the split, if they have been read already.
        shard: (index, count): only every count-th view, from view `index` on.
        predictor: `uncertainty.predict.Predictor`; its predicted errors are written to uncertainty/NNN.tiff, and
            compared with the true ones. None: no error is predicted.
        aligner: `alignment.align_views.Aligner`; its figures are in the results, too. None: no view is aligned.

    Returns:
        What results.json holds; None while views of other shards are missing.

    Raises:
        ValueError: if there is no such checkpoint or split, the result exists, or its finished views were scored with
            other settings.
    """
    step = newest_step(run, workdir, step)
    target = result_folder(run, workdir, split=split, step=step, overwrite=overwrite, shard=shard)
    split = split or run.experiment.config.eval.split
    views = run.experiment.load_split(split) if views is None else views
    with stages.stage("reading the checkpoint to score"):
        variables = run.variables(step)
        memory.release()
    views = refined_views(run, views, split, variables[0])
    partial, provenance = target.with_name(target.name + ".tmp"), _provenance(run, variables, views, split, step)
    sides = rays_per_side_of_views(run, views, training_cameras(run, workdir, variables[0]))
    if (sides > run.experiment.config.train.rays_per_side).any():
        provenance["rays_per_pixel"] = fingerprint(sides)
    if predictor is not None:
        provenance["uncertainty"] = predictor.identity
    if aligner is not None:
        provenance["aligned"] = aligner.identity
    if target.exists() and not overwrite:
        return aggregate.read(target, provenance, _REMEDY)
    shards.make_folder(partial, provenance, overwrite=overwrite, file=aggregate.PROVENANCE, remedy=_REMEDY)
    try:
        with atomic_files.naming(partial):
            for name in aggregate.FOLDERS:
                (partial / name).mkdir(exist_ok=True)
            render = functools.partial(render_pixels, run, variables, views)
            align = None if aligner is None else functools.partial(aligner.scored, run, variables, views)
            _score_views(run, render, views, sides, partial, shard, (predictor, align))

            def summarize(finished):
                results = aggregate.results_of(run, workdir, views, variables, finished, provenance)
                found = {} if predictor is None else {"uncertainty": predictor.summary(results["images"])}
                found |= {} if aligner is None else aligner.summary(results["images"])
                return results | found

            options = {"count": len(views.names), "errors": predictor is not None, "overwrite": overwrite}
            return aggregate.merge(partial, target, summarize, **options)
    except OSError as error:
        # Another process has finished and moved the folder, perhaps just now, which a later one may have made again.
        if overwrite or error.errno not in (errno.ENOENT, errno.ENOTEMPTY, errno.EEXIST) or not target.exists():
            raise
        shutil.rmtree(partial, ignore_errors=True)
        return aggregate.read(target, provenance, _REMEDY)


def result_folder(
    run: TrainedRun,
    workdir: str | os.PathLike,
    *,
    split: str | None = None,
    step: int | None = None,
    overwrite: bool = False,
    shard: tuple[int, int] = shards.WHOLE,
) -> pathlib.Path:
    """Returns the folder of a result; raises ValueError if it exists and is not to be replaced.

    For a shard it may exist: all shards are then finished, and this one has nothing to do.
    """
    step, default_split = newest_step(run, workdir, step), run.experiment.config.eval.split
    name = str(step) if split in (None, default_split) else f"{step}-{split}"
    target = pathlib.Path(workdir) / "eval" / name
    atomic_files.check_tree(target.parent)
    shards.refuse_overwrite(overwrite, shard, target)
    if target.exists() and not overwrite and shard == shards.WHOLE:
        raise ValueError(f"{target}: exists already; give --overwrite to score again, or another --step")
    return target


def _provenance(run, variables, views, split, step):
    """Returns everything that the metrics depend on; the chunk is absent, as it changes no pixel."""
    return {
        "split": split,
        "step": step,
        **run.settings,
        "config": fingerprint(run.identity),
        "parameters": fingerprint(variables[0]),
        "cameras": fingerprint(views.cameras, views.near, views.far, *views.names),
        "images": fingerprint(views.pixels, sample=4096),
    }


def summary(results: dict[str, Any]) -> str:
    """Returns one line that sums up results.json."""
    step = f"step {results['step']}: " if "step" in results else ""
    speed = f", {results['seconds_per_frame']:.2f} s per frame" if "seconds_per_frame" in results else ""
    metrics = f"PSNR {results['psnr']:.2f} dB, SSIM {results['ssim']:.4f}"
    if "lpips" in results:
        metrics += f", LPIPS {results['lpips']:.4f}"
    if "psnr_one_ray" in results:
        metrics += f" ({results['psnr_one_ray']:.2f} dB, {results['ssim_one_ray']:.4f} with one ray a pixel: these "
        metrics += "images are smaller than those of training, and have several rays, as frames have)"
    if results.get("exposure"):
        metrics += f" ({results['psnr_aligned']:.2f} dB, {results['ssim_aligned']:.4f} after colour alignment)"
    shared = results.get("conventions", {}).get("shared_with_training")
    note = f"; note: {shared['note']}" if shared else ""
    exact = [row["psnr"] == math.inf for row in results.get("images", ())]
    if any(exact):
        note += f"; note: {sum(exact)} images equal their references in 8 bits, so their PSNR and its mean are infinite"
    paired = "" if results.get("paired_by", "name") == "name" else f", paired by {results['paired_by']}"
    return f"{step}{metrics} over {results['views']} views{speed}{paired}{note}"


def _score_views(run, render, views, sides, folder, shard, tools):
    """Renders and scores those views of a shard that are not finished, with rays along the `sides` [V] of a pixel."""
    count, (predictor, align) = len(views.names), tools
    frames = shards.indices_of(range(count), shard)
    files = [aggregate.view_files(folder, index, count=count, errors=predictor is not None) for index in frames]
    sizes = [tuple(int(side) for side in views.size[index]) for index in frames]
    readable = output_images.readable(files, sizes, is_valid=aggregate.is_finished)
    todo = [index for index, finished in zip(frames, readable, strict=True) if not finished]
    with stages.Progress("scoring images", len(frames), processes.is_first()) as progress:
        for done, index in enumerate(todo, len(frames) - len(todo) + 1):
            progress.done = done - 1
            name, (height, width) = views.names[index], (int(value) for value in views.size[index])
            pixels = pixel_grid(height, width, offset=run.experiment.config.data.pixel_offset)
            started = time.perf_counter()
            image, depth = jax.block_until_ready(render(index, pixels, side=int(sides[index])))
            seconds = time.perf_counter() - started
            truth = views.image(index)
            row = {"name": name, **image_metrics(image.rgb, truth, pixel_mask(views, index)), "seconds": seconds}
            if (sides > run.experiment.config.train.rays_per_side).any():
                plain = image_metrics(render(index, pixels, side=1)[0].rgb, truth, pixel_mask(views, index))
                row |= {"rays_per_pixel": int(sides[index]) ** 2}
                row |= {f"{name}_one_ray": plain[name] for name in ("psnr", "ssim")}
            error = None
            if predictor is not None:
                rays = run.experiment.view_rays(views, index, pixels)
                error, figures = predictor.scored(rays, image.rgb, truth, views, index)
                row |= figures
            if align is not None:
                row |= align(index, image.rgb, side=int(sides[index]))
            output_images.write_view(folder, f"{index:03d}", image.rgb, truth, depth, error)
            aggregate.mark_finished(folder, index, row, truth, image, count=count, first=index == todo[0])
            progress.show(done, f"{name}: {row['psnr']:.2f} dB in {seconds:.2f} s")


def watch(
    workdir: str | os.PathLike,
    restore: Callable[[], TrainedRun],
    *,
    poll_seconds: float = 10.0,
    split: str | None = None,
) -> None:
    """Scores every new checkpoint of a training run until the last one, and prints a line when it waits.

    Args:
        workdir: the folder that training writes; it may not exist yet.
        restore: restores the run once there is one.
        poll_seconds: time between searches for a new checkpoint.
        split: see `score_run`.

    Raises:
        ValueError: as `score_run`.
    """
    workdir, said = pathlib.Path(workdir), None
    while not (workdir / "config.json").exists():
        said = _wait(f"{workdir}: no run yet", said, poll_seconds)
    run = restore()
    split = split or run.experiment.config.eval.split
    suffix = "" if split == run.experiment.config.eval.split else f"-{split}"
    views = run.experiment.load_split(split)
    while True:
        steps = run.steps()
        new = [step for step in steps if not (workdir / "eval" / f"{step}{suffix}").exists()]
        if new:
            try:
                results = score_run(run, workdir, split=split, step=new[0], views=views)
                print(summary(results), flush=True)
            except ValueError:
                if new[0] in run.steps():  # otherwise training has deleted it as too old, which is no error
                    raise
        elif metric_log.has_ended(run.experiment.config.train, steps, workdir):
            return
        else:
            said = _wait(f"{workdir}: no new checkpoint", said, poll_seconds)


def _wait(text, said, seconds):
    """Sleeps, after printing the text unless it was printed last; returns the text."""
    if text != said:
        print(f"{text}; checking again every {seconds:g} s", file=sys.stderr, flush=True)
    time.sleep(seconds)
    return text
