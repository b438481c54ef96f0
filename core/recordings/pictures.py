"""The bytes of a frame as the service takes them: JPEG, PNG and WebP stay as they are, all else becomes PNG."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from core.errors import EmptyImage, NotAnImage, UnsupportedFormat
from core.frames.containers import PNG_SIGNATURE
from core.frames.images import encode_png

READ = cv2.IMREAD_ANYDEPTH | cv2.IMREAD_ANYCOLOR
"""Grey stays grey and 16 bits stay 16, as PNG can have them; transparency is dropped, as the service would."""

IMAGE_ENCODINGS = {
    "mono8": None,
    "mono16": None,
    "bgr8": None,
    "rgb8": cv2.COLOR_RGB2BGR,
    "rgba8": cv2.COLOR_RGBA2BGR,
    "bgra8": cv2.COLOR_BGRA2BGR,
    "bayer_rggb8": cv2.COLOR_BayerRGGB2BGR,
    "bayer_bggr8": cv2.COLOR_BayerBGGR2BGR,
    "bayer_gbrg8": cv2.COLOR_BayerGBRG2BGR,
    "bayer_grbg8": cv2.COLOR_BayerGRBG2BGR,
    "yuv422": cv2.COLOR_YUV2BGR_UYVY,
    "uyvy": cv2.COLOR_YUV2BGR_UYVY,
    "yuv422_yuy2": cv2.COLOR_YUV2BGR_YUY2,
    "yuyv": cv2.COLOR_YUV2BGR_YUY2,
}
"""Encodings of sensor_msgs/Image that are read, and the conversion to BGR of OpenCV."""

_CHANNELS = {"bgr8": 3, "rgb8": 3, "rgba8": 4, "bgra8": 4} | dict.fromkeys(("yuv422", "uyvy", "yuv422_yuy2", "yuyv"), 2)


def is_sendable(data: bytes) -> bool:
    """Whether bytes are those of a format that the service takes, by their first bytes."""
    return data.startswith((b"\xff\xd8\xff", PNG_SIGNATURE)) or (data[:4] == b"RIFF" and data[8:12] == b"WEBP")


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
    return data if is_sendable(data) else png(_decoded(data))


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


def image_pixels(message: Any) -> NDArray[np.uint8]:
    """The pixels of a sensor_msgs/Image, uint8 [H, W] or [H, W, 3] in BGR.

    Of ``mono16`` the upper eight bits are used, as the service does with a PNG file of 16 bits.

    Raises:
        UnsupportedFormat: its encoding is none of ``IMAGE_ENCODINGS``.
        NotAnImage: it has fewer bytes than its size needs.
    """
    encoding, height, width = str(message.encoding).strip().lower(), int(message.height), int(message.width)
    if encoding not in IMAGE_ENCODINGS:
        raise UnsupportedFormat(
            f"The encoding {message.encoding!r} is not read; {', '.join(IMAGE_ENCODINGS)} are. "
            "Republish the topic as one of them or compressed."
        )
    width_bytes = width * (2 if encoding == "mono16" else _CHANNELS.get(encoding, 1))
    step = max(int(message.step), width_bytes)
    data = np.asarray(message.data, np.uint8)
    if not height or not width or len(data) < step * (height - 1) + width_bytes:
        raise NotAnImage(f"The message announces {width}x{height} pixels of {encoding} and has {len(data)} bytes.")
    rows = np.lib.stride_tricks.as_strided(data, (height, width_bytes), (step, 1))
    if encoding == "mono16":
        return np.ascontiguousarray(rows[:, 0 if message.is_bigendian else 1 :: 2])
    channels = _CHANNELS.get(encoding, 1)
    pixels = np.ascontiguousarray(rows) if channels == 1 else np.ascontiguousarray(rows).reshape(height, width, -1)
    conversion = IMAGE_ENCODINGS[encoding]
    if conversion is None:
        return pixels
    try:
        return np.asarray(cv2.cvtColor(pixels, conversion), np.uint8)
    except cv2.error as error:  # an odd width of 4:2:2, a mosaic of one row
        raise NotAnImage(f"{width}x{height} pixels of {encoding} cannot be converted to colours.") from error
