"""Arrays from .npy files of unknown origin: nothing is unpickled, nothing larger than the file is made."""

import math

import numpy as np


def read_npy(path, wanted):
    """Returns the array in a .npy file.

    Args:
        path: Path of the file.
        wanted: what it should hold, for the message.

    Raises:
        ValueError: if it is missing, cut short, or not a plain array; names the file.
    """
    try:
        with path.open("rb") as file:
            shape, fortran, dtype = read_header(file)
            if dtype.hasobject:
                raise ValueError("Python objects, which are never unpickled")
            size = math.prod(shape) * dtype.itemsize
            # Compared before anything of that size is made: a flipped bit in the header asks for gigabytes.
            there = path.stat().st_size - file.tell()
            if size != there:
                raise ValueError(f"{there} bytes of data, its header says {size}")
            content = file.read(size)
        array = np.frombuffer(content, dtype).reshape(shape, order="F" if fortran else "C")
    except FileNotFoundError:
        raise ValueError(f"{path}: no such file, wanted {wanted}; correct the folder") from None
    except Exception as error:  # a damaged header is parsed as Python, and raises almost anything
        reason = " ".join(str(error).split())[:200]
        raise ValueError(f"{path}: unreadable ({reason}), wanted {wanted}; make it again") from None
    return array


def read_header(file):
    """Returns shape, whether columns come first, and dtype; the open file then stands at the data.

    Raises:
        Exception: almost any, of a damaged header.
    """
    version = np.lib.format.read_magic(file)
    if version not in ((1, 0), (2, 0)):
        raise ValueError(f"version {version}")
    return getattr(np.lib.format, f"read_array_header_{version[0]}_0")(file)
