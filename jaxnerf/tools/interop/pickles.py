"""Reads lists of arrays that were pickled into .npy files of unknown origin, without calling anything in them.

An unpickler that is restricted to numpy's classes is not safe: with a crafted dtype state numpy dereferences
numbers in the file as addresses. This module therefore interprets the opcodes itself, keeps each object as a
record of its name and arguments, and passes only floating-point bytes to numpy.
"""

import math
import pathlib
import pickletools

import numpy as np

from jaxnerf.runtime.atomic_files import open_regular

# The names in a pickled list of arrays: of numpy 1 and 2, and of protocol 2, which encodes bytes as text.
_NAMES = {
    "numpy.core.multiarray _reconstruct": "array",
    "numpy._core.multiarray _reconstruct": "array",
    "numpy ndarray": "ndarray",
    "numpy dtype": "dtype",
    "_codecs encode": "bytes",
}
_CONSTANTS = {"NONE": None, "NEWTRUE": True, "NEWFALSE": False, "EMPTY_TUPLE": ()}
_VALUES = {f"{size}{kind}" for size in ("SHORT_", "") for kind in ("BINUNICODE", "BINBYTES", "BINSTRING")}
_VALUES |= {"BINUNICODE8", "BINBYTES8", "BININT", "BININT1", "BININT2", "LONG1"}
_COUNTS = {"TUPLE1": 1, "TUPLE2": 2, "TUPLE3": 3}
_FLOATS = ("f2", "f4", "f8")


class Record:
    """An object of a pickle, not created: its name, its arguments (None for the name alone) and its state."""

    def __init__(self, name: str, arguments: tuple | None):
        self.name, self.arguments, self.state = name, arguments, None


def _read_npy_header(file):
    """Returns shape, whether the order is Fortran's, and dtype; the file's position is then the data's start."""
    version = np.lib.format.read_magic(file)
    if version not in ((1, 0), (2, 0)):
        raise ValueError(f"version {version}")
    return getattr(np.lib.format, f"read_array_header_{version[0]}_0")(file)


def read_array_list(path: pathlib.Path, expected: str) -> list[np.ndarray]:
    """Returns the floating-point arrays of a .npy file that holds a list of them.

    Args:
        path: the file.
        expected: the content, for the message.

    Raises:
        ValueError: if the file is missing, damaged or holds anything else; names the file.
    """
    try:
        with open_regular(path, "rb") as file:
            shape, _, dtype = _read_npy_header(file)
            if not dtype.hasobject:
                raise ValueError(f"one array of {dtype}{list(shape)}, not a list")
            content = file.read()
        arrays = _arrays(_items(_follow(content)), len(content))
        if shape != (len(arrays),):
            raise ValueError(f"{len(arrays)} arrays, but its header states {list(shape)}")
    except FileNotFoundError:
        raise ValueError(f"{path}: no such file, expected {expected}; correct the name") from None
    except Exception as error:  # a damaged file can raise almost any exception
        reason = " ".join(str(error).split())[:200] or type(error).__name__
        raise ValueError(f"{path}: unreadable ({reason}), expected {expected}; fetch it again") from None
    return arrays


def _follow(content):
    """Returns the content of a pickle, with a Record in place of each object."""
    stack, marks, memo = [], [], {}
    for opcode, argument, position in pickletools.genops(content):
        name = opcode.name
        if name in _VALUES or name in _CONSTANTS:
            stack.append(_CONSTANTS.get(name, argument))
        elif name == "EMPTY_LIST":
            stack.append([])
        elif name == "MARK":
            marks.append(len(stack))
        elif name in ("MEMOIZE", "BINPUT", "LONG_BINPUT"):
            memo[len(memo) if argument is None else argument] = stack[-1]
        elif name in ("BINGET", "LONG_BINGET"):
            stack.append(memo[argument])
        elif name == "GLOBAL":
            stack.append(_name(argument))
        elif name == "STOP":
            if position + 1 != len(content):
                raise ValueError(f"{len(content) - position - 1} bytes after its end")
            return stack.pop()
        elif name not in ("PROTO", "FRAME"):
            _combine(name, stack, marks)


def _combine(name, stack, marks):
    """Executes an opcode that takes several values from the stack."""
    if name in ("TUPLE", "APPENDS"):
        first = marks.pop()
    else:
        first = len(stack) - _COUNTS.get(name, 1 if name == "APPEND" else 2)
    taken = stack[first:]
    del stack[first:]
    if name == "TUPLE" or name in _COUNTS:
        stack.append(tuple(taken))
    elif name in ("APPENDS", "APPEND"):
        stack[-1].extend(taken)
    elif name == "STACK_GLOBAL":
        stack.append(_name(" ".join(taken)))
    elif name == "REDUCE" and isinstance(taken[0], Record) and taken[0].arguments is None:
        stack.append(Record(taken[0].name, taken[1]))
    elif name == "BUILD" and isinstance(taken[0], Record):
        taken[0].state = taken[1]
        stack.append(taken[0])
    else:
        raise ValueError(f"it does more than list arrays: opcode {name}")


def _name(name):
    if name not in _NAMES:
        raise ValueError(f"it refers to {name.replace(' ', '.')!r}, which is never called")
    return Record(_NAMES[name], None)


def _state(record):
    """Returns the state of a pickled array: version, shape, dtype, whether in Fortran order, content."""
    if not isinstance(record, Record) or record.name != "array":
        raise ValueError(f"{type(record).__name__} in place of an array")
    return record.state


def _items(record):
    content = _state(record)[4]
    if not isinstance(content, list):
        raise ValueError("it is not a list of arrays")
    return content


def _arrays(records, size):
    """Returns the arrays of records; ValueError, before it makes more, if they hold more bytes than the file."""
    arrays = []
    for record in records:
        _, shape, dtype, fortran, content = _state(record)
        content, dtype = _text_or_bytes(content), _dtype(dtype)
        size -= len(content)
        if size < 0:
            raise ValueError("an array more than once")
        if len(shape) > 2 or min(shape, default=0) < 0 or math.prod(shape) * dtype.itemsize != len(content):
            raise ValueError(f"{len(content)} bytes for {dtype} of another shape")
        content = content.encode("latin1") if isinstance(content, str) else content
        arrays.append(np.frombuffer(content, dtype).reshape(shape, order="F" if fortran else "C"))
    return arrays


def _text_or_bytes(content):
    """Returns the content of an array: protocol 2 writes an encoding of text, and Python 2 text of as many letters."""
    if isinstance(content, Record) and content.name == "bytes":
        content = content.arguments[0]
    if not isinstance(content, str | bytes):
        raise ValueError(f"{type(content).__name__} in place of an array's bytes")
    return content


def _dtype(record):
    if not isinstance(record, Record) or record.name != "dtype" or record.arguments[0] not in _FLOATS:
        raise ValueError(f"numbers of another kind than {', '.join(_FLOATS)}")
    if record.state[1] not in ("<", ">"):
        raise ValueError("another byte order than < or >")  # a repr of nested tuples may be of any length
    return np.dtype(record.state[1] + record.arguments[0])
