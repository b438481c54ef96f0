"""From a camera's messages to pixels and files."""

from __future__ import annotations

from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from placerec_ros.pictures import UnfitPicture, picture_of, pixels_of
from tests.clients.ros2.ros_messages import image
from tests.service.scenes import encoded, scene

PICTURE = scene(5, 64, 48)
GREY = cv2.cvtColor(PICTURE, cv2.COLOR_BGR2GRAY)


@pytest.mark.parametrize(
    ("encoding", "data"),
    [
        ("bgr8", PICTURE.tobytes()),
        ("8UC3", PICTURE.tobytes()),
        ("rgb8", cv2.cvtColor(PICTURE, cv2.COLOR_BGR2RGB).tobytes()),
        ("bgra8", cv2.cvtColor(PICTURE, cv2.COLOR_BGR2BGRA).tobytes()),
        ("rgba8", cv2.cvtColor(PICTURE, cv2.COLOR_BGR2RGBA).tobytes()),
        ("rgb16", (cv2.cvtColor(PICTURE, cv2.COLOR_BGR2RGB).astype("<u2") * 256 + 7).tobytes()),
    ],
)
def test_colours_arrive_in_the_order_of_opencv(encoding: str, data: bytes) -> None:
    np.testing.assert_array_equal(pixels_of(image(encoding, 64, 48, data)), PICTURE)


@pytest.mark.parametrize(
    ("encoding", "data", "big"),
    [
        ("mono8", GREY.tobytes(), 0),
        ("8UC1", GREY.tobytes(), 0),
        ("mono16", (GREY.astype(np.uint16) * 256 + 99).astype("<u2").tobytes(), 0),
        ("mono16", (GREY.astype(np.uint16) * 256 + 99).astype(">u2").tobytes(), 1),
    ],
)
def test_grey_pictures_have_one_channel(encoding: str, data: bytes, big: int) -> None:
    np.testing.assert_array_equal(pixels_of(image(encoding, 64, 48, data, big=big)), GREY)


def test_rows_may_have_padding() -> None:
    padded = np.zeros((48, 200), np.uint8)
    padded[:, :192] = PICTURE.reshape(48, 192)
    np.testing.assert_array_equal(pixels_of(image("bgr8", 64, 48, padded.tobytes(), step=200)), PICTURE)
    last_row_short = padded.tobytes()[:-8]
    np.testing.assert_array_equal(pixels_of(image("bgr8", 64, 48, last_row_short, step=200)), PICTURE)


@pytest.mark.parametrize(
    ("encoding", "code"),
    [
        ("uyvy", cv2.COLOR_YUV2BGR_UYVY),
        ("yuv422", cv2.COLOR_YUV2BGR_UYVY),
        ("yuyv", cv2.COLOR_YUV2BGR_YUY2),
    ],
)
def test_paired_colours_are_those_of_opencv(encoding: str, code: int) -> None:
    data = np.random.default_rng(3).integers(0, 256, (48, 64, 2)).astype(np.uint8)
    found = pixels_of(image(encoding, 64, 48, data.tobytes())).astype(int)
    assert np.abs(found - cv2.cvtColor(data, code)).max() <= 1


@pytest.mark.parametrize(
    ("encoding", "width", "data", "said"),
    [
        ("bayer_rggb8", 64, b"\0" * 3072, "debayer"),
        ("16UC1", 64, b"\0" * 6144, "not supported"),
        ("", 64, b"", "not supported"),
        ("bgr8", 64, b"\0" * 9215, "has 9215 bytes"),
        ("bgr8", 0, b"", "has 0 bytes"),
        ("uyvy", 63, b"\0" * 6048, "odd width"),
    ],
)
def test_what_is_no_picture_is_refused(encoding: str, width: int, data: bytes, said: str) -> None:
    with pytest.raises(UnfitPicture, match=said):
        pixels_of(image(encoding, width, 48, data))


@pytest.mark.parametrize("extension", [".jpg", ".png", ".webp"])
def test_files_go_as_they_are(extension: str) -> None:
    data = encoded(PICTURE, extension)
    assert picture_of(SimpleNamespace(format="whatever", data=data)) == data


@pytest.mark.parametrize("data", [b"", b"\0\0\0\1\x67video", b"RIFF    WAVE"])
def test_files_of_other_formats_are_refused(data: bytes) -> None:
    with pytest.raises(UnfitPicture, match="'h264'"):
        picture_of(SimpleNamespace(format="h264", data=data))
