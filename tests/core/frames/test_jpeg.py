"""A JPEG whose data ends before its picture is refused; one that is whole never is."""

from __future__ import annotations

import io
import tracemalloc
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from PIL import Image

from core.errors import InvalidImage, NotAnImage, TruncatedImage
from core.frames import images, jpeg
from core.frames.containers import read_header, read_structure
from core.frames.images import decode

WAYS: dict[str, tuple[str, dict[str, Any]]] = {
    "baseline": ("RGB", {}),
    "unsubsampled": ("RGB", {"subsampling": 0}),
    "progressive": ("RGB", {"progressive": True}),
    "restarts": ("RGB", {"restart_marker_blocks": 4}),
    "grey": ("L", {}),
    "cmyk": ("CMYK", {}),
}
SHADES: dict[str, Any] = {"RGB": (128, 128, 128), "L": 128, "CMYK": (0, 0, 0, 127)}


def photograph(seed: int, mode: str = "RGB", width: int = 160, height: int = 112, **options: Any) -> bytes:
    """Noise over a slope: something in every block."""
    random = np.random.default_rng(seed)
    slope = np.linspace(20, 230, width)[None, :, None] * np.ones((height, 1, 3))
    pixels = np.clip(slope + random.normal(0, 25, slope.shape), 0, 255).astype(np.uint8)
    return saved(Image.fromarray(pixels).convert(mode), **options)


def saved(image: Image.Image, **options: Any) -> bytes:
    file = io.BytesIO()
    image.save(file, "JPEG", **{"quality": 85, **options})
    return file.getvalue()


def scan_start(data: bytes) -> int:
    return read_structure(data, read_header(data)).coded


@pytest.mark.parametrize("way", WAYS)
@pytest.mark.parametrize("share", [0.05, 0.4, 0.8])
def test_data_that_was_lost_before_an_end_marker(way: str, share: float) -> None:
    mode, options = WAYS[way]
    data = photograph(1, mode, **options)
    start = scan_start(data)
    cut = data[: start + round(share * (len(data) - 2 - start))] + b"\xff\xd9"
    with pytest.raises(TruncatedImage):
        decode(cut)


@pytest.mark.parametrize("way", WAYS)
@pytest.mark.parametrize("more", [16, 112, 1000])
def test_a_header_that_announces_more_rows_than_there_are(way: str, more: int) -> None:
    mode, options = WAYS[way]
    data = bytearray(photograph(2, mode, **options))
    frame = next(at for marker in (b"\xff\xc0", b"\xff\xc2") if (at := data.find(marker)) > 0)
    data[frame + 5 : frame + 7] = (112 + more).to_bytes(2, "big")
    with pytest.raises(TruncatedImage):
        decode(bytes(data))


def test_a_stretch_between_restart_markers_that_was_lost() -> None:
    data = photograph(3, restart_marker_blocks=4)
    first, second = data.index(b"\xff\xd2"), data.index(b"\xff\xd3")
    with pytest.raises(TruncatedImage, match="missing"):
        decode(data[:first] + data[second:])


@pytest.mark.parametrize(
    "filling", [b"\xff\x01" * 2_000_000, b"".join(bytes([0xFF, 0xD0 + i % 8]) for i in range(100_000))]
)
def test_odd_files_of_many_stretches_take_little_memory(filling: bytes) -> None:
    data = photograph(3)
    data = data.replace(b"JFIF\0\1", b"JFIF\0\x09", 1)  # an unknown version, for which it is decoded twice
    at = len(data) - 2
    tracemalloc.start()
    with pytest.raises(InvalidImage):
        decode(data[:at] + filling + data[at:])
    assert tracemalloc.get_traced_memory()[1] < 64 << 20
    tracemalloc.stop()


@pytest.mark.parametrize("way", WAYS)
@pytest.mark.parametrize("quality", [1, 30, 95])
def test_whole_pictures_are_decoded_whatever_they_show(way: str, quality: int) -> None:
    mode, options = WAYS[way]
    for seed, (width, height) in enumerate([(16, 16), (57, 40), (161, 97)]):
        assert decode(photograph(seed, mode, width, height, quality=quality, **options)).shape == (height, width, 3)
        flat = Image.new(mode, (width, height), SHADES[mode])
        assert decode(saved(flat, quality=quality, **options)).shape == (height, width, 3)


def padded(data: bytes, marker: bytes, padding: bytes) -> bytes:
    """The file with stray bytes before the last of a marker."""
    place = data.rindex(marker)
    return data[:place] + padding + data[place:]


ODDITIES: dict[str, Callable[[bytes], bytes]] = {
    "padding before the end": lambda data: padded(data, b"\xff\xd9", bytes(100)),
    "one byte before the end": lambda data: padded(data, b"\xff\xd9", b"\x5a"),
    "padding before a table": lambda data: padded(data, b"\xff\xdb", bytes(30)),
    "a version of JFIF that does not exist": lambda data: data[:11] + b"\x09" + data[12:],
    "a second scan": lambda data: data[:-2] + data[data.rindex(b"\xff\xda") :],
    "bytes after the end": lambda data: data + bytes(5000) + data[:300],
    "fill bytes": lambda data: padded(data, b"\xff\xd9", b"\xff" * 20),
}


@pytest.mark.parametrize("way", ["baseline", "unsubsampled", "restarts", "grey"])
@pytest.mark.parametrize("oddity", ODDITIES)
def test_what_cameras_write_is_taken_if_the_picture_is_whole(way: str, oddity: str) -> None:
    mode, options = WAYS[way]
    data = photograph(4, mode, **options)
    np.testing.assert_array_equal(decode(ODDITIES[oddity](data)), decode(data))
    start = scan_start(data)
    cut = data[: start + (len(data) - start) // 2] + b"\xff\xd9"
    with pytest.raises(TruncatedImage):
        decode(ODDITIES[oddity](cut))


def test_a_sound_picture_is_decoded_once(monkeypatch: pytest.MonkeyPatch) -> None:
    grey = saved(Image.new("RGB", (64, 64), (128, 128, 128)))
    monkeypatch.setattr(images, "_pixels", lambda _data: pytest.fail("it was decoded by the tolerant decoder"))
    for way in WAYS:
        mode, options = WAYS[way]
        assert decode(photograph(5, mode, **options)).any()
    assert (decode(grey) == 128).all()


def test_no_more_memory_is_taken_than_the_header_announces() -> None:
    data = photograph(6)
    with pytest.raises(NotAnImage, match="too small"):
        jpeg.decode_jpeg(data, (50, 160), scan_start(data), images._pixels)


@pytest.mark.parametrize(("width", "height"), [(64, 4), (4, 64), (1, 1), (7, 7), (2, 900), (8, 8), (9, 8)])
def test_a_picture_that_is_smaller_than_a_block(width: int, height: int) -> None:
    """A frame has no such sides, but the small picture of a panorama may."""
    limits = images.Limits(min_side=1)
    for image in (Image.new("RGB", (width, height), SHADES["RGB"]), Image.new("RGB", (width, height), "red")):
        assert decode(saved(image), limits).shape == (height, width, 3)
    data = photograph(9, width=width, height=height, quality=95)
    assert decode(data, limits).shape == (height, width, 3)
    if min(width, height) < 8 < max(width, height):
        start = scan_start(data)
        with pytest.raises(TruncatedImage):
            decode(data[: start + (len(data) - start) // 3] + b"\xff\xd9", limits)


def test_damage_that_is_no_cut_is_still_told() -> None:
    data = bytearray(photograph(8))
    data[data.index(b"\xff\xc0") + 9] = 9  # components
    with pytest.raises(InvalidImage):
        decode(bytes(data))
