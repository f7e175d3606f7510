"""The estimators of error that `--uncertainty` selects by name, and the function that adds one."""

from collections.abc import Callable
from typing import Any

from jaxnerf.registry import Registry

ESTIMATORS = Registry(
    "estimator of uncertainty",
    "jaxnerf.register_estimator",
    {
        "laplace": "jaxnerf.tools.uncertainty.laplace:estimate_laplace",
        "ensemble": "jaxnerf.tools.uncertainty.ensemble:estimate_ensemble",
    },
)


def register_estimator(name: str, estimate: Callable[..., Any]) -> None:
    """Registers an estimator of the error of each pixel under a name for `--uncertainty`.

    Args:
        name: of the estimator.
        estimate: (source: UncertaintySource) -> Estimate, see `jaxnerf.extend.UncertaintySource` and `Estimate`.

    Raises:
        ValueError: if another estimator has that name.
    """
    ESTIMATORS.add(name, estimate)
