"""Statistics of the answers of each map, by place, by week and by hour.

Answers are counted in memory and written at intervals, so that no query waits for the ledger; a crash loses the counts
since the last writing.  Services that share a ledger add their counts to the same rows, which are the sums of all.  The
tables are bounded: they have one row for each place, and each week of some years, of a map.
"""

from __future__ import annotations

import logging
import threading
from collections import Counter
from collections.abc import Callable, Mapping
from contextlib import suppress
from datetime import UTC, date, datetime, timedelta
from pathlib import Path
from typing import Any, Final

from sqlalchemy import Column, ForeignKey, MetaData, Table, UniqueConstraint, bindparam, delete, func, select
from sqlalchemy.sql import Select
from sqlalchemy.sql.elements import ClauseElement, ColumnElement

from core.disk.sqlite_file import DURABLE
from core.errors import PlacerecError, UnknownMap
from core.judgement.verdict import Verdict
from core.ledger import Connection, Ledger, Statement, Tables
from core.ledger.disposable import DisposableLedger, once_more_if_replaced
from core.ledger.sqlite import file_of
from core.ledger.statements import Insert, among, greatest, integer, real, text
from core.maps import Map
from core.upkeep.drift import SCORE_BINS, Week
from service.engine.engine import Engine
from service.queries.counts import AnswerCounts, HourCount, PlaceCount, Statistics, VerdictCounts, hour_of, monday_of
from service.queries.given_answers import MapKey
from service.queries.recent_answers import RecentAnswers

FILE = "statistics.sqlite"

MOST_WEEKS = 260
"""How many weeks of a map are stored."""

HOURS = 24
"""The hours of the last day, which are counted one by one."""

MOST_WAITING = 50_000
"""How many places may have counts that are not written yet; while the ledger refuses, further counts are lost."""

SPARE_PLACES = 1000
"""Counts of deleted places are removed once a map has this many more counted places than places."""

SHARED_SECONDS = 2.0
"""A ledger that services share gets their counts and answers at least so often, for each shows those of all."""

READ, WRITE = "read the statistics of queries", "write down the statistics of queries"

log = logging.getLogger("placerec.statistics")


# Tables

_METADATA = MetaData()
_FORMS: Final[Mapping[str, Any]] = {"sqlite_strict": True, "sqlite_with_rowid": False}


def _map() -> Column[int]:
    return Column("map", integer(), ForeignKey("counted_maps.code", ondelete="CASCADE"), primary_key=True)


def _numbers(*names: str) -> list[Column[int]]:
    return [Column(name, integer(), nullable=False) for name in names]


_MAPS = Table(
    "counted_maps",
    _METADATA,
    Column("code", integer(), primary_key=True, autoincrement=True),
    Column("id", text(), nullable=False),
    Column("made", text(), nullable=False),
    Column("since", text(), nullable=False),
    UniqueConstraint("id", "made"),
    sqlite_strict=True,
)
_PLACES = Table(
    "place_counts",
    _METADATA,
    _map(),
    Column("id", text(), primary_key=True),
    *_numbers("best", "recognized"),
    Column("last", text(), nullable=False),
    **_FORMS,
)
_WEEKS = Table(
    "week_counts",
    _METADATA,
    _map(),
    Column("monday", text(), primary_key=True),
    *_numbers("recognized", "ambiguous", "unknown", "blank"),
    *(Column(name, real(), nullable=False) for name in ("score", "score_squares", "decision", "decision_squares")),
    *_numbers(*(f"bin{number}" for number in range(SCORE_BINS))),
    **_FORMS,
)
_HOURS = Table(
    "hour_counts",
    _METADATA,
    _map(),
    Column("hour", integer(), primary_key=True),
    *_numbers("recognized", "ambiguous", "unknown"),
    **_FORMS,
)
_CALIBRATIONS = Table(
    "calibrations",
    _METADATA,
    _map(),
    *(Column(name, text(), nullable=False) for name in ("at", "report", "trials")),
    **_FORMS,
)
TABLES = Tables("statistics", 3, _METADATA)


# Statements

_OF_MAP = _MAPS.c.id == bindparam("id"), _MAPS.c.made == bindparam("made")


def _adding(table: Table) -> Statement:
    """Add counts to those of a row, which is made if it is missing; of a moment the later one stays."""
    keys = [column.name for column in table.primary_key]

    def sum_of(column: ColumnElement[Any], counted: ColumnElement[Any]) -> ColumnElement[Any]:
        return greatest(column, counted) if column.name == "last" else column + counted

    def made(insert: Insert) -> ClauseElement:
        put = insert(table).values({column.name: bindparam(column.name) for column in table.columns})
        sums = {each.name: sum_of(each, put.excluded[each.name]) for each in table.columns if each.name not in keys}
        return put.on_conflict_do_update(index_elements=keys, set_=sums)

    return Statement(made)


def _oldest_week() -> Select[Any]:
    """The Monday of the first week that is one too many."""
    ordered = select(_WEEKS.c.monday).where(_WEEKS.c.map == bindparam("code")).order_by(_WEEKS.c.monday.desc())
    return ordered.limit(1).offset(bindparam("most")).correlate(None)


def _hours_of(*only: ColumnElement[bool]) -> Statement:
    counts = _HOURS.c.recognized, _HOURS.c.ambiguous, _HOURS.c.unknown
    return Statement(
        select(_MAPS.c.id, _MAPS.c.made, _HOURS.c.hour, *counts)
        .join_from(_HOURS, _MAPS)
        .where(_HOURS.c.hour >= bindparam("oldest"), *only)
    )


# The row of the map is written either way, and so locked until the transaction ends.
_CODE = Statement(
    lambda insert: (
        insert(_MAPS)
        .values(id=bindparam("id"), made=bindparam("made"), since=bindparam("since"))
        .on_conflict_do_update(index_elements=["id", "made"], set_={"since": _MAPS.c.since})
        .returning(_MAPS.c.code)
    )
)
_COUNTED_MAPS = Statement(select(_MAPS.c.code, _MAPS.c.id, _MAPS.c.made))
_DELETE_MAP = Statement(delete(_MAPS).where(_MAPS.c.code == bindparam("code")))
_ADD_PLACE, _ADD_WEEK, _ADD_HOUR = _adding(_PLACES), _adding(_WEEKS), _adding(_HOURS)
_DELETE_HOURS = Statement(
    delete(_HOURS).where(_HOURS.c.map == bindparam("code"), _HOURS.c.hour < bindparam("oldest"))
)
_DELETE_WEEKS = Statement(
    delete(_WEEKS).where(_WEEKS.c.map == bindparam("code"), _WEEKS.c.monday <= _oldest_week().scalar_subquery())
)
_COUNT_PLACES = Statement(select(func.count()).select_from(_PLACES).where(_PLACES.c.map == bindparam("code")))
_DELETE_PLACES = Statement(
    delete(_PLACES).where(_PLACES.c.map == bindparam("code"), ~among(_PLACES.c.id, "present"))
)
_MAP = Statement(select(_MAPS.c.code, _MAPS.c.since).where(*_OF_MAP))
_COUNTS = _PLACES.c.best, _PLACES.c.recognized, _PLACES.c.last
_PLACES_OF_MAP = Statement(select(_PLACES.c.id, *_COUNTS).where(_PLACES.c.map == bindparam("code")))
_PLACE = Statement(
    select(*_COUNTS).join_from(_PLACES, _MAPS).where(*_OF_MAP, _PLACES.c.id == bindparam("place"))
)
_WEEKS_OF_MAP = Statement(
    select(*_WEEKS.columns[1:]).where(_WEEKS.c.map == bindparam("code")).order_by(_WEEKS.c.monday)
)
_LAST_HOURS, _LAST_HOURS_OF_MAP = _hours_of(), _hours_of(*_OF_MAP)
_PUT_CALIBRATION = Statement(
    lambda insert: (
        (put := insert(_CALIBRATIONS).values({column.name: bindparam(column.name) for column in _CALIBRATIONS.columns}))
        .on_conflict_do_update(
            index_elements=["map"], set_={name: put.excluded[name] for name in ("at", "report", "trials")}
        )
    )
)  # fmt: skip
_CALIBRATION = Statement(
    select(_CALIBRATIONS.c.at, _CALIBRATIONS.c.report, _CALIBRATIONS.c.trials)
    .join_from(_CALIBRATIONS, _MAPS)
    .where(*_OF_MAP)
)


def statistics_file(directory: Path) -> DisposableLedger:
    """The ledger of one data directory, which this process holds; a damaged file is put aside and made anew."""
    # A crash may lose the last counts, but never damages the file.
    settings = {**DURABLE, "synchronous": "NORMAL", "foreign_keys": "ON", "journal_size_limit": 1 << 20}
    readable = ["SELECT last FROM place_counts LIMIT 0"]
    return DisposableLedger(file_of(directory / FILE, TABLES, settings, readable, check_whole=False))


def map_key(map_: Map) -> MapKey:
    """The key of a map in the statistics."""
    return map_.record.id, map_.record.created_at.isoformat()


class QueryStatistics:
    """Counts the answers of all maps.  Thread-safe.

    Every method that reads may raise StorageFull or StorageFailure: the ledger refuses, or cannot be reached.

    Args:
        ledger: has the ``TABLES``.
        seconds: the interval between two writings.
        sizes: returns the number of places of every map; the counts of other maps are deleted.  It returns None while
            this is not known.
        present: returns the ids of the places of a map.
        shared: whether other services use the ledger too.  It has the latest answers then, and is not closed here.
    """

    def __init__(
        self,
        ledger: Ledger,
        seconds: float,
        sizes: Callable[[], Mapping[MapKey, int] | None],
        present: Callable[[str], set[str]],
        shared: bool = False,
    ) -> None:
        self._ledger, self._shared = ledger, shared
        self._seconds = min(seconds, SHARED_SECONDS) if shared else seconds
        self._sizes, self._present = sizes, present
        self._lock = threading.Lock()
        self._counts: dict[MapKey, AnswerCounts] = {}
        self._waiting = 0
        self.recent = RecentAnswers(ledger if shared else None)
        """The latest answers."""
        self.lost = 0
        """How many counts were dropped because the ledger refuses."""
        self._writing = threading.Lock()  # held while counts are on their way from memory to the ledger
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="statistics", daemon=True)

    @classmethod
    def of_engine(cls, engine: Engine, shared: Ledger | None = None) -> QueryStatistics:
        """The statistics of all maps of an engine.

        Args:
            shared: the ledger of several services; None: this one has its own, in its data directory.
        """

        def sizes() -> dict[MapKey, int] | None:
            if engine.maps.quarantined():
                return None  # a map that is quarantined may come back
            found = {}
            try:
                records = engine.all_records()
            except PlacerecError:
                return None
            for record in records:
                try:
                    map_ = engine.maps.find(record.id)
                except UnknownMap:
                    continue  # the map was deleted since it was listed
                except PlacerecError:
                    return None
                found[map_key(map_)] = map_.count_places()
            return found

        def present(map_id: str) -> set[str]:
            return {place.id for place in engine.maps.get(map_id).transfer.outline()}

        ledger = statistics_file(engine.settings.data_dir) if shared is None else shared
        return cls(ledger, engine.settings.statistics_seconds, sizes, present, shared is not None)

    def start(self) -> None:
        """Begin to write the counts at intervals."""
        self._thread.start()

    def close(self) -> None:
        """Write the remaining counts and close the file."""
        self._stop.set()
        if self._thread.is_alive():
            self._thread.join()
        with suppress(Exception):
            self.flush()
        if not self._shared:
            self._ledger.close()

    # Counting

    def observe(
        self, key: MapKey, verdict: Verdict, best: str | None, score: float | None, decision: float | None
    ) -> None:
        """Count one answer.

        Args:
            best: the id of the best match; None if there is none (a blank frame, an empty map).
        """
        now = datetime.now(UTC)
        counted = Week.of(monday_of(now.date()), verdict, score, decision)
        with self._lock:
            counts = self._counts.setdefault(key, AnswerCounts(since=now.isoformat()))
            counts.weeks[counted.monday] = counts.weeks.get(counted.monday, Week(counted.monday)) + counted
            counts.hours.setdefault(hour_of(now), Counter())[verdict] += 1
            if best is None:
                return
            if best not in counts.places:
                if self._waiting >= MOST_WAITING:
                    self.lost += 1
                    return
                self._waiting += 1
            seen = PlaceCount(1, int(verdict == "recognized"), now.isoformat(timespec="seconds"))
            counts.places[best] = counts.places.get(best, PlaceCount()) + seen

    def flush(self) -> None:
        """Write the counts, and the answers that others see.

        Raises:
            StorageFull, StorageFailure: the ledger refuses; the counts stay in memory.
        """
        with self._writing:
            self._write_counts()
        self.recent.flush()

    def _write_counts(self) -> None:
        with self._lock:
            taken, self._counts, self._waiting = self._counts, {}, 0
        if not taken:
            return
        try:
            self._write(taken)
        except BaseException:
            with self._lock:  # add the counts of the meantime to those that could not be written
                for key, newer in self._counts.items():
                    taken.setdefault(key, AnswerCounts(newer.since)).add(newer)
                self._counts = taken
                self._waiting = sum(len(counts.places) for counts in taken.values())
            raise

    def _run(self) -> None:
        while not self._stop.wait(self._seconds):
            try:
                self.flush()
            except Exception as error:
                log.error("the statistics of queries cannot be written: %s", error)

    @once_more_if_replaced
    def _write(self, counts: Mapping[MapKey, AnswerCounts]) -> None:
        """Add counts to those of the ledger, all or none."""
        sizes = self._sizes()
        with self._ledger.transaction(WRITE) as connection:
            if sizes is not None:
                stored = connection.execute(_COUNTED_MAPS)
                gone = [{"code": code} for code, *key in stored if tuple(key) not in sizes]
                connection.execute_many(_DELETE_MAP, gone)
            for key in sorted(counts):  # in one order, so that no two services wait for one another
                if sizes is None or key in sizes:
                    self._add(connection, key, counts[key], None if sizes is None else sizes[key])

    def _add(self, connection: Connection, key: MapKey, counted: AnswerCounts, places: int | None) -> None:
        code = _code(connection, key, counted.since)
        connection.execute_many(_ADD_PLACE, _place_rows(code, counted.places))
        connection.execute_many(_ADD_WEEK, [_week_row(code, week) for week in counted.weeks.values()])
        connection.execute_many(_ADD_HOUR, _hour_rows(code, counted.hours))
        connection.execute(_DELETE_HOURS, code=code, oldest=hour_of(datetime.now(UTC) - timedelta(hours=HOURS)))
        connection.execute(_DELETE_WEEKS, code=code, most=MOST_WEEKS)
        ((rows,),) = connection.execute(_COUNT_PLACES, code=code)
        if places is not None and rows > places + SPARE_PLACES:
            connection.execute(_DELETE_PLACES, code=code, present=list(self._present(key[0])))

    # Reading

    @once_more_if_replaced
    def read(self, key: MapKey) -> Statistics:
        """The statistics of a map, including the counts that are not written yet."""
        self.flush()
        with self._ledger.transaction(READ) as connection:
            found = connection.execute(_MAP, id=key[0], made=key[1])
            if not found:
                return Statistics()
            code, since = found[0]
            places = connection.execute(_PLACES_OF_MAP, code=code)
            weeks = connection.execute(_WEEKS_OF_MAP, code=code)
            counts = {place: PlaceCount(*values) for place, *values in places}
            return Statistics(datetime.fromisoformat(since), counts, tuple(_week_of(*row) for row in weeks))

    @once_more_if_replaced
    def of_place(self, key: MapKey, place_id: str) -> PlaceCount:
        """The counts of one place of a map, including those that are not written yet."""
        self.flush()
        found = self._ledger.execute(READ, _PLACE, id=key[0], made=key[1], place=place_id)
        return PlaceCount(*found[0]) if found else PlaceCount()

    def hours(self, key: MapKey) -> list[HourCount]:
        """The answers of a map in the last ``HOURS`` hours, including those that are not written yet; hours in order."""
        found = self._last_hours(key).get(key, {})
        return [
            HourCount(hour=datetime.fromtimestamp(3600 * hour, UTC), **counts.model_dump())
            for hour, counts in found.items()
        ]

    def last_day(self, key: MapKey | None = None) -> dict[MapKey, VerdictCounts]:
        """The answers of the last ``HOURS`` hours, of the maps that had any.

        Args:
            key: of the only map that is wanted; None: all.
        """
        found = self._last_hours(key)
        return {one: sum(hours.values(), VerdictCounts()) for one, hours in found.items()}

    @once_more_if_replaced
    def _last_hours(self, key: MapKey | None) -> dict[MapKey, dict[int, VerdictCounts]]:
        """The counts of the last hours by map and hour, in order."""
        oldest = hour_of(datetime.now(UTC) - timedelta(hours=HOURS - 1))
        found: dict[MapKey, dict[int, VerdictCounts]] = {}
        with self._writing:
            for map_id, made, hour, *counts in self._stored_hours(oldest, key):
                known = dict(zip(("recognized", "ambiguous", "unknown"), counts, strict=True))
                found.setdefault((map_id, made), {})[hour] = VerdictCounts(**known)
            with self._lock:
                for one, waiting in self._counts.items():
                    if key in (None, one):
                        of_map = found.setdefault(one, {})
                        for hour, verdicts in waiting.hours.items():
                            of_map[hour] = of_map.get(hour, VerdictCounts()) + VerdictCounts.of(verdicts)
        return {
            one: {hour: counts for hour, counts in sorted(hours.items()) if hour >= oldest}
            for one, hours in found.items()
        }

    def _stored_hours(self, oldest: int, key: MapKey | None) -> list[tuple[Any, ...]]:
        """The stored counts from an hour on: id and creation time of the map, hour, and count of each verdict."""
        if key is None:
            return self._ledger.execute(READ, _LAST_HOURS, oldest=oldest)
        return self._ledger.execute(READ, _LAST_HOURS_OF_MAP, oldest=oldest, id=key[0], made=key[1])

    # Calibrations

    @once_more_if_replaced
    def keep_calibration(self, key: MapKey, report: str, trials: str) -> None:
        """Store the measurements of a map's calibration, in place of earlier ones.

        Args:
            report, trials: JSON.
        """
        now = datetime.now(UTC).isoformat()
        with self._ledger.transaction("keep a calibration") as connection:
            code = _code(connection, key, now)
            connection.execute(_PUT_CALIBRATION, map=code, at=now, report=report, trials=trials)

    @once_more_if_replaced
    def calibration(self, key: MapKey) -> tuple[datetime, str, str] | None:
        """When a map was last measured to be calibrated, the report and the trials; None if it was not."""
        with self._ledger.transaction(READ) as connection:
            found = connection.execute(_CALIBRATION, id=key[0], made=key[1])
            return (datetime.fromisoformat(found[0][0]), found[0][1], found[0][2]) if found else None


def _code(connection: Connection, key: MapKey, since: str) -> int:
    """The number of a map in the tables, which it gets if it has none."""
    ((code,),) = connection.execute(_CODE, id=key[0], made=key[1], since=since)
    return int(code)


def _place_rows(code: int, places: Mapping[str, PlaceCount]) -> list[dict[str, Any]]:
    return [
        {"map": code, "id": place, "best": count.best, "recognized": count.recognized, "last": count.last}
        for place, count in places.items()
    ]


def _hour_rows(code: int, hours: Mapping[int, Counter[Verdict]]) -> list[dict[str, Any]]:
    return [{"map": code, "hour": hour, **VerdictCounts.of(counts).model_dump()} for hour, counts in hours.items()]


def _week_row(code: int, week: Week) -> dict[str, Any]:
    bins = {f"bin{number}": count for number, count in enumerate(week.bins)}
    return {**vars(week), **bins, "map": code, "monday": week.monday.isoformat()}


def _week_of(monday: str, *counts: Any) -> Week:
    return Week(date.fromisoformat(monday), *counts[:-SCORE_BINS], bins=counts[-SCORE_BINS:])
