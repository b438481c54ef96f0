"""An MCAP file, of a rosbag2 or alone, with messages of ROS 2 or ROS 1."""

from __future__ import annotations

import struct
from collections import Counter
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

from core.errors import InvalidRecording
from core.recordings.messages import Coding, stamp_of, type_name
from core.recordings.storage import MOST_UNPACKED, Entry, Key, Topic

MAGIC = b"\x89MCAP0\r\n"
LATEST = 2**63 - 1
"""The time of a message is not signed in the file; a later one, which no clock tells, counts as this."""

CODINGS: dict[str, Coding] = {"cdr": "cdr", "ros1": "ros1"}


class McapStorage:
    """An MCAP file, read by its index; one without an index, as of a recorder that was killed, from its beginning.

    A message is found by the place of its chunk in the file and its number in the chunk.  The chunk that was read last
    stays unpacked, so messages that are read in their order unpack each chunk once.
    """

    def __init__(self, path: Path) -> None:
        """Open the file.

        Raises:
            InvalidRecording: it is no MCAP file.
            OSError: it cannot be read.
        """
        self.problem: str | None = None
        self._file = path.open("rb")
        self._size = path.stat().st_size
        self._channels: dict[int, Any] = {}
        self._kinds: dict[int, str] = {}
        self._counts: Counter[int] = Counter()
        self._chunks: list[tuple[int, frozenset[int]]] = []
        """Where each chunk begins, or a message outside of chunks, and of which channels it has messages."""
        self._unpacked: tuple[int, list[Any]] = (-1, [])
        try:
            if self._file.read(len(MAGIC)) != MAGIC:
                raise InvalidRecording(f"{path} is not an MCAP file.")
            if not self._read_index():
                self._read_all()
        except BaseException:
            self._file.close()
            raise
        self.topics: dict[str, Topic] = {}
        for number, channel in self._channels.items():
            kind = type_name(self._kinds.get(channel.schema_id, ""))
            before = self.topics.get(channel.topic, Topic(kind, 0, None))
            count = before.messages + self._counts[number]
            self.topics[channel.topic] = Topic(before.kind, count, CODINGS.get(channel.message_encoding))

    def _read_index(self) -> bool:
        """Read the summary at the end of the file; whether it tells all that is needed."""
        from mcap.reader import SeekingReader

        self._file.seek(0)
        try:
            summary = SeekingReader(self._file).get_summary()
        except Exception:  # the file is cut, or its end is something else: the library has many words for that
            return False
        if summary is None or summary.statistics is None:
            return False
        if summary.statistics.message_count and not summary.chunk_indexes:
            return False
        if any(not chunk.message_index_offsets for chunk in summary.chunk_indexes):
            return False
        self._channels = dict(summary.channels)
        self._kinds = {number: schema.name for number, schema in summary.schemas.items()}
        self._counts = Counter(summary.statistics.channel_message_counts)
        self._chunks = sorted(
            (chunk.chunk_start_offset, frozenset(chunk.message_index_offsets)) for chunk in summary.chunk_indexes
        )
        return True

    def _read_all(self) -> None:
        """Read the file from its beginning to its end or to where it is cut."""
        from mcap.records import Channel, Chunk, Message, Schema

        self._channels, self._kinds, self._counts, self._chunks = {}, {}, Counter(), []
        for offset, record in self._records(0):
            if isinstance(record, Chunk):
                self._unpacked = (offset, self._unpack(record))
            found = self._unpacked[1] if isinstance(record, Chunk) else [record]
            self._channels |= {one.id: one for one in found if isinstance(one, Channel)}
            self._kinds |= {one.id: one.name for one in found if isinstance(one, Schema)}
            held = Counter(one.channel_id for one in found if isinstance(one, Message))
            if held:
                self._counts += held
                self._chunks.append((offset, frozenset(held)))

    def _records(self, offset: int) -> Iterator[tuple[int, Any]]:
        """The records from a place on, chunks packed, with their places."""
        from mcap.exceptions import McapError
        from mcap.stream_reader import StreamReader

        self._file.seek(offset)
        records = StreamReader(
            self._file, skip_magic=offset > 0, emit_chunks=True, record_size_limit=self._size
        ).records
        while True:
            place = self._file.tell()
            try:
                record = next(records)
            except StopIteration:
                return
            except (McapError, struct.error, ValueError, OSError) as error:  # ValueError: text that is none
                self.problem = f"is cut short or damaged after {place} bytes ({type(error).__name__})"
                return
            yield max(place, len(MAGIC)), record

    def _unpack(self, chunk: Any) -> list[Any]:
        from mcap.stream_reader import breakup_chunk

        try:
            return breakup_chunk(_plain(chunk))
        except Exception as error:  # of zstandard, lz4, struct, the library itself
            self.problem = f"has a damaged chunk, whose messages are left out ({error})"
            return []

    def entries(self, topic: str) -> Iterator[Entry]:
        from mcap.records import Message

        wanted = {
            number: coding
            for number, channel in self._channels.items()
            if channel.topic == topic and (coding := CODINGS.get(channel.message_encoding)) is not None
        }
        for offset, held in self._chunks:
            if not held & wanted.keys():
                continue
            for number, record in enumerate(self._at(offset)):
                if isinstance(record, Message) and (coding := wanted.get(record.channel_id)) is not None:
                    yield Entry(min(record.log_time, LATEST), stamp_of(record.data, coding), (offset, number))

    def read(self, key: Key) -> bytes:
        offset, number = key
        found = self._at(offset)
        if number >= len(found):
            raise InvalidRecording("A message cannot be read any more.")
        return bytes(found[number].data)

    def _at(self, offset: int) -> list[Any]:
        """The records of the chunk that begins there, or the message."""
        from mcap.records import Chunk

        if self._unpacked[0] != offset:
            record = next((record for _, record in self._records(offset)), None)
            whole = [] if record is None else self._unpack(record) if isinstance(record, Chunk) else [record]
            self._unpacked = (offset, whole)
        return self._unpacked[1]

    def close(self) -> None:
        self._file.close()


def _plain(chunk: Any) -> Any:
    """A chunk that is not packed, or whose unpacked size the library keeps to.

    Raises:
        InvalidRecording: it is larger than a chunk may be, or than it says.
        Others: of lz4, if it is damaged.
    """
    import lz4.frame

    if chunk.uncompressed_size > MOST_UNPACKED:
        raise InvalidRecording(f"it would have {chunk.uncompressed_size} bytes")
    if chunk.compression != "lz4":
        return chunk
    data = lz4.frame.LZ4FrameDecompressor().decompress(chunk.data, chunk.uncompressed_size + 1)
    if len(data) > chunk.uncompressed_size:
        raise InvalidRecording("it has more bytes than it says")
    return replace(chunk, data=data, compression="")
