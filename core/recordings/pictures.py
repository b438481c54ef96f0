"""The bytes of a frame as the service takes them: JPEG, PNG and WebP stay as they are, all else becomes PNG.

Of a recording whose frames have 16 bits and use a part of them, the range is measured.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from core.errors import EmptyImage, InvalidImage, InvalidRecording, NotAnImage, UnsupportedFormat
from core.frames.images import encode_png
from core.frames.pixel_formats import (
    UnfitPixels,
    UnknownPixelFormat,
    check_transport,
    is_file,
    mosaic_in,
    pixels_of,
)
from core.frames.value_ranges import ValueRange, has_16_bits, range_of, told
from core.recordings.frame import RecordedFrame

READ = cv2.IMREAD_ANYDEPTH | cv2.IMREAD_ANYCOLOR
"""Grey stays grey and 16 bits stay 16, as PNG can have them; transparency is dropped, as the service would."""

SAMPLE = 16
"""Frames of a recording that are measured, over its whole length."""


def sendable(data: bytes) -> bytes:
    """The bytes of an image file as the service takes them.

    JPEG, PNG and WebP files are returned as they are, whole or damaged: the service judges them.  A file of another
    format that OpenCV reads is decoded and encoded as PNG: without loss, and with the same bytes each time.

    Raises:
        EmptyImage: there are no bytes.
        NotAnImage: OpenCV cannot read them.
        UnsupportedFormat: the file holds several pictures, or pixels that PNG cannot hold.
    """
    if not data:
        raise EmptyImage("The image has no bytes.")
    return data if is_file(data) else png(_decoded(data))


def _decoded(data: bytes) -> NDArray[Any]:
    """The only picture of a file, [H, W] or [H, W, 3]."""
    try:
        _, pages = cv2.imdecodemulti(np.frombuffer(data, np.uint8), READ, range=(0, 2))
    except cv2.error:
        pages = ()
    if len(pages) > 1:
        raise UnsupportedFormat("The file holds several pictures; a frame is one.")
    if not pages:
        raise NotAnImage("The bytes are of no image format that can be read here, or are damaged.")
    return np.asarray(pages[0])


def png(pixels: NDArray[Any]) -> bytes:
    """Pixels as a PNG file, the same bytes each time.

    Args:
        pixels: uint8 or uint16, [H, W] or [H, W, 3], BGR.

    Raises:
        UnsupportedFormat: the pixels are of another type.
    """
    if pixels.dtype not in (np.uint8, np.uint16):
        raise UnsupportedFormat(f"The picture has pixels of the type {pixels.dtype}, which PNG cannot hold.")
    return encode_png(pixels)


def image_png(message: Any) -> bytes:
    """The PNG file of a ``sensor_msgs/Image``, of 8 or 16 bits.

    Raises:
        UnsupportedFormat: its encoding is none of ``core.frames.pixel_formats``.
        NotAnImage: it has fewer bytes than its size needs, or cannot have this size.
    """
    with _fitting():
        return png(
            pixels_of(
                str(message.encoding),
                int(message.height),
                int(message.width),
                message.data,
                int(message.step),
                bool(message.is_bigendian),
            )
        )


def compressed_file(form: str, data: bytes) -> bytes:
    """The file in a ``sensor_msgs/CompressedImage`` of the format ``form``, as ``sendable`` gives it; a Bayer mosaic in
    it becomes colours.

    Raises:
        UnsupportedFormat: it holds depth, or a packet of a video.
        InvalidImage: as of ``sendable``.
    """
    with _fitting():
        check_transport(form, data)
        colours = mosaic_in(form, data)
    return sendable(data) if colours is None else png(colours)


@contextmanager
def _fitting() -> Iterator[None]:
    """What is unfit by ``core.frames.pixel_formats``, as an error of the core."""
    try:
        yield
    except UnknownPixelFormat as error:
        raise UnsupportedFormat(str(error)) from error
    except UnfitPixels as error:
        raise NotAnImage(str(error)) from error


def used_range(frames: Sequence[RecordedFrame]) -> ValueRange | None:
    """The range of a recording's values, without a few at either end; None where the upper 8 bits show them.

    One frame is read of a recording whose frames have 8 bits.
    """
    return range_of(_sample(frames))


def _sample(frames: Sequence[RecordedFrame]) -> Iterator[bytes]:
    """The bytes of frames over the whole recording, while they have 16 bits."""
    for number in range(min(SAMPLE, len(frames))):
        try:
            data = frames[number * len(frames) // min(SAMPLE, len(frames))].load()
        except (InvalidImage, InvalidRecording, OSError):
            return  # what is wrong with it is said where it is enrolled; another one may be as costly to find damaged
        if not has_16_bits(data):
            return
        yield data


def range_remark(used: ValueRange, camera: str | None) -> str:
    """What is to be said of a recording that uses a part of 16 bits, and of its camera, which had no range before."""
    start = f"Its frames have 16 bits, whose values {told(used)}"
    if camera is None:
        return (
            f"{start}. Their upper 8 bits, which are used, show little: name a camera of the map, which gets this "
            "range if it has none."
        )
    low, high = used
    return (
        f"{start}. The camera {camera} had no range of values, and has {low} to {high} now, by which its frames are "
        "scaled."
    )
