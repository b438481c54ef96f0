"""Files of bags: their topics, where each message is, and its bytes.

A file is read once from its beginning to its end or to a damage, even if it has an index, and then by the places of its
messages.  rosbags reads 2 200 to 7 400 whole frames a second (here 3 000 to 4 300, of which a service encodes 130), but
none of 9 600 frames of cut bags (here 4 656; the cuts leave half of the bytes), half of the frames of MCAP files with
one bit turned over (here 98 %), and unpacks 6.6 MB to 3.5 GB, as mcap does (here 0.3 GB): ``python -m
benchmarks.recordings.damaged_bags --cuts 20 --flips 60``.
"""

from __future__ import annotations

import bz2
from abc import ABC, abstractmethod
from array import array
from collections import Counter, defaultdict
from collections.abc import Iterator
from functools import cached_property
from io import SEEK_END, BytesIO
from pathlib import Path
from typing import Any, BinaryIO, ClassVar, NamedTuple

from core.errors import InvalidRecording
from core.recordings.messages import CAMERA_INFO, IMAGE_TYPES, POSE_TYPES, Coding, stamp_of

Key = tuple[int, int]
"""Where a message is in its file; each kind of file has keys of its own."""

MOST_UNPACKED = 1 << 30
"""Bytes to which a chunk or a message is unpacked; more is not believed, since a few bytes can unpack to any number."""
PART = 1 << 20
"""Bytes that are unpacked at a time."""

WANTED = (*IMAGE_TYPES, *POSE_TYPES, CAMERA_INFO)
LATEST = 2**63 - 1
"""Nanoseconds; a later time, which no clock gives, counts as this."""


class Topic(NamedTuple):
    """A topic of a bag.

    kind: the type of its messages, as ROS 2 writes it.
    messages: how many there are.
    coding: how they are written; None if in no way that is read.
    schema: of protobuf: the file descriptors that define them.
    """

    kind: str
    messages: int
    coding: Coding | None
    schema: bytes = b""


class Entry(NamedTuple):
    """A message: when it was received and taken, nanoseconds (0: not stamped), and where it is."""

    received: int
    stamp: int
    key: Key


class TopicConnection(NamedTuple):
    """A writer of messages to a topic; a topic may have several."""

    topic: str
    kind: str
    coding: Coding | None
    schema: bytes = b""


class Storage(ABC):
    """One file of a bag, opened and read through.

    problem: the fault of the file, in words; None if it is whole.
    """

    def __init__(self) -> None:
        self.problem: str | None = None
        self._connections: dict[int, TopicConnection] = {}
        self._counts: Counter[int] = Counter()
        self._found: defaultdict[int, array[int]] = defaultdict(lambda: array("q"))
        """By connection: of each picture and pose when it was received and taken, and its key."""

    @cached_property
    def topics(self) -> dict[str, Topic]:
        """Topics by name, in the order of the file."""
        topics: dict[str, Topic] = {}
        for number, one in self._connections.items():
            before = topics.get(one.topic, Topic(one.kind, 0, one.coding, one.schema))
            topics[one.topic] = before._replace(messages=before.messages + self._counts[number])
        return topics

    def _wanted(self, number: int) -> bool:
        """Whether messages of a connection may be pictures, poses or intrinsics; one may be named behind them."""
        return number not in self._connections or self._connections[number].kind in WANTED

    def _note(self, number: int, received: int, start: bytes, coding: Coding | None, key: Key) -> None:
        """Note where a message is; ``start`` holds its first bytes, or all that ``stamp_of`` needs."""
        self._counts[number] += 1
        if coding is not None and self._wanted(number):
            one = self._connections.get(number, TopicConnection("", "", coding))
            stamp = stamp_of(start, coding, one.kind, one.schema)
            self._found[number].extend((min(received, LATEST), max(-LATEST, min(stamp, LATEST)), *key))

    def entries(self, topic: str) -> list[Entry]:
        """The messages of a topic in the order of the file; those behind a damage are left out."""
        found = []
        for number, one in self._connections.items():
            if one.topic == topic:
                values = iter(self._found[number])
                found += [Entry(*row[:2], row[2:]) for row in zip(values, values, values, values, strict=True)]
        return sorted(found, key=lambda entry: entry.key)

    @abstractmethod
    def read(self, key: Key) -> bytes:
        """The bytes of a message.

        Raises:
            OSError, InvalidRecording: they cannot be read any more.
        """

    @abstractmethod
    def close(self) -> None:
        """Close the file."""


class Record(NamedTuple):
    """A record of a file or of a chunk: its kind, its fields if they are before its data, and where its data is."""

    kind: int
    fields: dict[str, bytes]
    start: int
    end: int


class ChunkedStorage(Storage):
    """A file of records, some of which are chunks of packed records.

    A message is found by the place of its chunk in the file, 0 for the file itself, and its own place therein.  The
    chunk that was read last stays unpacked, so messages that are read in their order unpack each chunk once.
    """

    NAME: ClassVar[str]
    MAGIC: ClassVar[bytes]
    CHUNK: ClassVar[int]
    LAST: ClassVar[int | None] = None
    """The kind of the record that ends a whole file."""

    def __init__(self, path: Path) -> None:
        """Open the file and read it through.

        Raises:
            InvalidRecording: it is no such file.
            OSError: it cannot be read.
        """
        super().__init__()
        self._file = path.open("rb")
        self._unpacked: tuple[int, BinaryIO] = 0, self._file
        try:
            if self._file.read(len(self.MAGIC)) != self.MAGIC:
                raise InvalidRecording(f"{path} is not {self.NAME}.")
            for place, record in self._records(self._file, len(self.MAGIC)):
                if record.kind != self.CHUNK:
                    self._take(self._file, record, (0, place))
                    continue
                chunk = self._opened(place)
                for inner, packed in self._records(chunk, 0):
                    self._take(chunk, packed, (place, inner))
        except BaseException:
            self._file.close()
            raise

    def _records(self, file: BinaryIO, place: int) -> Iterator[tuple[int, Record]]:
        """The whole records from a place on with their places, and a chunk that is cut."""
        size, outside = file.seek(0, SEEK_END), file is self._file
        while place < size:
            file.seek(place)
            record = self._record(file)
            if record is not None and outside and record.kind == self.LAST:
                return
            if record is None or record.end > size:
                self.problem = self.problem or (
                    f"is cut short or damaged after {place} bytes" if outside else "has a damaged chunk"
                )
            if record is None or (record.end > size and record.kind != self.CHUNK):
                return
            yield place, record
            place = record.end
        if outside and self.LAST is not None:
            self.problem = self.problem or f"is cut short after {place} bytes"

    @abstractmethod
    def _record(self, file: BinaryIO) -> Record | None:
        """The record that begins here, its data unread; None if there is none, or it makes no sense."""

    @abstractmethod
    def _take(self, file: BinaryIO, record: Record, key: Key) -> None:
        """Note the content of a record that is a message or describes some."""

    @abstractmethod
    def _chunk(self, record: Record, data: bytes) -> tuple[bytes, str, int]:
        """The packed records of a chunk, how they are packed, and how many bytes they are said to have unpacked."""

    @abstractmethod
    def _message(self, data: bytes) -> bytes:
        """The bytes of the message in the data of a record."""

    def _opened(self, place: int) -> BinaryIO:
        """The file itself, or as much as can be unpacked of the chunk that begins there."""
        if place == 0:
            return self._file
        if self._unpacked[0] != place:
            self._file.seek(place)
            record = self._record(self._file)
            packed = (b"", "", 0) if record is None else self._chunk(record, _data(self._file, record))
            data, problem = unpacked(*packed)
            if problem is not None:
                self.problem = self.problem or f"has a damaged chunk ({problem})"
            self._unpacked = place, BytesIO(data)
        return self._unpacked[1]

    def read(self, key: Key) -> bytes:
        file = self._opened(key[0])
        file.seek(key[1])
        record = self._record(file)
        data = b"" if record is None else _data(file, record)
        if record is None or len(data) < record.end - record.start:
            raise InvalidRecording("A message cannot be read any more.")
        return self._message(data)

    def close(self) -> None:
        self._file.close()


def _data(file: BinaryIO, record: Record) -> bytes:
    """The data of a record, as much as there is; more than a chunk may have is not read."""
    left = file.seek(0, SEEK_END) - record.start
    file.seek(record.start)
    return file.read(max(0, min(record.end - record.start, left, MOST_UNPACKED)))


def unpacked(data: bytes, packing: str, size: int = MOST_UNPACKED) -> tuple[bytes, str | None]:
    """As much as can be unpacked of packed data, at most ``size`` and ``MOST_UNPACKED`` bytes, and the fault."""
    import lz4.frame
    import zstandard

    openers: dict[str, Any] = {
        "bz2": bz2.open,
        "lz4": lz4.frame.open,
        "zstd": lambda file: zstandard.ZstdDecompressor().stream_reader(file, read_across_frames=True),
    }
    if packing in ("", "none"):
        return data, None
    if packing not in openers:
        return b"", f"it is packed by {packing[:20]!r}"
    plain, problem, most = BytesIO(), None, min(size, MOST_UNPACKED)
    try:
        with openers[packing](BytesIO(data)) as file:
            # ``read`` would lose what it has at a damage.  Only with one byte more than may be is the end checked.
            while plain.tell() <= most and (part := file.read1(min(PART, most + 1 - plain.tell()))):
                plain.write(part)
            if plain.tell() > most:
                plain.truncate(most)
                problem = f"it is too large: of more than {most} bytes only the beginning is read"
    except (OSError, EOFError, RuntimeError, zstandard.ZstdError) as error:
        problem = str(error)
    return plain.getvalue(), problem
