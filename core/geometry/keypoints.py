"""The keypoints of a frame, quantized, and the record in which a place stores them.

Positions are shares of the frame's width and height, so that they mean the same at any size of the network's input;
:meth:`Keypoints.pixels` gives them in pixels of the frame.

A record is the frame's width and height in pixels and the number of keypoints n, each four bytes, then the positions,
two bytes each of x and y, and then the descriptors, 64 bytes each: 12 + 68 n bytes, least significant byte first.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from core.errors import InvalidKeypoints

MOST = 384
"""Keypoints that are found in a frame at most: with them, a place takes 26 KB.  With 576, and frames of 480 pixels, no
traverse is recognized better, and a frame takes twice the time."""
MOST_STORED = 576
"""Keypoints of a record at most."""
LENGTH = 64
"""Values of a descriptor: those of XFeat."""

SHARES = 1 << 16
"""Steps by which a position is quantized, over the whole width or height."""
RESOLUTION = 254.0
"""Steps of 1 / RESOLUTION quantize the values of descriptors; values of half a unit and more, which are rare, become
127."""

_HEADER = struct.Struct("<III")
_EACH = 4 + LENGTH


def record_bytes(count: int) -> int:
    """Bytes of the record of ``count`` keypoints."""
    return _HEADER.size + _EACH * count


def count_of(size: int) -> int:
    """How many keypoints a record of ``size`` bytes has."""
    return (size - _HEADER.size) // _EACH


@dataclass(frozen=True)
class Keypoints:
    """The n keypoints of a frame, best first; 0 <= n <= MOST_STORED.

    width, height: of the frame, in pixels.
    positions: uint16 [n, 2], x and y in steps of width / SHARES and height / SHARES from the frame's upper left corner.
    descriptors: int8 [n, 64], of the length RESOLUTION, except for rounding.

    Raises:
        InvalidKeypoints: the arrays have other shapes or types, or the frame has no pixels.
    """

    width: int
    height: int
    positions: NDArray[np.uint16]
    descriptors: NDArray[np.int8]

    def __post_init__(self) -> None:
        count = len(self.positions)
        right = (
            self.positions.shape == (count, 2)
            and self.descriptors.shape == (count, LENGTH)
            and self.positions.dtype == np.uint16
            and self.descriptors.dtype == np.int8
        )
        if (
            not right
            or count > MOST_STORED
            or not (0 < min(self.width, self.height) <= max(self.width, self.height) < 1 << 32)
        ):
            raise InvalidKeypoints(
                f"{list(self.positions.shape)} positions and {list(self.descriptors.shape)} descriptors of a frame of "
                f"{self.width} x {self.height} pixels are no keypoints."
            )
        self.positions.setflags(write=False)
        self.descriptors.setflags(write=False)

    def __len__(self) -> int:
        return len(self.positions)

    def shares(self) -> NDArray[np.float64]:
        """Positions in shares of the frame's width and height, float64 [n, 2], x and y from its upper left corner."""
        return (self.positions + 0.5) / SHARES

    def pixels(self) -> NDArray[np.float64]:
        """Positions in pixels of the frame, float64 [n, 2], x and y from its upper left corner."""
        return self.shares() * np.array([self.width, self.height])

    def record(self) -> bytes:
        """The record of the keypoints."""
        header = _HEADER.pack(self.width, self.height, len(self))
        return header + self.positions.astype("<u2").tobytes() + self.descriptors.tobytes()


def keypoints_of(record: bytes) -> Keypoints:
    """The keypoints that :meth:`Keypoints.record` has put into a record, whose memory they share.

    Raises:
        InvalidKeypoints: the record cannot have been made so.
    """
    if len(record) < _HEADER.size:
        raise InvalidKeypoints(f"A record of {len(record)} bytes holds no keypoints.")
    width, height, count = _HEADER.unpack_from(record)
    if len(record) != record_bytes(count):
        raise InvalidKeypoints(f"A record of {len(record)} bytes cannot hold {count} keypoints.")
    positions = np.frombuffer(record, "<u2", 2 * count, _HEADER.size).astype(np.uint16, copy=False)
    descriptors = np.frombuffer(record, np.int8, LENGTH * count, _HEADER.size + 4 * count)
    made = Keypoints(width, height, positions.reshape(count, 2), descriptors.reshape(count, LENGTH))
    if count and not made.descriptors.any(axis=1).all():
        raise InvalidKeypoints(f"A record of {count} keypoints lacks a descriptor.")
    return made
