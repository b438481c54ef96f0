"""Frames that a map in a data directory stores for review, in a small SQLite file of their own in the map's folder.

They go with the map.  A frame whose row does not match its checksum is dropped when the file is opened, and a file that
cannot be read is put aside and made anew: neither harms the map.
"""

from __future__ import annotations

import logging
import sqlite3
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from core.disk.files import Damage, disk_errors
from core.disk.sqlite_file import DURABLE, transaction
from core.errors import StorageFailure
from core.ledger import Tables
from core.ledger.maps.connection import MapConnection
from core.ledger.maps.review import METADATA, ReviewTable, drop, unsound
from core.ledger.sqlite import file_of
from core.maps.records import ReviewSetting
from core.storage.database.schema import connection_of, driver_of

FILE = "review.sqlite"

TABLES = Tables("review", 2, METADATA, application_id=0x504C5256)  # "PLRV"
_SETTINGS = {"auto_vacuum": "INCREMENTAL", **DURABLE, "journal_size_limit": 1 << 20}

log = logging.getLogger(__name__)


class ReviewFrames(ReviewTable):
    """The frames of one map that are stored for review (:class:`core.maps.review.Review`).

    Any thread may use it; the file is made with the first frame.  Every method may raise StorageFull and
    StorageFailure.

    Args:
        path: of the file.
        expect_open: raises if the map is closed, deleted or damaged.
    """

    def __init__(self, path: Path, expect_open: Callable[[], object]) -> None:
        super().__init__()
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

    @contextmanager
    def _reading(self) -> Iterator[MapConnection]:
        with self._using() as connection:  # nobody writes meanwhile
            yield connection

    @contextmanager
    def _writing(self) -> Iterator[MapConnection]:
        with self._using(create=True) as connection, transaction(driver_of(connection)):
            yield connection

    @contextmanager
    def _using(self, create: bool = False) -> Iterator[MapConnection]:
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
            self._connection = self._file.open_or_replace()
            _drop_unsound(connection_of(self._connection))
        return self._connection


def _empty() -> sqlite3.Connection:
    connection = sqlite3.connect(":memory:", isolation_level=None)
    for statement in TABLES.create("sqlite"):
        connection.execute(statement)
    return connection


def _drop_unsound(connection: MapConnection) -> None:
    if numbers := unsound(connection):
        log.error("%d frames of %s do not match their checksums and are dropped", len(numbers), FILE)
        with transaction(driver_of(connection)):
            drop(connection, numbers)
