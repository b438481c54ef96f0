"""NumPy files of Python objects, in which VPR-Bench, AnyLoc and GSV-Cities store lists of true references.

Such a file is a pickle, and to load one is to run it.  Here the standard library lists its instructions
(``pickletools``), and those that put numbers, texts, lists and arrays together are followed; nothing is imported or
called, and a file with anything else is refused.  Of the data sets that a preset names, some have no other truth, and
``torch.load(weights_only=True)`` reads none of these files: it knows neither protocol 3 nor 4, in which NumPy writes.
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

_PLAIN = (
    pickletools.pyint, pickletools.pyinteger_or_bool, pickletools.pyfloat, pickletools.pystring, pickletools.pybytes,
    pickletools.pybytes_or_str, pickletools.pyunicode,
)  # fmt: skip
"""The instructions that push the value of their argument, by the kind of the argument."""
_CONSTANTS: dict[str, Any] = {"NONE": None, "NEWTRUE": True, "NEWFALSE": False, "EMPTY_TUPLE": ()}
_MULTIARRAYS = ("numpy.core.multiarray", "numpy._core.multiarray")
_MARK = object()


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


class _Refused(Exception):
    """The file has an instruction that no array of numbers and lists needs."""


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
    wide = 2 if data[6:7] == b"\1" else 4  # of the header's length
    try:
        found = _value(data[8 + wide + int.from_bytes(data[8 : 8 + wide], "little") :])
    except _Refused as error:
        raise InvalidGroundTruth(f"{path.name} is not read: it holds {error}, as no list of references does.") from None
    # Whatever a damaged file makes of the instructions: too few values, a number for a list, no end.
    except (ValueError, TypeError, IndexError, KeyError, AttributeError, OverflowError, UnicodeError):
        found = None
    if data[:6] != b"\x93NUMPY" or not isinstance(found, Array):
        raise InvalidGroundTruth(f"{path.name} is not a whole NumPy file of objects.")
    return found


def _value(data: bytes) -> Any:
    """The value that a pickle's instructions build, on a stack as they assume; a function is given as its name."""
    stack, memo = list[Any](), dict[int, Any]()
    argument: Any
    for instruction, argument, _ in pickletools.genops(data):
        match instruction.name:
            case "PROTO" | "FRAME" | "STOP":
                pass
            case name if name in _CONSTANTS:
                stack.append(_CONSTANTS[name])
            case "MARK":
                stack.append(_MARK)
            case "EMPTY_LIST":
                stack.append([])
            case "LIST":
                stack.append(_since_mark(stack))
            case "TUPLE":
                stack.append(tuple(_since_mark(stack)))
            case "TUPLE1" | "TUPLE2" | "TUPLE3" as name:
                count = int(name[-1])
                stack[-count:] = [tuple(stack[-count:])]
            case "APPEND" | "APPENDS" as name:
                items = [stack.pop()] if name == "APPEND" else _since_mark(stack)
                stack[-1].extend(items)
            case "MEMOIZE" | "PUT" | "BINPUT" | "LONG_BINPUT":
                memo[len(memo) if argument is None else argument] = stack[-1]
            case "GET" | "BINGET" | "LONG_BINGET":
                stack.append(memo[argument])
            case "GLOBAL":
                stack.append(argument.replace(" ", "."))
            case "STACK_GLOBAL":
                stack[-2:] = [".".join(stack[-2:])]
            case "REDUCE":
                arguments = stack.pop()
                stack[-1] = _made(stack[-1], arguments)
            case "BUILD":
                _fill(stack[-2], stack.pop())
            case _ if argument is not None and instruction.stack_after[:1] and instruction.stack_after[0] in _PLAIN:
                stack.append(argument)
            case name:
                raise _Refused(f"the instruction {name}")
    return stack.pop()


def _since_mark(stack: list[Any]) -> list[Any]:
    items = []
    while (item := stack.pop()) is not _MARK:
        items.append(item)
    return items[::-1]


def _made(called: str, arguments: tuple[Any, ...]) -> Any:
    """The results of the calls that NumPy writes: an empty array, a type, a number, and bytes as Python 2 has them."""
    match called.rpartition("."):
        case (module, _, "_reconstruct") if module in _MULTIARRAYS:
            return Array()
        case (module, _, "scalar") if module in _MULTIARRAYS:
            return _numbers(arguments[0], arguments[1])[0]
        case ("numpy", _, "dtype"):
            return _Type(str(arguments[0]))
        case ("_codecs", _, "encode"):
            return arguments[0].encode("latin-1")
        case _:
            raise _Refused(f"a call of {called}"[:120])


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
