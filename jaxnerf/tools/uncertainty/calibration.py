"""Errors from raw scores: a monotone map and a conformal factor, both from views that were not trained on."""

import json
import math
import pathlib
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Bool

from jaxnerf.core.views import Views
from jaxnerf.runtime import atomic_files

_NUM_BINS = 50
_LEAST_ERROR = 1 / (255 * 12**0.5)  # the standard deviation of rounding to 8 bits
_FIGURES = ("coverage", "interval", "ause_rmse", "ause_mae", "ause_rmse_object", "ause_mae_object")
_AGAIN = "remove it, and the same command calibrates again"


class Calibration(NamedTuple):
    """Turns raw scores into errors.

    Attributes:
        scores: [M] ascending.
        errors: [M] ascending, the RMS error of pixels of such a score; linear in between, proportional to the score
            outside.
        factor: the error of a pixel is at most this times its predicted RMS error, with probability `coverage`.
        coverage: in (0, 1).
        num_pixels: that the factor was found from.
        views: names of the images.
    """

    scores: tuple[float, ...]
    errors: tuple[float, ...]
    factor: float
    coverage: float
    num_pixels: int
    views: tuple[str, ...]

    def predicted(self, score: ArrayLike) -> np.ndarray:
        """Returns the predicted RMS error [...] of scores [...], in units of colour."""
        score = np.asarray(score, np.float64)
        first, last = self.scores[0], self.scores[-1]
        error = np.interp(score, self.scores, self.errors)
        beyond = np.where(score > last, score / max(last, 1e-12), 1.0)
        below = np.where(score < first, score / max(first, 1e-12), 1.0)
        return np.maximum(error * beyond * below, _LEAST_ERROR).astype(np.float32)

    def interval(self, score: ArrayLike) -> np.ndarray:
        """Returns half the width [...] of the interval that holds a pixel's error with probability `coverage`."""
        return (self.factor * self.predicted(score)).astype(np.float32)


def pixel_error(rgb: ArrayLike, truth: ArrayLike) -> np.ndarray:
    """Returns the error [...] of colours [..., 3]: the RMS over their channels."""
    return np.sqrt(((np.clip(np.asarray(rgb), 0, 1) - np.asarray(truth)) ** 2).mean(axis=-1))


def object_mask(views: Views, index: int) -> Bool[np.ndarray, "H W"] | None:
    """Returns which pixels of one of Views show the object, by alpha above a half; None without alpha."""
    if views.pixels.shape[-1] != 4:
        return None
    (height, width), first = views.size[index], int(views.offset[index])
    alpha = np.asarray(views.pixels[first : first + height * width, 3]).reshape(height, width)
    return alpha > np.iinfo(alpha.dtype).max // 2


def calibrate(
    scores: Sequence[ArrayLike], errors: Sequence[ArrayLike], views: Sequence[str], coverage: float = 0.9
) -> Calibration:
    """Calibrates by split conformal prediction: every second view gives the map, the others the factor.

    The map is the RMS error by score, made monotone (isotonic regression of the means of bins with equally many
    pixels), so that it keeps the order of the scores. Pixels of equal scores, as those of culled rays have, stay
    together: a score that fills a bin has one of its own, and the map has the RMS error of that bin there. A
    constant factor then gives the predicted errors of all views the mean square of the true ones: all views
    together tell the level of the errors better than half of them, and the intervals do not depend on it. With n
    pixels of the other views the factor is the ceil((n + 1) coverage)-th smallest ratio of error and predicted
    error. A new pixel from the same distribution is then within the interval with at least that probability
    (arXiv:1604.04173). Pixels of one view are alike, so that the coverage of a single view differs from it by more
    than its number of pixels suggests.

    Args:
        scores, errors: of each view, [N] each.
        views: names.
        coverage: in (0, 1).

    Raises:
        ValueError: with fewer than two views, a score that is not finite, or too few pixels for the coverage.
    """
    if not 0 < coverage < 1:
        raise ValueError(f"coverage is {coverage}, expected a number between 0 and 1, such as 0.9; correct --coverage")
    if len(scores) < 2:
        raise ValueError(
            f"calibration has {len(scores)} views, expected at least 2; lower data.hold_out and train again"
        )
    scores, errors = ([np.ravel(np.asarray(each, np.float64)) for each in values] for values in (scores, errors))
    for name, found in zip(views, scores, strict=True):
        if not np.isfinite(found).all():
            raise ValueError(f"{name}: has scores that are not finite, so nothing can be calibrated; check the run")
    bins, known = _monotone(np.concatenate(scores[::2]), np.concatenate(errors[::2]))
    count = sum(found.size for found in scores[1::2])
    rank = math.ceil((count + 1) * coverage)
    if rank > count:
        raise ValueError(f"calibration has {count} pixels, too few for a coverage of {coverage}; lower --coverage")
    draft = Calibration(bins, known, 1.0, coverage, count, tuple(views))
    draft = draft._replace(errors=_scaled(known, draft.predicted(np.concatenate(scores)), np.concatenate(errors)))
    ratio = np.concatenate(errors[1::2]) / draft.predicted(np.concatenate(scores[1::2]))
    return draft._replace(factor=float(np.partition(ratio, rank - 1)[rank - 1]))


def _scaled(known, predicted, errors):
    """Returns the errors of a map, scaled so that the predicted errors have the mean square of the true ones."""
    scale = np.sqrt((errors**2).mean() / (predicted.astype(np.float64) ** 2).mean())
    return tuple(np.maximum(scale * np.array(known), _LEAST_ERROR).tolist())


def _monotone(scores, errors):
    """Returns (scores, errors) of bins, ascending: their mean scores and RMS errors, neighbours out of order merged.

    Where bins of one score each are merged, the result has the error at the first and the last of these scores.
    """
    order = np.argsort(scores, kind="stable")
    merged = []  # [sum of squared errors, sum of scores, count], and the [first, last] of the bins of one score
    for part in np.split(order, _bin_starts(scores[order])[1:]):
        alone = len(part) > 1 and scores[part[0]] == scores[part[-1]]
        ends = [scores[part[0]]] * 2 if alone else [np.inf, -np.inf]
        merged.append(([np.square(errors[part]).sum(), scores[part].sum(), part.size], ends))
        while len(merged) > 1 and merged[-2][0][0] / merged[-2][0][2] >= merged[-1][0][0] / merged[-1][0][2]:
            (sums, ends), (more, others) = merged[-2:]
            sums = [sum(pair) for pair in zip(sums, more, strict=True)]
            merged[-2:] = [(sums, [min(ends[0], others[0]), max(ends[1], others[1])])]
    points = []
    for (squares, total, count), (first, last) in merged:
        at = {first: None, last: None} if first <= last else {total / count: None}
        points += [(float(score), max(math.sqrt(squares / count), _LEAST_ERROR)) for score in at]
    return tuple(zip(*points, strict=True))


def _bin_starts(ascending):
    """Returns where the bins of ascending scores begin: equally many in each, but no score is in two of them."""
    size, bins = ascending.size, min(_NUM_BINS, ascending.size)
    starts = np.cumsum([0, *map(len, np.array_split(ascending, bins))])[:-1]
    first, end = (np.searchsorted(ascending, ascending[starts], side) for side in ("left", "right"))
    fills = end - first >= size / bins
    # A boundary inside of equal scores moves to their start, or, if these fill a bin, one is at both of their ends.
    return np.unique([0, *first, *end[fills & (end < size)]])


def sparsification(error: ArrayLike, score: ArrayLike, *, num_fractions: int = 100) -> dict[str, float]:
    """Computes the areas under the sparsification error, AUSE (as in arXiv:1802.07095), of one image.

    The pixels of the largest scores are removed, a fraction f at a time. The RMSE, or the mean error, of those that
    are left falls as f grows, and most if the scores sort the pixels as their errors do. AUSE is the mean over f of the
    difference from that best order, in units of the RMSE, or mean error, of the whole image: 0 is best.

    Args:
        error: [N], >= 0.
        score: [N]. Pixels of equal scores are removed in a random order.
        num_fractions: of f, evenly in [0, 1).

    Returns:
        "ause_rmse" and "ause_mae"; 0 for an image without any error.
    """
    error, score = np.ravel(np.asarray(error, np.float64)), np.ravel(np.asarray(score, np.float64))
    shuffled = np.random.default_rng(0).permutation(error.size)
    kept = error.size - (np.arange(num_fractions) * error.size) // num_fractions

    def curve(values, order):
        return (np.cumsum(values[order]) / np.arange(1, error.size + 1))[kept - 1]

    by_score, by_error = shuffled[np.argsort(score[shuffled], kind="stable")], np.argsort(error, kind="stable")
    found = {}
    for name, values, root in (("ause_rmse", error**2, np.sqrt), ("ause_mae", error, np.abs)):
        whole = root(values.mean())
        found[name] = float((root(curve(values, by_score)) - root(curve(values, by_error))).mean() / max(whole, 1e-12))
    return found


def score_order(
    error: ArrayLike, score: ArrayLike, kept: ArrayLike, on_object: ArrayLike | None = None
) -> dict[str, float]:
    """Computes the figures of `sparsification` of an image, and of its object alone.

    Around an object the background is known, so that any score that finds the object has a small AUSE.

    Args:
        error, score: [H, W].
        kept: [H, W] bool, the pixels that count.
        on_object: [H, W] bool, those of them that show the object; None: unknown.

    Returns:
        "ause_rmse" and "ause_mae"; and "ause_rmse_object" and "ause_mae_object" where at least two pixels show it.
    """
    error, score, kept = (np.asarray(each) for each in (error, score, kept))
    row = sparsification(error[kept], score[kept])
    chosen = kept & np.asarray(on_object, bool) if on_object is not None else np.zeros_like(kept)
    if chosen.sum() > 1:
        row |= {f"{name}_object": each for name, each in sparsification(error[chosen], score[chosen]).items()}
    return row


def save(path: pathlib.Path, calibration: Calibration, key: str) -> None:
    """Writes a calibration unless there is one: of processes that share a folder, the first one decides for all.

    Args:
        path: of the file.
        calibration: to write.
        key: text that is equal for the same checkpoint and estimate.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    atomic_files.write_text_once(path, json.dumps({"key": key, **calibration._asdict()}, indent=1) + "\n")


def load(path: pathlib.Path, key: str) -> Calibration:
    """Reads a calibration.

    Raises:
        ValueError: if it is damaged, or that of another checkpoint or estimate.
    """
    content = atomic_files.read_json(path, _AGAIN)
    if not isinstance(content, dict) or set(content) != {"key", *Calibration._fields}:
        raise ValueError(f"{path}: is damaged, expected what jaxnerf-eval --uncertainty writes; {_AGAIN}")
    if content.pop("key") != key:
        raise ValueError(f"{path}: was calibrated for other parameters, another field or other members; {_AGAIN}")
    try:
        found = Calibration(**{name: tuple(v) if isinstance(v, list) else v for name, v in content.items()})
        numbers = [*found.scores, *found.errors, found.factor, found.coverage, found.num_pixels]
        valid = all(type(number) in (int, float) and 0 <= number < math.inf for number in numbers)
        valid = valid and len(found.scores) == len(found.errors) > 0 and found.coverage < 1
        valid = valid and all(list(each) == sorted(each) for each in (found.scores, found.errors))
        valid = valid and all(isinstance(name, str) for name in found.views)
    except TypeError:
        valid = False
    if not valid:
        raise ValueError(f"{path}: is damaged, expected numbers of at least 0, in ascending order; {_AGAIN}")
    return found


def figures(rows: Sequence[dict[str, Any]]) -> dict[str, float]:
    """Returns the means over the images of the figures of `Predictor.scored` that all of them have."""
    names = [name for name in _FIGURES if all(name in row for row in rows)]
    return {name: float(np.mean([row[name] for row in rows])) for name in names}
