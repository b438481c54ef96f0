"""The file of a rosbag2 that is an SQLite database (``.db3``)."""

from __future__ import annotations

import sqlite3
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from core.errors import InvalidRecording
from core.recordings.messages import STAMP_BYTES, Coding, type_name
from core.recordings.storage import MOST_UNPACKED, Key, Storage, TopicConnection, unpacked

ZSTD = b"\x28\xb5\x2f\xfd"
"""A message that the recorder has compressed begins so; one in CDR cannot."""

CODINGS: dict[str, Coding] = {"cdr": "cdr", "ros1": "ros1"}


class SqliteStorage(Storage):
    """An SQLite database of messages, read by their row numbers; a file that is cut short is read up to the cut."""

    def __init__(self, path: Path) -> None:
        """Open the file and read it through.

        Raises:
            InvalidRecording: it is no such database.
        """
        super().__init__()
        try:
            self._database = sqlite3.connect(f"{path.resolve().as_uri()}?mode=ro", uri=True, check_same_thread=False)
            try:
                # Without this SQLite refuses a file that is shorter than its header says.
                self._database.execute("PRAGMA writable_schema = ON")
                # A file may have views, which can have any number of rows, and columns that compute values of any size.
                self._database.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, MOST_UNPACKED)
                self._database.set_authorizer(_allowed)
                self._read()
            except BaseException:
                self._database.close()
                raise
        except sqlite3.Error as error:
            raise InvalidRecording(f"{path} is not the database of a bag, or is damaged: {error}.") from error

    def _read(self) -> None:
        # A column of SQLite may hold values of any type.
        for number, name, kind, coding in self._database.execute(
            "SELECT id, coalesce(CAST(name AS TEXT), ''), coalesce(CAST(type AS TEXT), ''), serialization_format "
            "FROM topics ORDER BY id"
        ):
            self._connections[number] = TopicConnection(name, type_name(kind), CODINGS.get(coding))
        # There is no index by topic, and behind a damage no index helps.
        for number, row, received, start in self._rows(
            "SELECT topic_id, id, coalesce(CAST(timestamp AS INTEGER), 0), "
            f"coalesce(CAST(substr(data, 1, {STAMP_BYTES}) AS BLOB), x'') FROM messages ORDER BY id"
        ):
            if number in self._connections:
                packed = start.startswith(ZSTD) and self._wanted(number)
                head = self.read((row, 0)) if packed else start
                self._note(number, received, head, self._connections[number].coding, (row, 0))

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
            found = self._database.execute("SELECT CAST(data AS BLOB) FROM messages WHERE id = ?", key[:1]).fetchone()
        except sqlite3.DatabaseError as error:
            raise InvalidRecording(f"A message cannot be read: {error}.") from error
        data = bytes(found[0] or b"") if found is not None else b""
        data, problem = unpacked(data, "zstd" if data.startswith(ZSTD) else "")
        if problem is not None:
            raise InvalidRecording(f"A compressed message is damaged: {problem}.")
        return data

    def close(self) -> None:
        self._database.close()


def _allowed(action: int, first: str | None, second: str | None, _database: str | None, view: str | None) -> int:
    """Let statements read the two tables, and no view."""
    reads = action == sqlite3.SQLITE_READ and first in ("topics", "messages") and view is None
    calls = action == sqlite3.SQLITE_FUNCTION and second in ("coalesce", "substr")
    return sqlite3.SQLITE_OK if reads or calls or action == sqlite3.SQLITE_SELECT else sqlite3.SQLITE_DENY
