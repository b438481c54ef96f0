"""Pictures of 16 bits whose camera uses a part of them: ten bits, or the range of a thermal sensor.

A frame is encoded by 8 bits.  Without a range, those are the upper 8 of 16, which leave such a picture nearly black or
of one grey; so the camera of a map may have the range of its values, by which all its frames are scaled alike.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Annotated, Any

import cv2
import numpy as np
from numpy.typing import NDArray
from pydantic import AfterValidator, Field

from core.frames.containers import PNG_SIGNATURE

LARGEST = 65535
HALF = (LARGEST + 1) // 2
"""Values that use half of the range or more are used by their upper 8 bits."""

FRINGE = 0.0001
"""The share of a recording's values, at either end, that do not count for its range: dead and hot pixels."""


def _ascending(value: tuple[int, int]) -> tuple[int, int]:
    if value[0] >= value[1]:
        raise ValueError("the lower end of the range must be below the upper one")
    return value


_Value = Annotated[int, Field(strict=True, ge=0, le=LARGEST)]
ValueRange = Annotated[tuple[_Value, _Value], AfterValidator(_ascending)]
"""The values of 16 bits that become 0 and 255."""


def has_16_bits(data: bytes) -> bool:
    """Whether bytes are those of a PNG file of 16 bits."""
    return data.startswith(PNG_SIGNATURE) and data[24:25] == b"\x10"


def scaled(pixels: NDArray[np.uint16], value_range: ValueRange) -> NDArray[np.uint8]:
    """Pixels by 8 bits, of which 0 and 255 are the ends of the range; those beyond it are as its ends."""
    low, high = value_range
    steps = np.clip((np.arange(LARGEST + 1) - low) * 255 / (high - low), 0, 255)
    return np.rint(steps).astype(np.uint8)[pixels]


def few_values(data: bytes) -> ValueRange | None:
    """The lowest and the highest value of a PNG file of 16 bits that uses less than half of their range; else None."""
    found = _values(data)
    if found is None:
        return None
    low, high = int(found.min()), int(found.max())
    return (low, high) if 0 < high - low < HALF else None


def range_of(pictures: Iterable[bytes]) -> ValueRange | None:
    """The range of all values but a few at either end, of pictures of one camera.

    None if no file is a PNG of 16 bits, or if they use half of their range or more.
    """
    counts: NDArray[Any] = np.zeros(LARGEST + 1, np.int64)
    for data in pictures:
        if (found := _values(data)) is not None:
            counts += np.bincount(found.ravel(), minlength=LARGEST + 1)
    if not (total := int(counts.sum())):
        return None
    below = np.cumsum(counts) / total
    low, high = int(np.searchsorted(below, FRINGE)), int(np.searchsorted(below, 1 - FRINGE))
    return (low, high) if 0 < high - low < HALF else None


def told(value_range: ValueRange) -> str:
    """The part of a sentence that says which values are used."""
    low, high = value_range
    return f"reach only {high} of {LARGEST}" if 4 * low < high else f"lie between {low} and {high} of {LARGEST}"


def _values(data: bytes) -> NDArray[np.uint16] | None:
    """The values of a PNG file of 16 bits; None of another file, and of a damaged one."""
    if not has_16_bits(data):
        return None
    try:
        found = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_ANYDEPTH | cv2.IMREAD_ANYCOLOR)
    except cv2.error:
        return None
    return None if found is None or found.dtype != np.uint16 else np.asarray(found)
