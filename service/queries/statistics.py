"""Statistics of the answers of each map, by place and by week, in a small SQLite file in the data directory.

Answers are counted in memory and written at intervals, so that no query waits for the disk; a crash loses the counts
since the last writing.  The file is bounded: it has one row for each place and each week of a map.
"""

from __future__ import annotations

import logging
import sqlite3
import threading
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from datetime import UTC, date, datetime, timedelta
from pathlib import Path
from typing import Any

from core.disk.files import Damage, disk_errors
from core.disk.sqlite_file import DURABLE, Schema, SqliteFile, transaction
from core.errors import PlacerecError, UnknownMap
from core.judgement.verdict import Verdict
from core.storage import Map
from core.upkeep.drift import SCORE_BINS, Week
from service.engine.engine import Engine

FILE = "statistics.sqlite"

MOST_WEEKS = 260
"""How many weeks of a map are kept."""

MOST_WAITING = 50_000
"""How many places may have counts that are not written yet; while the disk refuses, further counts are lost."""

SPARE_PLACES = 1000
"""Counts of deleted places are removed once a map has so many more counted places than places."""

MapKey = tuple[str, str]
"""The id of a map and the time of its creation: a new map of the same id has statistics of its own."""

log = logging.getLogger("placerec.statistics")


def map_key(map_: Map) -> MapKey:
    """The key of a map in the statistics."""
    return map_.record.id, map_.record.created_at.isoformat()


_TABLES = (
    "CREATE TABLE maps (code INTEGER PRIMARY KEY, id TEXT NOT NULL, made TEXT NOT NULL, since TEXT NOT NULL,"
    " UNIQUE (id, made)) STRICT",
    "CREATE TABLE places (map INTEGER NOT NULL REFERENCES maps (code) ON DELETE CASCADE, id TEXT NOT NULL,"
    " best INTEGER NOT NULL, recognized INTEGER NOT NULL, last TEXT NOT NULL, PRIMARY KEY (map, id))"
    " STRICT, WITHOUT ROWID",
    "CREATE TABLE weeks (map INTEGER NOT NULL REFERENCES maps (code) ON DELETE CASCADE, monday TEXT NOT NULL,"
    " recognized INTEGER NOT NULL, ambiguous INTEGER NOT NULL, unknown INTEGER NOT NULL, blank INTEGER NOT NULL,"
    " score REAL NOT NULL, score_squares REAL NOT NULL, decision REAL NOT NULL, decision_squares REAL NOT NULL,"
    f" {', '.join(f'bin{number} INTEGER NOT NULL' for number in range(SCORE_BINS))}, PRIMARY KEY (map, monday))"
    " STRICT, WITHOUT ROWID",
)
_SCHEMA = Schema(application_id=0, version=1, create=_TABLES)


@dataclass(frozen=True)
class PlaceCount:
    """The counts of one place.

    best: how often it was the best match.
    recognized: how often it was recognized.
    last: when it was last the best match, ISO 8601 in UTC.
    """

    best: int = 0
    recognized: int = 0
    last: str = ""

    def __add__(self, other: PlaceCount) -> PlaceCount:
        return PlaceCount(self.best + other.best, self.recognized + other.recognized, max(self.last, other.last))


@dataclass(frozen=True)
class Statistics:
    """The statistics of a map.

    since: when the counting began; None if nothing was counted yet.
    places: the counts of the places that ever were the best match, by id.
    weeks: the weeks with at least one query, in order.
    """

    since: datetime | None = None
    places: Mapping[str, PlaceCount] = field(default_factory=dict)
    weeks: tuple[Week, ...] = ()


@dataclass
class _Counts:
    """The counts of one map that are not written yet."""

    since: str
    places: dict[str, PlaceCount] = field(default_factory=dict)
    weeks: dict[date, Week] = field(default_factory=dict)

    def add(self, other: _Counts) -> None:
        for place, count in other.places.items():
            self.places[place] = self.places.get(place, PlaceCount()) + count
        for monday, week in other.weeks.items():
            self.weeks[monday] = self.weeks.get(monday, Week(monday)) + week


class QueryStatistics:
    """Counts the answers of all maps.  Thread-safe.

    Args:
        directory: the data directory, which this process holds.
        seconds: the interval between two writings.
        sizes: returns the number of places of every map; the counts of other maps are deleted.  It returns None while
            this is not known.
        present: returns the ids of the places of a map.
    """

    def __init__(
        self,
        directory: Path,
        seconds: float,
        sizes: Callable[[], Mapping[MapKey, int] | None],
        present: Callable[[str], set[str]],
    ) -> None:
        settings = {**DURABLE, "foreign_keys": "ON", "journal_size_limit": 1 << 20}
        readable = ["SELECT last FROM places LIMIT 0"]
        self._database = SqliteFile(directory / FILE, _SCHEMA, settings, readable, check_whole=False)
        self._seconds, self._sizes, self._present = seconds, sizes, present
        self._lock = threading.Lock()
        self._counts: dict[MapKey, _Counts] = {}
        self._waiting = 0
        self.lost = 0
        """How many counts were dropped because the disk refuses."""
        self._file = threading.Lock()  # held while the connection is used
        self._connection: sqlite3.Connection | None = None
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="statistics", daemon=True)

    @classmethod
    def of_engine(cls, engine: Engine) -> QueryStatistics:
        """The statistics of all maps of an engine."""

        def sizes() -> dict[MapKey, int] | None:
            if engine.atlas.quarantined():
                return None  # a map that is quarantined may come back
            found = {}
            for record in engine.all_records():
                try:
                    map_ = engine.atlas.find(record.id)
                except UnknownMap:
                    continue  # the map was deleted since it was listed
                except PlacerecError:
                    return None
                found[map_key(map_)] = map_.count_places()
            return found

        def present(map_id: str) -> set[str]:
            return {place.id for place in engine.atlas.get(map_id).transfer.outline()}

        return cls(engine.settings.data_dir, engine.settings.statistics_seconds, sizes, present)

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
        with self._file:
            if self._connection is not None:
                self._connection.close()
                self._connection = None

    def observe(
        self, key: MapKey, verdict: Verdict, best: str | None, score: float | None, decision: float | None
    ) -> None:
        """Count one answer.

        Args:
            best: the id of the best match; None if there is none (a blank frame, an empty map).
        """
        now = datetime.now(UTC)
        counted = Week.of(_monday(now.date()), verdict, score, decision)
        with self._lock:
            counts = self._counts.setdefault(key, _Counts(since=now.isoformat()))
            counts.weeks[counted.monday] = counts.weeks.get(counted.monday, Week(counted.monday)) + counted
            if best is None:
                return
            if best not in counts.places:
                if self._waiting >= MOST_WAITING:
                    self.lost += 1
                    return
                self._waiting += 1
            seen = PlaceCount(1, int(verdict == "recognized"), now.isoformat(timespec="seconds"))
            counts.places[best] = counts.places.get(best, PlaceCount()) + seen

    def read(self, key: MapKey) -> Statistics:
        """The statistics of a map, including the counts that are not written yet.

        Raises:
            StorageFull, StorageFailure: the file cannot be read or written.
        """
        self.flush()
        with self._file, self._replacing_damage():
            connection = self._open()
            found = connection.execute("SELECT code, since FROM maps WHERE id = ? AND made = ?", key).fetchone()
            if found is None:
                return Statistics()
            code, since = found
            places = connection.execute("SELECT id, best, recognized, last FROM places WHERE map = ?", (code,))
            counts = {place: PlaceCount(*values) for place, *values in places.fetchall()}
            weeks = connection.execute("SELECT * FROM weeks WHERE map = ? ORDER BY monday", (code,)).fetchall()
            return Statistics(datetime.fromisoformat(since), counts, tuple(_week(row[1:]) for row in weeks))
        return Statistics()

    @contextmanager
    def _replacing_damage(self) -> Iterator[None]:
        """If the file turns out to be damaged within the context, rename it, so that a new one is made."""
        try:
            with disk_errors("use the statistics of queries", FILE):
                yield
        except (Damage, ValueError, TypeError) as damage:
            if self._connection is not None:
                self._connection.close()
                self._connection = None
            self._database.put_aside(damage)

    def flush(self) -> None:
        """Write the counts.

        Raises:
            StorageFull, StorageFailure: the disk refuses; the counts stay in memory.
        """
        with self._file:
            with self._lock:
                taken, self._counts, self._waiting = self._counts, {}, 0
            if not taken:
                return
            try:
                with self._replacing_damage():
                    self._write(taken)
                    return
                with disk_errors("write down the statistics of queries", FILE):
                    self._write(taken)  # into a new file
            except BaseException:
                with self._lock:  # add the counts of the meantime to those that could not be written
                    for key, newer in self._counts.items():
                        taken.setdefault(key, _Counts(newer.since)).add(newer)
                    self._counts = taken
                    self._waiting = sum(len(counts.places) for counts in taken.values())
                raise

    def _run(self) -> None:
        while not self._stop.wait(self._seconds):
            try:
                self.flush()
            except Exception as error:
                log.error("the statistics of queries cannot be written: %s", error)

    def _open(self) -> sqlite3.Connection:
        if self._connection is None:
            self._connection = self._database.open_or_replace()
            # A crash may lose the last counts, but never damages the file.
            self._connection.execute("PRAGMA synchronous = NORMAL")
        return self._connection

    def _write(self, counts: Mapping[MapKey, _Counts]) -> None:
        connection, sizes = self._open(), self._sizes()
        with transaction(connection):
            if sizes is not None:
                for code, *key in connection.execute("SELECT code, id, made FROM maps").fetchall():
                    if tuple(key) not in sizes:
                        connection.execute("DELETE FROM maps WHERE code = ?", (code,))
            for key, counted in counts.items():
                if sizes is None or key in sizes:
                    self._add(connection, key, counted, None if sizes is None else sizes[key])

    def _add(self, connection: sqlite3.Connection, key: MapKey, counted: _Counts, places: int | None) -> None:
        connection.execute(
            "INSERT INTO maps (id, made, since) VALUES (?, ?, ?) ON CONFLICT DO NOTHING", (*key, counted.since)
        )
        (code,) = connection.execute("SELECT code FROM maps WHERE id = ? AND made = ?", key).fetchone()
        connection.executemany(
            "INSERT INTO places VALUES (?1, ?2, ?3, ?4, ?5) ON CONFLICT DO UPDATE SET"
            " best = best + ?3, recognized = recognized + ?4, last = max(last, ?5)",
            [(code, place, count.best, count.recognized, count.last) for place, count in counted.places.items()],
        )
        for week in counted.weeks.values():
            stored = connection.execute(
                "SELECT * FROM weeks WHERE map = ? AND monday = ?", (code, week.monday.isoformat())
            ).fetchone()
            columns = _columns(week if stored is None else _week(stored[1:]) + week)
            marks = ", ".join("?" * (len(columns) + 1))
            connection.execute(f"INSERT OR REPLACE INTO weeks VALUES ({marks})", (code, *columns))
        oldest = "SELECT monday FROM weeks WHERE map = ?1 ORDER BY monday DESC LIMIT 1 OFFSET ?2"
        connection.execute(f"DELETE FROM weeks WHERE map = ?1 AND monday <= ({oldest})", (code, MOST_WEEKS))
        (rows,) = connection.execute("SELECT count(*) FROM places WHERE map = ?", (code,)).fetchone()
        if places is not None and rows > places + SPARE_PLACES:
            there = self._present(key[0])
            known = connection.execute("SELECT id FROM places WHERE map = ?", (code,)).fetchall()
            gone = [(code, place) for (place,) in known if place not in there]
            connection.executemany("DELETE FROM places WHERE map = ? AND id = ?", gone)


def _monday(day: date) -> date:
    return day - timedelta(days=day.weekday())


def _columns(week: Week) -> tuple[object, ...]:
    verdicts = (week.recognized, week.ambiguous, week.unknown, week.blank)
    sums = (week.score, week.score_squares, week.decision, week.decision_squares)
    return (week.monday.isoformat(), *verdicts, *sums, *week.bins)


def _week(row: tuple[Any, ...]) -> Week:
    return Week(date.fromisoformat(row[0]), *row[1:9], tuple(row[9:]))  # type: ignore[call-arg]
