"""Lists of arrays that were pickled into .npy files of unknown origin: read as data, nothing of it is called.

An unpickler that finds no class but numpy's is not enough: the state a file gives a dtype can have numpy
take numbers for addresses. So the opcodes are followed here, what they want made is kept as a record
beside its arguments, and numpy is given bytes of floating point alone.
"""

import math
import pickletools

import numpy as np

from jaxnerf.data.readers.npy import read_header

# All that a list of arrays needs, in numpy 1 and 2 and, with bytes as text, in pickles of protocol 2.
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
    """What a pickle wants made, by which name and of what, and the state it is to be given."""

    def __init__(self, name, arguments):
        self.name, self.arguments, self.state = name, arguments, None


def read_array_list(path, wanted):
    """Returns the arrays, of floating point, of a .npy file that holds a list of them.

    Args:
        path: Path of the file.
        wanted: what it should hold, for the message.

    Raises:
        ValueError: if it is missing, damaged or holds anything else; names the file.
    """
    try:
        with path.open("rb") as file:
            shape, _, dtype = read_header(file)
            if not dtype.hasobject:
                raise ValueError(f"one array of {dtype}{list(shape)}, not a list")
            content = file.read()
        arrays = [_array(record) for record in _items(_follow(content))]
        if shape != (len(arrays),) or sum(array.nbytes for array in arrays) > len(content):
            raise ValueError(f"{len(arrays)} arrays, its header says {list(shape)}")
    except FileNotFoundError:
        raise ValueError(f"{path}: no such file, wanted {wanted}; correct the name") from None
    except Exception as error:  # of damaged files almost any
        reason = " ".join(str(error).split())[:200] or type(error).__name__
        raise ValueError(f"{path}: unreadable ({reason}), wanted {wanted}; fetch it again") from None
    return arrays


def _follow(content):
    """Returns what a pickle describes, with a Record for each object that it wants made."""
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
    """Follows an opcode that takes several things from the stack."""
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
        raise ValueError(f"it does more than list arrays: {name}")


def _name(name):
    if name not in _NAMES:
        raise ValueError(f"it asks for {name.replace(' ', '.')!r}, which is never called")
    return Record(_NAMES[name], None)


def _state(record):
    """Returns version, shape, dtype, whether columns come first, and contents, as numpy pickles an array."""
    if not isinstance(record, Record) or record.name != "array":
        raise ValueError(f"{type(record).__name__} where an array should be")
    return record.state


def _items(record):
    content = _state(record)[4]
    if not isinstance(content, list):
        raise ValueError("it is no list of arrays")
    return content


def _array(record):
    _, shape, dtype, fortran, content = _state(record)
    content, dtype = _bytes(content), _dtype(dtype)
    if len(shape) > 2 or min(shape, default=0) < 0 or math.prod(shape) * dtype.itemsize != len(content):
        raise ValueError(f"{len(content)} bytes for {dtype}{list(shape)[:3]}")
    return np.frombuffer(content, dtype).reshape(shape, order="F" if fortran else "C")


def _bytes(content):
    """Returns bytes, which protocol 2 writes as text to be encoded, and Python 2 as text."""
    if isinstance(content, Record) and content.name == "bytes":
        content = content.arguments[0]
    return content.encode("latin1") if isinstance(content, str) else content


def _dtype(record):
    if not isinstance(record, Record) or record.name != "dtype" or record.arguments[0] not in _FLOATS:
        raise ValueError(f"numbers of another kind than {', '.join(_FLOATS)}")
    if record.state[1] not in ("<", ">"):
        raise ValueError(f"the byte order {record.state[1]!r}")
    return np.dtype(record.state[1] + record.arguments[0])
