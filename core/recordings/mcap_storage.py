"""An MCAP file, of a rosbag2 or alone, with messages of ROS 2, ROS 1 or Foxglove; its records are parsed by mcap."""

from __future__ import annotations

import struct
from io import BytesIO
from pathlib import Path
from typing import Any, BinaryIO

from core.errors import InvalidRecording
from core.recordings.messages import STAMP_BYTES, WHOLE, Coding, type_name
from core.recordings.storage import ChunkedStorage, Key, Record, TopicConnection

_SCHEMA, _CHANNEL, _MESSAGE = 3, 4, 5
_HEAD = 22
"""Bytes of a message's record before those of the message: its channel, number and times."""

CODINGS: dict[str, Coding] = {"cdr": "cdr", "ros1": "ros1", "protobuf": "protobuf", "json": "json"}


class McapStorage(ChunkedStorage):
    """An MCAP file."""

    NAME, MAGIC, CHUNK, LAST = "an MCAP file", b"\x89MCAP0\r\n", 6, 2

    def __init__(self, path: Path) -> None:
        self._schemas: dict[int, tuple[str, bytes]] = {}
        super().__init__(path)

    def _record(self, file: BinaryIO) -> Record | None:
        head = file.read(9)
        if len(head) < 9 or head[0] == 0:
            return None
        start = file.tell()
        return Record(head[0], {}, start, start + int.from_bytes(head[1:], "little"))

    def _take(self, file: BinaryIO, record: Record, key: Key) -> None:
        if record.kind not in (_SCHEMA, _CHANNEL, _MESSAGE):
            return
        size = record.end - record.start
        file.seek(record.start)
        data = file.read(min(size, _HEAD + STAMP_BYTES) if record.kind == _MESSAGE else size)
        if record.kind == _MESSAGE and self._is_whole(int.from_bytes(data[:2], "little")):
            data += file.read(size - len(data))
        try:
            self._learn(parsed(record.kind, data), key)
        except InvalidRecording as error:
            self.problem = self.problem or f"is damaged ({error})"

    def _is_whole(self, channel: int) -> bool:
        """Whether the stamp of a channel's messages may be anywhere in them, and is needed."""
        known = self._connections.get(channel)
        return known is not None and known.coding in WHOLE and self._wanted(channel)

    def _learn(self, record: Any, key: Key) -> None:
        from mcap.records import Channel, Schema

        if isinstance(record, Schema):
            self._schemas[record.id] = type_name(record.name), record.data
        elif isinstance(record, Channel):
            coding = CODINGS.get(record.message_encoding)
            kind, schema = self._schemas.get(record.schema_id, ("", b""))
            self._connections[record.id] = TopicConnection(
                record.topic, kind, coding, schema if coding == "protobuf" else b""
            )
        else:
            channel = self._connections.get(record.channel_id)
            self._note(record.channel_id, record.log_time, record.data, channel and channel.coding, key)

    def _chunk(self, record: Record, data: bytes) -> tuple[bytes, str, int]:
        try:
            chunk = parsed(record.kind, data)
        except InvalidRecording as error:
            self.problem = self.problem or f"has a damaged chunk ({error})"
            return b"", "", 0
        return chunk.data, chunk.compression, chunk.uncompressed_size

    def _message(self, data: bytes) -> bytes:
        return data[_HEAD:]


def parsed(kind: int, data: bytes) -> Any:
    """A record by mcap's own class.

    Raises:
        InvalidRecording: it is damaged.
    """
    from mcap.data_stream import ReadDataStream
    from mcap.exceptions import McapError
    from mcap.records import Channel, Chunk, Message, Schema

    stream = ReadDataStream(BytesIO(data))
    try:
        if kind == _MESSAGE:
            return Message.read(stream, len(data))
        kinds: dict[int, Any] = {_SCHEMA: Schema, _CHANNEL: Channel, McapStorage.CHUNK: Chunk}
        return kinds[kind].read(stream)
    except (McapError, struct.error, ValueError, OverflowError) as error:  # ValueError: text that is none
        raise InvalidRecording(f"A record is damaged: {type(error).__name__}.") from error
