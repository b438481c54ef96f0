"""Decoding: the three formats, orientation, limits, and a typed error for whatever is wrong."""

from __future__ import annotations

import io
import tracemalloc
import zlib
from typing import Any

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from PIL import Image, ImageOps

from core.errors import (
    EmptyImage,
    ImageTooLarge,
    ImageTooSmall,
    InvalidImage,
    NotAnImage,
    TooManyPixels,
    TruncatedImage,
    UnsupportedFormat,
)
from core.frames.containers import MAX_JPEG_SCANS, PNG_SIGNATURE
from core.frames.images import Limits, decode, encode_png, encode_thumbnail

EXTENSIONS = {"jpeg": ".jpg", "png": ".png", "webp": ".webp"}
LOSSLESS: dict[str, dict[str, Any]] = {
    "JPEG": {"quality": 100, "subsampling": 0},
    "PNG": {},
    "WEBP": {"lossless": True},
}


def scene(height: int = 24, width: int = 40) -> NDArray[np.uint8]:
    """A picture, BGR, whose eight orientations all differ."""
    y, x = np.mgrid[:height, :width]
    pixels = np.stack([x * 6 % 256, y * 10 % 256, (x + y) * 3 % 256], axis=2).astype(np.uint8)
    pixels[: height // 4, : width // 4] = (20, 30, 220)
    return pixels


def encoded(name: str, pixels: NDArray[np.uint8] | None = None, *options: int) -> bytes:
    done, data = cv2.imencode(EXTENSIONS[name], scene() if pixels is None else pixels, options)
    assert done
    return data.tobytes()


def saved(image: Image.Image, name: str, **options: Any) -> bytes:
    file = io.BytesIO()
    image.save(file, name, **(LOSSLESS.get(name, {}) | options))
    return file.getvalue()


def picture(mode: str = "RGB") -> Image.Image:
    return Image.fromarray(np.ascontiguousarray(scene()[:, :, ::-1])).convert(mode)


def as_bgr(image: Image.Image) -> NDArray[np.uint8]:
    return np.asarray(image.convert("RGB"))[:, :, ::-1]


def png_chunk(kind: bytes, content: bytes) -> bytes:
    return len(content).to_bytes(4, "big") + kind + content + zlib.crc32(kind + content).to_bytes(4, "big")


def png_header(width: int, height: int, depth: int = 8, colour: int = 2) -> bytes:
    content = width.to_bytes(4, "big") + height.to_bytes(4, "big") + bytes([depth, colour, 0, 0, 0])
    return png_chunk(b"IHDR", content)


def png_bomb(side: int) -> bytes:
    """A small PNG file that announces side x side pixels."""
    return PNG_SIGNATURE + png_header(side, side) + png_chunk(b"IDAT", zlib.compress(bytes(10_000_000)))


# What works


@pytest.mark.parametrize("name", EXTENSIONS)
@pytest.mark.parametrize(("height", "width"), [(16, 16), (17, 31), (48, 64), (300, 20)])
def test_each_format_gives_its_pixels(name: str, height: int, width: int) -> None:
    pixels = scene(height, width)
    data = encoded(name, pixels)
    found = decode(data)
    assert found.shape == (height, width, 3)
    assert found.dtype == np.uint8
    assert found.flags.c_contiguous
    np.testing.assert_array_equal(found, cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR))
    if name == "png":
        np.testing.assert_array_equal(found, pixels)


def test_a_progressive_jpeg_gives_its_pixels() -> None:
    plain, progressive = encoded("jpeg"), encoded("jpeg", None, cv2.IMWRITE_JPEG_PROGRESSIVE, 1)
    assert b"\xff\xc2" in progressive
    np.testing.assert_allclose(decode(plain).astype(int), decode(progressive), atol=2)


@pytest.mark.parametrize("orientation", range(1, 9))
@pytest.mark.parametrize("name", LOSSLESS)
def test_the_orientation_is_honoured(name: str, orientation: int) -> None:
    exif = Image.Exif()
    exif[0x0112] = orientation
    data = saved(picture(), name, exif=exif.tobytes())
    upright = as_bgr(ImageOps.exif_transpose(Image.open(io.BytesIO(data))))
    found = decode(data)
    assert found.shape == upright.shape
    assert found.flags.c_contiguous
    np.testing.assert_allclose(found.astype(int), upright, atol=3 if name == "JPEG" else 0)


@pytest.mark.parametrize("orientation", [0, 9, 200, 65535])
def test_an_orientation_that_does_not_exist_is_ignored(orientation: int) -> None:
    exif = Image.Exif()
    exif[0x0112] = orientation
    np.testing.assert_array_equal(decode(saved(picture(), "PNG", exif=exif.tobytes())), scene())


@pytest.mark.parametrize(
    ("name", "mode"),
    [("JPEG", "L"), ("PNG", "L"), ("PNG", "1"), ("PNG", "P"), ("PNG", "LA"), ("PNG", "RGBA"), ("WEBP", "RGBA")],
)
def test_grey_palette_and_alpha_images_become_colour(name: str, mode: str) -> None:
    image = picture(mode)
    found = decode(saved(image, name))
    assert found.shape == (24, 40, 3)
    np.testing.assert_allclose(found.astype(int), as_bgr(image), atol=2 if name == "JPEG" else 0)
    if mode in ("L", "1", "LA"):
        np.testing.assert_array_equal(found[..., 0], found[..., 2])


def test_transparency_is_dropped_and_the_colour_under_it_kept() -> None:
    pixels = np.dstack([scene(), np.zeros((24, 40), np.uint8)])
    np.testing.assert_array_equal(decode(encoded("png", pixels)), scene())


@pytest.mark.parametrize("channels", [1, 3, 4])
def test_sixteen_bits_become_eight(channels: int) -> None:
    deep = np.random.default_rng(0).integers(0, 65536, (24, 40, channels)).astype(np.uint16)
    done, data = cv2.imencode(".png", deep)
    assert done
    found = decode(data.tobytes())
    wanted = np.broadcast_to(deep[:, :, :3] / 257, (24, 40, 3))
    np.testing.assert_allclose(found, wanted, atol=1)


def test_a_cmyk_jpeg_has_its_colours() -> None:
    image = picture("CMYK")
    found = decode(saved(image, "JPEG"))
    np.testing.assert_allclose(found.astype(int), as_bgr(image), atol=6)


@pytest.mark.parametrize("name", EXTENSIONS)
def test_bytes_after_the_end_are_tolerated(name: str) -> None:
    data = encoded(name)
    np.testing.assert_array_equal(decode(data + b"trailing bytes \xff\xd8\xff\xd9" * 5), decode(data))


# What is refused


def test_no_bytes() -> None:
    with pytest.raises(EmptyImage):
        decode(b"")


@pytest.mark.parametrize(
    "data", [b"\0", b"hello, world", b"<html><body>Not found</body></html>", bytes(1000), b"%PDF-1.7\n", b"\xff\xd8\0"]
)
def test_bytes_that_are_no_image(data: bytes) -> None:
    with pytest.raises(NotAnImage):
        decode(data)


def test_more_bytes_than_the_limit() -> None:
    data = encoded("png")
    assert decode(data, Limits(max_bytes=len(data))).any()
    with pytest.raises(ImageTooLarge, match=str(len(data))):
        decode(data, Limits(max_bytes=len(data) - 1))


@pytest.mark.parametrize("name", EXTENSIONS)
def test_more_pixels_than_the_limit(name: str) -> None:
    data = encoded(name)
    assert decode(data, Limits(max_pixels=24 * 40)).any()
    with pytest.raises(TooManyPixels, match="40x24"):
        decode(data, Limits(max_pixels=24 * 40 - 1))


@pytest.mark.parametrize("side", [7_000, 60_000, 2**31 - 1])
def test_a_decompression_bomb_is_not_decoded(side: int, monkeypatch: pytest.MonkeyPatch) -> None:
    data = png_bomb(side)
    monkeypatch.setattr(cv2, "imdecode", lambda *_: pytest.fail("it was decoded"))
    tracemalloc.start()
    with pytest.raises(TooManyPixels):
        decode(data)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 100_000


@pytest.mark.parametrize("name", EXTENSIONS)
@pytest.mark.parametrize(("height", "width"), [(15, 40), (40, 15), (1, 1)])
def test_a_side_under_the_limit(name: str, height: int, width: int) -> None:
    with pytest.raises(ImageTooSmall, match=f"{width}x{height}"):
        decode(encoded(name, scene(40, 40)[:height, :width]))


@pytest.mark.parametrize("name", EXTENSIONS)
def test_a_file_cut_anywhere_is_truncated(name: str) -> None:
    data = encoded(name)
    for length in range(12 if name == "webp" else 8, len(data)):
        with pytest.raises(TruncatedImage):
            decode(data[:length])


def test_a_progressive_jpeg_cut_between_its_scans_is_truncated() -> None:
    data = encoded("jpeg", None, cv2.IMWRITE_JPEG_PROGRESSIVE, 1)
    with pytest.raises(TruncatedImage):
        decode(data[: data.rfind(b"\xff\xda")])


def test_the_end_of_a_thumbnail_is_not_the_end_of_its_jpeg() -> None:
    data, thumbnail = encoded("jpeg"), encoded("jpeg", scene(16, 16))
    block = b"Exif\0\0" + b"II*\0\x08\0\0\0\0\0\0\0\0\0" + thumbnail
    whole = data[:2] + b"\xff\xe1" + (len(block) + 2).to_bytes(2, "big") + block + data[2:]
    assert decode(whole).shape == (24, 40, 3)
    with pytest.raises(TruncatedImage):
        decode(whole[:-2])


def test_a_jpeg_inside_a_cut_jpeg_does_not_end_it() -> None:
    data = encoded("jpeg")
    with pytest.raises(TruncatedImage):
        decode(data[:-40] + data)


@pytest.mark.parametrize("where", ["IHDR", "IDAT", "tEXt"])
def test_a_png_with_a_wrong_checksum_is_damaged(where: str) -> None:
    text = png_chunk(b"tEXt", b"Comment\0a corridor")
    data = bytearray(encoded("png"))
    data[33:33] = text
    assert decode(bytes(data)).any()
    data[data.index(where.encode()) + 6] ^= 1
    with pytest.raises(NotAnImage, match="checksum"):
        decode(bytes(data))


def test_damaged_data_under_good_checksums() -> None:
    data = PNG_SIGNATURE + png_header(40, 24) + png_chunk(b"IDAT", b"not deflated at all") + png_chunk(b"IEND", b"")
    with pytest.raises(NotAnImage):
        decode(data)


def test_texts_and_profiles_of_a_png_do_not_reach_the_decoder(capfd: pytest.CaptureFixture[str]) -> None:
    image = picture()
    plain, told = io.BytesIO(), io.BytesIO()
    image.save(plain, "PNG")
    image.save(told, "PNG", icc_profile=bytes(range(256)) * 4)
    data = told.getvalue().replace(b"ICC Profile", b'a\n{"forged"')
    end = data.index(b"iCCP") + 4 + int.from_bytes(data[data.index(b"iCCP") - 4 :][:4], "big")
    start = data.index(b"iCCP")
    data = data[:end] + zlib.crc32(data[start:end]).to_bytes(4, "big") + data[end + 4 :]
    np.testing.assert_array_equal(decode(data), decode(plain.getvalue()))
    assert "forged" not in capfd.readouterr().err


@pytest.mark.parametrize("place", [33, -12])
@pytest.mark.parametrize("size", [(20, 12), (20_000, 20_000)])
def test_two_png_headers_are_refused(place: int, size: tuple[int, int]) -> None:
    data = encoded("png")
    with pytest.raises(NotAnImage):
        decode(data[:place] + png_header(*size) + data[place:])


@pytest.mark.parametrize("chunks", [b"", png_chunk(b"IDAT", b"")])
def test_a_png_without_image_data_is_damaged(chunks: bytes) -> None:
    with pytest.raises(NotAnImage):
        decode(PNG_SIGNATURE + png_header(40, 24) + chunks + png_chunk(b"IEND", b""))


def test_a_webp_without_image_data_is_damaged() -> None:
    canvas = b"VP8X" + (10).to_bytes(4, "little") + bytes(4) + bytes([39, 0, 0, 23, 0, 0])
    with pytest.raises(NotAnImage):
        decode(b"RIFF" + (4 + len(canvas)).to_bytes(4, "little") + b"WEBP" + canvas)


def test_a_webp_canvas_of_another_size_than_its_picture_is_refused() -> None:
    data = bytearray(saved(picture("RGBA"), "WEBP", exif=Image.Exif().tobytes()))
    assert data[12:16] == b"VP8X"
    assert decode(bytes(data)).shape == (24, 40, 3)
    data[24:27] = (99).to_bytes(3, "little")
    with pytest.raises(NotAnImage):
        decode(bytes(data))


@pytest.mark.parametrize("frame", [b"\xff\xc3", b"\xff\xc5", b"\xff\xcb", b"\xff\xf7"])
def test_jpegs_that_no_camera_sends_are_unsupported(frame: bytes) -> None:
    with pytest.raises(UnsupportedFormat):
        decode(encoded("jpeg").replace(b"\xff\xc0", frame))


def test_a_jpeg_of_a_thousand_scans_is_refused() -> None:
    data = encoded("jpeg", None, cv2.IMWRITE_JPEG_PROGRESSIVE, 1)
    last = data.rfind(b"\xff\xda")
    with pytest.raises(NotAnImage, match="scans"):
        decode(data[:-2] + data[last:-2] * MAX_JPEG_SCANS + data[-2:])


@pytest.mark.parametrize("name", ["PNG", "WEBP"])
def test_animations_are_refused(name: str) -> None:
    frames = [picture(), picture().transpose(Image.Transpose.ROTATE_180)]
    with pytest.raises(UnsupportedFormat, match="animation"):
        decode(saved(frames[0], name, save_all=True, append_images=frames[1:]))


def test_damage_is_told_in_the_error_and_not_on_stderr(capfd: pytest.CaptureFixture[str]) -> None:
    data = bytearray(encoded("webp"))
    data[40:] = bytes(len(data) - 40)
    with pytest.raises(InvalidImage):
        decode(bytes(data))
    assert capfd.readouterr().err == ""


# Whatever the bytes


def refuses_or_decodes(data: bytes) -> None:
    try:
        pixels = decode(data, Limits(max_pixels=100_000))
    except InvalidImage as error:
        assert str(error).endswith(".")
    else:
        assert pixels.ndim == 3
        assert pixels.shape[2] == 3
        assert min(pixels.shape[:2]) >= 16
        assert pixels.dtype == np.uint8


@given(st.binary(max_size=400))
def test_arbitrary_bytes_are_refused(data: bytes) -> None:
    with pytest.raises(InvalidImage):
        decode(data)


@settings(max_examples=150)
@given(
    st.sampled_from([b"\xff\xd8\xff", PNG_SIGNATURE, PNG_SIGNATURE + png_header(20, 20), b"RIFF\0\1\0\0WEBPVP8X"]),
    st.binary(max_size=300),
)
def test_bytes_after_a_signature_are_refused_or_decoded(start: bytes, rest: bytes) -> None:
    refuses_or_decodes(start + rest)


TURNED = Image.Exif()
TURNED[0x0112] = 6
REAL = [
    encoded("jpeg"),
    encoded("jpeg", None, cv2.IMWRITE_JPEG_PROGRESSIVE, 1),
    encoded("png"),
    encoded("webp"),
    encoded("webp", None, cv2.IMWRITE_WEBP_QUALITY, 60),
    *(saved(picture(), name, exif=TURNED.tobytes()) for name in LOSSLESS),
]


@pytest.mark.thorough
@settings(max_examples=200)
@given(st.sampled_from(REAL), st.data())
def test_mutated_images_are_refused_or_decoded(data: bytes, draw: st.DataObject) -> None:
    mutated = bytearray(data)
    for _ in range(draw.draw(st.integers(1, 6))):
        place = draw.draw(st.integers(0, max(0, len(mutated) - 1)))
        match draw.draw(st.sampled_from(["change", "delete", "insert", "repeat"])):
            case "change":
                mutated[place : place + 1] = draw.draw(st.binary(min_size=1, max_size=4))
            case "delete":
                del mutated[place : place + draw.draw(st.integers(1, 60))]
            case "insert":
                mutated[place:place] = draw.draw(st.binary(min_size=1, max_size=20))
            case _:
                mutated[place:place] = mutated[place : place + 100]
    refuses_or_decodes(bytes(mutated))


# Back to bytes


@pytest.mark.parametrize(
    ("height", "width", "wanted"),
    [(480, 640, (240, 320)), (640, 480, (320, 240)), (20, 30, (20, 30)), (16, 6400, (1, 320))],
)
def test_a_thumbnail_keeps_the_aspect_and_never_grows(height: int, width: int, wanted: tuple[int, int]) -> None:
    data = encode_thumbnail(scene(height, width))
    assert data.startswith(b"\xff\xd8\xff")
    assert decode(data, Limits(min_side=1)).shape[:2] == wanted


def test_a_thumbnail_of_lower_quality_is_smaller() -> None:
    pixels = np.random.default_rng(0).integers(0, 256, (200, 200, 3)).astype(np.uint8)
    assert len(encode_thumbnail(pixels, quality=30)) < len(encode_thumbnail(pixels, quality=90))


def test_a_png_keeps_every_pixel() -> None:
    np.testing.assert_array_equal(decode(encode_png(scene())), scene())


@pytest.mark.parametrize("encode", [encode_png, encode_thumbnail])
def test_a_picture_without_pixels_cannot_be_written(encode: Any) -> None:
    with pytest.raises(InvalidImage):
        encode(np.zeros((0, 40, 3), np.uint8))
