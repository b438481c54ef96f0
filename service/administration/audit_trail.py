"""Where the lines of the audit trail go, and from where they are read again.

A file with one JSON object a line, or the latest lines in memory, without PostgreSQL; with it, one table of all
services.  It is no table in both: operators move the file away, compress it, ship it, and keep it where the service's
host cannot rewrite it, which no database in the data directory allows.
"""

from __future__ import annotations

import json
import logging
import shutil
import threading
from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from datetime import datetime
from io import TextIOWrapper
from logging.handlers import WatchedFileHandler
from pathlib import Path
from typing import BinaryIO, ClassVar, Literal, Protocol

from sqlalchemy import Column, MetaData, Table, bindparam, delete, select

from core.disk.files import disk_errors, replacing
from core.disk.permissions import open_private
from core.errors import StorageFailure, StorageFull
from core.ledger import Ledger, Statement, Tables
from core.ledger.statements import among, integer, text
from service.access.audit import LOGGER
from service.administration.audit_lines import AuditLine, Position, lines_of_files
from service.telemetry.requests import JsonLines

RECENT_LINES = 1000
"""Lines that are held in memory while there is no file."""

MOST_WAITING = 10_000
"""Lines that wait for PostgreSQL; while it is away, the oldest ones beyond that are in the log alone."""

RETRY_SECONDS = 1.0
LINES_AT_ONCE = 500

_METADATA = MetaData()
_AUDIT = Table(
    "audit",
    _METADATA,
    Column("number", integer(), primary_key=True, autoincrement=True),
    Column("replica", text(), nullable=False),
    Column("line", text(), nullable=False),  # a JSON object
)
TABLES = Tables("audit", 1, _METADATA)

_ADD = Statement(lambda insert: insert(_AUDIT).values(replica=bindparam("replica"), line=bindparam("line")))
_OLDEST = Statement(select(_AUDIT.c.number, _AUDIT.c.line).order_by(_AUDIT.c.number).limit(bindparam("at_most")))
_FORGET = Statement(delete(_AUDIT).where(among(_AUDIT.c.number, "numbers")))
_LATEST = Statement(
    select(_AUDIT)
    .where(_AUDIT.c.number < bindparam("before"))
    .order_by(_AUDIT.c.number.desc())
    .limit(bindparam("at_most"))
)

Source = Literal["database", "file", "memory"]

log = logging.getLogger("placerec.shared")


class AuditTrail(Protocol):
    """Lines that were written, to be read again."""

    source: ClassVar[Source]

    def lines(self, before: Position | None) -> Iterator[AuditLine]:
        """The lines from the latest to the oldest, before one of them; None: all.

        Raises:
            StorageFailure: the file or the database cannot be read.
        """

    def forget_before(self, moment: datetime) -> None:
        """Drop the lines from before a moment; files that were moved away stay, for they are their movers'.

        Raises:
            StorageFull, StorageFailure: the file or the database cannot be written.
        """


@contextmanager
def audit_trail(path: Path | None) -> Iterator[AuditTrail]:
    """The trail of this service alone, which is written as long as the block runs.

    Args:
        path: of the file to which it is appended; if that is moved away, a new one is created.  None: the latest lines
            are held in memory.

    Raises:
        StorageFailure: the file cannot be opened.
    """
    trail = AuditMemory() if path is None else AuditFile(path)
    attach(trail)
    try:
        yield trail
    finally:
        detach(trail)


def attach(handler: logging.Handler) -> None:
    """Write the trail to a handler, too, as JSON."""
    handler.setFormatter(JsonLines())
    audit = logging.getLogger(LOGGER)
    audit.addHandler(handler)
    audit.setLevel(logging.INFO)  # whatever level the other logs have


def detach(handler: logging.Handler) -> None:
    """Write no more to a handler, and close it."""
    logging.getLogger(LOGGER).removeHandler(handler)
    handler.close()


class AuditFile(WatchedFileHandler):
    """A file, and those that were moved away from its name."""

    source: ClassVar[Source] = "file"

    def __init__(self, path: Path) -> None:
        self.path = path
        try:
            super().__init__(path, encoding="utf-8")
        except OSError as error:
            raise StorageFailure(f"The audit file {path} cannot be opened: {error.strerror}.") from error

    def _open(self) -> TextIOWrapper:
        """The file, which is made for this user alone if it is missing."""
        return open(self.baseFilename, "a", encoding=self.encoding, opener=open_private)

    def lines(self, before: Position | None) -> Iterator[AuditLine]:
        return lines_of_files(self.path, before)

    def forget_before(self, moment: datetime) -> None:
        """Write the file anew from its first line that is late enough; nothing is written if that is its first."""
        with self.lock or nullcontext(), disk_errors("shorten the audit trail", self.path.name):
            try:
                old = self.path.open("rb")
            except FileNotFoundError:
                return
            with old:
                start = _first_from(old, moment)
                if start == 0:
                    return
                old.seek(start)
                with replacing(self.path) as temporary, temporary.open("wb") as new:
                    shutil.copyfileobj(old, new)


class AuditMemory(logging.Handler):
    """The latest lines, as they would be written to a file."""

    source: ClassVar[Source] = "memory"

    def __init__(self) -> None:
        super().__init__()
        self._lines: deque[str] = deque(maxlen=RECENT_LINES)
        self._written = 0

    def emit(self, record: logging.LogRecord) -> None:
        self._lines.append(self.format(record))
        self._written += 1

    def lines(self, before: Position | None) -> Iterator[AuditLine]:
        with self.lock or nullcontext():
            lines, written = list(self._lines), self._written
        for back, line in enumerate(reversed(lines)):
            if before is None or written - back < before.offset:
                yield AuditLine(Position(0, written - back), len(line), json.loads(line))

    def forget_before(self, moment: datetime) -> None:
        """Drop the lines from before a moment."""
        with self.lock or nullcontext():
            while self._lines and _is_before(self._lines[0], moment):
                self._lines.popleft()


class AuditTable(logging.Handler):
    """The trail of all services in their ledger; a thread writes the lines of this one, so that no request waits.

    Args:
        replica: the id of this service, which its lines carry.
    """

    source: ClassVar[Source] = "database"

    def __init__(self, ledger: Ledger, replica: str) -> None:
        super().__init__()
        self._ledger, self._replica = ledger, replica
        self._waiting: deque[str] = deque()
        self._new, self._stopping = threading.Event(), False
        self.lost = 0
        self._thread = threading.Thread(target=self._write_on, name="audit", daemon=True)

    def start(self) -> None:
        """Begin to take lines."""
        self._thread.start()
        attach(self)

    def close(self) -> None:
        """Write the lines that wait, if the ledger takes them."""
        self._stopping = True
        self._new.set()
        if self._thread.is_alive():
            self._thread.join(10)
        super().close()

    def emit(self, record: logging.LogRecord) -> None:
        self._waiting.append(self.format(record))
        while len(self._waiting) > MOST_WAITING:
            self._waiting.popleft()
            self.lost += 1
        self._new.set()

    def _write_on(self) -> None:
        while not self._stopping:
            self._new.wait()
            self._new.clear()
            while self._waiting:
                try:
                    self._write()
                except (StorageFull, StorageFailure) as error:
                    log.warning("the audit trail cannot be written: %s", error, extra={"lost": self.lost})
                    if self._stopping:
                        return
                    threading.Event().wait(RETRY_SECONDS)

    def _write(self) -> None:
        taken = [self._waiting.popleft() for _ in range(min(len(self._waiting), LINES_AT_ONCE))]
        try:
            with self._ledger.transaction("write the audit trail") as connection:
                connection.execute_many(_ADD, [{"replica": self._replica, "line": line} for line in taken])
        except BaseException:
            self._waiting.extendleft(reversed(taken))
            raise

    def lines(self, before: Position | None) -> Iterator[AuditLine]:
        reached = (1 << 63) - 1 if before is None else before.offset
        while found := self._ledger.execute("read the audit trail", _LATEST, before=reached, at_most=LINES_AT_ONCE):
            for number, replica, line in found:
                yield AuditLine(Position(0, number), len(line), {**json.loads(line), "replica": replica})
            reached = found[-1][0]

    def forget_before(self, moment: datetime) -> None:
        """Drop the lines of all services from before a moment."""
        while True:
            found = self._ledger.execute("read the audit trail", _OLDEST, at_most=LINES_AT_ONCE)
            old = [number for number, line in found if _is_before(line, moment)]
            if old:
                self._ledger.change("shorten the audit trail", _FORGET, numbers=old)
            if len(old) < LINES_AT_ONCE:
                return


def _is_before(line: str | bytes, moment: datetime) -> bool:
    """Whether a line says that it is from before a moment; one that cannot be read is as old as those beside it."""
    try:
        return datetime.fromisoformat(json.loads(line)["time"]) < moment
    except (ValueError, TypeError, KeyError):
        return True


def _first_from(file: BinaryIO, moment: datetime) -> int:
    """Where the first line begins that is not from before a moment; the end of the file if there is none."""
    at = 0
    for line in file:
        if line.endswith(b"\n") and not _is_before(line, moment):
            return at
        at += len(line)
    return at
