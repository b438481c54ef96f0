"""NumPy files of Python objects, in which VPR-Bench and its followers keep lists of true references.

Such a file is a pickle, and to load one is to run it.  Here its instructions are only read, one after another
(``pickletools``): numbers, texts, lists and arrays are put together, nothing is imported or called, and a file with
anything else is refused.  ``torch.load(weights_only=True)`` would do, but knows no pickle protocol above 2, in which
NumPy writes.
"""

from __future__ import annotations

import math
import pickletools
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from core.errors import InvalidGroundTruth

MAX_BYTES = 2**26
"""Of a file; the largest published lists have less than 2 MB."""

_PUSHED = {
    "INT", "LONG", "LONG1", "LONG4", "BININT", "BININT1", "BININT2", "BINUNICODE", "SHORT_BINUNICODE", "UNICODE",
    "BINBYTES", "SHORT_BINBYTES", "BINBYTES8", "BINSTRING", "SHORT_BINSTRING", "STRING", "FLOAT", "BINFLOAT",
}  # fmt: skip
_CONSTANTS: dict[str, Any] = {"NONE": None, "NEWTRUE": True, "NEWFALSE": False}
_IGNORED = {"PROTO", "FRAME", "STOP"}
_MULTIARRAYS = ("numpy.core.multiarray", "numpy._core.multiarray")
_MARK = object()


@dataclass(frozen=True)
class _Name:
    """A function or a class that the file names; it is never looked up."""

    module: str
    name: str


@dataclass
class Array:
    """An array of the file: of numbers, or of objects.

    items: in row-major order.
    """

    shape: tuple[int, ...] = ()
    items: Any = ()


@dataclass
class _Type:
    code: str
    order: str = "<"


def read_object_array(path: Path) -> Array:
    """The array of a ``.npy`` file of objects; its items are numbers, texts, lists and arrays.

    Raises:
        InvalidGroundTruth: the file cannot be read, is no such array, is damaged, or holds anything else.
    """
    try:
        with path.open("rb") as file:
            data = file.read(MAX_BYTES + 1)
    except OSError as error:
        raise InvalidGroundTruth(f"{path} cannot be read: {error.strerror}.") from error
    if len(data) > MAX_BYTES:
        raise InvalidGroundTruth(f"{path.name} has more than {MAX_BYTES} bytes; no list of true references has.")
    try:
        found = _Reader().read(_pickle(data))
    except _Refused as error:
        raise InvalidGroundTruth(
            f"{path.name} is not read: it holds {error}, which no list of references does."
        ) from None
    # Faults of the instructions in a damaged file: too few values, a number for a list, no end.
    except (ValueError, TypeError, IndexError, KeyError, AttributeError, OverflowError, UnicodeError) as error:
        raise InvalidGroundTruth(f"{path.name} is not a whole NumPy file of objects.") from error
    if not isinstance(found, Array):
        raise InvalidGroundTruth(f"{path.name} holds no array.")
    return found


class _Refused(Exception):
    """The file asks for something that no array of numbers and lists needs."""


def _pickle(data: bytes) -> bytes:
    """The data behind the header of a ``.npy`` file."""
    if data[:6] != b"\x93NUMPY":
        raise ValueError("no NumPy file")
    wide = 2 if data[6] == 1 else 4
    return data[8 + wide + int.from_bytes(data[8 : 8 + wide], "little") :]


class _Reader:
    """Puts values together as a pickle's instructions say, on a stack as they assume."""

    def __init__(self) -> None:
        self._stack: list[Any] = []
        self._memo: dict[int, Any] = {}

    def read(self, data: bytes) -> Any:
        for instruction, argument, _ in pickletools.genops(data):
            self._step(instruction.name, argument)
        return self._stack.pop()

    def _step(self, name: str, argument: Any) -> None:
        stack = self._stack
        if name in _PUSHED:
            stack.append(argument)
        elif name in _CONSTANTS:
            stack.append(_CONSTANTS[name])
        elif name == "MARK":
            stack.append(_MARK)
        elif name in ("EMPTY_LIST", "EMPTY_TUPLE"):
            stack.append([] if name == "EMPTY_LIST" else ())
        elif name in ("LIST", "TUPLE"):
            items = self._since_mark()
            stack.append(items if name == "LIST" else tuple(items))
        elif name in ("TUPLE1", "TUPLE2", "TUPLE3"):
            count = int(name[-1])
            stack[-count:] = [tuple(stack[-count:])]
        elif name in ("APPEND", "APPENDS"):
            items = [stack.pop()] if name == "APPEND" else self._since_mark()
            stack[-1].extend(items)
        elif name in ("PUT", "BINPUT", "LONG_BINPUT"):
            self._memo[argument] = stack[-1]
        elif name == "MEMOIZE":
            self._memo[len(self._memo)] = stack[-1]
        elif name in ("GET", "BINGET", "LONG_BINGET"):
            stack.append(self._memo[argument])
        elif name == "GLOBAL":
            stack.append(_Name(*argument.split(" ")))
        elif name == "STACK_GLOBAL":
            stack[-2:] = [_Name(*stack[-2:])]
        elif name == "REDUCE":
            arguments = stack.pop()
            stack[-1] = _made(stack[-1], arguments)
        elif name == "BUILD":
            _fill(stack[-2], stack.pop())
        elif name not in _IGNORED:
            raise _Refused(f"the instruction {name}")

    def _since_mark(self) -> list[Any]:
        items = []
        while (item := self._stack.pop()) is not _MARK:
            items.append(item)
        return items[::-1]


def _made(named: Any, arguments: tuple[Any, ...]) -> Any:
    """The results of the calls that NumPy writes: an empty array, a type, a number, and bytes as Python 2 has them."""
    match named:
        case _Name(module=module, name="_reconstruct") if module in _MULTIARRAYS:
            return Array()
        case _Name(module=module, name="scalar") if module in _MULTIARRAYS:
            return _numbers(arguments[0], arguments[1])[0]
        case _Name(module="numpy", name="dtype"):
            return _Type(str(arguments[0]))
        case _Name(module="_codecs", name="encode"):
            return arguments[0].encode("latin-1")
        case _:
            raise _Refused(f"a call of {named.module}.{named.name}"[:120] if isinstance(named, _Name) else "a call")


def _fill(made: Any, state: tuple[Any, ...]) -> None:
    match made:
        case Array():
            _, shape, kind, fortran, content = state
            made.shape = tuple(int(side) for side in shape)
            made.items = content if isinstance(content, list) else _numbers(kind, content)
            if fortran and len(made.shape) > 1:
                order = np.arange(len(made.items)).reshape(made.shape, order="F").ravel()
                made.items = [made.items[index] for index in order]
            if math.prod(made.shape) != len(made.items):
                raise ValueError("an array lacks items")
        case _Type():
            made.order = state[1] if state[1] in ("<", ">") else "<"
        case _:
            raise _Refused("an object with a state of its own")


def _numbers(kind: _Type, data: bytes | str) -> list[Any]:
    """Whole numbers and floats as Python's."""
    if kind.code[0] not in "iufb":
        raise _Refused(f"values of the type {kind.code[:20]}")
    return np.frombuffer(data.encode("latin-1") if isinstance(data, str) else data, kind.order + kind.code).tolist()
