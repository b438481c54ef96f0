"""Sessions on disk: one small SQLite file in the data directory, written after every frame.

Before a frame is answered it is written and synced (``synchronous=FULL`` in WAL mode), so a power cut loses no answered
frame.  A damaged file is renamed and replaced by a new one, so that the service can start.
"""

from __future__ import annotations

import threading
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

from core.disk.files import disk_errors
from core.disk.sqlite_file import DURABLE, Schema, SqliteFile

FILE = "sessions.sqlite"

LOG_PAGES = 256
"""Pages of SQLite's log after which it is written back to the file."""

_TABLE = """
CREATE TABLE sessions (
    id TEXT PRIMARY KEY,
    map TEXT NOT NULL,
    map_created_at TEXT NOT NULL,
    options TEXT NOT NULL,
    created REAL NOT NULL,
    used REAL NOT NULL,
    number INTEGER,
    moment REAL,
    request TEXT,
    lost INTEGER,
    ended TEXT,
    state BLOB,
    answer TEXT
) STRICT
"""
_SCHEMA = Schema(application_id=0x504C5253, version=1, create=[_TABLE])  # "PLRS"


@dataclass(frozen=True)
class StoredSession:
    """One row of the file; times are seconds since 1970 UTC.

    number, moment, request, lost: as in :class:`service.sessions.sessions.Session`.
    ended: why the session has ended; None if it has not.
    state: the belief, as ``core.belief.record`` writes it.
    answer: the last answer, JSON.
    """

    id: str
    map: str
    map_created_at: str
    options: str
    created: float
    used: float
    number: int | None = None
    moment: float | None = None
    request: str | None = None
    lost: int | None = None
    ended: str | None = None
    state: bytes | None = None
    answer: str | None = None


COLUMNS = tuple(StoredSession.__dataclass_fields__)
HEAD = COLUMNS[:-2]
"""The columns that are read at the start; the others are read when a session goes on."""


class SessionRecords(Protocol):
    """The stored sessions.

    A write is durable when it returns.  Every method but ``close`` may raise an error if the disk or server refuses.
    """

    def all(self) -> list[StoredSession]: ...
    def read(self, session_id: str) -> StoredSession | None: ...
    def write(self, session: StoredSession) -> None: ...
    def renew(self, session: StoredSession, revision: int) -> bool: ...
    def end(self, session_id: str, reason: str, moment: float) -> None: ...
    def forget(self, session_id: str) -> None: ...
    def close(self) -> None: ...


class SessionStore:
    """The file of the sessions.  Thread-safe.

    Every method but ``close`` may raise ``sqlite3.Error``, if the disk refuses.
    """

    def __init__(self, folder: Path) -> None:
        """Open the file or make it; a damaged one is put aside.

        Raises:
            StorageFull, StorageFailure: the disk refuses.
        """
        self._lock = threading.Lock()
        settings = {**DURABLE, "wal_autocheckpoint": LOG_PAGES}
        readable = [f"SELECT {', '.join(HEAD)} FROM sessions", f"SELECT {', '.join(COLUMNS)} FROM sessions LIMIT 1"]
        file = SqliteFile(folder / FILE, _SCHEMA, settings, readable)
        with disk_errors(f"open {file.path}", FILE):
            self._connection = file.open_or_replace()

    def close(self) -> None:
        """Write the log back and close the file."""
        with self._lock:
            self._connection.close()

    def all(self) -> list[StoredSession]:
        """All sessions, including ended ones, without states and answers."""
        with self._lock:
            found = self._connection.execute(f"SELECT {', '.join(HEAD)} FROM sessions").fetchall()
        return [StoredSession(*row) for row in found]

    def read(self, session_id: str) -> StoredSession | None:
        """One session with all columns; None if there is no such session."""
        with self._lock:
            row = self._connection.execute(
                f"SELECT {', '.join(COLUMNS)} FROM sessions WHERE id = ?", [session_id]
            ).fetchone()
        return None if row is None else StoredSession(*row)

    def write(self, session: StoredSession) -> None:
        """Write a session, new or changed."""
        marks = ", ".join("?" * len(COLUMNS))
        values = [getattr(session, name) for name in COLUMNS]
        with self._lock:
            self._connection.execute(f"INSERT OR REPLACE INTO sessions VALUES ({marks})", values)

    def renew(self, session: StoredSession, revision: int = 0) -> bool:
        """Write a changed session; returns False, and writes nothing, if it was deleted or has ended.

        Args:
            revision: of the record that is changed.  Nobody else writes to this file, so it is not looked at.
        """
        assignments = ", ".join(f"{name} = ?" for name in COLUMNS)
        values = [getattr(session, name) for name in COLUMNS]
        with self._lock, closing(self._connection.cursor()) as cursor:
            cursor.execute(f"UPDATE sessions SET {assignments} WHERE id = ? AND ended IS NULL", [*values, session.id])
            return cursor.rowcount > 0

    def end(self, session_id: str, reason: str, moment: float) -> None:
        """Mark a session as ended, for a reason, and delete its state and answer."""
        with self._lock:
            self._connection.execute(
                "UPDATE sessions SET ended = ?, used = ?, state = NULL, answer = NULL WHERE id = ?",
                [reason, moment, session_id],
            )

    def forget(self, session_id: str) -> None:
        """Delete a session."""
        with self._lock:
            self._connection.execute("DELETE FROM sessions WHERE id = ?", [session_id])
