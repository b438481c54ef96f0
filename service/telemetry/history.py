"""The load of a service, minute by minute for a week: answers, their latencies, memory and disk.

It is for an operator's plots; Prometheus keeps longer histories.  The minute that is not over is in memory, so that a
crash loses it.  Services that share a ledger have rows of their own, which are put together when they are read.
"""

from __future__ import annotations

import logging
import os
import shutil
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

from sqlalchemy import Column, MetaData, Table, bindparam, delete, func, select
from sqlalchemy.sql.elements import ClauseElement

from core.disk.sqlite_file import DURABLE
from core.errors import StorageFull
from core.ledger import Ledger, Statement, Tables
from core.ledger.disposable import DisposableLedger, once_more_if_replaced
from core.ledger.sqlite import file_of
from core.ledger.statements import Insert, greatest, integer, real, text
from service.telemetry.latencies import LatencyCounts

FILE = "history.sqlite"

MINUTES = 7 * 24 * 60
"""Minutes that are stored."""

MOST_POINTS = 720
"""Points of time that are given at once, at most; each then stands for several minutes."""

ANSWERING = frozenset(
    {
        "/v1/maps/{map}/query",
        "/v1/maps/{map}/query:batch",
        "/v1/maps/{map}/query:enrol",
        "/v1/maps/{map}/sessions/{session}/frames",
        "/v1/query",
    }
)
"""Routes of the requests whose latencies count: those that answer where frames were taken."""


class LoadPoint(NamedTuple):
    """The load of some minutes.

    minute: the first of them, since 1970 in UTC.
    requests, errors: that asked where frames were taken, and how many of them were answered with 5xx.
    p50, p99: milliseconds, the mean of the minutes' medians and their highest; None without a request.
    resident: bytes of memory of all services together.
    disk_free, disk_total: bytes, of the disk that has least room.
    """

    minute: int
    recognized: int
    ambiguous: int
    unknown: int
    requests: int
    errors: int
    p50: float | None
    p99: float | None
    resident: int | None
    disk_free: int | None
    disk_total: int | None


_METADATA = MetaData()
_HISTORY = Table(
    "load_history", _METADATA,
    Column("minute", integer(), primary_key=True), Column("service", text(), primary_key=True),
    *(Column(name, integer(), nullable=False) for name in ("recognized", "ambiguous", "unknown", "requests", "errors")),
    Column("p50", real()), Column("p99", real()),
    *(Column(name, integer()) for name in ("resident", "disk_free", "disk_total")),
    sqlite_strict=True, sqlite_with_rowid=False,
)  # fmt: skip
TABLES = Tables("history", 1, _METADATA)

_C = _HISTORY.c
_NAMES = [column.name for column in _HISTORY.columns]


def _putting(insert: Insert) -> ClauseElement:
    """Add what was counted to the row of the minute, if it has one already."""
    put = insert(_HISTORY).values({name: bindparam(name) for name in _NAMES})
    new = put.excluded
    requests = _C.requests + new.requests
    medians = func.coalesce(_C.p50, 0.0) * _C.requests + func.coalesce(new.p50, 0.0) * new.requests
    longest = greatest(func.coalesce(_C.p99, new.p99), func.coalesce(new.p99, _C.p99))
    counts = {name: _C[name] + new[name] for name in ("recognized", "ambiguous", "unknown", "requests", "errors")}
    measured = {name: func.coalesce(new[name], _C[name]) for name in ("resident", "disk_free", "disk_total")}
    both = {"p50": medians / func.nullif(requests, 0), "p99": longest}
    return put.on_conflict_do_update(index_elements=["minute", "service"], set_={**counts, **both, **measured})


_PUT = Statement(_putting)
_DELETE = Statement(delete(_HISTORY).where(_C.minute < bindparam("oldest")))
_READ = Statement(
    select(_C.service, *(_C[name] for name in LoadPoint._fields))
    .where(_C.minute >= bindparam("oldest"), _C.minute <= bindparam("newest"))
    .order_by(_C.minute)
)

log = logging.getLogger("placerec.history")


@dataclass
class _Minute:
    """The counts of one minute."""

    number: int
    verdicts: Counter[str] = field(default_factory=Counter)
    latencies: LatencyCounts = field(default_factory=LatencyCounts)
    measured: tuple[int | None, int | None, int | None] = (None, None, None)  # memory, and free and all of the disk


class LoadHistory:
    """Counts the load of this service, and has the history of the load.  Thread-safe.

    Args:
        directory: the data directory, whose disk is watched.
        clock: seconds since 1970 in UTC.
    """

    def __init__(self, directory: Path, clock: Callable[[], float] = time.time) -> None:
        self._directory, self._clock = directory, clock
        self._lock, self._writing = threading.Lock(), threading.Lock()
        self._minutes = [_Minute(self._present())]
        self._ledger: Ledger | None = None
        self._service, self._shared = "", False
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="load history", daemon=True)

    def start(self, shared: Ledger | None = None, service: str = "") -> None:
        """Begin to write at the end of each minute.

        Args:
            shared: the ledger of several services, which has the ``TABLES``; None: one in the data directory.
            service: the name of this one among them.
        """
        self._service, self._shared = service, shared is not None
        self._ledger = history_file(self._directory) if shared is None else shared
        self._thread.start()

    def close(self) -> None:
        """Write the minute that is not over, and close the file."""
        self._stop.set()
        if self._thread.is_alive():
            self._thread.join()
        with suppress(Exception):
            self.write()
        if self._ledger is not None and not self._shared:
            self._ledger.close()

    # Counting

    def observe_answer(self, verdict: str) -> None:
        """Count an answer."""
        with self._lock:
            self._now().verdicts[verdict] += 1

    def observe_request(self, route: str, status: int, seconds: float) -> None:
        """Count a request, if it is one that asks where a frame was taken."""
        if route in ANSWERING:
            with self._lock:
                self._now().latencies.observe(seconds, status >= 500 or status == 0)

    def _present(self) -> int:
        return int(self._clock() // 60)

    def _now(self) -> _Minute:
        """The counts of this minute; the lock is held."""
        number = self._present()
        if self._minutes[-1].number != number:
            self._minutes.append(_Minute(number))
        return self._minutes[-1]

    # Writing and reading

    def write(self) -> None:
        """Write the minutes that are not written yet, and the present one as it stands.

        Raises:
            StorageFull, StorageFailure: the ledger refuses; the minutes stay in memory.
        """
        if self._ledger is None:
            return
        with self._writing:
            measured = (resident_memory(), *disk_of(self._directory))
            with self._lock:
                self._now().measured = measured
                taken, self._minutes = self._minutes, [_Minute(self._minutes[-1].number)]
            try:
                self._store([_point_of(one) for one in taken])
            except BaseException:
                with self._lock:
                    self._minutes = [*taken, *self._minutes][-2 * MINUTES :]
                raise

    @once_more_if_replaced
    def _store(self, rows: Sequence[LoadPoint]) -> None:
        assert self._ledger is not None
        with self._ledger.transaction("write down the load") as connection:
            connection.execute_many(_PUT, [{**row._asdict(), "service": self._service} for row in rows])
            connection.execute(_DELETE, oldest=rows[-1].minute - MINUTES)

    def _run(self) -> None:
        while not self._stop.wait(60 - self._clock() % 60):
            try:
                self.write()
            except Exception as error:
                log.error("the load of the service cannot be written: %s", error)

    def read(self, minutes: int) -> tuple[int, list[LoadPoint]]:
        """The load of the last minutes, of all services together.

        Args:
            minutes: how many, at most ``MINUTES``.

        Returns:
            How many minutes each point stands for, and the points in order, as far as there are any.

        Raises:
            StorageFull, StorageFailure: the ledger refuses, or cannot be reached.
        """
        with suppress(StorageFull):  # what has no room waits in memory, and is left out
            self.write()
        newest = self._present()
        step = -(-minutes // MOST_POINTS)
        return step, _points(self._read(newest - minutes + 1, newest), step)

    @once_more_if_replaced
    def _read(self, oldest: int, newest: int) -> list[_Row]:
        if self._ledger is None:
            return []
        found = self._ledger.execute("read the load", _READ, oldest=oldest, newest=newest)
        return [(service, LoadPoint(*values)) for service, *values in found]


def history_file(directory: Path) -> DisposableLedger:
    """The ledger of one data directory, which this process holds; a damaged file is put aside and made anew."""
    readable = ["SELECT minute FROM load_history LIMIT 0"]
    settings = {**DURABLE, "synchronous": "NORMAL", "journal_size_limit": 1 << 20}
    return DisposableLedger(file_of(directory / FILE, TABLES, settings, readable, check_whole=False))


def _point_of(minute: _Minute) -> LoadPoint:
    found, verdicts = minute.latencies, minute.verdicts
    p50, p99 = (1e3 * found.quantile(share) if found.count else None for share in (0.5, 0.99))
    counts = verdicts["recognized"], verdicts["ambiguous"], verdicts["unknown"], found.count, found.errors
    return LoadPoint(minute.number, *counts, p50, p99, *minute.measured)


_Row = tuple[str, LoadPoint]
"""A minute of one service, by its name."""


def _points(rows: Iterable[_Row], step: int) -> list[LoadPoint]:
    groups: dict[int, list[_Row]] = {}
    for row in rows:
        groups.setdefault(row[1].minute // step * step, []).append(row)
    return [_together(minute, group) for minute, group in groups.items()]


def _together(minute: int, rows: Sequence[_Row]) -> LoadPoint:
    """The load of some minutes of some services as one, which begins at a minute."""
    points = [point for _, point in rows]
    requests = sum(one.requests for one in points)
    medians = [(one.p50, one.requests) for one in points if one.p50 is not None]
    latest = {service: point for service, point in rows if point.resident is not None}.values()
    disks = [(one.disk_free, one.disk_total) for one in latest if one.disk_free is not None]
    free, total = min(disks, default=(None, None))
    return LoadPoint(
        minute,
        sum(one.recognized for one in points),
        sum(one.ambiguous for one in points),
        sum(one.unknown for one in points),
        requests,
        sum(one.errors for one in points),
        sum(value * count for value, count in medians) / requests if medians else None,
        max((one.p99 for one in points if one.p99 is not None), default=None),
        sum(one.resident or 0 for one in latest) if latest else None,
        free,
        total,
    )


def resident_memory() -> int | None:
    """The memory of this process in bytes; None where the system does not report it."""
    with suppress(OSError, ValueError, IndexError):
        return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")
    return None


def disk_of(directory: Path) -> tuple[int | None, int | None]:
    """The free bytes and the size of the disk of a directory; None where that is not known."""
    with suppress(OSError):
        usage = shutil.disk_usage(directory)
        return usage.free, usage.total
    return None, None
