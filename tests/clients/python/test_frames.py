"""What is sent for a frame, however it is given."""

from __future__ import annotations

import io
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from placerec_client import InvalidFrame, Map, Picture
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
        (np.zeros((4, 4, 4), np.uint8), r"shape \[4, 4, 4\]"),
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
    answer = lab.query(Picture(scene(2)[..., ::-1], order="rgb"))
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
