"""What is sent for a frame, however it is given."""

from __future__ import annotations

import io
import sys
from array import array
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from placerec_client import Enrolled, InvalidFrame, Located, Map, NewPlace, Picture
from placerec_client.events import Event, Reader
from placerec_client.frames import frame_bytes, media_type, png
from placerec_client.requests import Part, dumps, form, query_string
from tests.service.scenes import jpeg, scene


@pytest.mark.parametrize("shape", [(1, 1), (1, 1, 3), (48, 64), (48, 64, 3), (31, 7, 3), (600, 800, 3)])
def test_pixels_arrive_as_they_are(shape: tuple[int, ...]) -> None:
    pixels = np.random.default_rng(0).integers(0, 256, shape, np.uint8)
    data = frame_bytes(pixels)
    assert media_type(data) == "image/png"
    read = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    assert read is not None and np.array_equal(read, pixels)


def test_the_order_of_the_channels_and_views_of_arrays() -> None:
    pixels = scene(1)
    turned = Picture(np.ascontiguousarray(pixels[..., ::-1]), order="rgb")
    assert frame_bytes(turned) == frame_bytes(pixels) == frame_bytes(Picture(pixels[..., ::-1], order="rgb"))
    read = cv2.imdecode(np.frombuffer(png(pixels[10:50:2, 5:60]), np.uint8), cv2.IMREAD_COLOR)
    assert read is not None and np.array_equal(read, pixels[10:50:2, 5:60])


def test_opacity_is_left_out_and_sixteen_bits_stay() -> None:
    pixels = np.random.default_rng(0).integers(0, 1 << 16, (31, 7, 4), np.uint16)
    expected = frame_bytes(np.ascontiguousarray(pixels[..., :3]))
    read = cv2.imdecode(np.frombuffer(expected, np.uint8), cv2.IMREAD_UNCHANGED)
    assert read is not None and read.dtype == np.uint16 and np.array_equal(read, pixels[..., :3])
    for given in (pixels[..., :3], pixels, pixels.astype(">u2"), Picture(pixels[..., [2, 1, 0, 3]], order="rgb")):
        assert frame_bytes(given) == expected
    upper = (pixels >> 8).astype(np.uint8)
    assert frame_bytes(upper) == frame_bytes(np.ascontiguousarray(upper[..., :3]))
    read = cv2.imdecode(np.frombuffer(frame_bytes(pixels[..., 0]), np.uint8), cv2.IMREAD_UNCHANGED)
    assert read is not None and np.array_equal(read, pixels[..., 0])


def test_a_jpeg_has_the_upper_bits_if_there_is_something_in_them() -> None:
    pixels = np.asarray(cv2.GaussianBlur(scene(1), (0, 0), 3), np.uint8)
    full, ten = pixels.astype(np.uint16) * 257, pixels.astype(np.uint16) * 4
    assert frame_bytes(Picture(full, encoding="jpeg")) == frame_bytes(Picture(pixels, encoding="jpeg"))
    with pytest.raises(InvalidFrame, match=f"reach only {ten.max()} of 65535"):
        frame_bytes(Picture(ten, encoding="jpeg"))


def test_the_bytes_of_a_file_in_an_array() -> None:
    """ROS has the data of a CompressedImage so."""
    for data in (jpeg(1, 64, 48), png(scene(1))):
        assert frame_bytes(np.frombuffer(data, np.uint8)) == data
        assert frame_bytes(array("B", data)) == data


@pytest.mark.parametrize("missing", [(), ("cv2",)])
@pytest.mark.parametrize("order", ["bgr", "rgb"])
def test_pixels_as_a_jpeg(missing: tuple[str, ...], order: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in missing:
        monkeypatch.setitem(sys.modules, name, None)
    pixels = np.asarray(cv2.GaussianBlur(scene(1), (0, 0), 3), np.uint8)
    given = pixels if order == "bgr" else pixels[..., ::-1]
    data = frame_bytes(Picture(given, order, encoding="jpeg", quality=95))
    assert media_type(data) == "image/jpeg"
    assert len(frame_bytes(Picture(given, order, encoding="jpeg", quality=20))) < len(data) < len(png(pixels))
    read = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)
    assert read is not None and np.abs(read.astype(int) - pixels).mean() < 3
    grey = frame_bytes(Picture(pixels[..., 1], encoding="jpeg"))
    read = cv2.imdecode(np.frombuffer(grey, np.uint8), cv2.IMREAD_UNCHANGED)
    assert read is not None and read.shape == pixels.shape[:2]


def test_a_jpeg_without_what_writes_one(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("cv2", "PIL.Image"):
        monkeypatch.setitem(sys.modules, name, None)
    with pytest.raises(InvalidFrame, match="OpenCV or Pillow"):
        frame_bytes(Picture(scene(1), encoding="jpeg"))


@pytest.mark.parametrize(
    ("options", "told"),
    [
        ({"order": "grb"}, "'bgr' or 'rgb', not 'grb'"),
        ({"encoding": "gif"}, "'png' or 'jpeg', not 'gif'"),
        ({"quality": 0}, "from 1 to 100, not 0"),
        ({"quality": 9.5}, "whole number"),
    ],
)
def test_a_picture_that_cannot_be_sent_is_refused_when_it_is_made(options: Any, told: str) -> None:
    with pytest.raises(InvalidFrame, match=told):
        Picture(scene(1), **options)


def test_files_and_bytes(tmp_path: Path) -> None:
    data = jpeg(1, 64, 48)
    path = tmp_path / "frame.jpg"
    path.write_bytes(data)
    with path.open("rb") as file:
        given: list[Any] = [data, bytearray(data), memoryview(data), path, str(path), file, io.BytesIO(data)]
        assert [frame_bytes(one) for one in given] == [data] * len(given)


@pytest.mark.parametrize(
    ("frame", "told"),
    [
        ("/no/such/frame.jpg", "cannot be read: No such file"),
        (np.zeros((4, 4), np.float32), r"float32 of shape \[4, 4\] is no picture"),
        (np.zeros((4, 4, 5), np.uint8), r"shape \[4, 4, 5\]"),
        (np.zeros((4, 4, 1), np.uint8), r"shape \[4, 4, 1\]"),
        (np.zeros((4, 4), np.int16), r"int16 of shape \[4, 4\] is no picture: uint8 or uint16"),
        (np.zeros((4, 4), np.uint32), "uint32"),
        (np.zeros(16, np.uint8), "An array of 16 numbers is no picture"),
        (np.zeros(0, np.uint8), "An array of 0 numbers"),
        (np.frombuffer(jpeg(1, 64, 48), np.int8), "it has to be uint8 and hold a JPEG"),
        (array("B", b"GIF89a"), "An array of 6 numbers"),
        (array("h", [7]), "An array of 1 numbers"),
        (Picture([[1]]), "A list is no array of pixels"),  # type: ignore[arg-type]
        (Picture(np.zeros((1, 70000), np.uint8), encoding="jpeg"), "cannot be a JPEG file"),
        (np.zeros((0, 4), np.uint8), r"shape \[0, 4\]"),
        (7, "A int is no frame"),
        (io.StringIO("text"), "not opened in binary mode"),
    ],
)
def test_what_is_no_frame(frame: Any, told: str) -> None:
    with pytest.raises(InvalidFrame, match=told):
        frame_bytes(frame)


def test_the_content_type_is_that_of_the_bytes() -> None:
    assert media_type(b"\x89PNG\r\n") == "image/png"
    assert media_type(b"RIFF\0\0\0\0WEBPVP8 ") == "image/webp"
    assert media_type(b"RIFF\0\0\0\0WAVE") == "image/jpeg"
    assert media_type(b"") == "image/jpeg"


def test_the_service_takes_pixels(lab: Map) -> None:
    lab.places.put("grey", np.ascontiguousarray(scene(1)[..., 1]))
    lab.places.put("colour", scene(2))
    for frame in (
        Picture(scene(2)[..., ::-1], order="rgb"),
        Picture(scene(2), encoding="jpeg"),
        np.dstack([scene(2), scene(2)[..., 0]]),
        np.frombuffer(jpeg(2), np.uint8),
    ):
        answer = lab.query(frame)
        assert answer.place is not None and answer.place.id == "colour"


def test_parameters_as_text() -> None:
    given = {"x": np.float32(1.5), "k": np.int64(3), "explain": True, "where": {"floor": 2}, "bbox": [1, 2, 3, 4.5]}
    given |= {"sequences": ["a,b", "c"], "soft": ["heading", "time"], "after": datetime(2026, 1, 2, tzinfo=UTC)}
    assert query_string({**given, "y": None}) == (
        "?x=1.5&k=3&explain=true&where=%7B%22floor%22%3A+2%7D&bbox=1.0%2C2.0%2C3.0%2C4.5"
        "&sequences=%5B%22a%2Cb%22%2C+%22c%22%5D&soft=heading%2Ctime&after=2026-01-02T00%3A00%3A00%2B00%3A00"
    )
    assert query_string({"y": None}) == ""
    assert dumps({"at": datetime(2026, 1, 2), "n": np.int64(1)}) == '{"at": "2026-01-02T00:00:00", "n": 1}'


def test_the_name_of_a_part_cannot_end_its_head() -> None:
    content, _ = form([Part('a"\r\nX: y', b"data", "image/jpeg")])
    assert b'name="a%22%0D%0AX: y"; filename=' in content


def test_events_in_any_chunks() -> None:
    stream = b': hello\n\nevent: running\nid: 7\ndata: {"a":\ndata: 1}\n\ndata: x\r\n\r\nid: 9\n\n'
    for size in (1, 2, 3, 7, 1000):
        reader = Reader()
        chunks = [stream[start : start + size] for start in range(0, len(stream), size)]
        found = [event for chunk in chunks for event in reader.take(chunk)]
        assert found == [Event("running", '{"a":\n1}', "7"), Event("message", "x", None)], size


@pytest.mark.parametrize(
    ("frame", "text"),
    [
        (b"x" * 5000, "<5000 bytes>"),
        (memoryview(b"xy"), "<2 bytes>"),
        ("a/b.jpg", "'a/b.jpg'"),
        (np.zeros((480, 640, 3), np.uint8), "<ndarray of shape [480, 640, 3]>"),
        (Picture(np.zeros((4, 6), np.uint8)), "Picture(<ndarray of shape [4, 6]>, 'bgr', 'png', quality=90)"),
    ],
)
def test_a_frame_is_shown_without_its_bytes(frame: Any, text: str) -> None:
    assert repr(NewPlace("p", frame)) == f"NewPlace('p', {text}, {{}})"
    assert repr(Located(frame, None)) == f"Located({text}, answer=None)"
    assert repr(Enrolled(NewPlace("p", frame), "created")).startswith(f"Enrolled(place=NewPlace('p', {text}, {{}}), ")
