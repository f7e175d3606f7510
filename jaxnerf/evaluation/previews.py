"""What a training run shows of its images: a preview every so often, and a summary when it ends."""

import functools
import math
import os
import pathlib
import shlex
import time

import jax
import numpy as np
from jaxtyping import UInt8

from jaxnerf.core.cameras import pixel_grid
from jaxnerf.core.metrics import psnr, round_to_8_bits
from jaxnerf.core.views import Views
from jaxnerf.evaluation import aggregate, output_images
from jaxnerf.evaluation.metrics import pixel_mask
from jaxnerf.evaluation.restore import TrainedRun, newest_step, refined_views, restore_run
from jaxnerf.evaluation.supersampling import render_pixels
from jaxnerf.runtime import memory, processes, stages
from jaxnerf.training import metric_log
from jaxnerf.training.optimizer import image_params
from jaxnerf.training.state import TrainState
from jaxnerf.training.workdir import load_config

_MAX_VIEWS = 8  # of a split that the summary scores
# What may go wrong with an image must not end a run: files, and the memory of a device that is full of training.
_FAILURES = (ValueError, OSError, memory.OutOfMemory, jax.errors.JaxRuntimeError)
_MAX_RAYS = 2**16  # of an image; of larger ones only every n-th row and column is rendered


class Previews:
    """Renders and scores a few views of the run in a workdir, as evaluation renders them.

    The workdir is read when the first image is rendered. All processes of a run render, the first one writes.
    """

    def __init__(self, workdir: str | os.PathLike):
        self._workdir = pathlib.Path(workdir)

    def write(self, state: TrainState, views: Views) -> str:
        """Writes previews/<step>.png, a rendering beside the dataset's image, and returns a line about it.

        An error is reported in the line, as training does not depend on previews.

        Args:
            state: of the run; it is not changed.
            views: of the split "train", used where there are no held-out views.
        """
        try:
            return self._write(_on_one_device((image_params(state), state.grid)), int(state.step), views)
        except _FAILURES as error:
            return f"preview       none: {error}"

    def summary(self, views: Views) -> list[str]:
        """Returns the lines that sum up a run whose training is complete, and writes its last preview.

        Args:
            views: of the split "train".
        """
        run, rows = self._run, metric_log.read_rows(self._workdir)
        options, step = run.experiment.config.train, newest_step(run, self._workdir)
        row = next((row for row in rows if row["step"] == step), {"seconds": 0.0})
        seen = row.get("rays", math.inf) / max(_num_pixels(views), 1)
        if step >= options.max_steps:
            limit, more = "train.max_steps", 2 * step
            why = f"it reached train.max_steps = {options.max_steps:,}"
        else:
            limit, more = "train.max_seconds", 2 * options.max_seconds
            why = f"train.max_seconds = {options.max_seconds:g} have passed at step {metric_log.of_all(step, options)}"
        few = f"training saw at most {seen:.0%} of the pixels of its images, so it may show little yet"
        smaller = "--config.data.factor, with a new --workdir"
        return [
            f"done          {why}: {row.get('rays', 0):,} rays in {row['seconds']:.1f} s of training",
            *([f"note          {few}; train longer, or on smaller images ({smaller})"] if seen < 1 else []),
            *self._cameras(step, views),
            *self._scores(step, views),
            f"workdir       {self._workdir.absolute()}: {', '.join(self._contents())}",
            *self._commands(f"--config.{limit}={more:.10g}", is_early=seen < 1),
        ]

    def evaluated_run(self) -> TrainedRun:
        """Returns the run as evaluation restores it: the one of the previews, whose program is compiled and whose
        checkpoint is read once, unless evaluation bakes a grid.
        """
        baked = load_config(self._workdir).eval.bake_occupancy
        return restore_run(self._workdir) if baked else self._run

    @functools.cached_property
    def _run(self):
        run = restore_run(self._workdir, settings={"bake_occupancy": False})  # baking takes time
        return run._replace(variables=functools.lru_cache(maxsize=1)(run.variables))

    @functools.cached_property
    def _held_out(self):
        """The split of the held-out views, some of its Views or None, and why there are none."""
        experiment = self._run.experiment
        split = "held_out" if experiment.config.data.hold_out else experiment.config.eval.split
        if split == "train":
            return split, None, "eval.split is 'train'"
        try:
            return split, experiment.load_split(split, max_views=_MAX_VIEWS), None
        except (ValueError, OSError) as error:
            return split, None, str(error)

    def _cameras(self, step, views):
        """Returns lines about the parameters of the training images, if there are any."""
        cameras = self._run.experiment.cameras
        return [] if cameras is None else cameras.summary(self._run.variables(step)[0], views)

    def _scores(self, step, views):
        """Returns lines with the PSNR of training and held-out images, and writes the preview."""
        split, held_out, why = self._held_out
        results = self._workdir / "eval" / str(step) / "results.json"
        lines = []
        if self._run.experiment.config.eval.summary_seconds:
            try:
                with stages.stage("scoring some images"):
                    variables = _on_one_device(self._run.variables(step))
                    lines.append(f"training      {self._mean_psnr(variables, views)} of {len(views.offset)} images")
                    if held_out is not None and not results.exists():
                        scored = self._mean_psnr(variables, held_out)
                        lines.append(f"held-out      {scored} images of the split {split!r}")
                    lines.append(self._write(variables, step, views))
            except _FAILURES as error:
                lines.append(f"scores        none: {error}")
        if results.exists():
            try:
                found = aggregate.read_results(results.parent, "score it again with --overwrite")
                scored = f"PSNR {found['psnr']:.2f} dB over {found['views']} views, in {results.parent}"
            except _FAILURES as error:
                scored = f"none: {error}"
            lines.append(f"evaluation    {scored}")
        elif held_out is None:
            lines.append(f"held-out      no images ({why}); --config.data.hold_out=8 with a new --workdir keeps some")
        return lines

    def _contents(self):
        """Returns what there is in the workdir, for a line."""
        steps = ", ".join(map(str, self._run.steps()))
        names = ("metrics.jsonl", "config.json", "previews", "eval", "tensorboard")
        return [f"checkpoints ({steps})", *(name for name in names if (self._workdir / name).exists())]

    def _commands(self, more, is_early):
        split, held_out, _ = self._held_out
        workdir = f"--workdir={shlex.quote(str(self._workdir))}"
        option = "" if split == self._run.experiment.config.eval.split else f" --split={split}"
        commands = [f"jaxnerf-eval {workdir}{option}"] if held_out is not None else []
        commands += [f"jaxnerf-render {workdir}", f"jaxnerf-train {workdir} {more}"]
        purposes = ["scores all held-out images", "renders a video", "trains longer"][-len(commands) :]
        if is_early:
            commands, purposes = [commands[-1], *commands[:-1]], [purposes[-1], *purposes[:-1]]
        width = max(map(len, commands))
        lines = [f"{command:{width}}  {purpose}" for command, purpose in zip(commands, purposes, strict=True)]
        return [("next          " if not index else 14 * " ") + line for index, line in enumerate(lines)]

    def _write(self, variables, step, views):
        _, held_out, _ = self._held_out
        kind, views = ("training", views) if held_out is None else ("held-out", held_out)
        index = len(views.offset) // 2
        name = views.names[index] if views.names else index
        score, image = self._render(variables, views, index)
        path = self._workdir / "previews" / f"{step}.png"
        if processes.is_first():
            path.parent.mkdir(exist_ok=True)
            output_images.write_image(path, image)
        return f"preview       {score:.2f} dB on the {kind} image {name}: {path}"

    def _render(self, variables, views, index) -> tuple[float, UInt8[np.ndarray, "H W2 3"]]:
        """Returns the PSNR of a view, and its rendering beside the dataset's image."""
        experiment = self._run.experiment
        split = "train" if views is not self._held_out[1] else self._held_out[0]
        views = refined_views(self._run, views, split, variables[0])
        height, width = (int(value) for value in views.size[index])
        every = math.ceil(math.sqrt(height * width / _MAX_RAYS))
        pixels = pixel_grid(height, width, offset=experiment.config.data.pixel_offset)[::every, ::every]
        rgb = render_pixels(self._run, variables, views, index, pixels)[0].rgb
        truth, mask = views.image(index)[::every, ::every], pixel_mask(views, index)
        mask = None if mask is None else mask[::every, ::every]
        score = float(psnr(round_to_8_bits(rgb), round_to_8_bits(truth), mask=mask))
        return score, np.concatenate([output_images.to_8_bits(rgb), output_images.to_8_bits(truth)], axis=1)

    def _mean_psnr(self, variables, views):
        """Returns the mean PSNR of some views and their number, as text."""
        scores, count = [], min(len(views.offset), _MAX_VIEWS)
        for index in np.arange(count) * len(views.offset) // count:
            scores.append(self._render(variables, views, int(index))[0])
            if len(scores) == 1:
                started = time.perf_counter()  # the first one may compile
            elif time.perf_counter() - started > self._run.experiment.config.eval.summary_seconds:
                break
        return f"PSNR {np.mean(scores):.2f} dB over {len(scores)}"


def _num_pixels(views):
    """Returns how many pixels of Views are neither ignored nor transparent."""
    pixels = np.asarray(views.pixels)
    shown = pixels[:, 3] > 0 if pixels.shape[1] == 4 else np.ones(len(pixels), bool)
    return int(shown.sum() if views.mask is None else (shown & np.asarray(views.mask)).sum())


def _on_one_device(tree):
    """Returns the arrays on this process's first device, wherever the state of training is."""
    return jax.tree.map(lambda leaf: jax.device_put(np.asarray(leaf), jax.local_devices()[0]), tree)
