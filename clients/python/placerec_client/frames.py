"""Frames as they are given, and the bytes that are sent for them."""

from __future__ import annotations

import os
import struct
import zlib
from array import array
from dataclasses import dataclass
from importlib import import_module
from io import BytesIO
from typing import TYPE_CHECKING, Any, BinaryIO, Literal, TypeAlias

from placerec_client.errors import InvalidFrame

if TYPE_CHECKING:
    import numpy
    from numpy.typing import NDArray
    from PIL import Image

    Pixels: TypeAlias = NDArray[numpy.uint8] | NDArray[numpy.uint16]

Order: TypeAlias = str
Encoding: TypeAlias = Literal["png", "jpeg"]


@dataclass(frozen=True)
class Picture:
    """An array as a frame, with the order of its channels, and as which file it is sent.

    Args:
        pixels: uint8 or uint16, [height, width], [height, width, 3] or [height, width, 4]; or as the format has them;
            or an image of Pillow, whose order is its own.
        order: of the channels: ``bgr`` as OpenCV has them, or ``rgb``; a fourth one, of opacity, is left out.  Or a
            pixel format of ROS, in any case: ``rgba8``, ``mono16``, ``bayer_rggb8`` (which needs OpenCV), ``yuv422`` in
            an array [height, width, 2], ``nv12`` in one of 3/2 height rows; all are ``pixel_formats.NAMES``.
        encoding: ``png`` loses nothing, 16 bits stay 16; ``jpeg`` takes a fraction of the time and of the bytes, loses
            a little, of 16 bits the lower 8, and needs OpenCV or Pillow.
        quality: of a JPEG file, from 1 to 100.

    Raises:
        InvalidFrame: ``order``, ``encoding`` or ``quality`` is none of these.
    """

    pixels: Pixels | Image.Image
    order: Order = "bgr"
    encoding: Encoding = "png"
    quality: int = 90

    def __repr__(self) -> str:
        return shown(self)

    def __post_init__(self) -> None:
        if self.order not in ("bgr", "rgb"):
            from placerec_client.pixel_formats import NAMES  # here because NumPy takes a moment to load

            if str(self.order).strip().lower() not in NAMES:
                raise InvalidFrame(
                    f"The order of channels is 'bgr' or 'rgb', not {ascii(self.order)[:140]}; or it is a pixel format: "
                    f"{', '.join(NAMES)}."
                )
        if self.encoding not in ("png", "jpeg"):
            raise InvalidFrame(f"The encoding of a picture is 'png' or 'jpeg', not {ascii(self.encoding)[:140]}.")
        if not isinstance(self.quality, int) or not 1 <= self.quality <= 100:
            raise InvalidFrame(f"The quality is a whole number from 1 to 100, not {ascii(self.quality)[:140]}.")


Frame: TypeAlias = (
    "bytes | bytearray | memoryview | array[int] | str | os.PathLike[str] | BinaryIO | Pixels | Image.Image | Picture"
)
"""The bytes of a JPEG, PNG or WebP file, also in an array; the path of one; one opened for reading; pixels, in OpenCV's
order BGR; or an image of Pillow."""

FEWEST_VALUES = 4095
"""A picture of 16 bits has to reach this value to become a JPEG file: one of fewer bits would be nearly black there."""

LONGEST_SIDE = 65500
"""Pixels that a side of a JPEG file may have at most."""


def frame_bytes(frame: Frame) -> bytes:
    """Return the bytes of the file that is sent for a frame: pixels become a PNG, if nothing else is wanted.

    An image of Pillow is turned upright as its EXIF orientation says.

    Raises:
        InvalidFrame: the file cannot be read; the array has no such type and shape; or a JPEG is wanted where nothing
            that writes one is installed.
    """
    if isinstance(frame, bytes):
        return frame
    if isinstance(frame, bytearray | memoryview):
        try:
            return bytes(frame)
        except ValueError as error:  # one that was released
            raise InvalidFrame(f"The frame cannot be read: {error}.") from error
    if is_pillow(frame):
        return _by_pillow(frame, "png", 0)
    if isinstance(frame, Picture):
        if is_pillow(frame.pixels):
            return _by_pillow(frame.pixels, frame.encoding, frame.quality)
        if frame.encoding == "jpeg":
            return jpeg(frame.pixels, frame.order, frame.quality)
        return png(frame.pixels, frame.order)
    if isinstance(frame, array):
        return _file_of(frame, frame.typecode == "B")
    if hasattr(frame, "__array_interface__") and hasattr(frame, "dtype"):
        found: Any = frame
        return _file_of(found, str(found.dtype) == "uint8") if found.ndim == 1 else png(found)
    try:
        if isinstance(frame, str | os.PathLike):
            with open(frame, "rb") as file:
                return file.read()
        opened: Any = frame
        data = opened.read()
    except OSError as error:
        name = f"{os.fspath(frame)} " if isinstance(frame, str | os.PathLike) else "The frame's file "
        raise InvalidFrame(f"{name}cannot be read: {error.strerror}.") from error
    except ValueError as error:  # such as a closed file, or a name with a null
        raise InvalidFrame(f"The frame cannot be read: {error}.") from error
    except (AttributeError, TypeError) as error:
        raise InvalidFrame(f"A {type(frame).__name__} is no frame.") from error
    if not isinstance(data, bytes):
        raise InvalidFrame("The frame's file is not opened in binary mode.")
    return data


def shown(frame: object) -> str:
    """A frame as errors and interpreters show it: bytes and pixels by their number."""
    if isinstance(frame, bytes | bytearray | memoryview | array):
        return f"<{memoryview(frame).nbytes} bytes>"
    if isinstance(frame, Picture):
        return f"Picture({shown(frame.pixels)}, {frame.order!r}, {frame.encoding!r}, quality={frame.quality})"
    if is_pillow(frame):
        image: Any = frame
        return f"<image of Pillow, {image.mode}, {image.width}x{image.height} pixels>"
    shape = getattr(frame, "shape", None)
    return repr(frame) if shape is None else f"<{type(frame).__name__} of shape {list(shape)}>"


def media_type(data: bytes) -> str:
    """The content type of a frame by its first bytes; image/jpeg if unknown, which the service then checks."""
    if data.startswith(b"\x89PNG"):
        return "image/png"
    return "image/webp" if data[:4] == b"RIFF" and data[8:12] == b"WEBP" else "image/jpeg"


def _file_of(data: Any, is_bytes: bool) -> bytes:
    """The bytes of a picture file in an array, as ROS has them in a CompressedImage.

    Raises:
        InvalidFrame: they are none.
    """
    found = data.tobytes() if is_bytes else b""
    if media_type(found) == "image/jpeg" and not found.startswith(b"\xff\xd8\xff"):
        raise InvalidFrame(
            f"An array of {len(data)} numbers is no picture: it has to be uint8 and hold a JPEG, PNG or WebP file, or "
            "have rows and columns of pixels."
        )
    return found


def png(pixels: Any, order: str = "bgr") -> bytes:
    """Encode pixels as a PNG file.

    Args:
        pixels: NumPy array uint8 or uint16, [height, width], [height, width, 3] or [height, width, 4]; 16 bits stay
            16.
        order: as of ``Picture``.

    Raises:
        InvalidFrame: the array has another type or shape, or OpenCV is needed and missing.
    """
    found = _in_red_green_blue(pixels, order)
    shape, grey, bits = found.shape, found.ndim == 2, 8 * found.dtype.itemsize
    # PNG has the upper byte first.
    rows = found.astype(f">u{bits // 8}").reshape(shape[0], -1).view("uint8")
    # Each row is stored as its difference from the one above (the filter "up"), which compresses better.
    filtered = rows.copy()
    filtered[1:] -= rows[:-1]
    data = b"".join(b"\x02" + row.tobytes() for row in filtered)
    header = struct.pack(">IIBBBBB", shape[1], shape[0], bits, 0 if grey else 2, 0, 0, 0)
    return b"".join(
        [
            b"\x89PNG\r\n\x1a\n",
            _chunk(b"IHDR", header),
            _chunk(b"IDAT", zlib.compress(data, 1)),
            _chunk(b"IEND", b""),
        ]
    )


def jpeg(pixels: Any, order: str = "bgr", quality: int = 90) -> bytes:
    """Encode pixels as a JPEG file, by OpenCV if it is installed, else by Pillow.

    Args:
        pixels: as of ``png``.
        order: as of ``Picture``.
        quality: from 1 to 100.

    Raises:
        InvalidFrame: the array has another type or shape, is too large for a JPEG file, or has 16 bits of which its
            values use fewer than 12; or neither is installed.
    """
    found = _in_red_green_blue(pixels, order)
    if found.dtype.itemsize == 2:
        if 0 < (highest := int(found.max())) < FEWEST_VALUES:
            raise InvalidFrame(
                f"The values reach only {highest} of 65535, and a JPEG file has the upper 8 of 16 bits: send it as "
                "PNG, or scale it to 8 bits."
            )
        found = (found >> 8).astype("uint8")
    if max(found.shape) > LONGEST_SIDE:
        raise InvalidFrame(
            f"An array of shape {list(found.shape)} cannot be a JPEG file: a side has at most {LONGEST_SIDE} pixels."
        )
    try:
        cv2: Any = import_module("cv2")
    except ImportError:
        return _jpeg_by_pillow(found, quality)
    ordered = found if found.ndim == 2 else found[..., ::-1]
    is_written, data = cv2.imencode(".jpg", ordered.copy(), [cv2.IMWRITE_JPEG_QUALITY, quality])
    if not is_written:
        raise InvalidFrame(f"OpenCV writes no JPEG file of an array of shape {list(found.shape)}.")
    return bytes(data)


def is_pillow(frame: object) -> bool:
    """Whether a frame is an image of Pillow, which need not be installed."""
    return any(kind.__module__.partition(".")[0] == "PIL" for kind in type(frame).__mro__)


def _by_pillow(image: Any, encoding: Encoding, quality: int) -> bytes:
    """The file of an image of Pillow: in grey if it is, also of 16 bits as a PNG, else in RGB.

    Raises:
        InvalidFrame: its file is damaged or closed, it has no pixels, or it has numbers of other kinds.
    """
    file = BytesIO()
    try:
        upright = import_module("PIL.ImageOps").exif_transpose(image)
        if upright.mode == "F" or (upright.mode.startswith("I") and encoding == "jpeg"):
            raise InvalidFrame(f"An image of the mode {upright.mode} cannot be sent as {encoding}: it has no 8 bits.")
        if upright.mode != "L" and not upright.mode.startswith("I"):
            upright = upright.convert("RGB")
        options = {"quality": quality} if encoding == "jpeg" else {"compress_level": 1}
        upright.save(file, encoding, **options)
    except (OSError, ValueError, AttributeError, SyntaxError, SystemError) as error:
        if isinstance(error, InvalidFrame):
            raise
        raise InvalidFrame(f"The image cannot be read: {error}.") from error
    return file.getvalue()


def _jpeg_by_pillow(found: Any, quality: int) -> bytes:
    try:
        image: Any = import_module("PIL.Image")
    except ImportError as error:
        raise InvalidFrame("A picture becomes a JPEG file by OpenCV or Pillow; neither is installed.") from error
    file = BytesIO()
    image.fromarray(found.copy()).save(file, "JPEG", quality=quality)
    return file.getvalue()


def _in_red_green_blue(pixels: Any, order: str) -> Any:
    """Pixels as uint8 or uint16, [height, width] or [height, width, 3] in the order RGB.

    Raises:
        InvalidFrame: the array has another type or shape, or OpenCV is needed and missing.
    """
    if not (hasattr(pixels, "__array_interface__") and hasattr(pixels, "dtype")):
        raise InvalidFrame(f"A {type(pixels).__name__} is no array of pixels.")
    if order not in ("bgr", "rgb"):
        from placerec_client.pixel_formats import UnfitPixels, pixels_of_array

        try:
            pixels = pixels_of_array(order, pixels)
        except UnfitPixels as error:
            raise InvalidFrame(str(error)) from error
    shape, kind = tuple(pixels.shape), pixels.dtype
    has_channels = len(shape) == 3 and shape[2] in (3, 4)
    if kind.kind != "u" or kind.itemsize > 2 or not (len(shape) == 2 or has_channels) or 0 in shape:
        raise InvalidFrame(
            f"An array {kind} of shape {list(shape)} is no picture: uint8 or uint16, [H, W], [H, W, 3] or [H, W, 4]."
        )
    if not has_channels:
        return pixels
    return pixels[..., :3] if order == "rgb" else pixels[..., 2::-1]


def _chunk(kind: bytes, data: bytes) -> bytes:
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))
