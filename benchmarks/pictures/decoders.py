"""Ways from the bytes of a picture to pixels: the project's, and those of libraries by themselves."""

from __future__ import annotations

import io
from collections.abc import Callable

import cv2
import numpy as np
from PIL import Image, ImageOps

from core.errors import InvalidImage
from core.frames.images import Limits, decode
from core.frames.jpeg import decode_jpeg
from core.frames.preprocessing import Pixels

FORMATS = ("JPEG", "PNG", "WEBP")
MOST_PIXELS = Limits().max_pixels


class PictureRefused(Exception):
    """A picture that a way does not decode."""


def by_project(data: bytes) -> Pixels:
    """Header and parts by ``core.frames.containers``, then simplejpeg or OpenCV."""
    try:
        return decode(data)
    except InvalidImage as error:
        raise PictureRefused from error


def by_opencv(data: bytes) -> Pixels:
    """OpenCV alone, orientation included."""
    try:
        pixels = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)
    except cv2.error as error:
        raise PictureRefused from error
    if pixels is None:
        raise PictureRefused
    return np.asarray(pixels, np.uint8)


def _opened(data: bytes) -> Image.Image:
    image = Image.open(io.BytesIO(data), formats=FORMATS)
    if image.width * image.height > MOST_PIXELS or getattr(image, "n_frames", 1) > 1:
        raise PictureRefused
    return image


def by_pillow(data: bytes) -> Pixels:
    """Pillow alone, orientation included."""
    try:
        image = ImageOps.exif_transpose(_opened(data))
        return np.ascontiguousarray(np.asarray(image.convert("RGB"))[:, :, ::-1])
    except Exception as error:  # Pillow's plug-ins raise any error of their parsers
        raise PictureRefused from error


def by_pillows_header(data: bytes) -> Pixels:
    """Header, parts and orientation by Pillow in place of ``core.frames.containers``, pixels as the project does."""
    try:
        image = _opened(data)
        orientation = image.getexif().get(0x0112, 1)
        if image.format == "JPEG":
            found: Pixels | None = decode_jpeg(
                data, (image.height, image.width), data.index(b"\xff\xda") + 2, _tolerant
            )
        else:
            found = _tolerant(data)
    except Exception as error:  # as above
        raise PictureRefused from error
    if found is None or found.shape[:2] != (image.height, image.width):
        raise PictureRefused
    turned = {3: cv2.ROTATE_180, 6: cv2.ROTATE_90_CLOCKWISE, 8: cv2.ROTATE_90_COUNTERCLOCKWISE}
    return np.asarray(cv2.rotate(found, turned[orientation]) if orientation in turned else found, np.uint8)


def _tolerant(data: bytes) -> Pixels | None:
    pixels = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION)
    return None if pixels is None else np.asarray(pixels, np.uint8)


WAYS: dict[str, Callable[[bytes], Pixels]] = {
    "the project's": by_project,
    "OpenCV": by_opencv,
    "Pillow": by_pillow,
    "Pillow's header": by_pillows_header,
}
