"""Frames that a map in a data directory stores for review, in a small SQLite file of their own in the map's folder.

They go with the map, which the file names.  A frame whose row does not match its checksum is dropped when the file is
opened, and a file that cannot be read, or is of another map, is put aside and made anew: neither harms the map.
"""

from __future__ import annotations

import hashlib
import logging
import sqlite3
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from datetime import datetime
from pathlib import Path

from sqlalchemy import Column, MetaData, Table, bindparam, select

from core.disk.files import Damage, disk_errors
from core.disk.sqlite_file import DURABLE, UnreadVersion, rewrite, transaction
from core.errors import StorageFailure
from core.ledger import Tables
from core.ledger.maps.connection import MapConnection
from core.ledger.maps.review import METADATA, ReviewTable, drop, first_after, unsound
from core.ledger.sqlite import file_of
from core.ledger.statements import Statement, integer, text
from core.maps.records import ReviewSetting
from core.storage.database.schema import connection_of, driver_of

FILE = "review.sqlite"

_OWN = MetaData()
_OWNER = Table(
    "review_map", _OWN, Column("map", integer(), primary_key=True), Column("id", text(), nullable=False),
    sqlite_strict=True,
)  # fmt: skip
_OWNER_TABLE = Tables("owner", 1, _OWN).create("sqlite")
TABLES = Tables(
    "review",
    3,
    METADATA,
    application_id=0x504C5256,  # "PLRV"
    migrations={2: {"sqlite": _OWNER_TABLE}},
    more={"sqlite": _OWNER_TABLE},
)
_READ_OWNER = Statement(select(_OWNER.c.id))
_PUT_OWNER = Statement(
    lambda insert: insert(_OWNER).values(map=bindparam("map"), id=bindparam("id")).on_conflict_do_nothing()
)
_SETTINGS = {"auto_vacuum": "INCREMENTAL", **DURABLE, "secure_delete": "ON", "journal_size_limit": 1 << 20}

log = logging.getLogger(__name__)


class ReviewFrames(ReviewTable):
    """The frames of one map that are stored for review (:class:`core.maps.review.Review`).

    Any thread may use it; the file is made with the first frame.  Every method may raise StorageFull and
    StorageFailure.

    Args:
        path: of the file.
        map_id: of the map.
        expect_open: raises if the map is closed, deleted or damaged.
    """

    def __init__(self, path: Path, map_id: str, expect_open: Callable[[], object]) -> None:
        super().__init__()
        self._map_id = map_id
        self._file = file_of(path, TABLES, _SETTINGS, ["SELECT bytes FROM review_pictures LIMIT 0"])
        self._expect_open = expect_open
        self._lock = threading.Lock()
        self._connection: sqlite3.Connection | None = None
        self._closed = False

    def close(self) -> None:
        """Close the file for good."""
        with self._lock:
            self._closed = True
            if self._connection is not None:
                self._connection.close()
                self._connection = None

    def shrink(self, setting: ReviewSetting) -> None:
        super().shrink(setting)
        with self._using() as connection:
            driver_of(connection).executescript("PRAGMA incremental_vacuum")  # execute() would stop after one page

    def drop_before(self, moment: datetime) -> int:
        if not self._file.path.exists():
            return 0
        with self._using(opening=False) as connection, transaction(driver_of(connection)):
            return self._drop_before(connection, moment)

    def erase(self) -> int:
        """Rewrite the file without the frames that were dropped, and delete files that were put aside.

        Returns:
            The bytes by which the files got smaller.
        """
        path, gone = self._file.path, 0
        with disk_errors(f"erase what is left in {FILE}", FILE):
            for aside in path.parent.glob(f"{FILE}.damaged-*"):
                gone += aside.stat().st_size
                aside.unlink()
            if not path.exists():
                return gone
            with self._using() as connection:
                driver, before = driver_of(connection), path.stat().st_size
                rewrite(driver, path.parent)
                if driver.execute("PRAGMA wal_checkpoint(TRUNCATE)").fetchone()[0]:
                    raise StorageFailure(f"{FILE} is being read: try again.")
                return gone + max(0, before - path.stat().st_size)

    def check(self) -> tuple[list[str], int]:
        """Problems of the file, which is left as it is, and the bytes of the pictures that were read."""
        problems: list[str] = []
        number, checked = 0, 0
        try:
            with self._looking() as connection:
                if connection is None:
                    return problems, checked
                found = driver_of(connection).execute("PRAGMA integrity_check").fetchall()
                problems += [f"{FILE}: {line}" for (line,) in found if line != "ok"]
                problems += [f"{FILE}: frame {one} does not match its checksum" for one in unsound(connection)]
                if (owner := _owner(connection)) not in (None, self._map_id):
                    problems.append(f"{FILE}: it belongs to the map {owner!r}")
            while True:
                with self._looking() as connection:  # for one picture after the other, so that nobody waits for long
                    if connection is None or (frame := first_after(connection, number)) is None:
                        return problems, checked
                number, digest, picture = frame
                checked += len(picture or b"")
                if picture is None or hashlib.sha256(picture).digest() != digest:
                    problems.append(f"{FILE}: the picture of frame {number} does not match its digest")
        except (Damage, StorageFailure) as error:
            problems.append(str(error) if FILE in str(error) else f"{FILE}: {error}")
        return problems, checked

    @contextmanager
    def _looking(self) -> Iterator[MapConnection | None]:
        """A connection of its own to the file as it is; None if there is none, or the map is closed."""
        with self._lock, disk_errors(f"read {FILE}", FILE):
            if self._closed or not self._file.path.exists():
                yield None
                return
            try:
                connection = replace(self._file, check_whole=False).open(create=False)  # the caller checks it once
            except UnreadVersion as error:
                raise Damage(f"{FILE} {error}") from error
            try:
                yield connection_of(connection)
            finally:
                connection.close()

    @contextmanager
    def _reading(self) -> Iterator[MapConnection]:
        with self._using() as connection:  # nobody writes meanwhile
            yield connection

    @contextmanager
    def _writing(self) -> Iterator[MapConnection]:
        with self._using(create=True) as connection, transaction(driver_of(connection)):
            yield connection

    @contextmanager
    def _using(self, create: bool = False, opening: bool = True) -> Iterator[MapConnection]:
        if opening:
            self._expect_open()
        with self._lock:
            if self._closed:
                self._expect_open()  # raises the reason
                raise StorageFailure("The map is closed.")
            try:
                with disk_errors(f"use {FILE}", FILE):
                    yield connection_of(self._opened(create))
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
            self._connection = self._opened_as_own()
            _drop_unsound(connection_of(self._connection))
        return self._connection

    def _opened_as_own(self) -> sqlite3.Connection:
        opened = self._file.open_or_replace()
        owner = _claimed(connection_of(opened), self._map_id)
        if owner != self._map_id:
            opened.close()
            self._file.put_aside(Damage(f"it belongs to the map {owner!r}"))
            opened = self._file.open()
            _claimed(connection_of(opened), self._map_id)
        return opened


def _empty() -> sqlite3.Connection:
    connection = sqlite3.connect(":memory:", isolation_level=None)
    for statement in TABLES.create("sqlite"):
        connection.execute(statement)
    return connection


def _owner(connection: MapConnection) -> str | None:
    """The id of the map of a file; None if the file does not name it yet."""
    row = connection.one(_READ_OWNER)
    return None if row is None else str(row[0])


def _claimed(connection: MapConnection, map_id: str) -> str:
    """The id of the map of a file, which becomes ``map_id`` if the file names none."""
    connection.execute(_PUT_OWNER, id=map_id)
    return _owner(connection) or map_id


def _drop_unsound(connection: MapConnection) -> None:
    if numbers := unsound(connection):
        log.error("%d frames of %s do not match their checksums and are dropped", len(numbers), FILE)
        with transaction(driver_of(connection)):
            drop(connection, numbers)
