"""Checks of arguments, and readers of JSON and .npy files of unknown origin."""

import os
import unicodedata
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Shaped

from jaxnerf.options import short_repr
from jaxnerf.runtime import atomic_files

MAX_FLOAT32 = 3.4e38


def is_number(value: Any) -> bool:
    """Returns whether a value is a real number that float32 can hold: no NaN, infinity or boolean."""
    real = isinstance(value, int | float | np.integer | np.floating) and not isinstance(value, bool)
    return real and bool(abs(value) <= MAX_FLOAT32)


def read_json(path: Path) -> dict[str, Any]:
    """Returns the object in a JSON file; ValueError if the file is unreadable or holds no object."""
    try:
        content = atomic_files.read_json(path, "expected a complete file; export it again")
    except OSError as error:
        raise ValueError(f"{path}: {error.strerror}, expected a readable JSON file; correct the path") from None
    if not isinstance(content, dict):
        raise ValueError(f"{path}: holds a {type(content).__name__}, expected an object {{...}}; export it again")
    return content


def read_npy(path: Path, expected: str) -> Shaped[np.ndarray, "..."]:
    """Reads the array in a .npy file. Nothing is unpickled, and no more memory is allocated than the file's size.

    Args:
        path: of the file.
        expected: its expected content, for the message.

    Raises:
        ValueError: if the file is missing, truncated or holds no plain array; names the file.
    """
    try:
        with atomic_files.open_regular(path, "rb"):  # no pipe, for which numpy would wait
            # Mapped, since a flipped bit in the header may ask for gigabytes.
            return np.array(np.lib.format.open_memmap(path, mode="r"))
    except FileNotFoundError:
        raise ValueError(f"{path}: no such file, expected {expected}; correct the folder") from None
    except Exception as error:  # numpy parses the header as Python, so a damaged one raises almost any exception
        reason = " ".join(str(error).split())[:200]
        raise ValueError(f"{path}: unreadable ({reason}), expected {expected}; export it again") from None


def required(entries: Mapping[str, Any], key: str, source: Any) -> Any:
    """Returns entries[key]; ValueError with the existing keys if it is missing."""
    if key not in entries:
        # A key may contain line breaks; its repr is one line.
        existing = ", ".join(repr(key)[1:-1] for key in sorted(entries))[:200] or "none"
        raise ValueError(f"{source}: has no {key}, only {existing}; expected {key}; export the file again")
    return entries[key]


def read_times(frames: Sequence[tuple[Any, Mapping[str, Any]]]) -> list[float | None]:
    """Returns the "time" of each frame of a JSON file, or None for all of them if none states one.

    They are fractions of the sequence in [0, 1], as in the format of D-NeRF (arXiv:2011.13961), or other numbers, such
    as those of a video's frames, which `read_capture` scales.

    Args:
        frames: (where, entries of the frame); where: for the message.

    Raises:
        ValueError: if some frames state a time and others do not, or one is no number.
    """
    without = [where for where, frame in frames if "time" not in frame]
    if len(without) == len(frames):
        return [None] * len(frames)
    if without:
        raise ValueError(f"{without[0]}: has no time, other frames have; expected all or none; complete them")
    for where, frame in frames:
        if not is_number(frame["time"]):
            raise ValueError(
                f"{where}: time is {short_repr(frame['time'])}, expected a number; correct it, or remove all times if "
                "nothing moves"
            )
    return [float(frame["time"]) for _, frame in frames]


def check_inside(name: Any, *, key: str, source: Any) -> str:
    """Checks that a path in a file stays in the file's folder, and normalises it.

    Only the text is checked, links are not resolved: a link in the folder was made by the folder's owner, a
    ".." in a file possibly by a stranger.

    Args:
        name: the file's value of the key; / or \\ between folders.
        key, source: where it is stated, for the message.

    Returns:
        The path relative to the folder with / between folders, such as "images/0001.jpg".

    Raises:
        ValueError: if the value is no path or leads out of the folder.
    """
    # Messages and notes contain the name, so line breaks and other control characters are rejected.
    odd = ("Cc", "Cs", "Zl", "Zp")
    if not isinstance(name, str) or not name or any(unicodedata.category(letter) in odd for letter in name):
        raise ValueError(f"{source}: {key} is {short_repr(name)}, expected a path like ./train/r_0; export it again")
    inside = os.path.normpath(name.replace("\\", "/"))
    if os.path.isabs(inside) or inside.split("/")[0] in (".", ".."):
        raise ValueError(
            f"{source}: {key} {short_repr(name)} leaves the folder, expected a path inside; move the image"
        )
    return inside
