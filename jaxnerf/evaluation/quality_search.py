"""The cheapest way to render a trained model that stays within an error."""

import sys
import time
from typing import NamedTuple

import numpy as np

from jaxnerf.data.ray_batches import random_rays
from jaxnerf.evaluation.evaluate import claim_target
from jaxnerf.evaluation.restore import newest_step, restore_run

_EXACT = {
    "sample_multiplier": 4.0,
    "early_stop_eps": 0.0,
    "bake_occupancy": False,
}  # what the error is measured against
_SAMPLES = (1.0, 0.7, 0.5, 0.35, 0.25)
_STOPS = (1e-3, 1e-2, 3e-2, 1e-1)


class Choice(NamedTuple):
    """One way to render, and what it costs."""

    settings: dict  # of the configuration's eval section
    error: float  # root of the mean square, over colours, of the difference from the exact rendering
    seconds: float  # for the rays that were tried


def choose(folder, error_budget, *, config=None, split=None, step=None, chunk=None, overwrite=False):
    """Returns the settings of cheapest_settings for evaluate, and prints what was tried and picked."""
    # The search takes a while, so what would end the scoring after it comes first.
    claim_target(restore_run(folder, config), folder, split=split, step=step, overwrite=overwrite)
    options = {"config": config, "split": split, "step": step, "chunk": chunk}
    choice, tried = cheapest_settings(folder, error_budget, **options)
    for other in tried:
        print(f"{_text(other)}{'  <- picked' if other is choice else ''}", file=sys.stderr)
    return choice.settings


def _text(choice):
    settings = ", ".join(f"{name} {value}" for name, value in choice.settings.items())
    return f"RMS error {choice.error:.5f} in {choice.seconds:.3f} s: {settings}"


def cheapest_settings(folder, error_budget, *, config=None, split=None, step=None, chunk=None, num_rays=4096):
    """Returns the cheapest Choice within a budget, and all that were tried.

    Tried on rays through random pixels of a split's views, of which only the cameras count: the error is that
    against the same model's own rendering with four times the samples, no stop, and nothing skipped but what
    it was trained to skip.

    Args:
        folder: the workdir.
        error_budget: in units of colour, of [0, 1].
        config: see open_run.
        split: views held out of training; the configuration's eval.split when None.
        step: of the checkpoint; the newest when None.
        chunk: rays at once, see evaluate; of the exact rendering as many fewer as it has more samples.
        num_rays: to try on.

    Returns:
        Choice, and a list of Choices in the order in which they were tried.

    Raises:
        ValueError: if none is within the budget; says how near the best comes.
    """
    exact = restore_run(folder, config, settings=_EXACT)
    split = split or exact.experiment.eval.split
    experiment = exact.experiment
    rays = random_rays(
        experiment.load_split(split), num_rays, experiment.view_rays, pixel_offset=experiment.pixel_offset
    )
    step = newest_step(exact, folder, step)
    chunk = experiment.eval.chunk if chunk is None else chunk
    fewer = -(-chunk // int(_EXACT["sample_multiplier"]))
    truth = np.asarray(exact.render_image(exact.variables(step), rays, chunk=min(fewer, num_rays)).rgb)
    tried, variables = [], {}

    def attempt(settings):
        run = restore_run(folder, config, settings=settings)
        if settings["bake_occupancy"] not in variables:  # neither samples nor stop change them
            variables[settings["bake_occupancy"]] = run.variables(step)
        rgb, seconds = _render(run, variables[settings["bake_occupancy"]], rays, min(chunk, num_rays))
        tried.append(Choice(settings, float(np.sqrt(np.mean((rgb - truth) ** 2))), seconds))
        return tried[-1].error <= error_budget

    skips = exact.experiment.model.grid_schedule is not None
    for bake_occupancy in (False,) if skips else (False, True):
        _descend(attempt, tried, bake_occupancy, stops=_STOPS if skips or bake_occupancy else _STOPS[:1])
    within = [choice for choice in tried if choice.error <= error_budget]
    if not within:
        best = min(tried, key=lambda choice: choice.error)
        raise ValueError(
            f"{folder}: no settings stay within {error_budget:g}; the nearest, {best.settings}, differ by "
            f"{best.error:.2g}: allow that, or train with more samples"
        )
    return min(within, key=lambda choice: choice.seconds), tried


def _descend(attempt, tried, bake_occupancy, stops):
    """Tries fewer and fewer samples, and with the fewest that do, earlier and earlier stops."""
    fewest = _SAMPLES[0]
    for samples in _SAMPLES:
        if not attempt({"sample_multiplier": samples, "early_stop_eps": stops[0], "bake_occupancy": bake_occupancy}):
            break
        fewest = samples
    for stop in stops[1:]:
        if not attempt({"sample_multiplier": fewest, "early_stop_eps": stop, "bake_occupancy": bake_occupancy}):
            break


def _render(run, variables, rays, chunk):
    """Returns colours [N, 3] and the seconds that they took, compilation not counted."""
    rgb, seconds = run.render_image(variables, rays, chunk=chunk).rgb, []
    for _ in range(3):
        started = time.perf_counter()
        run.render_image(variables, rays, chunk=chunk)
        seconds.append(time.perf_counter() - started)
    return np.asarray(rgb), min(seconds)
