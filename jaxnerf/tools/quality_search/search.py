"""Searches for the cheapest settings that render a trained model within an error."""

import os
import sys
import time
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np

from jaxnerf.data.ray_batches import random_rays
from jaxnerf.evaluation.evaluate import result_folder
from jaxnerf.evaluation.restore import TrainedRun, newest_step
from jaxnerf.runtime import stages

# What the error is measured against.
_EXACT = {"sample_multiplier": 4.0, "early_stop_eps": 0.0, "bake_occupancy": False}
_FRACTIONS = (1.0, 0.7, 0.5, 0.35, 0.25)  # of the run's own sample multiplier
_EARLY_STOP_EPS = (1e-3, 1e-2, 3e-2, 1e-1)


class Candidate(NamedTuple):
    """One way to render, and what it costs.

    Attributes:
        settings: of the config's section `eval`.
        error: root mean square, over colours, of the difference from the exact rendering.
        seconds: for the rays that were rendered.
    """

    settings: dict[str, Any]
    error: float
    seconds: float


def choose(
    workdir: str | os.PathLike,
    restore: Callable[..., TrainedRun],
    error_budget: float,
    *,
    split: str | None = None,
    step: int | None = None,
    overwrite: bool = False,
) -> dict[str, Any]:
    """Returns the settings of `cheapest_settings` for evaluation, and prints all candidates."""
    # The search takes a while, so errors that would end the later evaluation are raised first.
    result_folder(restore(), workdir, split=split, step=step, overwrite=overwrite)
    with stages.stage("searching settings within the error budget"):
        best, candidates = cheapest_settings(workdir, restore, error_budget, split=split, step=step)
    for candidate in candidates:
        tried = ", ".join(f"{name} {value}" for name, value in candidate.settings.items())
        line = f"RMS error {candidate.error:.5f} in {candidate.seconds:.3f} s: {tried}"
        print(f"{line}{'  <- chosen' if candidate is best else ''}", file=sys.stderr)
    return best.settings


def cheapest_settings(
    workdir: str | os.PathLike,
    restore: Callable[..., TrainedRun],
    error_budget: float,
    *,
    split: str | None = None,
    step: int | None = None,
    num_rays: int = 4096,
    sample_multipliers: Sequence[float] | None = None,
    early_stop_eps: Sequence[float] = _EARLY_STOP_EPS,
) -> tuple[Candidate, list[Candidate]]:
    """Returns the cheapest candidate within a budget, and all candidates.

    Candidates render rays through random pixels of a split's views, of which only the cameras are used. The
    error is the difference from the same model's own rendering with four times the samples, no early
    termination, and no grid but the one that the model was trained with.

    Args:
        workdir: the folder that training wrote.
        restore: () -> the run; given settings of the config's section `eval` by name, with these. The exact rendering
            takes smaller chunks than its `chunk`, as it has more samples.
        error_budget: in units of colour, in [0, 1].
        split: of views; the config's eval.split when None.
        step: of the checkpoint; the newest when None.
        num_rays: to render.
        sample_multipliers, early_stop_eps: values of the settings to try, in this order; the first are the most
            exact. None: fractions of the run's own eval.sample_multiplier, from 1 down to a quarter.

    Returns:
        The Candidate, and all in the order in which they were rendered.

    Raises:
        ValueError: if none is within the budget; says how close the best comes.
    """
    if sample_multipliers is None:
        multiplier = restore().experiment.config.eval.sample_multiplier
        sample_multipliers = [multiplier * fraction for fraction in _FRACTIONS]
    exact = restore(_EXACT)
    experiment = exact.experiment
    views = experiment.load_split(split or experiment.config.eval.split)
    rays = random_rays(views, num_rays, experiment.view_rays, pixel_offset=experiment.config.data.pixel_offset)
    step = newest_step(exact, workdir, step)
    smaller_chunk = -(-experiment.config.eval.chunk // int(_EXACT["sample_multiplier"]))
    exact_variables = exact.variables(step)
    truth = np.asarray(exact.render_image(exact_variables, rays, chunk=smaller_chunk).rgb)
    candidates, variables = [], {False: exact_variables}

    def is_within(multiplier, eps, bake):
        tried = {"sample_multiplier": multiplier, "early_stop_eps": eps, "bake_occupancy": bake}
        run = restore(tried)
        if bake not in variables:  # the other settings do not change them
            variables[bake] = run.variables(step)
        rgb, seconds = _render(run, variables[bake], rays)
        candidates.append(Candidate(tried, float(np.sqrt(np.mean((rgb - truth) ** 2))), seconds))
        return candidates[-1].error <= error_budget

    has_grid = experiment.model.grid_schedule is not None
    for bake in (False,) if has_grid else (False, True):
        # Without a grid there is no early termination.
        _search(is_within, sample_multipliers, early_stop_eps if has_grid or bake else early_stop_eps[:1], bake)
    return _fastest(candidates, error_budget, workdir), candidates


def _search(is_within, sample_multipliers, early_stop_eps, bake):
    """Lowers the number of samples while the error allows it, then raises early_stop_eps."""
    lowest = sample_multipliers[0]
    for multiplier in sample_multipliers:
        if not is_within(multiplier, early_stop_eps[0], bake):
            break
        lowest = multiplier
    for eps in early_stop_eps[1:]:
        if not is_within(lowest, eps, bake):
            break


def _fastest(candidates, error_budget, workdir):
    within = [candidate for candidate in candidates if candidate.error <= error_budget]
    if not within:
        best = min(candidates, key=lambda candidate: candidate.error)
        raise ValueError(
            f"{workdir}: no settings stay within {error_budget:g}; the closest, {best.settings}, differ by "
            f"{best.error:.2g}: allow that, or train with more samples"
        )
    return min(within, key=lambda candidate: candidate.seconds)


def _render(run, variables, rays):
    """Returns colours [N, 3] and the seconds that they took, without compilation."""
    rgb, seconds = run.render_image(variables, rays).rgb, []
    for _ in range(3):
        started = time.perf_counter()
        run.render_image(variables, rays)
        seconds.append(time.perf_counter() - started)
    return np.asarray(rgb), min(seconds)
