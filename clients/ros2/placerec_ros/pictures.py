"""From the messages of cameras to what the service takes: the bytes of a picture file, or pixels in the order BGR."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

Pixels = NDArray[np.uint8]

# Channels in memory, bytes of a channel, and the channels in the order blue, green, red.
PLAIN: dict[str, tuple[int, int, tuple[int, ...]]] = {
    "mono8": (1, 1, (0,)),
    "8UC1": (1, 1, (0,)),
    "mono16": (1, 2, (0,)),
    "bgr8": (3, 1, (0, 1, 2)),
    "8UC3": (3, 1, (0, 1, 2)),
    "rgb8": (3, 1, (2, 1, 0)),
    "bgra8": (4, 1, (0, 1, 2)),
    "8UC4": (4, 1, (0, 1, 2)),
    "rgba8": (4, 1, (2, 1, 0)),
    "bgr16": (3, 2, (0, 1, 2)),
    "rgb16": (3, 2, (2, 1, 0)),
}
# Where in four bytes the luminance of two pixels and their common blue and red difference are.
PAIRED: dict[str, tuple[int, int, int, int]] = {
    "yuv422": (1, 3, 0, 2),
    "uyvy": (1, 3, 0, 2),
    "yuv422_yuy2": (0, 2, 1, 3),
    "yuyv": (0, 2, 1, 3),
}

MAGIC = {b"\xff\xd8\xff": "image/jpeg", b"\x89PNG\r\n\x1a\n": "image/png"}


class UnfitPicture(Exception):
    """The message holds no picture that the service could use."""


def media_type(data: bytes) -> str | None:
    """The media type of a file by its first bytes; None if the service takes none such."""
    if data[:4] == b"RIFF" and data[8:12] == b"WEBP":
        return "image/webp"
    return next((kind for first, kind in MAGIC.items() if data.startswith(first)), None)


def file_of(message: Any) -> bytes:
    """The bytes of a ``sensor_msgs/CompressedImage``, as they are.

    Raises:
        UnfitPicture: they are not those of a JPEG, PNG or WebP file.
    """
    data = bytes(message.data)
    if media_type(data) is None:
        raise UnfitPicture(
            f"a CompressedImage of the format {message.format[:60]!r} is no JPEG, PNG or WebP file; depth and video "
            "transports carry none"
        )
    return data


def pixels_of(message: Any) -> Pixels:
    """The pixels of a ``sensor_msgs/Image``, uint8 [height, width] or [height, width, 3] in the order BGR.

    Of channels with 16 bits the upper 8 are used.

    Raises:
        UnfitPicture: the encoding is none of a picture, or the data are fewer than the message says.
    """
    encoding, height, width = message.encoding, message.height, message.width
    if encoding in PLAIN:
        channels, size, order = PLAIN[encoding]
        row = width * channels * size
    elif encoding in PAIRED:
        row = 2 * width
        if width % 2:
            raise UnfitPicture(f"an Image of {encoding} has an odd width of {width}")
    else:
        advice = "; image_proc/debayer makes it a picture" if encoding.startswith("bayer") else ""
        raise UnfitPicture(f"the encoding {encoding[:60]!r} of the Image is not supported{advice}")
    step = message.step or row
    if not height or not width or step < row or len(message.data) < step * (height - 1) + row:
        raise UnfitPicture(
            f"the Image of {width} x {height} in {encoding} has {len(message.data)} bytes in rows of {step}"
        )
    data = np.frombuffer(message.data, np.uint8)
    rows = np.lib.stride_tricks.as_strided(data, (height, row), (step, 1), writeable=False)
    if encoding in PAIRED:
        return _paired(rows, PAIRED[encoding])
    if size == 2:
        rows = rows[:, 0 if message.is_bigendian else 1 :: 2]
    if channels == 1:
        return np.ascontiguousarray(rows)
    return np.ascontiguousarray(rows.reshape(height, width, channels)[:, :, order])


def _paired(rows: Pixels, places: tuple[int, int, int, int]) -> Pixels:
    """Pixels of YUV 4:2:2 by ITU-R BT.601 with luminance from 16 to 235, as OpenCV and so cv_bridge take them."""
    first, second, blue, red = places
    height, width = rows.shape[0], rows.shape[1] // 2
    quads = rows.reshape(height, width // 2, 4)
    luminance = 1.164 * np.maximum(quads[:, :, [first, second]].reshape(height, width).astype(np.float32) - 16, 0)
    u = np.repeat(quads[:, :, blue].astype(np.float32) - 128, 2, axis=1)
    v = np.repeat(quads[:, :, red].astype(np.float32) - 128, 2, axis=1)
    picture = np.stack([luminance + 2.018 * u, luminance - 0.391 * u - 0.813 * v, luminance + 1.596 * v], axis=2)
    return np.clip(np.rint(picture), 0, 255).astype(np.uint8)


def picture_of(message: Any) -> bytes | Pixels:
    """The picture of a message: the bytes of a file, or pixels.

    Raises:
        UnfitPicture: it holds no picture that the service could use.
    """
    return file_of(message) if hasattr(message, "format") else pixels_of(message)
