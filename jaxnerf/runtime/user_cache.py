"""A cache on disk for arrays that take long to compute. A cache that cannot be used is never an error."""

import logging
import os
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

from jaxnerf.runtime.atomic_files import partial_file


def load_or_make(
    folder: str | os.PathLike | None,
    name: str,
    make: Callable[[], dict[str, np.ndarray]],
    *,
    is_valid: Callable[[dict[str, np.ndarray]], bool],
    min_seconds: float = 0.0,
) -> dict[str, np.ndarray]:
    """Reads arrays from a cache file, or computes them and writes the file.

    Problems with the cache are logged as warnings.

    Args:
        folder: the cache's folder; None: `default_folder()`.
        name: of the file, without extension. It must contain a hash of everything that the arrays depend on.
        make: computes the arrays by name.
        is_valid: returns whether arrays from a file have the expected names, shapes and types. A file with
            other arrays is treated as damaged and replaced.
        min_seconds: arrays that are computed in less time are not written.

    Returns:
        The arrays, bit for bit the same whether they are read or computed.
    """
    path = None
    try:
        path = (default_folder() if folder is None else Path(folder)) / f"{name}.npz"
        with np.load(path) as content:
            arrays = dict(content)
        if is_valid(arrays):
            return arrays
        logging.warning("%s holds unexpected arrays; they are computed again", path)
    except FileNotFoundError:
        logging.info("%s does not exist yet; its arrays are computed", path)
    except Exception as error:  # a damaged zip file raises almost any exception
        logging.warning("%s cannot be read (%s); its arrays are computed again", path or folder, error)
    start = time.perf_counter()
    arrays = make()
    if path is not None and time.perf_counter() - start >= min_seconds:
        _store(path, arrays)
    return arrays


def default_folder() -> Path:
    """Returns the folder `jaxnerf` in $XDG_CACHE_HOME or ~/.cache; raises RuntimeError if there is no home."""
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "jaxnerf"


def _store(path, arrays):
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with partial_file(path) as partial, partial.open("wb") as file:
            np.savez_compressed(file, **arrays)
    except OSError as error:
        logging.warning("%s cannot be written (%s); its arrays will be computed again", path, error)
