"""The table of bounds, bounds.json: of each row and column the largest error found, its bound, and the input."""

import json
import pathlib
from typing import Any

import numpy as np

from known_errors.search import Worst

PATH = pathlib.Path(__file__).parent / "bounds.json"
_ROUND = (0, 1, 1.5, 2, 3, 4, 6, 8)


def read() -> dict[str, Any]:
    """Returns {row: {"nanoseconds": ..., "jitted value": {"found", "bound", "inputs", "slopes"}, ...}}."""
    return json.loads(PATH.read_text()) if PATH.exists() else {}


def entry(worst: Worst) -> dict[str, Any]:
    """Returns what the table says of a column."""
    return {
        "found": float(f"{worst.error:.3g}"),
        "bound": bound(worst.error),
        "inputs": {name: _plain(value) for name, value in worst.inputs.items()},
        "slopes": _plain(worst.slopes),
    }


def bound(error: float) -> float:
    """Returns a round number that is at least 1.5 times an error: the rounding of other processors differs."""
    scale = 1.0
    while 1.5 * error > scale * _ROUND[-1]:
        scale *= 8
    return next(scale * each for each in _ROUND if scale * each >= 1.5 * error)


def known(record: dict[str, Any]) -> list[tuple[dict[str, np.ndarray], np.ndarray]]:
    """Returns the inputs and slopes of all columns of a row."""
    columns = [each for each in record.values() if isinstance(each, dict)]
    arrays = [({name: _array(x) for name, x in each["inputs"].items()}, _array(each["slopes"])) for each in columns]
    return arrays


def _plain(array):
    """Returns float32 as the shortest decimal numbers that are read as the same."""
    return np.vectorize(lambda x: float(str(x)), otypes=[object])(np.asarray(array, np.float32)).tolist()


def _array(values):
    return np.asarray(values, np.float32)
