"""From the bytes of an image file to colour pixels, and from pixels to thumbnails and PNG files."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import cv2.utils.logging
import numpy as np
from numpy.typing import NDArray

from core.errors import (
    EmptyImage,
    ImageTooLarge,
    ImageTooSmall,
    InvalidImage,
    NotAnImage,
    TooManyPixels,
)
from core.frames.containers import Header, read_header, read_structure
from core.frames.exif import read_orientation
from core.frames.jpeg import decode_jpeg
from core.frames.preprocessing import Pixels
from core.frames.value_ranges import ValueRange, has_16_bits, scaled

__all__ = ["Header", "Limits", "Pixels", "decode", "encode_png", "encode_thumbnail", "read_header"]

# The orientation is applied here in the same way for all formats; OpenCV's versions differ in this.
_COLOUR = cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION

# A damaged image raises an error; OpenCV need not write to stderr as well.
cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)


@dataclass(frozen=True)
class Limits:
    """Limits of an image file: its bytes, the pixels that its header announces, and its shorter side."""

    max_bytes: int = 16 * 1024 * 1024
    max_pixels: int = 40_000_000
    min_side: int = 16


ANY_SIZE = Limits(max_bytes=1 << 30, max_pixels=1_000_000_000, min_side=1)
"""The limits of a picture that was accepted, under any settings; no service can be set to accept a larger one."""


def decode(data: bytes, limits: Limits = Limits(), value_range: ValueRange | None = None) -> Pixels:
    """Decode a JPEG, PNG or WebP file, upright by its EXIF orientation.

    Grey pictures and palettes become colour, transparency is dropped, 16 bits become 8.

    Args:
        value_range: of 16 bits, the values that become 0 and 255; None: the upper 8 bits are used.

    Returns:
        uint8 [H, W, 3], BGR, contiguous.

    Raises:
        EmptyImage: there are no bytes.
        ImageTooLarge: the file has more than ``limits.max_bytes``.
        TooManyPixels: the header announces more than ``limits.max_pixels``; nothing was decoded.
        ImageTooSmall: a side is under ``limits.min_side``.
        TruncatedImage: the bytes end before the image does, or a part of it is missing.
        UnsupportedFormat: the file is an image of another format, or an animation.
        NotAnImage: the file is not an image, or is damaged.
        MemoryError: there is not enough memory for the pixels.
    """
    if not data:
        raise EmptyImage("The image has no bytes.")
    if len(data) > limits.max_bytes:
        raise ImageTooLarge(f"The image has {len(data)} bytes; the limit is {limits.max_bytes}.")
    header = read_header(data)
    size = f"{header.width}x{header.height} pixels"
    if header.width * header.height > limits.max_pixels:
        raise TooManyPixels(f"The image has {size}; the limit is {limits.max_pixels}.")
    if min(header.width, header.height) < limits.min_side:
        raise ImageTooSmall(f"The image has {size}; a side needs at least {limits.min_side}.")
    structure = read_structure(data, header)
    if structure.needed:
        data = b"".join(data[start:end] for start, end in structure.needed)
    if header.format == "jpeg":
        pixels: Pixels | None = decode_jpeg(data, (header.height, header.width), structure.coded, _pixels)
    else:
        pixels = _pixels(data) if value_range is None else _scaled_pixels(data, value_range)
    if pixels is None:
        raise NotAnImage(f"The {header.format} data is damaged: it cannot be decoded.")
    if pixels.shape != (header.height, header.width, 3) or pixels.dtype != np.uint8:
        raise NotAnImage(f"The {header.format} header announces {size}, its data holds another picture.")
    return _upright(pixels, read_orientation(structure.exif))


def _scaled_pixels(data: bytes, value_range: ValueRange) -> Pixels | None:
    """Decode a file with OpenCV, 16 bits by their range; None if it cannot."""
    found: Any = _pixels(data, _COLOUR | cv2.IMREAD_ANYDEPTH) if has_16_bits(data) else _pixels(data)
    return scaled(found, value_range) if found is not None and found.dtype == np.uint16 else found


def _pixels(data: bytes, flags: int = _COLOUR) -> Pixels | None:
    """Decode a file with OpenCV; None if it cannot."""
    try:
        decoded = cv2.imdecode(np.frombuffer(data, np.uint8), flags)
    except cv2.error as error:
        if error.code == cv2.Error.StsNoMem:
            raise MemoryError("the pixels find no room") from error
        return None
    return None if decoded is None else np.asarray(decoded)


def _upright(pixels: Pixels, orientation: int) -> Pixels:
    """Turn pixels upright by their EXIF orientation, 1 to 8; no copy is made for 1."""
    match orientation:
        case 2:
            turned = cv2.flip(pixels, 1)
        case 3:
            turned = cv2.rotate(pixels, cv2.ROTATE_180)
        case 4:
            turned = cv2.flip(pixels, 0)
        case 5:
            turned = cv2.transpose(pixels)
        case 6:
            turned = cv2.rotate(pixels, cv2.ROTATE_90_CLOCKWISE)
        case 7:
            turned = cv2.transpose(cv2.rotate(pixels, cv2.ROTATE_180))
        case 8:
            turned = cv2.rotate(pixels, cv2.ROTATE_90_COUNTERCLOCKWISE)
        case _:
            return pixels
    return np.asarray(turned, np.uint8)


def encode_thumbnail(pixels: Pixels, longest_side: int = 320, quality: int = 80) -> bytes:
    """Encode a picture as JPEG, shrunk (never enlarged) to ``longest_side`` pixels.

    Args:
        pixels: uint8 [H, W, 3], BGR.
        longest_side: at most this many pixels of the longer side.
        quality: of the JPEG, 1 to 100.

    Raises:
        InvalidImage: the picture cannot be encoded (a side is zero, or over 65 535).
    """
    height, width = pixels.shape[:2]
    factor = longest_side / max(height, width, 1)
    if factor < 1:
        size = (max(1, round(width * factor)), max(1, round(height * factor)))
        pixels = np.asarray(cv2.resize(pixels, size, interpolation=cv2.INTER_AREA), np.uint8)
    return _encode(".jpg", pixels, [cv2.IMWRITE_JPEG_QUALITY, quality])


def encode_png(pixels: NDArray[np.uint8] | NDArray[np.uint16]) -> bytes:
    """Encode a picture as PNG, without loss.

    Args:
        pixels: uint8 or uint16, [H, W, 3] in BGR or [H, W].

    Raises:
        InvalidImage: the picture cannot be encoded (a side is zero).
    """
    return _encode(".png", pixels, [])


def _encode(extension: str, pixels: NDArray[Any], options: list[int]) -> bytes:
    try:
        done, encoded = cv2.imencode(extension, pixels, options)
    except cv2.error:
        done = False
    if not done:
        raise InvalidImage(f"A picture of the shape {pixels.shape} cannot be written as {extension[1:]}.")
    return encoded.tobytes()
