"""One map as an SQLite file: its connections, one that writes and as many as needed that read.

In WAL mode readers see the last commit and never wait for the writer.  With ``synchronous=FULL`` a COMMIT returns when
the log is synced; SQLite also syncs the folder when it creates the log.
"""

from __future__ import annotations

import shutil
import sqlite3
import threading
from collections import OrderedDict
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import cache
from pathlib import Path

from core.disk import sqlite_file
from core.disk.files import Damage, disk_errors, is_full, sync_file, sync_folder
from core.disk.permissions import PRIVATE_FOLDER
from core.disk.sqlite_file import DURABLE, NotOurs, Schema, UnreadVersion, rewrite, transaction
from core.disk.write_ahead_log import check_log
from core.errors import MapBusy
from core.ledger.maps import record
from core.ledger.maps.connection import MapConnection
from core.ledger.maps.record import MapState
from core.ledger.maps.schema import TABLES
from core.ledger.sqlite import SqliteConnection
from core.maps.records import MapRecord
from core.store.database import Closed

FILE = "map.sqlite"

SCARCE_BYTES = 256 << 20
"""Where the disk has less room than this, files are made smaller when something was deleted from them."""

_PAGES_AT_ONCE = 128
_IDLE_READERS = 4
_LOG_BYTES = 64 << 20  # a log that a large batch made longer is cut to this size
_SETTINGS = {
    **DURABLE,
    "secure_delete": "ON",
    "temp_store": "MEMORY",
    "journal_size_limit": _LOG_BYTES,
}
_NEW = {"page_size": 8192, "auto_vacuum": "INCREMENTAL", **_SETTINGS}  # fixed when a file gets its first table
_SCHEMA = Schema(TABLES.application_id, TABLES.version, TABLES.create("sqlite"))


def connection_of(driver: sqlite3.Connection) -> MapConnection:
    """The connection to the only map of a file."""
    return MapConnection(SqliteConnection(driver), 1)


def create(folder: Path, made: MapRecord) -> None:
    """Make a folder with an empty map in it, durable except for the folder's own name.

    Raises:
        OSError, sqlite3.Error: the disk refuses.
    """
    folder.mkdir(PRIVATE_FOLDER)
    driver = sqlite_file.connect(folder / FILE, "rwc", _NEW)
    try:
        _SCHEMA.prepare(driver, create=True)
        with transaction(driver):
            record.create(SqliteConnection(driver), made)
    finally:
        driver.close()  # SQLite moves its log into the file and deletes it
    sync_file(folder / FILE)
    sync_folder(folder)


class OpenFiles:
    """The files that are open: beyond a number, those that were not used for the longest time are closed.

    Any thread may use it.

    Args:
        most: files that are open together, unless more are in use.
    """

    def __init__(self, most: int) -> None:
        self.most = most
        self._lock = threading.Lock()
        self._files: OrderedDict[MapFile, None] = OrderedDict()

    def __len__(self) -> int:
        return len(self._files)

    def note(self, file: MapFile) -> None:
        """Note the use of a file that is open, and close others for it."""
        going: list[MapFile] = []
        with self._lock:
            self._files[file] = None
            self._files.move_to_end(file)
            while len(self._files) > self.most:
                going.append(self._files.popitem(last=False)[0])
        in_use = [other for other in going if other is not file and not other.rest()]
        with self._lock:
            for other in in_use:
                self._files.setdefault(other)

    def touch(self, file: MapFile) -> None:
        """Note the use of what is in memory of a file, if it is open."""
        with self._lock:
            if file in self._files:
                self._files.move_to_end(file)

    def drop(self, file: MapFile) -> None:
        """Note that a file is closed."""
        with self._lock:
            self._files.pop(file, None)


class MapFile:
    """The file of one map (:class:`core.store.database.MapDatabase`), which is opened when it is first used.

    Args:
        folder: that it is in.
        open_files: of all maps.
        rested: is called when the file was closed because others are used more.
    """

    name, shared = FILE, False

    def __init__(self, folder: Path, open_files: OpenFiles, rested: Callable[[], None] = lambda: None) -> None:
        self.folder, self.path = folder, folder / FILE
        self._open_files, self.rested = open_files, rested
        self._lock = threading.RLock()  # held while the map is written to
        self._condition = threading.Condition()
        self._opening = threading.Lock()
        self._writer: sqlite3.Connection | None = None
        self._idle: list[sqlite3.Connection] = []
        self._using = 0
        self._closed = self._checked = self._doubtful = False

    # Connections

    def _connected(self) -> sqlite3.Connection:
        """A new connection; the first one checks the file.

        Raises:
            DataDirectoryTooNew, DataDirectoryTooOld: it is of a version that is not read.
            Damage: it is not the database of a map.
            OSError, sqlite3.Error: it cannot be read.
        """
        if self._checked:
            return sqlite_file.connect(self.path, settings=_SETTINGS)
        with self._opening:
            if not self.path.is_file():
                self.folder.stat()  # a folder that cannot be reached is no damage: its disk may come back
                raise Damage(f"{FILE} is missing")
            check_log(self.path.with_name(f"{FILE}-wal"))
            driver = sqlite_file.connect(self.path, settings=_SETTINGS)
            try:
                prepare(driver, str(self.path))
                with suppress(OSError):  # the name of SQLite's log, of which the first write makes sure
                    sync_folder(self.folder)
            except BaseException:
                driver.close()
                raise
            self._checked = True
            return driver

    @contextmanager
    def _used(self) -> Iterator[None]:
        with self._condition:
            if self._closed:
                raise Closed
            self._using += 1
        try:
            yield
        finally:
            with self._condition:
                self._using -= 1
                self._condition.notify_all()
        self._open_files.note(self)

    @contextmanager
    def _reader(self, action: str) -> Iterator[sqlite3.Connection]:
        with self._used(), disk_errors(f"{action} map {self.folder.name!r}", FILE):
            with self._condition:
                driver = self._idle.pop() if self._idle else None
            driver = driver or self._connected()
            try:
                yield driver
            finally:
                # A connection within a transaction would see the moment of its beginning for ever.
                with self._condition:
                    keep = not driver.in_transaction and len(self._idle) < _IDLE_READERS
                    if keep:
                        self._idle.append(driver)
                if not keep:
                    driver.close()

    @contextmanager
    def glancing(self) -> Iterator[MapConnection]:
        """A connection for single statements, each of which sees its own moment."""
        with self._reader("read") as driver:
            yield connection_of(driver)

    @contextmanager
    def reading(self) -> Iterator[MapConnection]:
        """A transaction that sees the moment of its first statement."""
        with self._reader("read") as driver:
            driver.execute("BEGIN")
            try:
                yield connection_of(driver)
            finally:
                if driver.in_transaction:  # SQLite ends some transactions itself, when the disk fails
                    driver.execute("ROLLBACK")

    fresh = reading

    @contextmanager
    def paused(self) -> Iterator[None]:
        """Nobody but this thread writes to the map during the block."""
        with self._lock:
            yield

    @contextmanager
    def writing(self, alone: bool = True) -> Iterator[MapConnection]:
        """A transaction that is synced at the end of the block, and undone if it raises."""
        with self._lock, self._used(), disk_errors(f"write to map {self.folder.name!r}", FILE):
            if self._writer is None:
                self._writer = self._connected()
                sqlite_file.expect_writable(self._writer)
                sync_folder(self.folder)
            driver, committing = self._writer, False
            if self._doubtful:
                self._empty_log(driver)
            driver.execute("BEGIN IMMEDIATE")
            try:
                yield connection_of(driver)
                committing = True
                driver.execute("COMMIT")
            except BaseException as error:
                with suppress(sqlite3.Error):  # the first error is the one to report
                    if driver.in_transaction:
                        driver.execute("ROLLBACK")
                # A COMMIT that found no room has not written the end of its transaction.
                found_no_room = isinstance(error, sqlite3.Error) and is_full(error)
                self._doubtful |= committing and not found_no_room
                if self._doubtful or found_no_room:  # the log takes up room, too
                    with suppress(OSError, sqlite3.Error, MapBusy):
                        self._empty_log(driver)
                raise

    def _empty_log(self, driver: sqlite3.Connection) -> None:
        """Move all of the log into the file.

        After a COMMIT that failed while the log was being synced, it is undone in memory, but its frames may have
        reached the disk, from where SQLite would replay them after a crash; so no write begins before the log is empty.

        Raises:
            MapBusy: readers keep the log from being emptied.
            OSError, sqlite3.Error: it could not be emptied.
        """
        (busy, _, _) = driver.execute("PRAGMA wal_checkpoint(TRUNCATE)").fetchone()
        if busy:
            raise MapBusy("The map is being read, by an export or a check: try again later.")
        sync_file(self.path.with_name(f"{FILE}-wal"))  # or a power cut could restore its former content
        self._doubtful = False

    def touch(self) -> None:
        """Note that the map is used, whether or not that needs its file."""
        self._open_files.touch(self)

    def rest(self) -> bool:
        """Close the file until its next use; False if it is in use, or would come back with a write that was undone."""
        if not self._lock.acquire(blocking=False):
            return False
        try:
            with self._condition:
                if self._using or self._doubtful:
                    return False
                self._close_connections()
                self._open_files.drop(self)
        finally:
            self._lock.release()
        self.rested()
        return True

    def close(self) -> None:
        """Wait for reads and the write under way, refuse further ones, and close the file.

        No connection may be open when the file gets another name: SQLite deletes the log by its path when the last
        connection closes, and that path may belong to a new map by then.
        """
        with self._condition:
            self._closed = True
            self._condition.wait_for(lambda: self._using == 0)
            self._close_connections()
        self._open_files.drop(self)

    def _close_connections(self) -> None:
        for driver in [*self._idle, *([] if self._writer is None else [self._writer])]:
            driver.close()
        self._idle.clear()
        self._writer, self._checked = None, False

    # The map

    def state(self) -> MapState:
        """The state of the map.

        Raises:
            Damage: it is not a map, or another one than its folder says.
        """
        with self.glancing() as connection:
            return record.state_of(connection, self.folder.name)

    def room(self) -> int:
        """The bytes of the file and its log."""
        return sum(one.stat().st_size for one in self.folder.iterdir())

    def erase(self) -> int:
        """Rewrite the file without what was deleted from it, and empty the log; the bytes by which it got smaller.

        This takes as much room on the disk again as the file has.
        """
        with self._lock:  # nobody closes the file in between
            with self.writing():
                pass  # opens the file, and makes sure of its log
            with self._used(), disk_errors(f"erase deleted places of map {self.folder.name!r}", FILE):
                assert self._writer is not None
                before = self.path.stat().st_size
                rewrite(self._writer, self.folder)
                self._writer.execute("PRAGMA temp_store = MEMORY")
                self._empty_log(self._writer)
                return max(0, before - self.path.stat().st_size)

    def give_back(self) -> None:
        """Make the file smaller by what was deleted from it, and empty the log, where the disk has little room left."""
        if shutil.disk_usage(self.folder).free >= SCARCE_BYTES:
            return
        with self._lock, self._used(), disk_errors(f"make map {self.folder.name!r} smaller", FILE):
            if (driver := self._writer) is None:  # it was closed meanwhile
                return
            before = -1
            self._empty_log(driver)
            while (left := driver.execute("PRAGMA freelist_count").fetchone()[0]) not in (0, before):
                driver.executescript(f"PRAGMA incremental_vacuum({_PAGES_AT_ONCE})")  # execute() would free one page
                self._empty_log(driver)
                before = left

    def check(self, *tables: str) -> list[str]:
        """What SQLite finds damaged in some tables; none: in the whole file."""
        with self._reader("read") as driver:
            checks = [f"PRAGMA integrity_check({table})" for table in tables] or ["PRAGMA integrity_check"]
            return [line for check in checks for (line,) in driver.execute(check) if line != "ok"]


def prepare(driver: sqlite3.Connection, file: str = FILE) -> None:
    """Check that a file has the tables of a map with their columns.

    Args:
        file: its name in a refusal.

    Raises:
        DataDirectoryTooNew: a later version of placerec wrote the file.
        DataDirectoryTooOld: an earlier version did.
        Damage: it is not the database of a map, or lacks some of its tables.
    """
    try:
        _SCHEMA.prepare(driver)
    except NotOurs as error:
        raise Damage(f"{FILE} is not one of placerec's databases") from error
    except UnreadVersion as error:
        if _columns(driver) == _expected():
            raise Damage(f"{FILE} says that it is of schema {error.version}, but its tables are of this one") from error
        raise error.refusal(file) from error
    found = _columns(driver)
    for table, columns in _expected().items():
        if missing := columns - found.get(table, set()):
            raise Damage(f"{FILE} lacks {', '.join(sorted(missing))} of its table {table!r}")


def _columns(driver: sqlite3.Connection) -> dict[str, set[str]]:
    query = (
        "SELECT tables.name, columns.name FROM sqlite_schema AS tables, pragma_table_info(tables.name) AS columns"
        " WHERE tables.type = 'table'"
    )
    found: dict[str, set[str]] = {}
    for table, column in driver.execute(query).fetchall():
        found.setdefault(table, set()).add(column)
    return found


@cache
def _expected() -> dict[str, set[str]]:
    driver = sqlite3.connect(":memory:", isolation_level=None)
    try:
        _SCHEMA.prepare(driver, create=True)
        return _columns(driver)
    finally:
        driver.close()
