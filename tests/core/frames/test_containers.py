"""Headers and structure of image files, from their bytes alone."""

from __future__ import annotations

import io
import time

import cv2
import numpy as np
import pytest
from PIL import Image

from core.errors import EmptyImage, InvalidImage, NotAnImage, TruncatedImage, UnsupportedFormat
from core.frames.containers import MAX_JPEG_SCANS, Header, find_exif, read_header, read_structure
from core.frames.images import Limits, decode

BLANK = np.zeros((64, 64, 3), np.uint8)

OTHERS = {
    "GIF": b"GIF89a\x28\0\x18\0",
    "BMP": b"BM\x36\x0b\0\0\0\0\0\0\x36\0\0\0\x28\0\0\0\x28\0\0\0",
    "TIFF": b"MM\0*\0\0\0\x08",
    "AVIF": b"\0\0\0\x20ftypavif\0\0\0\0",
    "HEIC": b"\0\0\0\x20ftypheic\0\0\0\0",
    "JPEG XL": b"\xff\x0a\x38\x04",
    "JPEG 2000": b"\0\0\0\x0cjP  \r\n\x87\n",
    "Netpbm": b"P6\n40 24\n255\n",
    "OpenEXR": b"v/1\x01\x02\0\0\0",
    "Radiance HDR": b"#?RADIANCE\n",
    "Sun raster": b"\x59\xa6\x6a\x95\0\0",
    "Photoshop": b"8BPS\0\x01",
    "icon": b"\0\0\x01\0\x01\0\x20\x20\0\0",
    "QOI": b"qoif\0\0\0\x28",
    "SVG": b'<?xml version="1.0"?>\n<svg xmlns="http://www.w3.org/2000/svg">',
}


def with_pillow(name: str, **options: object) -> bytes:
    file = io.BytesIO()
    Image.new("RGBA" if name == "WEBP" else "RGB", (40, 24), "teal").save(file, name, **options)
    return file.getvalue()


@pytest.mark.parametrize(
    ("wanted", "extension", "options"),
    [
        ("jpeg", ".jpg", []),
        ("jpeg", ".jpg", [cv2.IMWRITE_JPEG_PROGRESSIVE, 1]),
        ("png", ".png", []),
        ("webp", ".webp", [cv2.IMWRITE_WEBP_QUALITY, 80]),  # VP8
        ("webp", ".webp", [cv2.IMWRITE_WEBP_QUALITY, 101]),  # VP8L
    ],
)
@pytest.mark.parametrize(("height", "width"), [(24, 40), (1, 1), (300, 257)])
def test_format_and_size(wanted: str, extension: str, options: list[int], height: int, width: int) -> None:
    data = cv2.imencode(extension, np.full((height, width, 3), 99, np.uint8), options)[1].tobytes()
    header = read_header(data)
    assert header == Header(wanted, width, height)  # type: ignore[arg-type]
    assert read_structure(data, header).exif is None


def test_an_extended_webp_announces_its_canvas() -> None:
    data = with_pillow("WEBP", exif=b"Exif\0\0II*\0")
    assert data[12:16] == b"VP8X"
    assert read_header(data) == Header("webp", 40, 24)


def test_the_size_is_the_one_stored_whatever_the_orientation() -> None:
    exif = Image.Exif()
    exif[0x0112] = 6
    assert read_header(with_pillow("JPEG", exif=exif.tobytes())) == Header("jpeg", 40, 24)


@pytest.mark.parametrize("name", OTHERS)
def test_other_formats_are_named(name: str) -> None:
    with pytest.raises(UnsupportedFormat, match=name):
        read_header(OTHERS[name] + bytes(40))


@pytest.mark.parametrize("extension", [".gif", ".bmp", ".tiff", ".jp2", ".ppm", ".avif", ".hdr", ".ras"])
def test_other_formats_as_they_are_written(extension: str) -> None:
    done, data = cv2.imencode(extension, BLANK)
    assert done
    with pytest.raises(UnsupportedFormat):
        read_header(data.tobytes())


@pytest.mark.parametrize("data", [b"BM, the shop", b"P6", b"\0\0\x01\0", b"\0\0\0\x20ftypisom", b"RIFF\0\0\0\0WAVE"])
def test_what_only_looks_like_an_image_is_none(data: bytes) -> None:
    with pytest.raises(NotAnImage):
        read_header(data.ljust(60, b"x"))


def test_no_bytes() -> None:
    with pytest.raises(EmptyImage):
        read_header(b"")


@pytest.mark.parametrize("extension", [".jpg", ".png", ".webp"])
def test_a_header_can_be_read_before_the_file_is_whole(extension: str) -> None:
    noise = np.random.default_rng(0).integers(0, 256, (200, 200, 3)).astype(np.uint8)
    data = cv2.imencode(extension, noise)[1].tobytes()
    header = read_header(data[:1000])
    assert (header.width, header.height) == (200, 200)
    with pytest.raises(TruncatedImage):
        decode(data[:1000])


@pytest.mark.parametrize("filling", [b"\xff", b"\xff\0", b"\0", b"\xff\xd0", b"\xff\xe0\0\2", b"\xff\xda\0\2"])
@pytest.mark.parametrize("start", [b"\xff\xd8\xff\xe0\0\4ab", b"\x89PNG\r\n\x1a\n", b"RIFF\0\0\0\1WEBPVP8X"])
def test_hostile_bytes_are_refused_at_once(start: bytes, filling: bytes) -> None:
    data = start + filling * (2**24 // len(filling))
    began = time.process_time()
    with pytest.raises(InvalidImage):
        decode(data, Limits(max_pixels=10**12))
    assert time.process_time() - began < 1  # a loop over all bytes would take many seconds


@pytest.mark.parametrize(
    ("name", "prefix"),
    [("JPEG", b"Exif\0\0"), ("PNG", b"Exif\0\0"), ("PNG", b""), ("WEBP", b"Exif\0\0"), ("WEBP", b"")],
)
def test_the_exif_block_is_found_with_and_without_its_prefix(name: str, prefix: bytes) -> None:
    block = b"II*\0\x08\0\0\0\0\0\0\0\0\0"
    assert find_exif(with_pillow(name, exif=prefix + block)) == block


def test_no_exif_block() -> None:
    assert find_exif(with_pillow("PNG")) is None
    assert find_exif(b"hello") is None


def test_a_jpeg_without_image_data_is_damaged() -> None:
    data = with_pillow("JPEG")
    with pytest.raises(NotAnImage):
        read_structure(data[: data.index(b"\xff\xda")] + b"\xff\xd9", read_header(data))


@pytest.mark.parametrize("options", [{}, {"progressive": True}])
def test_scans_are_counted_where_a_decoder_reads_all(options: dict[str, bool]) -> None:
    """Of a file whose first scan has all colours, decoders read no other; then others are not counted."""
    data = with_pillow("JPEG", **options)
    at = data.index(b"\xff\xda")
    one = b"\xff\xda\0\x08\1\1\0\0\x3f\0"  # of one colour, without data
    for scans, allowed in ((MAX_JPEG_SCANS - 20, True), (MAX_JPEG_SCANS + 1, False)):
        many = data[:at] + scans * one + data[at:]
        if allowed:
            assert read_structure(many, read_header(many)).coded == at + len(one)
        else:
            with pytest.raises(NotAnImage, match="scans"):
                read_structure(many, read_header(many))
    if not options:
        behind = data + 1000 * one
        assert read_structure(behind, read_header(behind)).coded > at


def test_padding_before_a_marker_is_allowed() -> None:
    data = with_pillow("JPEG")
    padded = data[:2] + b"\xff" * 20 + data[2:]
    assert read_header(padded) == Header("jpeg", 40, 24)
    assert read_structure(padded, read_header(padded)).exif is None
