"""Decoding JPEG files by libjpeg-turbo in its strict mode, so that no part of a frame is made up.

Where coded data is missing, a tolerant decoder fills in flat grey and says nothing: of a frame that lost its lower half
on the way comes a picture whose lower half is grey, which would be answered as a place.  The strict mode refuses it.
It also refuses files that merely say something odd, as cheap cameras do (bytes of padding before a marker, a wrong
version).  Such a file is decoded twice by the tolerant decoder, the second time with other bytes before its end marker:
a picture that is whole does not depend on what follows its data, one that is cut takes it for the missing part.
"""

from __future__ import annotations

import re
from collections.abc import Callable

import numpy as np
import simplejpeg

from core.errors import NotAnImage, TruncatedImage
from core.frames.preprocessing import Pixels

_ODD = re.compile(
    r"extraneous bytes before marker|Invalid SOS parameters|unknown JFIF revision|Unknown Adobe color|bad ICC marker"
    r"|subsampling level|more than one scan"
)
"""Complaints of libjpeg-turbo about files that may be whole."""

_CUT = re.compile(r"[Pp]remature end|instead of RST|two SOI")
"""Complaints about data that is missing."""

_NOISE = b"\0" + bytes((37 * i * i + 101 * i + 53) % 255 for i in range(127))
"""Without FF, which would begin a marker. The 0 keeps a fill byte FF before it from becoming one."""

_EOI = b"\xff\xd9"
_STRETCH_END = re.compile(rb"(?=\xff[\x01-\xcf\xd8-\xfe])")
"""Before a marker that ends a stretch of coded data: of all but restarts."""

_RESTART = re.compile(rb"\xff([\xd0-\xd7])")
_MOST_STRETCHES, _MOST_RESTARTS = 1024, 65_536
"""Of a file that is decoded twice; noise behind each takes memory."""


def decode_jpeg(data: bytes, shape: tuple[int, int], coded: int, tolerant: Callable[[bytes], Pixels | None]) -> Pixels:
    """The pixels of a whole JPEG file as they are stored, uint8 [H, W, 3], BGR; bytes after its end are tolerated.

    Args:
        shape: height and width that its header announces; no more memory is taken.
        coded: where its coded data begins.
        tolerant: a decoder that gives the same pixels of a sound file, and accepts the strict mode's oddities; None
            if it cannot decode.

    Raises:
        TruncatedImage: a part of the picture is missing.
        NotAnImage: the file is damaged.
        MemoryError: there is not enough memory for the pixels.
    """
    try:
        return np.asarray(simplejpeg.decode_jpeg(data, "BGR", buffer=np.empty((*shape, 3), np.uint8)))
    except ValueError as error:
        complaint = str(error)
    if "memory" in complaint:
        raise MemoryError("the pixels find no room")
    if _CUT.search(complaint):
        raise TruncatedImage(f"The JPEG file is cut: a part of its data is missing ({complaint}).")
    pixels = tolerant(data) if _ODD.search(complaint) else None
    if pixels is None:
        raise NotAnImage(f"The JPEG file is damaged: {complaint}.")
    other = _with_other_endings(data, coded)
    again = None if other is None else tolerant(other)
    if again is None or not np.array_equal(pixels, again):
        raise TruncatedImage(f"The JPEG file is cut: a part of its data is missing ({complaint}).")
    return pixels


def _with_other_endings(data: bytes, start: int) -> bytes | None:
    """The file with noise behind each stretch of coded data; None without an end, with a gap between restarts, or with
    more stretches or restarts than a camera writes.
    """
    end = data.find(_EOI, start)
    if end < 0 or sum(data.count(bytes([0xFF, 0xD0 + number]), start, end) for number in range(8)) > _MOST_RESTARTS:
        return None
    parts = [data[:start]]
    stretches = _STRETCH_END.split(data[start:end], maxsplit=_MOST_STRETCHES)
    if len(stretches) > _MOST_STRETCHES:
        return None
    for stretch in stretches:
        restarts = [marker[0] - 0xD0 for marker in _RESTART.findall(stretch)]
        if any(number != place % 8 for place, number in enumerate(restarts)):
            return None
        # Whole stretches between restarts may be missing at the end: here they are.
        more = [bytes([0xFF, 0xD0 + (len(restarts) + place) % 8]) + _NOISE for place in range(8)]
        parts += [_RESTART.sub(lambda marker: _NOISE + marker[0], stretch), _NOISE, *more]
    return b"".join([*parts, data[end:]])
