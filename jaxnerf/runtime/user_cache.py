"""Arrays that take a while to make, kept on disk between runs. Failing to keep them is never an error."""

import logging
import os
import tempfile
import time
from pathlib import Path

import numpy as np


def load_or_make(folder, name, make, *, fits, worth=0.0):
    """Returns the arrays that a cache file holds, or makes them and leaves them there.

    Args:
        folder: of the cache; None for jaxnerf in $XDG_CACHE_HOME or ~/.cache.
        name: of the file, without extension. Whatever the arrays depend on belongs in it.
        make: () -> {name: array}.
        fits: {name: array} -> whether these are arrays of that kind. A file with others counts as broken and
            is made again.
        worth: seconds; arrays that were made faster are not kept.

    Returns:
        The arrays, bit for bit the same from the file and from make. What goes wrong is logged as a warning.
    """
    path = None
    try:
        path = (default_folder() if folder is None else Path(folder)) / f"{name}.npz"
        with np.load(path) as content:
            arrays = dict(content)
        if fits(arrays):
            return arrays
        logging.warning("%s holds other arrays, making them again", path)
    except FileNotFoundError:
        logging.info("%s is not there yet, making it", path)
    except Exception as error:  # a damaged zip raises almost anything, and no cache is worth failing for
        logging.warning("the cache %s is of no use (%s), making its content again", path or folder, error)
    started = time.perf_counter()
    arrays = make()
    if path is not None and time.perf_counter() - started >= worth:
        _store(path, arrays)
    return arrays


def default_folder():
    """Returns jaxnerf in $XDG_CACHE_HOME or ~/.cache."""
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "jaxnerf"


def _store(path, arrays):
    """Writes beside the file and then renames, so that no reader meets half of it."""
    partial = None
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.NamedTemporaryFile(dir=path.parent, suffix=".tmp", delete=False) as file:
            partial = Path(file.name)
            np.savez_compressed(file, **arrays)
        os.replace(partial, path)
    except OSError as error:
        logging.warning("the cache %s cannot be written (%s), its content will be made again", path, error)
        if partial is not None:
            partial.unlink(missing_ok=True)
