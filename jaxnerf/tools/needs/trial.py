"""Trials: a model trained for some seconds and scored on views that are held out of training."""

import copy
import dataclasses
import math
import pathlib
import time
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import UInt8

from jaxnerf.core.cameras import pixel_grid
from jaxnerf.core.metrics import align_colors, mse
from jaxnerf.core.views import Views
from jaxnerf.evaluation.image_renderer import image_renderer
from jaxnerf.evaluation.metrics import pixel_mask
from jaxnerf.evaluation.output_images import to_8_bits
from jaxnerf.evaluation.supersampling import render_pixels
from jaxnerf.options import replaced
from jaxnerf.runtime import cores
from jaxnerf.tools.needs.pacing import PacedClock, Pacer
from jaxnerf.tools.needs.view_poses import aligned_views
from jaxnerf.training import auto_config, build
from jaxnerf.training.compiled_step import CompiledStep, compile_training
from jaxnerf.training.config import RunConfig, changed
from jaxnerf.training.dead_networks import make_reinitializer
from jaxnerf.training.optimizer import image_params
from jaxnerf.training.options import UNLIMITED_STEPS
from jaxnerf.training.pace import Pace
from jaxnerf.training.state import create_state

_MOST_VIEWS = 24  # that are scored
_MOST_PIXELS = 2**14  # of a view that are scored
_LEAST_MSE = 1e-10  # of an image that is exact; 100 dB
_MOST_NONFINITE = 20  # steps in a row
_MOST_FITTED = 6  # views whose poses are fitted


def seconds() -> float:
    """Returns the time of a clock that trials are measured with.

    On one CPU core it is the CPU time of this process, so that other processes count little, see also `pacing`. On
    several cores and on accelerators it is the time that passes.
    """
    return time.process_time() if counts_cpu_time() else time.perf_counter()


def counts_cpu_time() -> bool:
    """Returns whether `seconds` is CPU time."""
    return jax.default_backend() == "cpu" and cores.usable() == 1


class Result(NamedTuple):
    """What a trial measured.

    Attributes:
        psnr: dB of each held-out view.
        psnr_colors: the same after `align_colors`.
        psnr_pose: of some of them after their poses are fitted; None: not measured.
        steps: of training.
        seconds: of training.
        spent: seconds of everything, compilation included.
        compile_seconds: of training and rendering, in this trial.
        frame_seconds: of one frame of the size of a held-out view.
        parameters: their number.
        memory: bytes of a training step.
    """

    psnr: list[float]
    psnr_colors: list[float]
    psnr_pose: list[float] | None
    steps: int
    seconds: float
    spent: float
    compile_seconds: float
    frame_seconds: float
    parameters: int
    memory: float


class Trainer:
    """Trains and scores variants of a run on one dataset.

    Attributes:
        config: of the complete model, not resolved, with held-out views.
        views: of the split "train".
        pacer: of the machine's speed; None: seconds are those of the clock.
        split: whose views are scored.
        most_pixels: of a view that are scored: every n-th row and column, see `stride`.
    """

    def __init__(
        self,
        config: RunConfig,
        views: Views,
        pacer: Pacer | None = None,
        *,
        split: str = "held_out",
        most_pixels: float = _MOST_PIXELS,
    ):
        self.config, self.views, self.pacer, self.split = config, views, pacer, split
        self.most_pixels = most_pixels
        self._compiled: dict[str, _Compiled] = {}
        self._compiling: dict[str, float] = {}  # seconds that no result has reported yet
        self._held_out: dict[str, Views] = {}

    def resolved(self, values: Mapping[str, Any]) -> auto_config.Resolved:
        """Returns the resolved config of a variant; what was inferred follows its changes."""
        return auto_config.resolve(changed(self.config, values), self.views)

    def run(
        self, values: Mapping[str, Any], seed: int, length: float, *, steps: int = 0, pose: bool = False
    ) -> tuple[Result, list[UInt8[np.ndarray, "H W 3"]]]:
        """Trains a variant and scores it.

        Args:
            values: {"section.option": value} that differ from the complete model.
            seed: of the run.
            length: seconds of training.
            steps: in place of the seconds; 0: none.
            pose: whether to score with fitted poses, too.

        Returns:
            The Result, and the images of the held-out views.

        Raises:
            ValueError: if the variant cannot be built, or does not train.
        """
        compiled = self._of(values)
        compiling = self._compiling.pop(_key(values), 0.0)
        began = seconds() - compiling
        state, done, took = compiled.train(seed, length, steps, self.pacer)
        self._last = compiled, state
        scores, images, frame = compiled.score(state, pose)
        result = Result(
            **scores,
            steps=done,
            seconds=took,
            spent=seconds() - began,
            compile_seconds=compiling,
            frame_seconds=frame,
            parameters=compiled.parameters,
            memory=compiled.memory,
        )
        return result, images

    def psnr_of(self, split: str) -> list[float]:
        """Returns the PSNR, dB, of each view of another split after the training of the last `run`."""
        compiled, state = self._last
        return compiled.psnr_of(state, split)

    def make_pacer(self, file: pathlib.Path) -> Pacer:
        """Makes the pacer that takes steps of the complete model; file: see `Pacer`."""
        return Pacer(self._of({}).taker(), seconds, file)

    def _of(self, values):
        key = _key(values)
        if key not in self._compiled:
            began = seconds()
            config, views, _ = self.resolved(values)
            self._compiled[key] = _Compiled(config, views, self._views_held_out, self.most_pixels)
            self._compiling[key] = seconds() - began
        return self._compiled[key]

    def forget(self, values: Mapping[str, Any]) -> None:
        """Frees the compiled program of a variant."""
        self._compiled.pop(_key(values), None)

    def held_out(self) -> Views:
        """Returns the held-out views of the complete model that are scored."""
        config, _ = auto_config.resolve_for_device(self.resolved({}).config, training=False)
        return self._views_held_out(build.render_parts(config))

    def _views_held_out(self, experiment) -> Views:
        key = repr((experiment.config.data, "image_index" in experiment.model.needs))
        if key not in self._held_out:
            self._held_out[key] = experiment.load_split(self.split, max_views=_MOST_VIEWS)
        return self._held_out[key]


class _Run(NamedTuple):
    """What `render_pixels` asks of a run."""

    experiment: Any
    render_image: Callable[..., Any]


class _Compiled:
    """A variant's compiled program of training, and its renderer."""

    def __init__(self, config: RunConfig, views: Views, held_out: Callable[[Any], Views], most_pixels: float):
        # The length of a trial is no part of what is resolved: the complete run's length says what is inferred.
        train = replaced(
            config.train, max_steps=UNLIMITED_STEPS, lr_steps=UNLIMITED_STEPS, max_seconds=1e6, max_reinits=3
        )
        config, _ = auto_config.resolve_for_device(replaced(config, train=train))
        experiment = build.build(config)
        build.check_views(config, views)
        self._experiment, self._views, self._most_pixels = experiment, views, most_pixels
        self._cells = experiment.prepare(views)[0]
        self._step, state = compile_training(experiment, views)
        self._held_out = held_out(experiment)
        self.parameters = sum(leaf.size for leaf in jax.tree.leaves(image_params(state)))
        self.memory = _bytes_of(self._step, state)
        model = experiment.model
        part = jax.jit(lambda variables, rays: model.view(*variables, rays))
        cull = model.cull and jax.jit(lambda variables, rays: model.cull(variables[1], rays))
        self._run = _Run(experiment, image_renderer(part, config.eval.chunk, cull))
        create = jax.jit(lambda seed, cells: create_state(model, experiment.optimizer, seed, cells))
        shardings = jax.tree.map(lambda leaf: leaf.sharding, state)
        self._create = lambda seed: jax.block_until_ready(jax.device_put(create(seed, self._cells), shardings))
        self._view(_on_one_device((image_params(state), state.grid)), self._held_out, 0)

    def taker(self) -> Callable[[int], None]:
        """Returns a function that takes so many steps of a run of its own."""
        state, take, data = self._create(0), self._step.of(1), self._step.data

        def steps(count):
            nonlocal state
            for _ in range(count):
                state, _ = take(state, data)
            jax.block_until_ready(state)

        return steps

    def train(self, seed: int, length: float, steps: int, pacer: Pacer | None) -> tuple[Any, int, float]:
        """Returns the state after training, its steps and seconds."""
        options = self._experiment.config.train
        options = replaced(options, max_seconds=0.0 if steps else length, lr_steps=steps or UNLIMITED_STEPS)
        step, state = self._step, self._create(seed)
        data = step.data._replace(seed=np.uint32(seed % 2**32))
        if steps:
            data = _of_steps(data, steps)
        config = replaced(self._experiment.config, seed=seed)
        reinitialize = make_reinitializer(dataclasses.replace(self._experiment, config=config), "this dataset")
        clock, done, metrics = PacedClock(seconds, pacer), 0, None
        pace = Pace(options, clock, data)
        take = step.of(1)
        while (done < steps) if steps else (clock.seconds() < length):
            state, metrics = take(state, pace.data_of(done + 1))
            done += 1
            state, metrics = reinitialize(done, state, metrics)
            # Queued steps would all have the learning rate of the moment when they were queued.
            jax.block_until_ready(state)
            clock.probe()
        if metrics is not None and int(metrics["nonfinite_in_a_row"]) >= _MOST_NONFINITE:
            raise ValueError(f"the gradient of {int(metrics['nonfinite_in_a_row'])} steps in a row is not finite")
        return state, done, clock.seconds()

    def score(self, state: Any, pose: bool) -> tuple[dict[str, Any], list[np.ndarray], float]:
        """Returns the scores by name, the images, and the seconds of a frame."""
        variables, views = _on_one_device((image_params(state), state.grid)), self._held_out
        cameras = self._experiment.cameras
        if cameras is not None:
            views = cameras.refined_views(state.params, views, "held_out")
        found = {"psnr": [], "psnr_colors": [], "psnr_pose": [] if pose else None}
        images, frames = [], []
        count = len(views.size)
        for index in range(count):
            began = seconds()
            rgb, every = self._view(variables, views, index)
            frames.append((seconds() - began) * every**2)
            truth, mask = self._truth(index, every)
            found["psnr"].append(_psnr(rgb, truth, mask))
            found["psnr_colors"].append(_psnr(np.asarray(align_colors(rgb, truth, mask=mask)), truth, mask))
            images.append(to_8_bits(rgb))
        if pose:
            chosen = np.unique(np.linspace(0, count - 1, _MOST_FITTED).astype(int))
            fitted = aligned_views(
                views,
                chosen,
                lambda views, index: self._view(variables, views, index)[0],
                lambda index: self._truth(index)[0],
            )
            for index in chosen:
                rgb, every = self._view(variables, fitted, index)
                found["psnr_pose"].append(_psnr(rgb, *self._truth(index, every)))
        return found, images, float(np.median(frames))

    def psnr_of(self, state: Any, split: str) -> list[float]:
        """Returns the PSNR of each view of a split."""
        other = copy.copy(self)
        other._held_out = self._experiment.load_split(split, max_views=_MOST_VIEWS)
        return other.score(state, False)[0]["psnr"]

    def _view(self, variables, views, index):
        """Returns the colours [H, W, 3] of every n-th row and column of a view, and n."""
        height, width = (int(side) for side in views.size[index])
        every = stride(views, index, self._most_pixels)
        pixels = pixel_grid(height, width, offset=self._experiment.config.data.pixel_offset)[::every, ::every]
        return np.asarray(render_pixels(self._run, variables, views, index, pixels)[0].rgb), every

    def _truth(self, index, every=None):
        views = self._held_out
        every = every or stride(views, index, self._most_pixels)
        mask = pixel_mask(views, index)
        mask = None if mask is None else np.asarray(mask)[::every, ::every]
        return np.asarray(views.image(index))[::every, ::every], mask


def _on_one_device(tree):
    return jax.device_put(tree, jax.local_devices()[0])


def _key(values):
    return repr(sorted(values.items()))


def stride(views: Views, index: int, most_pixels: float = _MOST_PIXELS) -> int:
    """Returns n, of whose rows and columns of a view every n-th is scored; 1, all of them, where most_pixels is inf."""
    return max(math.ceil(math.sqrt(float(np.prod(views.size[index])) / most_pixels)), 1)


def _of_steps(data, steps):
    """Returns TrainData whose learning rate and progress end after so many steps."""
    data = data._replace(decay=data.decay._replace(steps=np.float32(steps)))
    return data if data.progress is None else data._replace(progress=data.progress._replace(steps=np.float32(steps)))


def _bytes_of(step: CompiledStep, state: Any) -> float:
    """Returns the bytes of a training step: its state, and what it computes in between."""
    compiled = getattr(step.of(1), "compiled", None)
    stats = compiled.memory_analysis() if hasattr(compiled, "memory_analysis") else None
    between = 0 if stats is None else stats.temp_size_in_bytes
    return float(sum(leaf.nbytes for leaf in jax.tree.leaves(state)) + between)


def _psnr(image, truth, mask=None):
    """Returns the PSNR of an image, dB, at most 100."""
    error = float(mse(np.clip(image, 0, 1), truth, mask=mask))
    return -10 * math.log10(max(error, _LEAST_MSE)) if math.isfinite(error) else 0.0
