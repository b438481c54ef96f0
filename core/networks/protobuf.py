"""The protobuf wire format, as far as reading a model without its schema needs it (protobuf.dev, "Encoding").

A message is a run of fields, each a number and a value: a whole number, a fixed-width float, or a stretch of
bytes that may be text, packed numbers or another message; only the reader knows which.  Nothing is copied
until it is asked for, so a file of hundreds of megabytes can be read through a memory map.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from core.errors import InvalidModel

Value = int | memoryview | NDArray[Any]

MAX_FIELDS = 100_000
"""Fields of one message; a network of a thousand layers has a thousand. Unpacked floats in a row count as one."""

_VARINT, _FIXED64, _BYTES, _FIXED32 = 0, 1, 2, 5
_FLOATS: dict[int, np.dtype[Any]] = {_FIXED32: np.dtype("<f4"), _FIXED64: np.dtype("<f8")}


class Message:
    """The fields of one message by number.  A field that is absent reads as none, zero or its default.

    Args:
        views: the bytes; several are one message that was sent in parts.

    Raises:
        InvalidModel: the bytes are not a message, or one of more than ``MAX_FIELDS`` fields.
    """

    def __init__(self, *views: memoryview) -> None:
        self._fields: dict[int, list[Value]] = {}
        for view in views:
            for count, (number, value) in enumerate(_read_fields(view)):
                if count >= MAX_FIELDS:
                    raise InvalidModel(f"A message of the model has more than {MAX_FIELDS} fields.")
                self._fields.setdefault(number, []).append(value)

    def __contains__(self, number: int) -> bool:
        return number in self._fields

    def integers(self, number: int) -> list[int]:
        """All values of a field of whole numbers, packed or not; negative ones come as their value mod 2^64."""
        found: list[int] = []
        for value in self._fields.get(number, ()):
            if isinstance(value, int):
                found.append(value)
            elif isinstance(value, memoryview):
                found += _read_varints(value)
            else:
                raise InvalidModel(f"Field {number} of the model does not hold whole numbers.")
        return found

    def integer(self, number: int, default: int = 0) -> int:
        """The value of a field of one whole number; the last one counts."""
        return (self.integers(number) or [default])[-1]

    def floats(self, number: int) -> NDArray[np.float32]:
        """All values of a field of 32-bit floats, packed or not: [n]."""
        return self._numbers(number, np.dtype("<f4")).astype(np.float32, copy=False)

    def doubles(self, number: int) -> NDArray[np.float64]:
        """All values of a field of 64-bit floats, packed or not: [n]."""
        return self._numbers(number, np.dtype("<f8")).astype(np.float64, copy=False)

    def float(self, number: int, default: float) -> float:
        """The value of a field of one 32-bit float; the last one counts."""
        found = self.floats(number)
        return float(found[-1]) if len(found) else default

    def texts(self, number: int) -> list[str]:
        """All values of a field of text."""
        try:
            return [bytes(view).decode() for view in self._views(number)]
        except UnicodeDecodeError:
            raise InvalidModel(f"Field {number} of the model is not UTF-8 text.") from None

    def text(self, number: int) -> str:
        """The value of a field of text; the last one counts."""
        return (self.texts(number) or [""])[-1]

    def messages(self, number: int) -> list[Message]:
        """All values of a field of messages."""
        return [Message(view) for view in self._views(number)]

    def message(self, number: int) -> Message:
        """The value of a field of one message; empty without one, its parts together if it was sent in parts."""
        return Message(*self._views(number))

    def _numbers(self, number: int, dtype: np.dtype[Any]) -> NDArray[Any]:
        parts: list[NDArray[Any]] = []
        for value in self._fields.get(number, ()):
            if isinstance(value, memoryview) and len(value) % dtype.itemsize == 0:
                parts.append(np.frombuffer(value, dtype))
            elif isinstance(value, np.ndarray) and value.dtype == dtype:
                parts.append(value)
            else:
                raise InvalidModel(f"Field {number} of the model does not hold numbers of {dtype.itemsize} bytes.")
        return np.concatenate(parts) if parts else np.empty(0, dtype)

    def _views(self, number: int) -> list[memoryview]:
        views = [value for value in self._fields.get(number, ()) if isinstance(value, memoryview)]
        if len(views) != len(self._fields.get(number, ())):
            raise InvalidModel(f"Field {number} of the model is a number where bytes belong.")
        return views


def _read_varint(view: memoryview, position: int) -> tuple[int, int]:
    """A number of at most 64 bits, seven in a byte, and the position after it."""
    value = 0
    for shift, byte in zip(range(0, 70, 7), view[position : position + 10], strict=False):
        value |= (byte & 0x7F) << shift
        if byte < 0x80:
            return value & 0xFFFF_FFFF_FFFF_FFFF, position + shift // 7 + 1
    raise InvalidModel("The model is damaged: a number does not end.")


def _read_varints(view: memoryview) -> list[int]:
    found: list[int] = []
    position = 0
    while position < len(view):
        if len(found) >= MAX_FIELDS:
            raise InvalidModel(f"A field of the model has more than {MAX_FIELDS} whole numbers.")
        value, position = _read_varint(view, position)
        found.append(value)
    return found


def _read_fields(view: memoryview) -> Iterator[tuple[int, Value]]:
    position = 0
    while position < len(view):
        start = position
        tag, position = _read_varint(view, position)
        number, kind = tag >> 3, tag & 7
        value: Value
        if number == 0:
            raise InvalidModel("The model is damaged: a field has no number.")
        if kind == _VARINT:
            value, position = _read_varint(view, position)
        elif kind == _BYTES:
            length, position = _read_varint(view, position)
            if length > len(view) - position:
                raise InvalidModel("The model is cut: a field ends after the file.")
            value = view[position : position + length]
            position += length
        elif kind in _FLOATS:
            value = _read_run(view, start, position, _FLOATS[kind])
            position = start + len(value) * (position - start + value.itemsize)
        else:
            raise InvalidModel(f"The model is damaged: a field has the wire type {kind}.")
        yield number, value


def _read_run(view: memoryview, start: int, position: int, dtype: np.dtype[Any]) -> NDArray[Any]:
    """The floats of all fields in a row that bear the tag ``view[start:position]``: [n], n > 0.

    Weights that are not packed come as millions of such fields.
    """
    tag = bytes(view[start:position])
    record = np.dtype([("tag", f"V{len(tag)}"), ("value", dtype)])
    available = (len(view) - start) // record.itemsize
    if not available:
        raise InvalidModel("The model is cut: a number ends after the file.")
    # The stretch that is looked at doubles while it holds nothing else, so that the work follows the run's length.
    length = 1
    while True:
        length = min(2 * length, available)
        records = np.frombuffer(view[start : start + length * record.itemsize], record)
        others = np.flatnonzero(records["tag"] != np.void(tag))
        if len(others) or length == available:
            return np.asarray(records["value"][: others[0] if len(others) else length])
