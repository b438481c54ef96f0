"""JPEG, PNG and WebP files seen from outside: which format, how large, where the EXIF block is.

Everything is read from the bytes alone and before any decoding, so that a picture of a billion pixels costs as little
to refuse as a small one to accept.  The walks read a file as its decoder does: PNG and WebP files to their end, JPEG
files to their first scan, because only decoding shows whether the rest is there (``core.frames.jpeg``).

Libraries do not replace them.  Of 10 800 damaged pictures, 2 830 are decoded to wrong pixels, one of which lost its
end; with Pillow's header in place of the walks there are as many, by OpenCV alone 5 378, by Pillow alone 5 668
(``python -m benchmarks.pictures.damaged``).  But Pillow bounds no parts: 16 MiB of empty segments or chunks take it 5.4
or 3.6 s where the walks take 0.02, empty scans of 40 megapixels 7.4 s, and a sound PNG 2.9 ms instead of 1.5, since it
decodes the picture to find its orientation.  OpenCV bounds no pixels: 2.7 GB for a PNG of 900 megapixels
(``python -m benchmarks.pictures.hostile``).
"""

from __future__ import annotations

import re
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal

from core.errors import EmptyImage, InvalidImage, NotAnImage, TruncatedImage, UnsupportedFormat

Format = Literal["jpeg", "png", "webp"]

PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"
EXIF_PREFIX = b"Exif\0\0"
MAX_JPEG_SCANS = 64
"""Encoders write about ten; each may cost the decoder a pass over the whole picture, even an empty one."""

MAX_SEGMENTS = 2048
"""Parts of a JPEG file before its first scan. A frame has about ten; metadata of 16 MiB needs 256."""

MAX_GAP = 256
"""Stray bytes tolerated before a JPEG marker, so that a header is found at once or not."""

MAX_CHUNKS = 16_384
"""Parts of a PNG or WebP file. A frame has a few; a PNG of 16 MiB in pieces of 8 KiB has 2 048."""

# A marker of a JPEG file. FF00 is a data byte FF, FFFF is padding, D0 to D7 only restart the decoder.
_MARKER = re.compile(rb"\xff([\x02-\xcf\xd8-\xfe])")
_SOI, _EOI, _SOS, _APP1, _JPEG_LS = 0xD8, 0xD9, 0xDA, 0xE1, 0xF7
_FRAMES = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}  # SOFn; DHT, JPG and DAC lie between them
_PROGRESSIVE_FRAMES = frozenset({0xC2, 0xCA})
_DECODABLE_FRAMES = _PROGRESSIVE_FRAMES | {0xC0, 0xC1, 0xC9}  # baseline, extended, progressive, both codings

_OTHER_FORMATS: tuple[tuple[str, re.Pattern[bytes]], ...] = tuple(
    (name, re.compile(pattern, re.DOTALL))
    for name, pattern in (
        ("GIF", rb"GIF8[79]a"),
        ("BMP", rb"BM.{8}.{4}[\x0c\x28\x34\x38\x40\x6c\x7c]\0\0\0"),
        ("TIFF", rb"II[*+]\0|MM\0[*+]"),
        ("AVIF", rb".{4}ftypavi[fs]"),
        ("HEIC", rb".{4}ftyp(hei[cxms]|hev[cxms]|mif[12]|msf1)"),
        ("JPEG XL", rb"\xff\x0a|\0\0\0\x0cJXL \r\n\x87\n"),
        ("JPEG 2000", rb"\0\0\0\x0cjP  \r\n\x87\n|\xff\x4f\xff\x51"),
        ("Netpbm", rb"P[1-7]\s|P[Ff]\n"),
        ("OpenEXR", rb"v/1\x01"),
        ("Radiance HDR", rb"#\?(RADIANCE|RGBE)\n"),
        ("Sun raster", rb"\x59\xa6\x6a\x95"),
        ("Photoshop", rb"8BPS\0[\x01\x02]"),
        ("icon", rb"\0\0[\x01\x02]\0[\x01-\x40]\0..[\0-\x10]\0"),
        ("DDS", rb"DDS \x7c\0\0\0"),
        ("QOI", rb"qoif"),
        ("MNG", rb"\x8aMNG\r\n\x1a\n|\x8bJNG\r\n\x1a\n"),
        ("SVG", rb"\s*<svg[\s>]|(\xef\xbb\xbf)?\s*<\?xml.{0,400}?<svg[\s>]"),
    )
)


@dataclass(frozen=True)
class Header:
    """The announcement of a file: its format, and its pixels as they are stored, before any orientation."""

    format: Format
    width: int
    height: int


@dataclass(frozen=True)
class Structure:
    """The result of a walk through a file; of a JPEG file, through the parts before its first scan.

    exif: the EXIF block (a TIFF file of its own), or None.
    coded: of a JPEG file, where the data of its first scan begins.
    needed: of a PNG file, where chunks stand that a decoder needs; empty if it needs all of them.
    """

    exif: bytes | None
    coded: int = 0
    needed: tuple[tuple[int, int], ...] = ()


@dataclass(frozen=True)
class _Segment:
    """A part of a JPEG file: ``data[start:end]`` is the content after its length; empty for a lone marker."""

    marker: int
    start: int
    end: int


@dataclass(frozen=True)
class _Chunk:
    """A part of a PNG or WebP file: ``data[start:end]`` is its content."""

    kind: bytes
    start: int
    end: int


def read_header(data: bytes) -> Header:
    """Format and size of an image file, in microseconds; nothing is decoded.

    Raises:
        EmptyImage: no bytes.
        UnsupportedFormat: an image of another format, or a kind of the three that no camera frame has.
        TruncatedImage: the bytes end inside the header.
        NotAnImage: anything else, or a header that makes no sense.
    """
    if not data:
        raise EmptyImage("The image has no bytes.")
    if data.startswith(b"\xff\xd8\xff"):
        header = _read_jpeg_header(data)
    elif data.startswith(PNG_SIGNATURE):
        header = _read_png_header(data)
    elif data.startswith(b"RIFF") and data[8:12] == b"WEBP":
        header = _read_webp_header(data)
    else:
        for name, pattern in _OTHER_FORMATS:
            if pattern.match(data[:512]):
                raise UnsupportedFormat(f"The image is of the format {name}; send JPEG, PNG or WebP.")
        raise NotAnImage("The bytes are not those of an image.")
    if not header.width or not header.height:
        raise NotAnImage(f"The {header.format} header announces {header.width}x{header.height} pixels.")
    return header


def read_structure(data: bytes, header: Header) -> Structure:
    """Walk through the file, of JPEG up to its first scan.

    Raises:
        TruncatedImage: the file ends before the image does. Bytes after its end are tolerated.
        NotAnImage: the parts of the file are damaged, or more than any real file has.
        UnsupportedFormat: an animation.
    """
    match header.format:
        case "jpeg":
            return _check_jpeg(data)
        case "png":
            return _check_png(data)
        case "webp":
            return Structure(_bare(_check_webp(data)))


def _bare(exif: bytes | None) -> bytes | None:
    return exif.removeprefix(EXIF_PREFIX) if exif is not None else None


def find_exif(data: bytes) -> bytes | None:
    """The EXIF block of an image file; None if it has none or its parts are damaged."""
    try:
        return read_structure(data, read_header(data)).exif
    except InvalidImage:
        return None


# JPEG (ITU-T T.81, annex B)


def _walk_jpeg(data: bytes) -> Iterator[_Segment]:
    """The segments of a JPEG file up to the header of its first scan.

    Raises:
        TruncatedImage: the file ends before, or a segment is cut.
        NotAnImage: a segment is shorter than its own length field, or bytes between segments are of none.
    """
    position = 2
    for _ in range(MAX_SEGMENTS):
        limit = min(len(data), position + MAX_GAP)
        found = _MARKER.search(data, position, limit)
        if found is None and limit < len(data):
            raise NotAnImage("The JPEG file is damaged: a segment does not begin where it should.")
        if found is None:
            raise TruncatedImage("The JPEG file is cut: it ends inside its header.")
        marker, start = found[1][0], found.end() + 2
        if marker == _SOI:
            raise TruncatedImage("The JPEG file is cut: another one begins inside it.")
        if marker == _EOI:
            return
        position = start - 2 + int.from_bytes(data[start - 2 : start], "big")
        if max(start, position) > len(data):
            raise TruncatedImage("The JPEG file is cut inside a segment.")
        if position < start:
            raise NotAnImage("The JPEG file is damaged: a segment has no length.")
        yield _Segment(marker, start, position)
        if marker == _SOS:
            return
    raise NotAnImage(f"The JPEG file has more than {MAX_SEGMENTS} segments.")


def _read_jpeg_header(data: bytes) -> Header:
    for segment in _walk_jpeg(data):
        if segment.marker == _JPEG_LS:
            raise UnsupportedFormat("The image is of the format JPEG-LS; send JPEG, PNG or WebP.")
        if segment.marker not in _FRAMES:
            continue
        if segment.end - segment.start < 6:
            raise NotAnImage("The JPEG file is damaged: its frame header is too short.")
        precision = data[segment.start]
        if segment.marker not in _DECODABLE_FRAMES or precision != 8:
            kind = f"SOF{segment.marker - 0xC0}, {precision} bits"
            raise UnsupportedFormat(f"The JPEG file is lossless, hierarchical or not of 8 bits ({kind}).")
        height = int.from_bytes(data[segment.start + 1 : segment.start + 3], "big")
        width = int.from_bytes(data[segment.start + 3 : segment.start + 5], "big")
        return Header("jpeg", width, height)
    raise NotAnImage("The JPEG file is damaged: it has no frame header.")


def _check_jpeg(data: bytes) -> Structure:
    exif, segment, colours, progressive = None, None, 0, False
    for segment in _walk_jpeg(data):
        if segment.marker == _APP1 and exif is None and data.startswith(EXIF_PREFIX, segment.start, segment.end):
            exif = data[segment.start : segment.end]
        elif segment.marker in _FRAMES and segment.end - segment.start >= 6:
            colours, progressive = data[segment.start + 5], segment.marker in _PROGRESSIVE_FRAMES
    if segment is None or segment.marker != _SOS or segment.start == segment.end:
        raise NotAnImage("The JPEG file is damaged: it has no image data.")
    # Unless the first scan has all colours at once, decoders read on to the last scan, and each takes them a pass.
    reads_on = progressive or data[segment.start] < colours
    if reads_on and data.count(bytes([0xFF, _SOS]), segment.start) >= MAX_JPEG_SCANS:
        raise NotAnImage(f"The JPEG file has more than {MAX_JPEG_SCANS} scans.")
    return Structure(_bare(exif), segment.end)


# PNG (W3C, section 5)


def _read_png_header(data: bytes) -> Header:
    if len(data) < 33:
        raise TruncatedImage("The PNG file is cut inside its header.")
    if data[8:16] != b"\0\0\0\x0dIHDR":
        raise NotAnImage("The PNG file is damaged: it does not begin with its header.")
    width, height = int.from_bytes(data[16:20], "big"), int.from_bytes(data[20:24], "big")
    return Header("png", width, height)


def _walk_png(data: bytes) -> Iterator[_Chunk]:
    """The chunks of a PNG file up to its IEND, their checksums verified.

    Raises:
        TruncatedImage: there is no IEND.
        NotAnImage: a checksum is wrong.
    """
    view, position = memoryview(data), len(PNG_SIGNATURE)
    for _ in range(MAX_CHUNKS):
        start = position + 8
        end = start + int.from_bytes(data[position : position + 4], "big")
        if end + 4 > len(data):
            raise TruncatedImage("The PNG file is cut: it has no end chunk.")
        if zlib.crc32(view[position + 4 : end]) != int.from_bytes(data[end : end + 4], "big"):
            raise NotAnImage("The PNG file is damaged: a checksum is wrong.")
        chunk = _Chunk(data[position + 4 : start], start, end)
        yield chunk
        if chunk.kind == b"IEND":
            return
        position = end + 4
    raise NotAnImage(f"The PNG file has more than {MAX_CHUNKS} chunks.")


def _check_png(data: bytes) -> Structure:
    exif, all_needed = None, True
    needed: list[tuple[int, int]] = [(0, len(PNG_SIGNATURE))]
    for chunk in _walk_png(data):
        if chunk.kind == b"acTL":
            raise UnsupportedFormat("The PNG file is an animation; send one frame.")
        if chunk.kind == b"eXIf" and exif is None:
            exif = data[chunk.start : chunk.end]
        if chunk.kind[:1].islower() and chunk.kind != b"tRNS":  # texts, profiles: they unpack to much, and say things
            all_needed = False
        else:
            needed.append((chunk.start - 8, chunk.end + 4))
    return Structure(_bare(exif), needed=() if all_needed else tuple(needed))


# WebP (RFC 9649, section 2)


def _walk_webp(data: bytes) -> Iterator[_Chunk]:
    """The chunks of a WebP file.

    Raises:
        TruncatedImage: the bytes end before the file does, by its own size or a chunk's.
    """
    size = 8 + int.from_bytes(data[4:8], "little")
    if len(data) < size:
        raise TruncatedImage(f"The WebP file is cut: it has {len(data)} of {size} bytes.")
    position = 12
    for _ in range(MAX_CHUNKS):
        if position + 8 > size:
            return
        start = position + 8
        end = start + int.from_bytes(data[position + 4 : start], "little")
        if end > size:
            raise TruncatedImage("The WebP file is cut: a chunk ends after the file.")
        yield _Chunk(data[position : position + 4], start, end)
        position = end + (end - start) % 2
    raise NotAnImage(f"The WebP file has more than {MAX_CHUNKS} chunks.")


def _read_webp_header(data: bytes) -> Header:
    if len(data) < 30:
        raise TruncatedImage("The WebP file is cut inside its header.")
    match data[12:16]:
        case b"VP8 ":
            if data[20] & 1 or data[23:26] != b"\x9d\x01\x2a":
                raise NotAnImage("The WebP file is damaged: its VP8 data does not begin with a key frame.")
            width, height = (int.from_bytes(data[i : i + 2], "little") & 0x3FFF for i in (26, 28))
        case b"VP8L":
            if data[20] != 0x2F:
                raise NotAnImage("The WebP file is damaged: its VP8L data has no signature.")
            packed = int.from_bytes(data[21:25], "little")
            width, height = (packed & 0x3FFF) + 1, (packed >> 14 & 0x3FFF) + 1
        case b"VP8X":
            if data[20] & 2:
                raise UnsupportedFormat("The WebP file is an animation; send one frame.")
            width, height = (int.from_bytes(data[i : i + 3], "little") + 1 for i in (24, 27))
        case _:
            raise NotAnImage("The WebP file is damaged: it does not begin with image data.")
    return Header("webp", width, height)


def _check_webp(data: bytes) -> bytes | None:
    exif = None
    for chunk in _walk_webp(data):
        if chunk.kind == b"EXIF" and exif is None:
            exif = data[chunk.start : chunk.end]
    return exif
