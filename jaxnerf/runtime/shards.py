"""Frames that one call or many make: whose they are, which are finished, and files that no two calls spoil.

Calls may run at the same time and on any machine that sees the folder; they need not know of each other. A
frame is finished when its files are there, and they are there whole or not at all.
"""

import contextlib
import json
import os
import re
import secrets
import shutil
import zlib

import jax
import numpy as np

from jaxnerf.runtime import processes

WHOLE = (0, 1)


def parse(text):
    """Returns (index, count) of "3/16", the fourth of sixteen: they count from 0, as launchers do.

    "auto" is the place of this process among those that srun or mpirun has started; None is the whole.

    Raises:
        ValueError: on anything else.
    """
    if text is None:
        return WHOLE
    if text == "auto":
        if place := processes.launched():
            return place
        raise ValueError("--shard=auto: neither srun nor mpirun has started this; give --shard=K/N")
    found = re.fullmatch(r"(\d+)/(\d+)", text)
    index, count = map(int, found.groups()) if found else (0, 0)
    if index >= count:
        last = f": the last of {count} is {count - 1}/{count}" if count else ""
        raise ValueError(f"--shard is {text!r}, wanted K/N with K from 0 below N{last}")
    return index, count


def own(indices, shard):
    """Returns those of the frames' indices that are a shard's: every count-th, so that all take as long."""
    return [index for index in indices if index % shard[1] == shard[0]]


def refuse_overwrite(overwrite, shard, folder):
    """Raises a ValueError where a shard would delete what others have made."""
    if overwrite and shard != WHOLE:
        raise ValueError(f"--overwrite with --shard would delete other shards' frames; remove {folder} first")


def claim_folder(folder, origin, *, overwrite=False, file="path.json", other="give --overwrite, or another --name"):
    """Makes a folder with a file of the origin of what is in it, or checks that it has the same.

    Raises:
        ValueError: if it holds anything of another origin; names what differs, and what else to do.
    """
    if overwrite and folder.exists():
        shutil.rmtree(folder)
    folder.mkdir(parents=True, exist_ok=True)
    if not (folder / file).exists() and all(path.suffix == ".tmp" for path in folder.iterdir()):
        _write_new(folder / file, json.dumps(origin, indent=2) + "\n")
    check_origin(folder, origin, file=file, other=other)


def check_origin(folder, origin, *, file, other):
    """Raises a ValueError if what a folder holds is of another origin; names what differs."""
    try:
        found = json.loads((folder / file).read_text())
        differ = [key for key in origin | found if found.get(key) != origin.get(key)]
    except (OSError, ValueError, TypeError, AttributeError):
        raise ValueError(f"{folder / file}: cannot be read; {other}") from None
    if differ:
        shown = ", ".join(f"{key} {found.get(key)!r}, not {origin.get(key)!r}" for key in differ[:2])
        raise ValueError(f"{folder}: holds frames rendered with {shown}; {other}")


@contextlib.contextmanager
def partial_of(path, suffix=".tmp"):
    """Gives a path beside a file to write to, which then takes its place, whoever else does so as well."""
    partial = path.with_name(f"{path.name}.{secrets.token_hex(4)}{suffix}")
    try:
        yield partial
        try:
            os.replace(partial, path)
        except FileNotFoundError:
            if not path.exists():  # else all was finished meanwhile, and swept
                raise
    finally:
        partial.unlink(missing_ok=True)


def _write_new(path, text):
    """Writes a text file, whole, unless there is one."""
    partial = path.with_name(f"{path.name}.{secrets.token_hex(4)}.tmp")
    try:
        partial.write_text(text)
        try:
            os.link(partial, path)  # which, unlike a move, replaces nothing
        except FileExistsError:
            pass
        except OSError:  # a file system without links
            os.replace(partial, path)
    finally:
        partial.unlink(missing_ok=True)


def sweep(folder, pattern="*.tmp"):
    """Removes what killed calls have left half written below a folder in which all is finished."""
    for path in folder.rglob(pattern):
        path.unlink(missing_ok=True)


def digest(*values, sample=None):
    """Returns 8 hexadecimal digits of text and trees of arrays; sample: of about so many rows of each."""
    total = 0
    for leaf in jax.tree.leaves(values):
        if isinstance(leaf, str):
            content = leaf.encode()
        else:
            rows = np.asarray(leaf) if sample is None else leaf[:: max(len(leaf) // sample, 1)]
            content = np.ascontiguousarray(rows)
        total = zlib.crc32(content, total)
    return f"{total:08x}"
