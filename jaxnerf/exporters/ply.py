"""Writes points with any properties as a binary PLY file (Turk 1994)."""

import os
from collections.abc import Mapping

import numpy as np

_TYPES = {"f": ("float", "<f4"), "u": ("uchar", "u1")}


def write_ply(path: str | os.PathLike, properties: Mapping[str, np.ndarray]) -> None:
    """Writes the element "vertex".

    Args:
        path: of the file.
        properties: arrays [N] by name, in the file's order; floating-point numbers as float, uint8 as uchar.
    """
    kinds = {name: _TYPES[np.asarray(values).dtype.kind] for name, values in properties.items()}
    count = len(next(iter(properties.values())))
    rows = np.empty(count, [(name, kind) for name, (_, kind) in kinds.items()])
    for name, values in properties.items():
        rows[name] = values
    lines = [f"property {kind} {name}" for name, (kind, _) in kinds.items()]
    header = "\n".join(["ply", "format binary_little_endian 1.0", f"element vertex {count}", *lines, "end_header\n"])
    with open(path, "wb") as file:
        file.write(header.encode("ascii"))
        file.write(rows.tobytes())
