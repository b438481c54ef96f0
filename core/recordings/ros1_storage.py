"""The bag of ROS 1 (format 2.0): records in chunks, and an index behind them that a killed recorder does not write.

https://wiki.ros.org/Bags/Format/2.0
"""

from __future__ import annotations

import struct
from typing import BinaryIO

from core.recordings.frame import NANOSECONDS
from core.recordings.messages import STAMP_BYTES, type_name
from core.recordings.storage import ChunkedStorage, Key, Record, TopicConnection

_MESSAGE, _CONNECTION = 2, 7
LARGEST_HEADER = 1 << 20
"""Bytes; a header has a few dozen."""


class Ros1Storage(ChunkedStorage):
    """A bag of ROS 1."""

    NAME, MAGIC, CHUNK = "a bag of ROS 1 (format 2.0)", b"#ROSBAG V2.0\n", 5

    def _record(self, file: BinaryIO) -> Record | None:
        size = int.from_bytes(file.read(4), "little")
        fields = _fields(file.read(size)) if 0 < size <= LARGEST_HEADER else None
        length = file.read(4)
        if not fields or len(length) < 4:
            return None
        start = file.tell()
        return Record(_number(fields, "op", 1), fields, start, start + int.from_bytes(length, "little"))

    def _take(self, file: BinaryIO, record: Record, key: Key) -> None:
        number = _number(record.fields, "conn")
        if record.kind == _MESSAGE:
            seconds, nanoseconds = struct.unpack("<II", record.fields.get("time", b"").ljust(8, b"\0")[:8])
            file.seek(record.start)
            start = file.read(min(STAMP_BYTES, record.end - record.start))
            self._note(number, seconds * NANOSECONDS + nanoseconds, start, "ros1", key)
        elif record.kind == _CONNECTION:
            file.seek(record.start)
            fields = _fields(file.read(min(LARGEST_HEADER, record.end - record.start))) or {}
            topic, kind = (
                one.decode(errors="replace") for one in (record.fields.get("topic", b""), fields.get("type", b""))
            )
            self._connections[number] = TopicConnection(topic, type_name(kind), "ros1")

    def _chunk(self, record: Record, data: bytes) -> tuple[bytes, str, int]:
        packing = record.fields.get("compression", b"none").decode(errors="replace")
        return data, packing, _number(record.fields, "size")

    def _message(self, data: bytes) -> bytes:
        return data


def _number(fields: dict[str, bytes], name: str, size: int = 4) -> int:
    return int.from_bytes(fields.get(name, b"")[:size], "little")


def _fields(header: bytes) -> dict[str, bytes] | None:
    """The fields of a header; None if it makes no sense."""
    found, place = {}, 0
    while place < len(header):
        size = int.from_bytes(header[place : place + 4], "little")
        name, equals, value = header[place + 4 : place + 4 + size].partition(b"=")
        if not equals or place + 4 + size > len(header):
            return None
        found[name.decode(errors="replace")] = value
        place += 4 + size
    return found
