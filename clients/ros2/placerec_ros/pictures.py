"""From the messages of cameras to what the service takes: the bytes of a picture file, or pixels in the order BGR."""

from __future__ import annotations

from typing import Any

from placerec_client.pixel_formats import Pixels, UnfitPixels, check_transport, is_file, mosaic_in, pixels_of


class UnfitPicture(Exception):
    """The message holds no picture that the service could use."""


def picture_of(message: Any) -> bytes | Pixels:
    """The picture of a message: the bytes of a file as they are, or pixels, uint8 or uint16, [height, width] or
    [height, width, 3] in the order BGR.

    Raises:
        UnfitPicture: it holds no picture that the service could use.
    """
    try:
        if hasattr(message, "format"):
            return _compressed(message.format, bytes(message.data))
        big = bool(message.is_bigendian)
        return pixels_of(message.encoding, message.height, message.width, message.data, message.step, big)
    except UnfitPixels as error:
        raise UnfitPicture(str(error)) from error


def _compressed(form: str, data: bytes) -> bytes | Pixels:
    """The file of a ``sensor_msgs/CompressedImage``, or the pixels of a Bayer mosaic in it.

    Raises:
        UnfitPicture: it is no JPEG, PNG or WebP file.
        UnfitPixels: it holds depth or a packet of a video, or OpenCV is needed and missing.
    """
    check_transport(form, data)
    if not is_file(data):
        raise UnfitPicture(f"a CompressedImage of the format {form[:60]!r} holds no JPEG, PNG or WebP file")
    colours = mosaic_in(form, data)
    return data if colours is None else colours
