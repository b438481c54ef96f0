"""The file of a rosbag2 that is an SQLite database (``.db3``)."""

from __future__ import annotations

import sqlite3
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from core.errors import InvalidRecording
from core.recordings.messages import STAMP_BYTES, Coding, stamp_of, type_name
from core.recordings.storage import MOST_UNPACKED, Entry, Key, Topic

ZSTD = b"\x28\xb5\x2f\xfd"
"""A message that the recorder has compressed begins so; one in CDR cannot."""

CODINGS: dict[str, Coding] = {"cdr": "cdr", "ros1": "ros1"}


class SqliteStorage:
    """An SQLite database of messages, read by their row numbers; a file that is cut short is read up to the cut."""

    def __init__(self, path: Path) -> None:
        """Open the file.

        Raises:
            InvalidRecording: it is no such database.
        """
        self.problem: str | None = None
        uri = f"{path.resolve().as_uri()}?mode=ro"
        try:
            self._database = sqlite3.connect(uri, uri=True, check_same_thread=False)
            try:
                # Without this SQLite refuses a file that is shorter than its header says.
                self._database.execute("PRAGMA writable_schema = ON")
                self._topics = {
                    row: (name, type_name(kind), CODINGS.get(coding))
                    for row, name, kind, coding in self._database.execute(
                        "SELECT id, coalesce(CAST(name AS TEXT), ''), coalesce(CAST(type AS TEXT), ''), "
                        "serialization_format FROM topics ORDER BY id"
                    )
                }
                counts = Counter(topic for (topic,) in self._rows("SELECT topic_id FROM messages ORDER BY id"))
            except BaseException:
                self._database.close()
                raise
        except sqlite3.Error as error:
            raise InvalidRecording(f"{path} is not the database of a bag, or is damaged: {error}.") from error
        self.topics = {name: Topic(kind, counts[row], coding) for row, (name, kind, coding) in self._topics.items()}

    def entries(self, topic: str) -> Iterator[Entry]:
        ids = {row: coding for row, (name, _, coding) in self._topics.items() if name == topic}
        # All topics are read, for there is no index by topic, and behind a damage no index helps.
        # A column of SQLite may hold anything, whatever its type.
        rows = self._rows(
            "SELECT topic_id, id, coalesce(CAST(timestamp AS INTEGER), 0), "
            f"coalesce(CAST(substr(data, 1, {STAMP_BYTES}) AS BLOB), x'') FROM messages ORDER BY id"
        )
        for number, row, received, start in rows:
            coding = ids.get(number)
            if coding is not None:
                head = self.read((row,)) if start.startswith(ZSTD) else start
                yield Entry(received, stamp_of(head, coding), (row,))

    def _rows(self, statement: str) -> Iterator[Any]:
        """The rows of a statement, up to a damage."""
        cursor = self._database.execute(statement)
        while True:
            try:
                row = cursor.fetchone()
            except sqlite3.DatabaseError as error:
                self.problem = f"is cut short or damaged ({error})"
                return
            if row is None:
                return
            yield row

    def read(self, key: Key) -> bytes:
        try:
            found = self._database.execute("SELECT CAST(data AS BLOB) FROM messages WHERE id = ?", key).fetchone()
        except sqlite3.DatabaseError as error:
            raise InvalidRecording(f"A message cannot be read: {error}.") from error
        data = bytes(found[0] or b"") if found is not None else b""
        return _unpacked(data) if data.startswith(ZSTD) else data

    def close(self) -> None:
        self._database.close()


def _unpacked(data: bytes) -> bytes:
    import zstandard

    try:
        unpacked = zstandard.ZstdDecompressor().stream_reader(data).read(MOST_UNPACKED + 1)
    except zstandard.ZstdError as error:
        raise InvalidRecording(f"A compressed message is damaged: {error}.") from error
    if len(unpacked) > MOST_UNPACKED:
        raise InvalidRecording("A compressed message is too large.")
    return unpacked
