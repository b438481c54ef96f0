"""Every pixel format has the right colours by every way in: bags of ROS 1, ROS 2 and Foxglove, the node, the client."""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any, NamedTuple

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from core.errors import InvalidImage
from core.frames.pixel_formats import NAMES
from core.recordings import open_recording
from placerec_client import InvalidFrame, Picture
from placerec_client.frames import frame_bytes
from placerec_ros.pictures import UnfitPicture, picture_of
from tests.clients.ros2.ros_messages import image as ros_image
from tests.core.recordings.bags import START, compressed, image, write_mcap, write_ros1
from tests.core.recordings.foxglove import time, write
from tests.service.scenes import encoded, scene

Array = NDArray[Any]

COLOURS = scene(5, 64, 48)
DEEP = COLOURS.astype(np.uint16) * 200 + np.arange(64, dtype=np.uint16)[None, :, None]
"""16 bits, with something in the lower eight."""
NOISE = np.random.default_rng(3).integers(0, 256, (48, 64, 2)).astype(np.uint8)
HALVED = np.random.default_rng(4).integers(0, 256, (72, 64)).astype(np.uint8)


class Published(NamedTuple):
    """A picture as a driver has it in memory, and the picture that it is.  array: as OpenCV has such pixels."""

    array: Array
    expected: Array
    big: bool = False


def published(name: str, width: int = 64) -> Published:
    """A picture in a pixel format, its colours computed by OpenCV alone."""
    name = name.lower()
    colours = DEEP[:, :width] if "16" in name else COLOURS[:, :width]
    if name.startswith("bayer"):
        mosaic, places = np.zeros(colours.shape[:2], colours.dtype), ((0, 0), (0, 1), (1, 0), (1, 1))
        for letter, (row, column) in zip(name[6:10], places, strict=True):
            mosaic[row::2, column::2] = colours[row::2, column::2, "bgr".index(letter)]
        return Published(mosaic, cv2.cvtColor(mosaic, getattr(cv2, f"COLOR_Bayer{name[6:10].upper()}2BGR")))
    if name.startswith("nv"):
        return Published(HALVED, cv2.cvtColor(HALVED, getattr(cv2, f"COLOR_YUV2BGR_{name.upper()}")))
    if "yu" in name or "uyvy" in name:
        second = name in ("yuv422_yuy2", "yuy2", "yuyv")
        return Published(NOISE, cv2.cvtColor(NOISE, cv2.COLOR_YUV2BGR_YUY2 if second else cv2.COLOR_YUV2BGR_UYVY))
    if name.startswith("mono") or name.endswith("c1"):
        return Published(colours[:, :, 1], colours[:, :, 1])
    given = colours[:, :, ::-1] if name.startswith("rgb") else colours
    opaque = "a" in name or name.endswith("c4")
    return Published(np.dstack([given, 77 + 0 * given[:, :, 0]]) if opaque else given, colours)


class Source(NamedTuple):
    """A way in: what it makes of raw pictures, each by format, height, width, bytes, and 1 if big-endian."""

    read: Callable[[Path, Sequence[tuple[str, int, int, bytes, int]]], list[Array]]
    refuses: type[Exception]


def decoded(data: bytes) -> Array:
    return np.asarray(cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_ANYDEPTH | cv2.IMREAD_ANYCOLOR))


def loaded(path: Path) -> list[Array]:
    with open_recording(path) as recording:
        return [decoded(frame.load()) for frame in recording.frames]


def by_ros(writer: Callable[[Path, Any], Path]) -> Source:
    def read(path: Path, given: Any) -> list[Array]:
        said = [image(START + n, w, h, name, data, 0, big) for n, (name, h, w, data, big) in enumerate(given)]
        return loaded(writer(path / "a.bag" if writer is write_ros1 else path / "a.mcap", said))

    return Source(read, InvalidImage)


def by_foxglove(path: Path, given: Any) -> list[Array]:
    def raw(number: int, name: str, height: int, width: int, data: bytes) -> dict[str, Any]:
        size = {"width": width, "height": height, "encoding": name, "step": 0}
        return {"timestamp": time(START + number), "frame_id": "camera", "data": data, **size}

    messages = [("/raw", "RawImage", n, raw(n, *one[:4])) for n, one in enumerate(given)]
    return loaded(write(path / "b.mcap", "protobuf", messages))


def by_node(path: Path, given: Any) -> list[Array]:
    """As the node sends them."""
    sent = [picture_of(ros_image(name, width, height, data, 0, big)) for name, height, width, data, big in given]
    return [decoded(frame_bytes(one)) for one in sent]


SOURCES = {
    "ros1": by_ros(write_ros1),
    "ros2": by_ros(write_mcap),
    "foxglove": Source(by_foxglove, InvalidImage),
    "node": Source(by_node, UnfitPicture),
}


def raw(name: str, array: Array, big: bool = False) -> tuple[str, int, int, bytes, int]:
    height = 2 * len(array) // 3 if name.lower().startswith("nv") else len(array)
    ordered = array.astype(array.dtype.newbyteorder(">" if big else "<"))
    return name, height, array.shape[1], ordered.tobytes(), int(big)


@pytest.mark.parametrize("source", SOURCES)
def test_every_format_has_its_colours(source: str, tmp_path: Path) -> None:
    names = [*NAMES, *(name.upper() for name in NAMES), "  Mono8 "]
    told = [published(name.strip()) for name in names]
    found = SOURCES[source].read(tmp_path, [raw(name, one.array) for name, one in zip(names, told, strict=True)])
    for name, one, picture in zip(names, told, found, strict=True):
        assert picture.dtype == one.expected.dtype, name
        np.testing.assert_array_equal(picture, one.expected, name)


@pytest.mark.parametrize("name", [*NAMES, "Bayer_RGGB8", "MONO16"])
def test_every_format_in_an_array_of_the_client(name: str) -> None:
    given = published(name)
    for array in (given.array, given.array.astype(given.array.dtype.newbyteorder(">"))):
        np.testing.assert_array_equal(decoded(frame_bytes(Picture(array, name))), given.expected)


@pytest.mark.parametrize("source", ["ros1", "ros2", "node"])
def test_the_upper_byte_may_come_first(source: str, tmp_path: Path) -> None:
    names = [name for name in NAMES if "16" in name]
    told = [published(name) for name in names]
    found = SOURCES[source].read(tmp_path, [raw(name, one.array, True) for name, one in zip(names, told, strict=True)])
    for name, one, picture in zip(names, told, found, strict=True):
        np.testing.assert_array_equal(picture, one.expected, name)


@pytest.mark.parametrize("source", SOURCES)
def test_rows_of_an_odd_width(source: str, tmp_path: Path) -> None:
    names = ["bgr8", "mono16", "rgba16", "bayer_gbrg8", "bayer_rggb16"]
    told = [published(name, 63) for name in names]
    found = SOURCES[source].read(tmp_path, [raw(name, one.array) for name, one in zip(names, told, strict=True)])
    for name, one, picture in zip(names, told, found, strict=True):
        np.testing.assert_array_equal(picture, one.expected, name)


REFUSED: list[tuple[str, int, int, int, str]] = [
    ("32FC1", 48, 64, 12288, "The encoding '32FC1' is not read; mono8, mono16, "),
    ("", 48, 64, 3072, "The encoding '' is not read"),
    ("bgr8", 48, 64, 9215, "64x48 pixels of bgr8 in rows of 192 bytes and has 9215 bytes"),
    ("bgr8", 48, 0, 0, "has 0 bytes"),
    ("nv12", 48, 64, 4607, "64x48 pixels of nv12 in rows of 64 bytes and has 4607 bytes"),
    ("UYVY", 48, 63, 6048, "uyvy cannot have an odd width or height: 63x48"),
    ("nv21", 47, 64, 4512, "nv21 cannot have an odd width or height: 64x47"),
]


@pytest.mark.parametrize("case", REFUSED)
@pytest.mark.parametrize("source", SOURCES)
def test_what_is_no_picture_is_refused(source: str, case: tuple[str, int, int, int, str], tmp_path: Path) -> None:
    *made, size, said = case
    good = raw("mono8", COLOURS[:, :, 1])
    with pytest.raises(SOURCES[source].refuses) as refused:
        SOURCES[source].read(tmp_path, [good, (*made, bytes(size), 0)])  # type: ignore[list-item]
    assert said in str(refused.value)


@pytest.mark.parametrize(
    ("name", "array", "said"),
    [
        ("rgba8", COLOURS, r"uint8 of shape \[48, 64, 3\] is no picture of rgba8: uint8 \[H, W, 4\]"),
        ("mono16", COLOURS[..., 0], r"no picture of mono16: uint16 \[H, W\]"),
        ("nv12", HALVED[:71], "71 rows is no picture of nv12"),
        ("yuv422", NOISE[:, :63], "odd width"),
    ],
)
def test_an_array_of_another_format_is_refused(name: str, array: Array, said: str) -> None:
    with pytest.raises(InvalidFrame, match=said):
        frame_bytes(Picture(array, name))


def test_without_opencv_a_mosaic_alone_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    told = {name: published(name) for name in NAMES}
    monkeypatch.setitem(sys.modules, "cv2", None)
    for name, given in told.items():
        _, height, width, data, _ = raw(name, given.array)
        message = ros_image(name, width, height, data)
        if name.startswith("bayer"):
            with pytest.raises(InvalidFrame, match=f"{name} needs OpenCV"):
                frame_bytes(Picture(given.array, name))
            with pytest.raises(UnfitPicture, match=f"{name} needs OpenCV"):
                picture_of(message)
        else:
            np.testing.assert_array_equal(picture_of(message), given.expected, name)


def from_bag(path: Path, form: str, data: bytes) -> bytes:
    with open_recording(write_mcap(path / "a.mcap", [compressed(START, data, form=form)])) as recording:
        return recording.frames[0].load()


def from_node(path: Path, form: str, data: bytes) -> bytes:
    return frame_bytes(picture_of(SimpleNamespace(format=form, data=data)))


BOTH = pytest.mark.parametrize("read", [from_bag, from_node])
MOSAIC = published("bayer_rggb8").array


@BOTH
@pytest.mark.parametrize("name", ["bayer_rggb8", "bayer_bggr8", "bayer_gbrg16", "bayer_grbg8"])
@pytest.mark.parametrize("end", ["; png compressed", "; png compressed mono8", ";PNG COMPRESSED"])
def test_a_mosaic_in_a_file_becomes_colours(read: Any, name: str, end: str, tmp_path: Path) -> None:
    given = published(name)
    np.testing.assert_array_equal(decoded(read(tmp_path, name + end, encoded(given.array, ".png"))), given.expected)


@BOTH
@pytest.mark.parametrize(
    ("form", "data"),
    [
        ("mono16; png compressed", encoded(DEEP[..., 1], ".png")),
        ("rgb8; jpeg compressed bgr8", encoded(COLOURS)),
        ("bayer_rggb8; jpeg compressed bgr8", encoded(COLOURS)),
        ("png", encoded(MOSAIC, ".png")),
        ("bayer_rggb8; png compressed", encoded(MOSAIC, ".png")[:60]),
        ("bayer_rggb8; png compressed", encoded(MOSAIC, ".png")[:16] + b"\x7f\xff" * 4 + encoded(MOSAIC, ".png")[24:]),
        ("h264", encoded(COLOURS)),
        ("", encoded(COLOURS, ".webp")),
    ],
)
def test_other_files_stay_as_they_are(read: Any, form: str, data: bytes, tmp_path: Path) -> None:
    assert read(tmp_path, form, data) == data


@BOTH
@pytest.mark.parametrize(
    ("form", "said"),
    [
        ("h264", "h264 is another transport. Republish the topic as raw or compressed"),
        ("H.265", "H.265 is another transport"),
        ("theora", "theora is another transport"),
        ("rgb8; hevc_nvenc", "hevc is another transport"),
        ("zstd", "zstd is another transport"),
        ("16UC1; compressedDepth png", "'16UC1; compressedDepth png' holds a depth image"),
        ("32FC1; compressedDepth rvl", "holds a depth image, which shows no place"),
    ],
)
def test_other_transports_are_refused_by_their_name(read: Any, form: str, said: str, tmp_path: Path) -> None:
    with pytest.raises((InvalidImage, UnfitPicture)) as refused:
        read(tmp_path, form, bytes(12) + encoded(DEEP[..., 1], ".png"))
    assert said in str(refused.value)
