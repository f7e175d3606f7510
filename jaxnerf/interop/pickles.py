"""Reads lists of arrays that were pickled into .npy files of unknown origin, without calling anything in them.

An unpickler that is restricted to numpy's classes is not safe: with a crafted dtype state numpy dereferences
numbers in the file as addresses. This module therefore interprets the opcodes itself, keeps each object as a
record of its name and arguments, and passes only floating-point bytes to numpy.
"""

import math
import pathlib
import pickletools

import numpy as np

from jaxnerf.data.readers.validation import read_npy_header

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


def read_array_list(path: pathlib.Path, expected: str) -> list[np.ndarray]:
    """Returns the floating-point arrays of a .npy file that holds a list of them.

    Args:
        path: the file.
        expected: the content, for the message.

    Raises:
        ValueError: if the file is missing, damaged or holds anything else; names the file.
    """
    try:
        with path.open("rb") as file:
            shape, _, dtype = read_npy_header(file)
            if not dtype.hasobject:
                raise ValueError(f"one array of {dtype}{list(shape)}, not a list")
            content = file.read()
        arrays = [_array(record) for record in _items(_follow(content))]
        if shape != (len(arrays),) or sum(array.nbytes for array in arrays) > len(content):
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


def _array(record):
    _, shape, dtype, fortran, content = _state(record)
    content, dtype = _bytes(content), _dtype(dtype)
    if len(shape) > 2 or min(shape, default=0) < 0 or math.prod(shape) * dtype.itemsize != len(content):
        raise ValueError(f"{len(content)} bytes for {dtype}{list(shape)[:3]}")
    return np.frombuffer(content, dtype).reshape(shape, order="F" if fortran else "C")


def _bytes(content):
    """Returns bytes, which protocol 2 writes as an encoding of text, and Python 2 as text."""
    if isinstance(content, Record) and content.name == "bytes":
        content = content.arguments[0]
    return content.encode("latin1") if isinstance(content, str) else content


def _dtype(record):
    if not isinstance(record, Record) or record.name != "dtype" or record.arguments[0] not in _FLOATS:
        raise ValueError(f"numbers of another kind than {', '.join(_FLOATS)}")
    if record.state[1] not in ("<", ">"):
        raise ValueError(f"the byte order {record.state[1]!r}")
    return np.dtype(record.state[1] + record.arguments[0])
