"""An array that takes a while to make, kept on disk between runs. Failing to keep it is never an error."""

import logging
import os
import tempfile
from pathlib import Path

import numpy as np


def load_or_make(folder, name, make, *, shape, dtype):
    """Returns the array that a cache file holds, or makes it and leaves it there.

    Args:
        folder: of the cache; None for jaxnerf in $XDG_CACHE_HOME or ~/.cache.
        name: of the file, without extension. Whatever the array depends on belongs in it.
        make: () -> array.
        shape, dtype: of the array. A file with another content counts as broken and is made again.

    Returns:
        The array, bit for bit the same from the file and from make. What goes wrong is logged as a warning.
    """
    path = None
    try:
        path = (default_folder() if folder is None else Path(folder)) / f"{name}.npz"
        with np.load(path) as content:
            array = content["array"]
        if array.dtype == dtype and array.shape == shape:
            return array
        logging.warning("%s holds another array, making it again", path)
    except FileNotFoundError:
        logging.info("%s is not there yet, making it", path)
    except Exception as error:  # a damaged zip raises almost anything, and no cache is worth failing for
        logging.warning("the cache %s is of no use (%s), making its content again", path or folder, error)
    array = make()
    if path is not None:
        _store(path, array)
    return array


def default_folder():
    """Returns jaxnerf in $XDG_CACHE_HOME or ~/.cache."""
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "jaxnerf"


def _store(path, array):
    """Writes beside the file and then renames, so that no reader meets half of it."""
    partial = None
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.NamedTemporaryFile(dir=path.parent, suffix=".tmp", delete=False) as file:
            partial = Path(file.name)
            np.savez_compressed(file, array=array)
        os.replace(partial, path)
    except OSError as error:
        logging.warning("the cache %s cannot be written (%s), its content will be made again", path, error)
        if partial is not None:
            partial.unlink(missing_ok=True)
