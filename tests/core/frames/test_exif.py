"""Orientation, position and time of EXIF blocks, good and broken."""

from __future__ import annotations

import io
from datetime import UTC, datetime
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import ExifTags, Image

from core.frames.exif import read_orientation, read_pose_and_time
from core.places import Pose

GPS = {1: "N", 2: (48.0, 51.0, 29.6), 3: "E", 4: (2.0, 17.0, 40.2), 7: (9.0, 30.0, 15.0), 29: "2026:11:20"}
EIFFEL = (48 + 51 / 60 + 29.6 / 3600, 2 + 17 / 60 + 40.2 / 3600)
CLOCK = {0x9003: "2026:11:20 10:30:16", 0x9011: "+01:00", 0x9291: "25"}


def photograph(name: str = "JPEG", gps: dict[int, Any] | None = None, clock: dict[int, Any] | None = None) -> bytes:
    exif = Image.Exif()
    exif.get_ifd(ExifTags.IFD.GPSInfo).update(gps or {})
    exif.get_ifd(ExifTags.IFD.Exif).update(clock or {})
    file = io.BytesIO()
    Image.new("RGB", (32, 24)).save(file, name, exif=exif.tobytes())
    return file.getvalue()


def test_no_block_means_no_turn() -> None:
    assert read_orientation(None) == 1
    assert read_orientation(b"") == 1


@pytest.mark.parametrize("order", ["little", "big"])
@pytest.mark.parametrize(("kind", "size"), [(3, 2), (4, 4), (1, 1)])
def test_the_orientation_in_both_byte_orders(order: Any, kind: int, size: int) -> None:
    def number(value: int, length: int) -> bytes:
        return value.to_bytes(length, order)

    block = (b"II*\0" if order == "little" else b"MM\0*") + number(8, 4) + number(1, 2)
    block += number(0x0112, 2) + number(kind, 2) + number(1, 4) + number(6, size).ljust(4, b"\0") + number(0, 4)
    assert read_orientation(block) == 6


@pytest.mark.parametrize("name", ["JPEG", "PNG", "WEBP"])
def test_position_and_satellite_time(name: str) -> None:
    pose, moment = read_pose_and_time(photograph(name, GPS))
    assert pose is not None
    assert (pose.latitude, pose.longitude) == pytest.approx(EIFFEL, abs=1e-7)
    assert pose.heading is None
    assert moment == datetime(2026, 11, 20, 9, 30, 15, tzinfo=UTC)


@pytest.mark.parametrize("zeros", [(0.0, 0.0, 0.0), (0.0, 0.0, 0.001)])
def test_zeros_are_no_position(zeros: tuple[float, float, float]) -> None:
    data = photograph(gps=GPS | {2: zeros, 4: (0.0, 0.0, 0.0)})
    pose, moment = read_pose_and_time(data)
    assert pose is None and moment is not None
    assert read_pose_and_time(data, with_zeros=True)[0] == Pose(latitude=zeros[2] / 3600, longitude=0.0)
    assert read_pose_and_time(photograph(gps=GPS | {2: zeros}))[0] is not None, "the equator is a place"


def test_south_and_west_are_negative() -> None:
    pose, _ = read_pose_and_time(photograph(gps=GPS | {1: "S", 3: "W"}))
    assert pose is not None
    assert (pose.latitude, pose.longitude) == pytest.approx((-EIFFEL[0], -EIFFEL[1]), abs=1e-7)


@pytest.mark.parametrize(("reference", "heading"), [("T", 123.5), ("M", None), (None, 123.5)])
def test_only_a_direction_from_true_north_is_a_heading(reference: str | None, heading: float | None) -> None:
    direction = {17: 123.5} if reference is None else {16: reference, 17: 123.5}
    pose, _ = read_pose_and_time(photograph(gps=GPS | direction))
    assert pose is not None
    assert pose.heading == heading


@pytest.mark.parametrize(
    "gps",
    [
        {},
        {key: value for key, value in GPS.items() if key != 4},
        GPS | {1: "X"},
        GPS | {2: (91.0, 0.0, 0.0)},
        GPS | {4: (180.0, 59.0, 0.0)},
        GPS | {2: (48.0, 51.0)},
        GPS | {9: "V"},
    ],
)
def test_a_position_that_makes_no_sense_is_absent(gps: dict[int, Any]) -> None:
    assert read_pose_and_time(photograph(gps=gps))[0] is None


def test_the_clock_with_an_offset_comes_before_the_satellites() -> None:
    _, moment = read_pose_and_time(photograph(gps=GPS, clock=CLOCK))
    assert moment == datetime(2026, 11, 20, 9, 30, 16, 250_000, tzinfo=UTC)


def test_a_clock_without_an_offset_names_no_instant() -> None:
    clock = {0x9003: CLOCK[0x9003]}
    assert read_pose_and_time(photograph(clock=clock)) == (None, None)
    assert read_pose_and_time(photograph(gps=GPS, clock=clock))[1] == datetime(2026, 11, 20, 9, 30, 15, tzinfo=UTC)


@pytest.mark.parametrize(
    "clock",
    [
        CLOCK | {0x9003: "2026:13:40 10:30:16"},
        CLOCK | {0x9011: "+99:00"},
        CLOCK | {0x9003: "0001:01:01 00:00:00"},
        CLOCK | {0x9003: "yesterday"},
    ],
)
def test_a_time_that_makes_no_sense_is_absent(clock: dict[int, Any]) -> None:
    assert read_pose_and_time(photograph(clock=clock)) == (None, None)


@pytest.mark.parametrize("data", [b"", b"hello", b"GIF89a", b"\xff\xd8\xff\xe1"])
def test_other_bytes_know_nothing(data: bytes) -> None:
    assert read_pose_and_time(data) == (None, None)


WHOLE = photograph(gps=GPS | {16: "T", 17: 10.0}, clock=CLOCK)
START, END = WHOLE.index(b"Exif\0\0") + 6, WHOLE.index(b"\xff\xdb")


def test_the_block_that_is_mutated_below_is_whole() -> None:
    pose, moment = read_pose_and_time(WHOLE)
    assert pose == Pose(latitude=EIFFEL[0], longitude=EIFFEL[1], heading=10.0)
    assert moment is not None


@pytest.mark.thorough
@settings(max_examples=400)
@given(st.lists(st.tuples(st.integers(0, END - START - 1), st.integers(0, 255)), min_size=1, max_size=8))
def test_a_broken_block_never_raises(changes: list[tuple[int, int]]) -> None:
    data = bytearray(WHOLE)
    for place, value in changes:
        data[START + place] = value
    pose, moment = read_pose_and_time(bytes(data))
    assert pose is None or pose.kind() == "geographic"
    assert moment is None or moment.tzinfo is UTC
    assert read_orientation(bytes(data[START:END])) in range(1, 9)


@given(st.sampled_from([b"", b"II*\0", b"MM\0*", b"II*\0\x08\0\0\0"]), st.binary(max_size=200))
def test_garbage_never_raises(start: bytes, rest: bytes) -> None:
    assert read_orientation(start + rest) in range(1, 9)
