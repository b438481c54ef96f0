"""The bag of ROS 1 (format 2.0): records in chunks, and an index behind them that a killed recorder does not write.

https://wiki.ros.org/Bags/Format/2.0
"""

from __future__ import annotations

import bz2
import struct
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from core.errors import InvalidRecording
from core.recordings.frame import NANOSECONDS
from core.recordings.messages import stamp_of, type_name
from core.recordings.storage import MOST_UNPACKED, Entry, Key, Topic

MAGIC = b"#ROSBAG V2.0\n"
_MESSAGE, _INDEX, _CHUNK, _CONNECTION = 2, 4, 5, 7
LARGEST_HEADER = 1 << 20
"""Bytes; a header has a few dozen."""


@dataclass(frozen=True)
class _Record:
    """A record: its fields, and where its data begins and ends in the bytes that it was read from."""

    fields: dict[str, bytes]
    start: int
    end: int

    @property
    def kind(self) -> int:
        return self.fields.get("op", b"\0")[0]

    def number(self, name: str) -> int:
        return int.from_bytes(self.fields.get(name, b"")[:4], "little")


@dataclass
class _Chunk:
    """A chunk, or messages outside of chunks: where its data is, how it is packed, and its messages by connection."""

    start: int
    end: int
    packing: bytes
    messages: Counter[int]
    indexed: bool = False


class Ros1Storage:
    """A bag of ROS 1; one without an index is read from its beginning.

    A message is found by the number of its chunk and its place in the unpacked chunk.  The chunk that was read last
    stays unpacked.
    """

    def __init__(self, path: Path) -> None:
        """Open the file.

        Raises:
            InvalidRecording: it is no bag of this format.
            OSError: it cannot be read.
        """
        self.problem: str | None = None
        self._file = path.open("rb")
        self._size = path.stat().st_size
        self._connections: dict[int, tuple[str, str]] = {}
        self._chunks: list[_Chunk] = []
        self._unpacked: tuple[int, bytes] = (-1, b"")
        try:
            if self._file.read(len(MAGIC)) != MAGIC:
                raise InvalidRecording(f"{path} is not a bag of ROS 1 (format 2.0).")
            self._read_outline()
            self._read_what_is_not_indexed()
        except BaseException:
            self._file.close()
            raise
        self.topics: dict[str, Topic] = {}
        counts = sum((chunk.messages for chunk in self._chunks), Counter[int]())
        for number, (topic, kind) in self._connections.items():
            before = self.topics.get(topic, Topic(kind, 0, "ros1"))
            self.topics[topic] = Topic(before.kind, before.messages + counts[number], "ros1")

    def _read_outline(self) -> None:
        """Go from record to record, over the data of chunks."""
        place = len(MAGIC)
        while place < self._size:
            record = self._record_at(place)
            if record is None:
                self._cut(place)
                return
            whole = record.end <= self._size
            if not whole:
                self._cut(place)
            match record.kind:
                case kind if kind == _CHUNK:
                    packing = record.fields.get("compression", b"none")
                    self._chunks.append(_Chunk(record.start, min(record.end, self._size), packing, Counter()))
                case kind if kind == _INDEX and self._chunks and whole:
                    self._chunks[-1].messages[record.number("conn")] += record.number("count")
                    self._chunks[-1].indexed = True
                case kind if kind == _CONNECTION and whole:
                    self._connect(record, self._bytes(record.start, record.end))
                case kind if kind == _MESSAGE and whole:  # of a recorder that was killed within a chunk
                    self._chunks.append(_Chunk(place, record.end, b"none", Counter()))
            place = record.end

    def _cut(self, place: int) -> None:
        self.problem = f"is cut short after {place} bytes"

    def _record_at(self, place: int) -> _Record | None:
        """The record at a place of the file; its data is not read.  None where the file ends or makes no sense."""
        size = int.from_bytes(self._bytes(place, place + 4), "little")
        if not 0 < size <= LARGEST_HEADER:
            return None
        return _record(self._bytes(place, place + 8 + size), 0, place)

    def _bytes(self, start: int, end: int) -> bytes:
        self._file.seek(start)
        return self._file.read(end - start)

    def _connect(self, record: _Record, data: bytes) -> None:
        fields = _fields(data) or {}
        topic = record.fields.get("topic", b"").decode(errors="replace")
        self._connections[record.number("conn")] = topic, type_name(fields.get("type", b"").decode(errors="replace"))

    def _read_what_is_not_indexed(self) -> None:
        """Count the messages of chunks without an index, and learn connections that only chunks name."""
        indexed = {number for chunk in self._chunks for number in chunk.messages}
        all_known = indexed <= self._connections.keys()
        for number, chunk in enumerate(self._chunks):
            if chunk.indexed and all_known:
                continue
            chunk.messages = Counter()
            data = self._data_of(number)
            for record in _records(data):
                if record.kind == _CONNECTION:
                    self._connect(record, data[record.start : record.end])
                elif record.kind == _MESSAGE:
                    chunk.messages[record.number("conn")] += 1

    def entries(self, topic: str) -> Iterator[Entry]:
        wanted = {number for number, (name, _) in self._connections.items() if name == topic}
        for number, chunk in enumerate(self._chunks):
            if not chunk.messages.keys() & wanted:
                continue
            data = self._data_of(number)
            for record in _records(data):
                if record.kind == _MESSAGE and record.number("conn") in wanted:
                    seconds, nanoseconds = struct.unpack("<II", record.fields.get("time", b"").ljust(8, b"\0")[:8])
                    stamp = stamp_of(data[record.start : record.end], "ros1")
                    yield Entry(seconds * NANOSECONDS + nanoseconds, stamp, (number, record.start, record.end))

    def read(self, key: Key) -> bytes:
        number, start, end = key
        data = self._data_of(number)[start:end]
        if len(data) < end - start:
            raise InvalidRecording("A message cannot be read any more.")
        return data

    def _data_of(self, number: int) -> bytes:
        """The unpacked data of a chunk, or as much as there is of it."""
        if self._unpacked[0] != number:
            chunk = self._chunks[number]
            self._unpacked = number, self._unpack(self._bytes(chunk.start, chunk.end), chunk.packing)
        return self._unpacked[1]

    def _unpack(self, data: bytes, packing: bytes) -> bytes:
        import lz4.frame

        if packing == b"none":
            return data
        if packing not in (b"bz2", b"lz4"):
            raise InvalidRecording(f"Chunks packed by {packing.decode(errors='replace')!r} are not read.")
        unpacker = bz2.BZ2Decompressor() if packing == b"bz2" else lz4.frame.LZ4FrameDecompressor()
        try:
            unpacked = bytes(unpacker.decompress(data, MOST_UNPACKED))
        except (OSError, RuntimeError, EOFError) as error:
            self.problem = f"has a damaged chunk, whose messages are left out ({error})"
            return b""
        if len(unpacked) == MOST_UNPACKED:
            self.problem = "has a chunk that is too large, of which only the beginning is read"
        return unpacked

    def close(self) -> None:
        self._file.close()


def _records(data: bytes) -> Iterator[_Record]:
    """The whole records of a chunk."""
    place = 0
    while (record := _record(data, place, 0)) is not None and record.end <= len(data):
        yield record
        place = record.end


def _record(data: bytes, place: int, offset: int) -> _Record | None:
    """The record at ``place``, whose data need not be there; its bounds count from ``offset``."""
    if place + 4 > len(data):
        return None
    size = int.from_bytes(data[place : place + 4], "little")
    head = place + 4 + size
    fields = _fields(data[place + 4 : head])
    if fields is None or head + 4 > len(data):
        return None
    start = offset + head + 4
    return _Record(fields, start, start + int.from_bytes(data[head : head + 4], "little"))


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
