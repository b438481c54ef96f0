"""Frames that a map stores because its answers were doubtful, and people's labels of them.

They are in a small SQLite file of their own in the map's folder, ``review.sqlite``, and go with the map.  A frame is
stored whole or not at all.  The file is bounded by the map's setting: the oldest frame without a label goes first, then
the oldest with one.  Frames have their SHA-256, and their rows a checksum; a row that does not match it is dropped when
the file is opened, and a file that cannot be read is put aside and made anew: neither harms the map.
"""

from __future__ import annotations

import hashlib
import json
import logging
import sqlite3
import threading
import zlib
from collections.abc import Callable, Container, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from core.disk.files import Damage, disk_errors
from core.disk.sqlite_file import DURABLE, Schema, SqliteFile, transaction
from core.errors import StorageFailure, UnknownFrame
from core.maps.records import ReviewSetting
from core.maps.review import ReviewFrame, StoredReviews, frames_to_drop
from core.maps.stored_fields import moment_text

FILE = "review.sqlite"

_TABLES = (
    """CREATE TABLE frames (
        number INTEGER PRIMARY KEY AUTOINCREMENT,
        at TEXT NOT NULL,
        digest BLOB NOT NULL UNIQUE CHECK (length(digest) = 32),
        size INTEGER NOT NULL,
        answer TEXT NOT NULL,
        label TEXT,
        seal INTEGER NOT NULL
    ) STRICT""",
    # Apart from the frames, so that a listing need not read the pictures.
    """CREATE TABLE pictures (
        frame INTEGER PRIMARY KEY REFERENCES frames (number) ON DELETE CASCADE,
        bytes BLOB NOT NULL
    ) STRICT""",
    "CREATE INDEX frames_by_label ON frames (label IS NOT NULL, number)",
)
_SCHEMA = Schema(application_id=0x504C5256, version=1, create=_TABLES)  # "PLRV"
_SETTINGS = {"auto_vacuum": "INCREMENTAL", **DURABLE, "foreign_keys": "ON", "journal_size_limit": 1 << 20}
_COLUMNS = "number, at, digest, size, answer, label"

log = logging.getLogger(__name__)


class ReviewFrames:
    """The frames of one map that are stored for review (:class:`core.maps.review.Review`).

    Any thread may use it; the file is made with the first frame.  Every method may raise StorageFull and
    StorageFailure.

    Args:
        path: of the file.
        expect_open: raises if the map is closed, deleted or damaged.
    """

    def __init__(self, path: Path, expect_open: Callable[[], object]) -> None:
        self._file = SqliteFile(path, _SCHEMA, _SETTINGS, ["SELECT bytes FROM pictures LIMIT 0"])
        self._expect_open = expect_open
        self._lock = threading.Lock()
        self._connection: sqlite3.Connection | None = None
        self._closed = False
        self._held: set[int] = set()

    def close(self) -> None:
        """Close the file for good."""
        with self._lock:
            self._closed = True
            if self._connection is not None:
                self._connection.close()
                self._connection = None

    def keep(self, data: bytes, answer: Mapping[str, Any], setting: ReviewSetting) -> bool:
        if len(data) > setting.most_bytes:
            return False
        digest = hashlib.sha256(data).digest()
        at, text = moment_text(datetime.now(UTC)), json.dumps(answer)
        with self._using(create=True) as connection, transaction(connection):
            cursor = connection.execute(
                "INSERT INTO frames (at, digest, size, answer, seal) VALUES (?, ?, ?, ?, 0) ON CONFLICT DO NOTHING",
                (at, digest, len(data), text),
            )
            if cursor.rowcount < 1:
                return False
            number = cursor.lastrowid
            connection.execute("INSERT INTO pictures VALUES (?, ?)", (number, data))
            _write_seal(connection, number)
            _drop_oldest(connection, setting, self._held)
        return True

    def shrink(self, setting: ReviewSetting) -> None:
        with self._using() as connection:
            with transaction(connection):
                _drop_oldest(connection, setting, self._held)
            connection.executescript("PRAGMA incremental_vacuum")  # execute() would stop after one page

    def page(self, before: int | None, limit: int, labelled: bool | None = None) -> StoredReviews:
        conditions = ["number < ?1"] + ([] if labelled is None else [f"label IS {'NOT ' * labelled}NULL"])
        query = f"SELECT {_COLUMNS} FROM frames WHERE {' AND '.join(conditions)} ORDER BY number DESC LIMIT ?2"
        with self._using() as connection:  # nobody writes meanwhile
            rows = connection.execute(query, (2**62 if before is None else before, limit)).fetchall()
            count, size = _size(connection)
        return StoredReviews([_frame(row) for row in rows], count, size)

    def labelled(self) -> list[ReviewFrame]:
        query = f"SELECT {_COLUMNS} FROM frames WHERE label IS NOT NULL ORDER BY number"
        with self._using() as connection:
            return [_frame(row) for row in connection.execute(query).fetchall()]

    def find(self, number: int) -> ReviewFrame:
        with self._using() as connection:
            return _frame(_expect(connection, number))

    def picture(self, number: int) -> bytes:
        with self._using() as connection:
            frame = _frame(_expect(connection, number))
            found = connection.execute("SELECT bytes FROM pictures WHERE frame = ?", (number,)).fetchone()
        if found is None or hashlib.sha256(found[0]).digest() != frame.digest:
            raise StorageFailure(f"The picture of the frame {number} is damaged; discard the frame.")
        data: bytes = found[0]
        return data

    @contextmanager
    def held(self, number: int) -> Iterator[None]:
        self._held.add(number)
        try:
            yield
        finally:
            self._held.discard(number)

    def label(self, number: int, label: Mapping[str, Any]) -> ReviewFrame:
        with self._using() as connection, transaction(connection):
            frame = _frame(_expect(connection, number))
            connection.execute("UPDATE frames SET label = ? WHERE number = ?", (json.dumps(label), number))
            _write_seal(connection, number)
        return replace(frame, label=label)

    def discard(self, number: int) -> None:
        with self._using() as connection, transaction(connection):
            _expect(connection, number)
            connection.execute("DELETE FROM frames WHERE number = ?", (number,))

    @contextmanager
    def _using(self, create: bool = False) -> Iterator[sqlite3.Connection]:
        self._expect_open()
        with self._lock:
            if self._closed:
                self._expect_open()  # raises the reason
                raise StorageFailure("The map is closed.")
            try:
                with disk_errors(f"use {FILE}", FILE):
                    yield self._opened(create)
            except Damage as damage:
                if self._connection is not None:
                    self._connection.close()
                    self._connection = None
                with disk_errors(f"put {FILE} aside", FILE):
                    aside = self._file.put_aside(damage)
                raise StorageFailure(f"{FILE} is damaged and put aside as {aside.name}; ask again.") from damage

    def _opened(self, create: bool) -> sqlite3.Connection:
        """The connection; to an empty file in memory if there is none, and none is to be made."""
        if self._connection is None:
            if not create and not self._file.path.exists():
                return _empty()
            self._connection = self._file.open_or_replace()
            _drop_unsound(self._connection)
        return self._connection


def _empty() -> sqlite3.Connection:
    connection = sqlite3.connect(":memory:", isolation_level=None)
    _SCHEMA.prepare(connection, create=True)
    return connection


def _seal_of(row: tuple[Any, ...]) -> int:
    return zlib.crc32(ascii(row).encode())


def _write_seal(connection: sqlite3.Connection, number: int | None) -> None:
    row = connection.execute(f"SELECT {_COLUMNS} FROM frames WHERE number = ?", (number,)).fetchone()
    connection.execute("UPDATE frames SET seal = ? WHERE number = ?", (_seal_of(row), number))


def _drop_unsound(connection: sqlite3.Connection) -> None:
    rows = connection.execute(f"SELECT {_COLUMNS}, seal FROM frames").fetchall()
    unsound = [(row[0],) for row in rows if _seal_of(row[:-1]) != row[-1]]
    if unsound:
        log.error("%d frames of %s do not match their checksums and are dropped", len(unsound), FILE)
        with transaction(connection):
            connection.executemany("DELETE FROM frames WHERE number = ?", unsound)


def _drop_oldest(connection: sqlite3.Connection, setting: ReviewSetting, held: Container[int]) -> None:
    """Drop frames, those without a label first and the oldest of these first, until the limits hold.

    Those that are held stay.
    """
    count, size = _size(connection)
    if setting.allows(count, size):
        return
    frames = connection.execute("SELECT number, size FROM frames ORDER BY label IS NOT NULL, number")
    going = frames_to_drop(frames, count, size, setting, held)
    connection.executemany("DELETE FROM frames WHERE number = ?", [(number,) for number in going])


def _size(connection: sqlite3.Connection) -> tuple[int, int]:
    """How many frames are stored, and their bytes."""
    count, size = connection.execute("SELECT count(*), coalesce(sum(size), 0) FROM frames").fetchone()
    return int(count), int(size)


def _expect(connection: sqlite3.Connection, number: int) -> tuple[Any, ...]:
    row = connection.execute(f"SELECT {_COLUMNS} FROM frames WHERE number = ?", (number,)).fetchone()
    if row is None:
        raise UnknownFrame(f"The map keeps no frame {number} for review.")
    found: tuple[Any, ...] = row
    return found


def _frame(row: tuple[Any, ...]) -> ReviewFrame:
    number, at, digest, size, answer, label = row
    moment = datetime.fromisoformat(at)
    return ReviewFrame(number, moment, digest, size, json.loads(answer), None if label is None else json.loads(label))
