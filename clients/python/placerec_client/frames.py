"""Frames as they are given, and the bytes that are sent for them."""

from __future__ import annotations

import os
import struct
import zlib
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, BinaryIO, Literal, TypeAlias

from placerec_client.errors import InvalidFrame

if TYPE_CHECKING:
    import numpy
    from numpy.typing import NDArray

    Pixels: TypeAlias = NDArray[numpy.uint8]


@dataclass(frozen=True)
class Picture:
    """An array as a frame, with the order of its channels.

    Args:
        pixels: uint8, [height, width] or [height, width, 3].
        order: of the channels: ``bgr`` as OpenCV has them, or ``rgb``.
    """

    pixels: Pixels
    order: Literal["bgr", "rgb"] = "bgr"


Frame: TypeAlias = "bytes | bytearray | memoryview | str | os.PathLike[str] | BinaryIO | Pixels | Picture"
"""The bytes of a JPEG, PNG or WebP file; the path of one; one opened for reading; or pixels, in OpenCV's order BGR."""


def frame_bytes(frame: Frame) -> bytes:
    """Return the bytes of the file that is sent for a frame: pixels become a PNG, which loses nothing.

    Raises:
        InvalidFrame: the file cannot be read, or the array is not uint8 of shape [H, W] or [H, W, 3].
    """
    if isinstance(frame, bytes):
        return frame
    if isinstance(frame, bytearray | memoryview):
        return bytes(frame)
    if isinstance(frame, Picture):
        return png(frame.pixels, frame.order)
    if hasattr(frame, "__array_interface__"):
        return png(frame)
    try:
        if isinstance(frame, str | os.PathLike):
            with open(frame, "rb") as file:
                return file.read()
        data = frame.read()
    except OSError as error:
        name = f"{os.fspath(frame)} " if isinstance(frame, str | os.PathLike) else "The frame's file "
        raise InvalidFrame(f"{name}cannot be read: {error.strerror}.") from error
    except ValueError as error:  # such as a closed file, or a name with a null
        raise InvalidFrame(f"The frame cannot be read: {error}.") from error
    except AttributeError as error:
        raise InvalidFrame(f"A {type(frame).__name__} is no frame.") from error
    if not isinstance(data, bytes):
        raise InvalidFrame("The frame's file is not opened in binary mode.")
    return data


def media_type(data: bytes) -> str:
    """The content type of a frame by its first bytes; image/jpeg if unknown, which the service then checks."""
    if data.startswith(b"\x89PNG"):
        return "image/png"
    return "image/webp" if data[:4] == b"RIFF" and data[8:12] == b"WEBP" else "image/jpeg"


def png(pixels: Any, order: str = "bgr") -> bytes:
    """Encode pixels as a PNG file.

    Args:
        pixels: NumPy array uint8, [height, width] or [height, width, 3].
        order: of the channels, ``bgr`` or ``rgb``.

    Raises:
        InvalidFrame: the array has another type or shape.
    """
    shape = tuple(pixels.shape)
    if str(pixels.dtype) != "uint8" or not (len(shape) == 2 or (len(shape) == 3 and shape[2] == 3)) or 0 in shape:
        raise InvalidFrame(f"An array {pixels.dtype} of shape {list(shape)} is no picture: uint8 [H, W] or [H, W, 3].")
    grey = len(shape) == 2
    rows = pixels if grey or order == "rgb" else pixels[..., ::-1]
    rows = rows.reshape(shape[0], -1)
    # Each row is stored as its difference from the one above (the filter "up"), which compresses better.
    filtered = rows.copy()
    filtered[1:] -= rows[:-1]
    data = b"".join(b"\x02" + row.tobytes() for row in filtered)
    header = struct.pack(">IIBBBBB", shape[1], shape[0], 8, 0 if grey else 2, 0, 0, 0)
    return b"".join(
        [
            b"\x89PNG\r\n\x1a\n",
            _chunk(b"IHDR", header),
            _chunk(b"IDAT", zlib.compress(data, 1)),
            _chunk(b"IEND", b""),
        ]
    )


def _chunk(kind: bytes, data: bytes) -> bytes:
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))
