"""Verdicts about parts from paired trials, and which trial comes next.

Trials race as in Moore and Lee, "Efficient algorithms for minimizing cross validation error" (ICML 1994), after the
Hoeffding races of Maron and Moore (NIPS 1993): all variants are compared with the complete model on the same seeds and
views, and only those whose verdict is open get further trials. The number of seeds doubles from one look to the
next, as in successive halving (Karnin et al., ICML 2013).

The interval is that of the mean paired difference over seeds and views, both random: its variance is that of the means
over views divided by the number of seeds, plus that of the means over seeds divided by the number of views, which
counts what they share twice. A few seeds estimate their own variance badly, so it is moderated by that of the other
variants (Smyth, Statistical Applications in Genetics and Molecular Biology 2004). The level is divided by the number of
looks.
"""

import math
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

NEEDED, NOT_NEEDED, OPEN = "needed", "not needed", "cannot tell"
LOOKS = (2, 4, 8)  # numbers of seeds after which a verdict is sought
_PRIOR = 4.0  # degrees of freedom that the other variants' variance counts
_LEVEL = 0.05  # of each end of the interval, over all looks


class Effect(NamedTuple):
    """What a part contributes: the complete model's score less that without it; or what adding it gains.

    Attributes:
        mean: dB.
        lower, upper: the ends of the interval, dB; infinite where nothing is known of the seeds' variance.
        seeds, views: their numbers.
    """

    mean: float
    lower: float
    upper: float
    seeds: int
    views: int

    def verdict(self, margin: float) -> str:
        """Returns whether the part is needed: whether it contributes at least the margin, dB.

        One seed decides nothing, as training may have failed with it.
        """
        if self.seeds < LOOKS[0]:
            return OPEN
        if self.lower >= margin:
            return NEEDED
        return NOT_NEEDED if self.upper < margin else OPEN


def effects(differences: Mapping[str, Float[np.ndarray, "_ _"]]) -> dict[str, Effect]:
    """Computes the effect of each part.

    Args:
        differences: by variant, dB [seeds, views] of its part's contribution.
    """
    pooled, degrees = _pooled(differences.values())
    return {name: _effect(each, pooled, degrees) for name, each in differences.items()}


def _effect(found, pooled, degrees):
    from scipy import stats  # jax depends on it

    num_seeds, num_views = found.shape
    mean, own = float(found.mean()), num_seeds - 1
    prior = min(_PRIOR, degrees)
    if not prior + own or num_views < 2:
        return Effect(mean, -math.inf, math.inf, num_seeds, num_views)
    variance = float(found.mean(axis=1).var(ddof=1)) if own else 0.0
    of_seeds = (prior * pooled + own * variance) / (prior + own) / num_seeds
    of_views = float(found.mean(axis=0).var(ddof=1)) / num_views
    total = of_seeds + of_views
    if total <= 0:
        return Effect(mean, mean, mean, num_seeds, num_views)
    # Satterthwaite's degrees of freedom of a sum of variances.
    freedom = total**2 / (of_seeds**2 / (prior + own) + of_views**2 / (num_views - 1))
    half = float(stats.t.ppf(1 - _LEVEL / len(LOOKS), freedom)) * math.sqrt(total)
    return Effect(mean, mean - half, mean + half, num_seeds, num_views)


def _pooled(found) -> tuple[float, float]:
    """Returns a typical variance over seeds of the means over views, and its degrees of freedom.

    It is a median, so that a variant that fails to train with some seed does not hide all others.
    """
    from scipy import stats

    several = [each for each in found if len(each) > 1]
    if not several:
        return 0.0, 0.0
    scaled = []
    for each in several:
        freedom = len(each) - 1
        scaled.append(float(each.mean(axis=1).var(ddof=1)) * freedom / float(stats.chi2.median(freedom)))
    return float(np.median(scaled)), float(sum(len(each) - 1 for each in several))


def next_trial(done: Mapping[str, int], open_parts: Sequence[str], base: str) -> tuple[str, int] | None:
    """Returns the variant and the seed of the next trial; None where no verdict is open, or no look is left.

    Args:
        done: by variant, how many seeds have been tried, 0 for the first ones.
        open_parts: the variants whose verdict is open, those to be tried first in front.
        base: the variant that the others are compared with; it comes first in each round.
    """
    waiting = [name for name in open_parts if done.get(name, 0) < LOOKS[-1]]
    if not waiting:
        return None
    fewest = min(done.get(name, 0) for name in waiting)
    if done.get(base, 0) <= fewest:
        return base, done.get(base, 0)
    return next(name for name in waiting if done.get(name, 0) == fewest), fewest
