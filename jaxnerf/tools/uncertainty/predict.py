"""Predicts the error of each pixel of a trained run: an estimator, calibrated where the run has held-out views."""

import functools
import os
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from jax.typing import ArrayLike

from jaxnerf.core.cameras import pixel_grid
from jaxnerf.core.types import Rays
from jaxnerf.core.views import Views
from jaxnerf.evaluation.metrics import pixel_mask
from jaxnerf.evaluation.restore import TrainedRun, newest_step, refined_views
from jaxnerf.options import is_auto
from jaxnerf.runtime import stages
from jaxnerf.runtime.fingerprint import fingerprint
from jaxnerf.tools.uncertainty import calibration as calibrations
from jaxnerf.tools.uncertainty.base import Score, UncertaintySource
from jaxnerf.tools.uncertainty.calibration import Calibration, object_mask, pixel_error, score_order
from jaxnerf.tools.uncertainty.cleaning import MAX_UNCERTAINTY
from jaxnerf.tools.uncertainty.one_at_a_time import one_at_a_time
from jaxnerf.tools.uncertainty.registration import ESTIMATORS


class Predictor(NamedTuple):
    """Predicts errors of one checkpoint.

    Attributes:
        name: of the estimator.
        score: see `Estimate`.
        calibration: None without held-out views; a predicted error is then the raw score.
        identity: text that is equal for predictors that predict the same.
    """

    name: str
    score: Score
    calibration: Calibration | None
    identity: str

    def error(self, rays: Rays) -> np.ndarray:
        """Returns the predicted RMS error [...] of the colours of Rays [...]."""
        return self._error(self._score(rays))

    def _score(self, rays):
        with stages.stage("predicting the errors"):
            return np.asarray(self.score(rays))

    def _error(self, score):
        return np.float32(score) if self.calibration is None else self.calibration.predicted(score)

    def scored(
        self,
        rays: Rays,
        rgb: ArrayLike,
        truth: ArrayLike,
        views: Views,
        index: int,
    ) -> tuple[np.ndarray, dict]:
        """Predicts the errors of an image, and compares them with its true errors.

        Args:
            rays: Rays [H, W].
            rgb, truth: [H, W, 3].
            views, index: that the image shows, for its mask and its alpha.

        Returns:
            The predicted errors [H, W]; and the figures of `score_order`, with a calibration "coverage", the
            fraction of pixels whose errors are within their intervals, and "interval", the mean half width.
        """
        score, error = self._score(rays), pixel_error(rgb, truth)
        mask = pixel_mask(views, index)
        kept = np.ones(error.shape, bool) if mask is None else np.asarray(mask, bool)
        row = score_order(error, score, kept, object_mask(views, index))
        if self.calibration is not None:
            width = self.calibration.interval(score)
            row |= {"coverage": float((error <= width)[kept].mean()), "interval": float(width[kept].mean())}
        return self._error(score), row

    def summary(self, rows: Sequence[dict[str, Any]]) -> dict[str, Any]:
        """Returns what results.json holds about the figures of its images."""
        target = None if self.calibration is None else self.calibration.coverage
        return {"estimator": self.name, "target_coverage": target, **calibrations.figures(rows)}


def line(results: Mapping[str, Any]) -> str | None:
    """Returns the line that sums up the predicted errors of results.json; None without any."""
    found = results.get("uncertainty")
    if not found:
        return None
    text = f"predicted errors: AUSE {found['ause_rmse']:.3f} (RMSE), {found['ause_mae']:.3f} (MAE)"
    if "ause_rmse_object" in found:
        text += f", on the object {found['ause_rmse_object']:.3f}, {found['ause_mae_object']:.3f}"
    if "coverage" in found:
        target = f"{100 * found['target_coverage']:g} %"
        text += f", {100 * found['coverage']:.1f} % of errors within intervals for {target}"
    return text


def requested(
    name: str | None,
    workdir: str | os.PathLike | None,
    *,
    step: int | None = None,
    members: Sequence[str] | None = None,
    coverage: float = 0.9,
) -> Callable[[TrainedRun], Predictor] | None:
    """Returns the function that makes the Predictor that the flags of a program ask for; None without --uncertainty.

    Args:
        name: of the estimator, or None.
        workdir, step, members, coverage: see `make_predictor`.

    Raises:
        ValueError: on a wrong flag, before anything is read.
    """
    if not 0 < coverage < 1:
        raise ValueError(f"--coverage is {coverage}, expected a number between 0 and 1, such as 0.9; correct it")
    if name is None:
        if members:
            raise ValueError("--members is given without --uncertainty=ensemble; add that, or drop --members")
        return None
    ESTIMATORS.get(name)
    options = {"step": step, "members": members or (), "coverage": coverage}
    return functools.partial(make_predictor, workdir=workdir, name=name, **options)


def make_predictor(
    run: TrainedRun,
    workdir: str | os.PathLike,
    name: str,
    *,
    step: int | None = None,
    members: Sequence[str] = (),
    coverage: float = 0.9,
    say: Callable[[str], None] = print,
) -> Predictor:
    """Makes the Predictor of a checkpoint, calibrated on the views that `data.hold_out` kept from training.

    The calibration is written to <workdir>/uncertainty/STEP/NAME.json, and read again if it fits. Of several processes,
    such as the shards of an evaluation, one calibrates, and the others wait for it. A run without held-out views has no
    calibration, which is said.

    Args:
        run: restored from the workdir.
        workdir: the run's folder.
        name: of the estimator.
        step: of the checkpoint; the newest when None.
        members: see `UncertaintySource`.
        coverage: of the intervals, in (0, 1).
        say: called with each line for the user.

    Raises:
        ValueError: if there is no such estimator or checkpoint, or the stored calibration is that of another.
    """
    estimate = ESTIMATORS.get(name)
    step = newest_step(run, workdir, step)
    variables = run.variables(step)
    source = UncertaintySource.of(run, workdir, step, variables, members=members, say=say)
    key = fingerprint(run.identity, variables[0], *([] if variables[1] is None else [variables[1]]))
    path, limit = source.folder / f"{name}.json", run.settings.get(MAX_UNCERTAINTY)
    if limit is not None:
        path = path.with_stem(f"{name}-max_uncertainty-{limit if is_auto(limit) else f'{limit:g}'}")
    with one_at_a_time(path.with_suffix(".lock"), lambda: say(f"{path}: waits for another process")):
        found = estimate(source)
        key = fingerprint(key, found.identity)
        known = calibrations.load(path, key) if path.is_file() else None
        if known is not None and known.coverage != coverage:
            say(f"{path}: was calibrated for a coverage of {known.coverage:g}, and is calibrated again")
            path.unlink()
            known = None
        if known is None and run.experiment.config.data.hold_out:
            calibrations.save(path, _calibrate(run, variables, found.score, coverage), key)
            known = calibrations.load(path, key)
    if known is None:
        say(
            f"uncertainty: {name}, not calibrated, as no views were held out; "
            "train with --config.data.hold_out=8 for errors that are calibrated"
        )
    else:
        say(
            f"uncertainty: {name}, calibrated on {len(known.views)} held-out views; {100 * known.coverage:g} % of "
            f"errors are expected within {known.factor:.2f} times the predicted one"
        )
    identity = f"{name} {key} {known.factor if known else 'uncalibrated'} {coverage}"
    return Predictor(name, found.score, known, fingerprint(identity))


def _calibrate(run, variables, score, coverage):
    """Calibrates a score on the split "held_out"."""
    experiment = run.experiment
    views: Views = refined_views(run, experiment.load_split("held_out"), "held_out", variables[0])
    scores, errors, render = [], [], functools.partial(run.render_image, variables)
    with stages.stage("calibrating the uncertainty on held-out images") as stage:
        for index in range(len(views.names)):
            stage.update(index, len(views.names))
            height, width = (int(side) for side in views.size[index])
            pixels = pixel_grid(height, width, offset=experiment.config.data.pixel_offset)
            rays = experiment.view_rays(views, index, pixels)
            kept = pixel_mask(views, index)
            kept = np.ones((height, width), bool) if kept is None else np.asarray(kept, bool)
            scores.append(np.asarray(score(rays))[kept])
            errors.append(pixel_error(render(rays).rgb, views.image(index))[kept])
    return calibrations.calibrate(scores, errors, views.names, coverage)
