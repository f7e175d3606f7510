"""Cases, their checks, and how errors are measured."""

import dataclasses
from collections.abc import Callable

import numpy as np

TINY = 1.2e-38  # below the smallest normal float32, which is 0 on many devices: counts as 0


@dataclasses.dataclass(frozen=True)
class Check:
    """A measured error and its bound."""

    what: str  # for example "weights", or "gradient of colour by density"
    error: float
    bar: float
    kind: str = "value"  # "value", "gradient", "finite", or "chance" for what draws decide

    @property
    def passed(self):
        return self.error <= self.bar  # never with NaN

    def __str__(self):
        return f"{self.what}: error {self.error:.3g}, bar {self.bar:.3g}"


@dataclasses.dataclass(frozen=True)
class Case:
    """One numerical problem of other implementations."""

    family: str
    name: str
    run: Callable[[], list[Check]]  # computes, once a process, and returns what it measured

    def __str__(self):
        return f"{self.family}: {self.name}"


def absolute(got, want):
    """Returns the largest |got - want|: 0 between equal infinities, NaN wherever one is NaN."""
    return _largest(_difference(got, want))


def relative(got, want, *, beyond=TINY):
    """Returns the largest (|got - want| - beyond) / |want|."""
    difference = np.maximum(_difference(got, want) - beyond, 0)
    size = np.abs(np.asarray(want, np.float64))
    with np.errstate(divide="ignore", invalid="ignore"):
        return _largest(np.where(difference == 0, 0, difference / size))


def of_largest(got, want, *, beyond=TINY):
    """Returns the largest |got - want| over the largest |want|: how far a gradient is off."""
    difference = _largest(np.maximum(_difference(got, want) - beyond, 0))
    with np.errstate(divide="ignore"):
        return float(difference / np.float64(np.abs(want).max())) if difference else 0.0


def count(wrong):
    """Returns how many of the conditions hold."""
    return float(np.count_nonzero(wrong))


def not_finite(*arrays):
    """Returns how many numbers of all arrays are not finite."""
    return float(sum(np.count_nonzero(~np.isfinite(array)) for array in arrays))


def _difference(got, want):
    got, want = np.asarray(got, np.longdouble), np.asarray(want, np.longdouble)
    if want.shape not in (got.shape, ()):
        raise ValueError(f"compares {got.shape} with {want.shape}")
    same = got == want
    return np.abs(np.where(same, 0, got) - np.where(same, 0, want))


def _largest(values):
    return float(np.max(values)) if np.size(values) else 0.0
