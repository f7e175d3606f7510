"""Checks of what a caller passes to a reader, and of the numbers in a JSON file."""

import json
import operator
import os
import unicodedata

import numpy as np

LARGEST = 3.4e38  # that float32 can hold


def check_factor(factor):
    """Returns the downsampling factor as an int; ValueError unless it is a whole number >= 1."""
    try:
        whole = operator.index(factor)
    except TypeError:
        whole = 0
    if whole < 1 or isinstance(factor, bool):
        raise ValueError(f"factor is {factor!r}, wanted a whole number >= 1; 1 keeps the images as they are")
    return whole


def check_range(near, far):
    """Raises a ValueError unless 0 <= near < far, finite and apart in float32."""
    if not (is_number(near) and is_number(far) and 0 <= near < far):
        raise ValueError(
            f"near, far is {near!r}, {far!r}, wanted finite numbers with 0 <= near < far; enclose the scene"
        )


def check_background(background):
    """Returns a colour as a tuple of 3 floats, or None for None; ValueError unless all are in [0, 1]."""
    if background is None:
        return None
    values = tuple(background) if np.ndim(background) == 1 else ()
    if len(values) != 3 or not all(is_number(value) and 0 <= value <= 1 for value in values):
        raise ValueError(
            f"background is {background!r}, wanted red, green, blue in [0, 1]; None takes RGB without alpha"
        )
    return tuple(float(value) for value in values)


def is_number(value):
    """Returns whether value is a real number that float32 can hold; NaN, infinity and booleans are none."""
    real = isinstance(value, int | float | np.integer | np.floating) and not isinstance(value, bool)
    return real and bool(abs(value) <= LARGEST)


def read_json(path):
    """Returns the object that a JSON file holds; ValueError if it is unreadable or not an object."""
    try:
        content = json.loads(path.read_text(encoding="utf-8-sig"))
    except OSError as error:
        raise ValueError(f"{path}: {error.strerror}, wanted a JSON file that can be read") from None
    except (ValueError, RecursionError) as error:
        raise ValueError(f"{path}: malformed JSON ({error}), wanted a whole file; export it again") from None
    if not isinstance(content, dict):
        raise ValueError(f"{path}: holds a {type(content).__name__}, wanted an object {{...}}; export again")
    return content


def required(entries, key, source):
    """Returns entries[key]; ValueError that lists the keys that are there if it is missing."""
    if key not in entries:
        # A key may hold anything, a line break too: its repr is one line.
        there = ", ".join(repr(key)[1:-1] for key in sorted(entries))[:200] or "none"
        raise ValueError(f"{source}: has no {key}, only {there}; wanted {key} as in the Blender format")
    return entries[key]


def check_inside(name, *, key, source):
    """Returns a path that a file states, normalised and relative to that file's folder, which it stays in.

    Judged by its text and not resolved: a link inside the folder is the owner's choice, ".." the file's.

    Args:
        name: what the file has for the key; / or \\ between folders.
        key, source: where it stands, for the message.

    Returns:
        str with / between folders, such as "images/0001.jpg".

    Raises:
        ValueError: if it is no path, or leads out of the folder.
    """
    # Messages and notes show the name: one with line breaks or other control characters is no file's.
    odd = ("Cc", "Cs", "Zl", "Zp")
    if not isinstance(name, str) or not name or any(unicodedata.category(letter) in odd for letter in name):
        raise ValueError(f"{source}: {key} is {shown(name)}, wanted a path as ./train/r_0; export again")
    inside = os.path.normpath(name.replace("\\", "/"))
    if os.path.isabs(inside) or inside.split("/")[0] in (".", ".."):
        raise ValueError(f"{source}: {key} {shown(name)} leaves the folder, wanted one inside; move the image")
    return inside


def shown(value):
    """Returns a value of a file as a message shows it: one line, and not all of a long one."""
    text = repr(value)
    return text if len(text) <= 80 else text[:77] + "..."
