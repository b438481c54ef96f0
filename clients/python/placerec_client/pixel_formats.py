# Written from core/frames/pixel_formats.py by scripts/client.  Do not edit.
"""Pixel formats as cameras' drivers publish them, for bags, the ROS 2 node and the Python client alike.

The module needs NumPy alone; for a Bayer mosaic it takes OpenCV where that is installed.  Names are those of
``sensor_msgs/image_encodings``, of OpenCV's types and of V4L2, without regard to case.
"""

from __future__ import annotations

import re
from importlib import import_module
from typing import Any

import numpy as np
from numpy.typing import NDArray

Pixels = NDArray[np.uint8] | NDArray[np.uint16]
"""[H, W], grey, or [H, W, 3], in the order BGR."""

PLAIN: dict[str, tuple[int, int, tuple[int, ...]]] = {
    "mono8": (1, 1, (0,)),
    "mono16": (1, 2, (0,)),
    "bgr8": (3, 1, (0, 1, 2)),
    "rgb8": (3, 1, (2, 1, 0)),
    "bgra8": (4, 1, (0, 1, 2)),
    "rgba8": (4, 1, (2, 1, 0)),
    "bgr16": (3, 2, (0, 1, 2)),
    "rgb16": (3, 2, (2, 1, 0)),
    "bgra16": (4, 2, (0, 1, 2)),
    "rgba16": (4, 2, (2, 1, 0)),
    "8uc1": (1, 1, (0,)),
    "8uc3": (3, 1, (0, 1, 2)),
    "8uc4": (4, 1, (0, 1, 2)),
    "16uc1": (1, 2, (0,)),
    "16uc3": (3, 2, (0, 1, 2)),
    "16uc4": (4, 2, (0, 1, 2)),
}
"""Channels in memory, bytes of a channel, and where blue, green and red are among the channels, or grey."""

_TILES = {"bayer_rggb": "BayerBG", "bayer_bggr": "BayerRG", "bayer_gbrg": "BayerGR", "bayer_grbg": "BayerGB"}
BAYER = {f"{tile}{8 * size}": (size, f"COLOR_{code}2BGR") for size in (1, 2) for tile, code in _TILES.items()}
"""Bytes of a pixel, and OpenCV's conversion, which calls a mosaic by the second row's second and third pixel."""

_UYVY, _YUYV = (1, 3, 0, 2), (0, 2, 1, 3)
PAIRED = {"yuv422": _UYVY, "uyvy": _UYVY, "yuv422_uyvy": _UYVY} | {"yuv422_yuy2": _YUYV, "yuyv": _YUYV, "yuy2": _YUYV}
"""YUV 4:2:2: where in four bytes are the luminance of two pixels, and their common blue and red difference."""

PLANAR = {"nv12": (0, 1), "nv21": (1, 0)}
"""YUV 4:2:0, a plane of luminance above one of differences: where in two bytes of that are the blue and the red one."""

NAMES = (*PLAIN, *BAYER, *PAIRED, *PLANAR)

TRANSPORT = re.compile(
    r"compresseddepth|h\.?26[45]|hevc|theora|av1|vp[89]|mpeg-?[124]|ffmpeg|avif|zstd|draco|rvl", re.IGNORECASE
)
"""How ``CompressedImage.format`` names what is no picture file: depth, the packets of a video."""

_MOSAIC = re.compile(r"\s*(bayer_[rgb]{4})(8|16)\s*;", re.IGNORECASE)
_FILES = re.compile(rb"\xff\xd8\xff|\x89PNG\r\n\x1a\n|RIFF....WEBP", re.DOTALL)


class UnfitPixels(ValueError):
    """What is given makes no picture; the text is a sentence."""


class UnknownPixelFormat(UnfitPixels):
    """The pixels, or the file, have a format that is not read."""


def pixels_of(name: str, height: int, width: int, data: Any, step: int = 0, big_endian: bool = False) -> Pixels:
    """The picture in the bytes of ``sensor_msgs/Image`` and of what is like it; 16 bits stay 16.

    Args:
        name: of the pixel format, one of ``NAMES`` in any case.
        height, width: of the picture, pixels.
        data: the bytes, or a buffer of them.
        step: bytes from one row to the next; 0, or less than a row has: rows follow each other without a gap.
        big_endian: whether the upper byte of 16 bits comes first.

    Raises:
        UnknownPixelFormat: the name is none of them.
        UnfitPixels: the bytes are too few, such a picture cannot have this size, or OpenCV is needed and missing.
    """
    kind = _known(name)
    size, row, rows = _sizes(kind, height, width)
    step = max(step, row)
    found = np.frombuffer(data, np.uint8)
    if height < 1 or width < 1 or len(found) < step * (rows - 1) + row:
        raise UnfitPixels(
            f"The picture announces {width}x{height} pixels of {kind} in rows of {step} bytes and has {len(found)} "
            "bytes."
        )
    strided = np.lib.stride_tricks.as_strided(found, (rows, row), (step, 1), writeable=False)
    lines: Any = np.ascontiguousarray(strided)
    if size == 2:
        lines = lines.view(">u2" if big_endian else "<u2").astype(np.uint16)
    if kind in BAYER:
        return _demosaiced(lines, kind)
    if kind in PAIRED:
        first, second, blue, red = PAIRED[kind]
        quads = lines.reshape(height, width // 2, 4)
        luminance = quads[:, :, [first, second]].reshape(height, width)
        return _in_colours(luminance, *(np.repeat(quads[:, :, place], 2, axis=1) for place in (blue, red)))
    if kind in PLANAR:
        pairs = lines[height:].reshape(height // 2, width // 2, 2).repeat(2, axis=0).repeat(2, axis=1)
        return _in_colours(lines[:height], *(pairs[:, :, place] for place in PLANAR[kind]))
    channels, _, order = PLAIN[kind]
    if channels == 1:
        return lines
    return np.ascontiguousarray(lines.reshape(height, width, channels)[:, :, order])


def pixels_of_array(name: str, array: Any) -> Pixels:
    """The picture in an array of this pixel format; 16 bits stay 16.

    Args:
        name: of the pixel format, one of ``NAMES`` in any case.
        array: uint8 or uint16 by the format, [H, W] or [H, W, channels]; of YUV 4:2:2 [H, W, 2], and of YUV 4:2:0
            [3 H / 2, W], as OpenCV has them.

    Raises:
        UnknownPixelFormat: the name is none of them.
        UnfitPixels: the array has another type or shape, or OpenCV is needed and missing.
    """
    kind, shape = _known(name), tuple(array.shape)
    channels = PLAIN[kind][0] if kind in PLAIN else 2 if kind in PAIRED else 1
    size = PLAIN[kind][1] if kind in PLAIN else BAYER[kind][0] if kind in BAYER else 1
    inner = shape[2:] if channels > 1 else shape[2:] or (1,)
    if len(shape) < 2 or inner != (channels,) or 0 in shape or array.dtype.kind != "u" or array.dtype.itemsize != size:
        wanted = f"uint{8 * size} [H, W{f', {channels}' if channels > 1 else ''}]"
        raise UnfitPixels(f"An array {array.dtype} of shape {list(shape)} is no picture of {kind}: {wanted}.")
    height = shape[0]
    if kind in PLANAR:
        if height % 3:
            raise UnfitPixels(f"An array of {height} rows is no picture of {kind}, which has 3 for 2 rows of pixels.")
        height = 2 * height // 3
    return pixels_of(kind, height, shape[1], array.astype(f"<u{size}").tobytes())


def is_file(data: bytes) -> bool:
    """Whether bytes are those of a JPEG, PNG or WebP file, by their first ones."""
    return _FILES.match(data) is not None


def check_transport(form: str, data: bytes) -> None:
    """Check that a ``CompressedImage`` may hold a picture file.

    Args:
        form: its ``format``.
        data: its bytes, which count where they are a file's that is read; but a depth image shows no place.

    Raises:
        UnknownPixelFormat: it holds depth, or a packet of a video.
    """
    named = TRANSPORT.search(form)
    if named is None:
        return
    if named[0].lower() in ("compresseddepth", "rvl"):
        raise UnknownPixelFormat(
            f"A CompressedImage of the format {form[:60]!r} holds a depth image, which shows no place: take the topic "
            "of the camera's pictures."
        )
    if not is_file(data):
        raise UnknownPixelFormat(
            f"A CompressedImage of the format {form[:60]!r} holds no picture file: {named[0]} is another transport. "
            "Republish the topic as raw or compressed (ros2 run image_transport republish)."
        )


def mosaic_in(form: str, data: bytes) -> Pixels | None:
    """The picture in a file whose pixels are a Bayer mosaic, as ``CompressedImage.format`` says; else None.

    Raises:
        UnfitPixels: OpenCV is needed and missing.
    """
    named = _MOSAIC.match(form)
    if named is None or not is_file(data):
        return None
    opencv = _opencv(named[1])
    try:
        found = opencv.imdecode(np.frombuffer(data, np.uint8), -1)
    except opencv.error:
        return None
    if found is None or found.ndim != 2:  # damaged, which is said where it is decoded; or colours were made of it
        return None
    return pixels_of_array(f"{named[1]}{8 * found.dtype.itemsize}", found)


def _known(name: str) -> str:
    kind = name.strip().lower()
    if kind not in NAMES:
        raise UnknownPixelFormat(
            f"The encoding {name[:60]!r} is not read; {', '.join(NAMES)} are. Make the pictures one of them, or files."
        )
    return kind


def _sizes(kind: str, height: int, width: int) -> tuple[int, int, int]:
    """Bytes of a value and of a row, and the number of rows, those of differences included.

    Raises:
        UnfitPixels: such a picture cannot have this size.
    """
    if kind in PLAIN:
        channels, size, _ = PLAIN[kind]
        return size, width * channels * size, height
    if kind in BAYER:
        return BAYER[kind][0], width * BAYER[kind][0], height
    if width % 2 or (kind in PLANAR and height % 2):
        raise UnfitPixels(f"A picture of {kind} cannot have an odd width or height: {width}x{height} pixels.")
    return (1, 2 * width, height) if kind in PAIRED else (1, width, height + height // 2)


def _demosaiced(values: Pixels, kind: str) -> Pixels:
    """The colours of a Bayer mosaic, by OpenCV's bilinear interpolation."""
    opencv = _opencv(kind)
    if min(values.shape) < 2:
        raise UnfitPixels(f"{values.shape[1]}x{values.shape[0]} pixels of {kind} cannot be converted to colours.")
    made: Pixels = opencv.cvtColor(values, getattr(opencv, BAYER[kind][1]))
    return made


def _opencv(kind: str) -> Any:
    try:
        return import_module("cv2")
    except ImportError as error:
        raise UnfitPixels(
            f"A picture of {kind} needs OpenCV, which is not installed (python3-opencv, opencv-python-headless); or "
            "make colours of it before, as image_proc does."
        ) from error


def _in_colours(luminance: Any, blue: Any, red: Any) -> NDArray[np.uint8]:
    """YUV by ITU-R BT.601 with luminance from 16 to 235, uint8 [H, W] each, to the bit as OpenCV makes them colours."""
    bright = np.maximum(luminance.astype(np.int32) - 16, 0) * 1220542 + (1 << 19)
    u, v = blue.astype(np.int32) - 128, red.astype(np.int32) - 128
    made = np.empty((*luminance.shape, 3), np.uint8)
    for channel, sum_ in enumerate((bright + 2116026 * u, bright - 409993 * u - 852492 * v, bright + 1673527 * v)):
        made[:, :, channel] = np.clip(sum_ >> 20, 0, 255)
    return made
