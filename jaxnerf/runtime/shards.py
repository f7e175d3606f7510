"""Splits frames among independent processes, and claims the folder that they share.

Any number of processes may run at the same time, on any machine that sees the folder. A frame is finished when
its files exist; each file appears completely or not at all, see `atomic_files`.
"""

import json
import pathlib
import re
from collections.abc import Iterable, Mapping
from typing import Any

from jaxnerf.runtime import atomic_files, processes

WHOLE = (0, 1)


def parse(text: str | None) -> tuple[int, int]:
    """Parses the flag --shard.

    Args:
        text: "3/16", the fourth of sixteen shards: they count from 0, as launchers do. "auto": the rank of this
            process among those that srun or mpirun has started. None: all frames.

    Returns:
        (index, count).

    Raises:
        ValueError: on anything else.
    """
    if text is None:
        return WHOLE
    if text == "auto":
        if rank := processes.launched():
            return rank
        raise ValueError("--shard=auto: neither srun nor mpirun has started this process; give --shard=K/N")
    found = re.fullmatch(r"(\d+)/(\d+)", text)
    index, count = map(int, found.groups()) if found else (0, 0)
    if index >= count:
        last = f": the last of {count} is {count - 1}/{count}" if count else ""
        raise ValueError(f"--shard is {text!r}, expected K/N with K from 0 below N{last}")
    return index, count


def indices_of(indices: Iterable[int], shard: tuple[int, int]) -> list[int]:
    """Returns the indices of a shard's frames: every count-th, so that all shards take about the same time."""
    return [index for index in indices if index % shard[1] == shard[0]]


def refuse_overwrite(overwrite: bool, shard: tuple[int, int], folder: pathlib.Path) -> None:
    """Raises a ValueError where overwriting by one shard would delete the frames of others."""
    if overwrite and shard != WHOLE:
        raise ValueError(f"--overwrite with --shard would delete other shards' frames; remove {folder} first")


def make_folder(
    folder: pathlib.Path,
    provenance: Mapping[str, Any],
    *,
    overwrite: bool = False,
    file: str = "path.json",
    remedy: str = "give --overwrite, or another --name",
) -> None:
    """Makes a folder with a file that records the provenance of its frames, or checks that of an existing one.

    Args:
        folder: made if missing.
        provenance: everything that the frames depend on, as JSON.
        overwrite: whether to delete the folder first.
        file: the name of the file.
        remedy: the end of the error message, which says what to do.

    Raises:
        ValueError: if the folder holds frames of another provenance; names what differs.
    """
    if overwrite:
        atomic_files.remove(folder)
    folder.mkdir(parents=True, exist_ok=True)
    if not (folder / file).exists() and all(path.suffix == ".tmp" for path in folder.iterdir()):
        atomic_files.write_text_once(folder / file, json.dumps(provenance, indent=2) + "\n")
    check_provenance(folder, provenance, file=file, remedy=remedy)


def check_provenance(folder: pathlib.Path, provenance: Mapping[str, Any], *, file: str, remedy: str) -> None:
    """Checks that the frames in a folder have the given provenance; see `make_folder`.

    Raises:
        ValueError: if they have another, or the file cannot be read; names what differs.
    """
    try:
        found = atomic_files.read_json(folder / file, remedy)
        differ = [key for key in provenance | found if found.get(key) != provenance.get(key)]
    except (OSError, ValueError, TypeError, AttributeError):
        raise ValueError(f"{folder / file}: cannot be read; {remedy}") from None
    if differ:
        shown = ", ".join(f"{key} {found.get(key)!r}, not {provenance.get(key)!r}" for key in differ[:2])
        raise ValueError(f"{folder}: holds frames rendered with {shown}; {remedy}")
