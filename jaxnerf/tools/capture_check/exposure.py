"""Finds images whose exposure or white balance differs from the others', by the colours of corners that they share."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float, Int

from jaxnerf.data.readers.base import Capture
from jaxnerf.tools.capture_check.findings import Finding
from jaxnerf.tools.capture_check.images import ImageSummary
from jaxnerf.tools.capture_check.tracks import Evidence, fitting_matches

_DARKEST, _BRIGHTEST = 0.03, 0.97  # colours between which 8 bits tell a ratio
_MIN_MATCHES = 40  # of an image with its neighbours, to judge its exposure
_ITERATIONS = 30  # of reweighted least squares
_ROUNDING = 0.02  # of the logarithm of a ratio, below which deviations are all as good
# Logarithms of factors of brightness and of one channel beside the others. From one image to those next to it the
# largest are 0.04, 0.07, 0.02, 0.17, 0.05, 0.07 and 0.02, 0.01, 0.00, 0.04, 0.02, 0.02 in lego, mic, fern, fox, can,
# trex; the standard deviations over all images are 0.05, 0.04, 0.01, 0.13, 0.02, 0.03 and 0.01, 0.01, 0.00, 0.04, 0.01,
# 0.01. In fox, which drifts most, gains are no gain: see tried_without_gain.
_BESIDE, _OVERALL = np.array([0.22, 0.09]), np.array([0.18, 0.08])


def judge_exposure(capture: Capture, images: Sequence[ImageSummary | None], evidence: Evidence) -> list[Finding]:
    """Returns a Finding if the same surfaces are brighter, or of other colours, in some images than in others."""
    factors, count = exposures(images, evidence)
    known = np.flatnonzero(count >= _MIN_MATCHES)
    if len(known) < 3:
        return []
    logs = np.log(factors)
    beside = [np.median(logs[[k for k in evidence.near[view] if k in set(known)] or [view]], axis=0) for view in known]
    off = _brightness_and_tint(logs[known] - beside)
    spread = _brightness_and_tint(logs[known] - logs[known].mean(axis=0))
    varies = (off > _BESIDE).any(axis=0) | (np.sqrt((spread**2).mean(axis=0)) > _OVERALL)
    if not varies.any():
        return []
    level = logs[known].mean(axis=1)
    tint = logs[known, 0] - logs[known, 2]
    parts = []
    for is_odd, values, what in zip(varies, (level, tint), ("brighter", "redder, beside blue,"), strict=True):
        if is_odd:
            most, least = (capture.frames[known[index]].name for index in (values.argmax(), values.argmin()))
            parts.append(f"{np.exp(np.ptp(values)):.2f} times {what} in {most} than in {least}")
    found = f"{capture.source}: exposure or white balance differ: the same surfaces are {' and '.join(parts)}"
    change = "--config.cameras.exposure=True in training, which finds a gain for each image and colour"
    return [Finding("warning", "exposure", found, "one exposure and white balance", change)]


def _brightness_and_tint(logs):
    """Returns [..., 2]: the absolute mean of three channels' logarithms, and the largest deviation from it."""
    mean = logs.mean(axis=-1)
    return np.stack([np.abs(mean), np.abs(logs - mean[..., None]).max(axis=-1)], axis=-1)


def exposures(
    images: Sequence[ImageSummary | None], evidence: Evidence
) -> tuple[Float[np.ndarray, "V 3"], Int[np.ndarray, " V"]]:
    """Computes the factor of each image's colours that explains those of the corners that it shares with others.

    The logarithms of the factors are those with the least sum of absolute deviations (by reweighted least squares), so
    that highlights, shadows and wrong matches hardly count.

    Returns:
        Factors [V, 3] of red, green and blue, of which the median is 1; and the number of matches of each image.
    """
    views, others, ratios = [], [], []
    for view, near in enumerate(evidence.near):
        for other in near:
            first, second = fitting_matches(evidence, view, int(other))
            one, two = evidence.keypoints[view].colors[first], evidence.keypoints[other].colors[second]
            good = ((np.minimum(one, two) > _DARKEST) & (np.maximum(one, two) < _BRIGHTEST)).all(axis=1)
            views.append(np.full(good.sum(), view))
            others.append(np.full(good.sum(), other))
            ratios.append(np.log(one[good]) - np.log(two[good]))
    views, others = (np.concatenate([*each, np.zeros(0, int)]).astype(int) for each in (views, others))
    ratios = np.concatenate([*ratios, np.zeros((0, 3))])
    count = len(images)
    logs = np.stack([_solve(views, others, ratio, count) for ratio in ratios.T], axis=-1)
    return np.exp(logs - np.median(logs, axis=0)), np.bincount(views, minlength=count) + np.bincount(
        others, minlength=count
    )


def _solve(views, others, ratio, count):
    """Returns the logarithms x [V] with the least sum of |x[views] - x[others] - ratio|."""
    x = np.zeros(count)
    for _ in range(_ITERATIONS):
        weight = 1 / np.maximum(np.abs(x[views] - x[others] - ratio), _ROUNDING)
        matrix = 1e-6 * np.eye(count)  # images without matches stay at 0
        for one, two, sign in ((views, views, 1), (others, others, 1), (views, others, -1), (others, views, -1)):
            np.add.at(matrix, (one, two), sign * weight)
        right = np.bincount(views, weight * ratio, count) - np.bincount(others, weight * ratio, count)
        x = np.linalg.solve(matrix, right)
    return x
