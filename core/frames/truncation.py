"""Whether a JPEG file held all of the picture that was decoded from it.

Where coded data is missing, a decoder fills in flat grey and says nothing: of a frame that lost its lower half on
the way, and got an end marker behind what was left, comes a picture whose lower half is grey.  It would be answered
as a place.

Nothing needs to be known here of how coefficients are coded.  A picture that is whole does not depend on what
follows its coded data; one that is not takes whatever follows for its missing part.  So the file is decoded once
more with other bytes behind each stretch of coded data, and both pictures are compared.  That costs as much as the
first decoding, so it is done only where a block of the picture is filler by its looks, or where filler looks
otherwise: scans laid over each other, four inks.
"""

from __future__ import annotations

import re

import numba
import numpy as np

from core.frames.containers import Structure
from core.frames.preprocessing import Pixels

_FILLER = 128
"""Of each colour, where no data was."""

_BLOCK = 8
_PROBES = ((2, 2), (5, 5), (2, 5), (5, 2), (3, 4), (4, 3))
"""Side of a block, and pixels of it (row, column) that smoothed colours of the blocks around do not reach."""

_NOISE = b"\0" + bytes((37 * i * i + 101 * i + 53) % 255 for i in range(127))
"""Without FF, which would be a marker. The 0 keeps a fill byte FF before it from becoming one."""

_RESTART = re.compile(rb"\xff[\xd0-\xd7]")


def may_be_filled(structure: Structure, pixels: Pixels) -> bool:
    """Whether a part of the picture may be the decoder's filler; it is not in nearly all that a camera sends.

    Args:
        structure: of the JPEG file.
        pixels: H x W x 3 uint8, BGR, as they are stored, not turned.
    """
    if not structure.plain or min(pixels.shape[:2]) < _BLOCK:  # a block that is cut by two edges has few pixels
        return True
    return bool(_has_filler(pixels))


@numba.njit(cache=True, nogil=True)
def _has_filler(pixels):  # type: ignore[no-untyped-def]
    """Whether all probes of a block are filler; uint8 [H, W, 3]."""
    height, width = pixels.shape[:2]
    # The last block may be cut by the edge of the picture: its last pixels are looked at by themselves.
    if (pixels[-1, -2:] == _FILLER).all():
        return True
    for top in range(0, height - _BLOCK + 1, _BLOCK):
        for left in range(0, width - _BLOCK + 1, _BLOCK):
            for down, right in _PROBES:
                pixel = pixels[top + down, left + right]
                if pixel[0] != _FILLER or pixel[1] != _FILLER or pixel[2] != _FILLER:
                    break  # of nearly all blocks the first
            else:
                return True
    return False


def with_other_endings(data: bytes, structure: Structure) -> bytes:
    """The same JPEG file with noise behind each stretch of coded data; a decoder passes over it where none is missing.

    Args:
        structure: of the file.
    """
    parts: list[bytes] = []
    done = 0
    for start, end in structure.coded:
        coded = data[start:end]
        parts += [data[done:start], _RESTART.sub(lambda found: _NOISE + found[0], coded), _NOISE]
        if structure.restarts:  # whole stretches may be missing at the end: here they are
            last = len(_RESTART.findall(coded))
            parts += [bytes([0xFF, 0xD0 + (last + i) % 8]) + _NOISE for i in range(8)]
        done = end
    return b"".join([*parts, data[done:]])


def same(one: Pixels | None, other: Pixels) -> bool:
    """Whether two pictures are equal in each pixel; False if the first could not be decoded."""
    return one is not None and one.shape == other.shape and bool(np.array_equal(one, other))
