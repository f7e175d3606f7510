"""Reader of points in PLY files, such as nerfstudio's sparse_pc.ply, that may come from strangers.

Every count is compared with the file's size before memory is allocated.
"""

import os

import numpy as np
from jaxtyping import Float

from jaxnerf.runtime.atomic_files import open_regular

_TYPES = {
    **{"char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1", "short": "i2", "int16": "i2"},
    **{"ushort": "u2", "uint16": "u2", "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4"},
    **{"float": "f4", "float32": "f4", "double": "f8", "float64": "f8"},
}
_ORDERS = {"ascii": None, "binary_little_endian": "<", "binary_big_endian": ">"}


def read_points(path: str | os.PathLike) -> Float[np.ndarray, "N 3"]:
    """Returns the x, y, z of a PLY file's vertices as float64; other properties are ignored.

    Args:
        path: an ASCII or binary PLY file whose first element is "vertex". It may have no vertices.

    Raises:
        ValueError: if the file cannot be read, is no such PLY file, ends before its last vertex, or has a
            coordinate that is not finite.
    """
    try:
        with open_regular(path, "rb") as file:
            order, count, columns = _header(file, path)
            if order is None:
                points = _ascii(file, count, columns, path)
            else:
                points = _binary(file, count, [(name, order + kind) for name, kind in columns], path)
    except OSError as error:
        raise ValueError(f"{path}: {error.strerror}, expected a readable PLY file; correct the path") from None
    if not np.isfinite(points).all():
        row = np.argwhere(~np.isfinite(points))[0][0]
        raise _wrong(path, f"vertex {row} is {points[row].tolist()}", "finite numbers")
    return points


def _header(file, path):
    """Returns the byte order (None: ASCII), and the vertices' count and [(property, type)]."""
    if file.readline(8).strip() != b"ply":
        raise _wrong(path, "does not begin with ply", "a PLY file")
    order, count, columns, element = "", 0, [], None
    for _ in range(1000):  # a limit on the lines, as below on their length
        words = file.readline(1000).decode("ascii", "replace").split()
        match words:
            case ["end_header"]:
                break
            case ["format", name, _] if name in _ORDERS:
                order = _ORDERS[name]
            case ["element", name, number] if number.isdecimal() and len(number) < 16:
                if name == "vertex" and element is not None:
                    raise _wrong(path, f"has {element} before its vertices", "vertices first")
                element = name
                count = int(number) if name == "vertex" else count
            case ["property", kind, name] if kind in _TYPES and element is not None:
                columns += [(name, _TYPES[kind])] if element == "vertex" else []
            case ["property", "list", *_] if element not in (None, "vertex"):
                pass
            case ["comment" | "obj_info", *_]:
                pass
            case _:
                raise _wrong(path, f"has the header line {' '.join(words)[:60]!r}", "a PLY header")
    else:
        raise _wrong(path, "has a header without end_header", "a PLY header")
    names = [name for name, _ in columns]
    if order == "" or len(set(names)) < len(names) or not {"x", "y", "z"} <= set(names):
        raise _wrong(path, f"has vertices of {' '.join(names)[:60] or 'nothing'!r}", "a format and x y z")
    return order, count, columns


def _ascii(file, count, columns, path):
    _check_size(file, count, 2 * len(columns), path)  # at least a digit and a space for each number
    if not count:
        return np.zeros((0, 3))
    try:
        rows = np.loadtxt(file, max_rows=count, ndmin=2, comments=None, encoding="latin-1")
    except ValueError as error:
        reason = str(error).splitlines()[0][:80]
        raise _wrong(path, f"has a line that is no vertex ({reason})", "numbers") from None
    if rows.shape != (count, len(columns)):
        found = f"{len(rows)} vertices of {rows.shape[1]} numbers"
        raise _wrong(path, f"holds {found}", f"{count} of {len(columns)} as its header states")
    names = [name for name, _ in columns]
    return rows[:, [names.index(axis) for axis in "xyz"]]


def _binary(file, count, columns, path):
    dtype = np.dtype(columns)
    _check_size(file, count, dtype.itemsize, path)
    rows = np.fromfile(file, dtype, count)
    with np.errstate(invalid="ignore"):  # signalling NaNs; read_points reports them
        return np.stack([rows[axis].astype(np.float64) for axis in "xyz"], axis=-1)


def _check_size(file, count, least, path):
    left = os.fstat(file.fileno()).st_size - file.tell() + 1  # the last line's end may be missing
    if count * least > left:
        raise _wrong(path, f"holds {left - 1} bytes after its header", f"{count} vertices as the header states")


def _wrong(path, found, expected):
    return ValueError(f"{path}: {found}, expected {expected}; export it again")
