"""MATLAB's ``.mat`` files of level 5, in which MatConvNet (Vedaldi and Lenc, 2015) keeps its networks.

The format is MathWorks' "MAT-File Level 5 File Format": elements of a kind, a length and their bytes, one within
another.  SciPy's reader trusts what a file says of itself, and a damaged file ends the process with it; this one
checks each length, and reads no more kinds than a network has.
"""

from __future__ import annotations

import math
import mmap
import struct
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from core.errors import InvalidModel

Value = Any  # str, NDArray, list (a cell), dict (a structure), or Unreadable

MAX_BYTES = 4 * 2**30
"""Of a variable, inflated; the published NetVLAD networks have 600 MB."""

MAX_DEPTH = 32
MAX_DIMENSIONS = 32

_HEADER_BYTES = 128
_HDF5 = b"\x89HDF\r\n\x1a\n"

# Kinds of elements, and classes of arrays.
_MATRIX, _COMPRESSED = 14, 15
_KINDS = {
    1: "i1", 2: "u1", 3: "<i2", 4: "<u2", 5: "<i4", 6: "<u4", 7: "<f4", 9: "<f8", 12: "<i8", 13: "<u8",
}  # fmt: skip
_TEXTS = {1: "latin-1", 2: "latin-1", 4: "utf-16-le", 16: "utf-8", 17: "utf-16-le", 18: "utf-32-le"}
_CELL, _STRUCTURE, _OBJECT, _TEXT, _SPARSE, _FUNCTION, _OPAQUE = 1, 2, 3, 4, 5, 16, 17
_CLASSES = {
    6: "<f8", 7: "<f4", 8: "i1", 9: "u1", 10: "<i2", 11: "<u2", 12: "<i4", 13: "<u4", 14: "<i8", 15: "<u8",
}  # fmt: skip
_COMPLEX = 0x08

Element = tuple[int, memoryview]


@dataclass(frozen=True)
class Unreadable:
    """An object of a MATLAB class, a function, or numbers of a kind that no network has."""

    kind: str


def read_mat(path: Path) -> dict[str, Value]:
    """The variables of a file by name.

    A structure becomes a dict (several in an array a list), a cell a list in MATLAB's order, text a str,
    numbers an array of the sides that MATLAB sees, at least two.

    Raises:
        InvalidModel: it is of MATLAB's 7.3 format, no ``.mat`` file, or damaged.
    """
    try:
        with path.open("rb") as file:
            content = memoryview(mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ))
    except (OSError, ValueError) as error:
        raise InvalidModel(f"{path.name} cannot be read: {error}") from error
    header = bytes(content[:_HEADER_BYTES])
    if header.startswith((b"MATLAB 7.3", _HDF5)):
        raise InvalidModel(f"{path.name} is of MATLAB's 7.3 format (HDF5); save it in MATLAB again, with '-v7'.")
    if len(header) < _HEADER_BYTES or header[126:] != b"IM":
        raise InvalidModel(f"{path.name} is not a MATLAB file of level 5 from a little-endian machine.")
    try:
        return dict(_variable(element) for element in _elements(content[_HEADER_BYTES:]))
    except InvalidModel as error:
        raise InvalidModel(f"{path.name} cannot be used: {error}") from error


def is_mat(path: Path) -> bool:
    """Whether a file begins as MATLAB's do, of level 5 or 7.3."""
    try:
        with path.open("rb") as file:
            start = file.read(8)
    except OSError:
        return False
    return start.startswith((b"MATLAB", _HDF5))


def numbers(value: Value, what: str, *shape: int | None) -> NDArray[np.float32]:
    """Numbers as float32 of a shape; MATLAB drops sides of length 1 at the end, they are put back.

    Args:
        what: the name for the reader of an error.
        shape: sides; None for any.

    Raises:
        InvalidModel: it holds no numbers, of another shape, or some that are not finite.
    """
    if not isinstance(value, np.ndarray) or value.dtype.kind not in "fiu":
        raise InvalidModel(f"{what} does not hold numbers.")
    found = value.shape + (1,) * (len(shape) - value.ndim)
    if len(found) != len(shape) or any(side not in (None, have) for side, have in zip(shape, found, strict=True)):
        wanted = " x ".join("any" if side is None else str(side) for side in shape)
        raise InvalidModel(f"{what} has the shape {value.shape}; {wanted} is needed.")
    with np.errstate(over="ignore"):  # a double too large for a float is found below
        numbers = np.array(value.reshape(found), np.float32, order="C")
    if not np.isfinite(numbers).all():
        raise InvalidModel(f"{what} holds values that are not finite.")
    return numbers


# Elements


def _elements(content: memoryview) -> Iterator[Element]:
    """The elements that lie in a row, each its kind and its bytes."""
    position = 0
    while position < len(content):
        tag = content[position : position + 8]
        if len(tag) < 8:
            raise InvalidModel("the file is cut.")
        kind, length = struct.unpack("<II", tag)
        if kind > 0xFFFF:  # a small element: its length is above its kind, its bytes within the tag
            kind, length = kind & 0xFFFF, kind >> 16
            start, end, following = position + 4, position + 4 + length, position + 8
        else:
            start, end = position + 8, position + 8 + length
            following = end if kind == _COMPRESSED else end + -length % 8
        if end > min(following, len(content)):
            raise InvalidModel("the file is cut or damaged.")
        yield kind, content[start:end]
        position = following


def _variable(element: Element) -> tuple[str, Value]:
    kind, content = element
    if kind == _COMPRESSED:
        inflater = zlib.decompressobj()
        try:
            inflated = memoryview(inflater.decompress(content, MAX_BYTES))
        except zlib.error as error:
            raise InvalidModel(f"the file is damaged: {error}.") from error
        if not inflater.eof:
            raise InvalidModel(f"the file is cut, or has a variable of more than {MAX_BYTES} bytes.")
        kind, content = next(_elements(inflated), (0, inflated))
    if kind != _MATRIX:
        raise InvalidModel("the file is damaged: a variable is no array.")
    return _array(content, 0)


def _next(elements: Iterator[Element], *kinds: int) -> memoryview:
    """The bytes of the next element, which must be of one of the kinds."""
    kind, content = next(elements, (0, memoryview(b"")))
    if kind not in kinds:
        raise InvalidModel("the file is damaged: an array lacks a part of its head.")
    return content


# Arrays


def _array(content: memoryview, depth: int) -> tuple[str, Value]:
    """The name of an array, which only variables have, and its value."""
    if depth > MAX_DEPTH:
        raise InvalidModel("its structures are too deep.")
    if not len(content):
        return "", np.zeros((0, 0))
    elements = _elements(content)
    flags = _next(elements, 6)
    if len(flags) != 8:
        raise InvalidModel("the file is damaged: an array lacks a part of its head.")
    kind = flags[0]
    if kind == _OPAQUE:  # an object of a class: no sides, but the names of variable, system and class
        name, _, described = (_text(_next(elements, 1), "latin-1") for _ in range(3))
        return name, Unreadable(described)
    sides = np.frombuffer(_whole(_next(elements, 5), 4), "<i4").tolist()
    if not 2 <= len(sides) <= MAX_DIMENSIONS or min(sides) < 0:
        raise InvalidModel("the file is damaged: an array has impossible sides.")
    name = _text(_next(elements, 1), "latin-1")
    return name, _value(kind, flags[1], tuple(sides), elements, depth)


def _value(kind: int, flags: int, sides: tuple[int, ...], elements: Iterator[Element], depth: int) -> Value:
    if kind in _CLASSES and not flags & _COMPLEX:
        return _numbers(np.dtype(_CLASSES[kind]), sides, elements)
    if kind == _CELL:
        items = [_array(item, depth + 1)[1] for item in _matrices(elements)]
        if len(items) != math.prod(sides):
            raise InvalidModel("the file is damaged: a cell has not as many values as it says.")
        return items
    if kind == _STRUCTURE:
        return _structures(math.prod(sides), elements, depth)
    if kind == _TEXT:
        return _lines(sides, elements)
    if kind == _OBJECT:  # of MATLAB's older kind of classes
        return Unreadable(_text(_next(elements, 1), "latin-1"))
    return Unreadable({_SPARSE: "sparse", _FUNCTION: "function"}.get(kind, f"class {kind}"))


def _matrices(elements: Iterator[Element]) -> Iterator[memoryview]:
    for kind, content in elements:
        if kind != _MATRIX:
            raise InvalidModel("the file is damaged: a value of a cell or structure is no array.")
        yield content


def _structures(count: int, elements: Iterator[Element], depth: int) -> Value:
    """One dict, or a list of them: the values come structure by structure, field by field."""
    widths = np.frombuffer(_whole(_next(elements, 5), 4), "<i4").tolist()
    table = _next(elements, 1)  # of names, each ``width`` bytes long
    if len(widths) != 1 or widths[0] < 1 or len(table) % widths[0]:
        raise InvalidModel("the file is damaged: a structure has no names.")
    names = [_text(table[i : i + widths[0]], "latin-1") for i in range(0, len(table), widths[0])]
    values = [_array(item, depth + 1)[1] for item in _matrices(elements)]
    if not names and not values:
        return {}
    if len(values) != count * len(names):
        raise InvalidModel("the file is damaged: a structure has not as many values as it says.")
    found = [dict(zip(names, values[i : i + len(names)], strict=True)) for i in range(0, len(values), len(names))]
    return found[0] if count == 1 else found


def _numbers(dtype: np.dtype[Any], sides: tuple[int, ...], elements: Iterator[Element]) -> NDArray[Any]:
    """Numbers of a class; MATLAB writes them in the smallest kind that holds their values."""
    kind, content = next(elements, (0, memoryview(b"")))
    if kind not in _KINDS:
        raise InvalidModel("the file is damaged: an array has no numbers.")
    written = np.dtype(_KINDS[kind])
    found = np.frombuffer(_whole(content, written.itemsize), written)
    if len(found) != math.prod(sides):
        raise InvalidModel(f"the file is damaged: an array of the sides {sides} has {len(found)} numbers.")
    return found.astype(dtype, copy=False).reshape(sides, order="F")


def _lines(sides: tuple[int, ...], elements: Iterator[Element]) -> str:
    """Text; of several rows, which lie column by column, one line each."""
    kind, content = next(elements, (1, memoryview(b"")))
    if kind not in _TEXTS:
        raise InvalidModel("the file is damaged: a text has no characters.")
    text = _text(content, _TEXTS[kind])
    return text if sides[0] <= 1 else "\n".join(text[row :: sides[0]] for row in range(min(sides[0], len(text))))


def _text(content: memoryview, encoding: str) -> str:
    return bytes(content).decode(encoding, "replace").rstrip("\0")


def _whole(content: memoryview, size: int) -> memoryview:
    if len(content) % size:
        raise InvalidModel("the file is damaged: a number is cut.")
    return content
