"""Statistics of the answers of each map, by place and by week, in a small SQLite file in the data directory.

Answers are counted in memory and written at intervals, so that no query waits for the disk; a crash loses the counts
since the last writing.  The file is bounded: it has one row for each place and each week of a map.
"""

from __future__ import annotations

import logging
import sqlite3
import threading
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from datetime import UTC, date, datetime, timedelta
from pathlib import Path
from typing import Any

from pydantic import BaseModel, ConfigDict, Field

from core.disk.files import Damage, disk_errors
from core.disk.sqlite_file import DURABLE, Schema, SqliteFile, transaction
from core.errors import PlacerecError, UnknownMap
from core.judgement.verdict import Verdict
from core.maps import Map
from core.places import Timestamp
from core.upkeep.drift import SCORE_BINS, Week
from service.engine.engine import Engine
from service.queries.given_answers import MapKey, RecentAnswers

FILE = "statistics.sqlite"

MOST_WEEKS = 260
"""How many weeks of a map are stored."""

HOURS = 24
"""The hours of the last day, which are counted one by one."""

MOST_WAITING = 50_000
"""How many places may have counts that are not written yet; while the disk refuses, further counts are lost."""

SPARE_PLACES = 1000
"""Counts of deleted places are removed once a map has this many more counted places than places."""

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
    "CREATE TABLE hours (map INTEGER NOT NULL REFERENCES maps (code) ON DELETE CASCADE, hour INTEGER NOT NULL,"
    " recognized INTEGER NOT NULL, ambiguous INTEGER NOT NULL, unknown INTEGER NOT NULL, PRIMARY KEY (map, hour))"
    " STRICT, WITHOUT ROWID",
    "CREATE TABLE calibrations (map INTEGER PRIMARY KEY REFERENCES maps (code) ON DELETE CASCADE,"
    " at TEXT NOT NULL, report TEXT NOT NULL, trials TEXT NOT NULL) STRICT",
)
_SCHEMA = Schema(application_id=0, version=2, create=_TABLES)


class VerdictCounts(BaseModel):
    """How many answers had each verdict."""

    model_config = ConfigDict(frozen=True)

    recognized: int = 0
    ambiguous: int = 0
    unknown: int = 0

    @classmethod
    def of(cls, counts: Mapping[Verdict, int]) -> VerdictCounts:
        """The counts of some answers."""
        return VerdictCounts(
            recognized=counts.get("recognized", 0),
            ambiguous=counts.get("ambiguous", 0),
            unknown=counts.get("unknown", 0),
        )

    def __add__(self, other: VerdictCounts) -> VerdictCounts:
        return VerdictCounts(
            recognized=self.recognized + other.recognized,
            ambiguous=self.ambiguous + other.ambiguous,
            unknown=self.unknown + other.unknown,
        )


class HourCount(VerdictCounts):
    """How many answers had each verdict within an hour."""

    hour: Timestamp = Field(description="When the hour began.")


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
class AnswerCounts:
    """The counts of one map that are not written yet."""

    since: str
    places: dict[str, PlaceCount] = field(default_factory=dict)
    weeks: dict[date, Week] = field(default_factory=dict)
    hours: dict[int, Counter[Verdict]] = field(default_factory=dict)

    def add(self, other: AnswerCounts) -> None:
        for place, count in other.places.items():
            self.places[place] = self.places.get(place, PlaceCount()) + count
        for monday, week in other.weeks.items():
            self.weeks[monday] = self.weeks.get(monday, Week(monday)) + week
        for hour, verdicts in other.hours.items():
            self.hours.setdefault(hour, Counter()).update(verdicts)


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
        self._counts: dict[MapKey, AnswerCounts] = {}
        self._waiting = 0
        self.recent = RecentAnswers()
        """The latest answers, which are in memory alone."""
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
            return Statistics(datetime.fromisoformat(since), counts, tuple(week_of(row[1:]) for row in weeks))
        return Statistics()

    def of_place(self, key: MapKey, place_id: str) -> PlaceCount:
        """The counts of one place of a map, including those that are not written yet.

        Raises:
            StorageFull, StorageFailure: the file cannot be read or written.
        """
        self.flush()
        query = (
            "SELECT best, recognized, last FROM places p JOIN maps m ON m.code = p.map"
            " WHERE m.id = ? AND m.made = ? AND p.id = ?"
        )
        with self._file, self._replacing_damage():
            found = self._open().execute(query, (*key, place_id)).fetchone()
            return PlaceCount() if found is None else PlaceCount(*found)
        return PlaceCount()

    def hours(self, key: MapKey) -> list[HourCount]:
        """The answers of a map in the last ``HOURS`` hours, including those that are not written yet; hours in order.

        Raises:
            StorageFull, StorageFailure: the file cannot be read.
        """
        found = self._last_hours(key).get(key, {})
        return [
            HourCount(hour=datetime.fromtimestamp(3600 * hour, UTC), **counts.model_dump())
            for hour, counts in found.items()
        ]

    def last_day(self, key: MapKey | None = None) -> dict[MapKey, VerdictCounts]:
        """The answers of the last ``HOURS`` hours, of the maps that had any.

        Args:
            key: of the only map that is wanted; None: all.

        Raises:
            StorageFull, StorageFailure: the file cannot be read.
        """
        found = self._last_hours(key)
        return {one: sum(hours.values(), VerdictCounts()) for one, hours in found.items()}

    def _stored_hours(self, oldest: int, key: MapKey | None) -> list[tuple[Any, ...]]:
        """The stored counts from an hour on: id and creation time of the map, hour, and count of each verdict.

        Args:
            key: of the only map that is wanted; None: all.
        """
        query = (
            "SELECT m.id, m.made, h.hour, h.recognized, h.ambiguous, h.unknown FROM hours h JOIN maps m"
            " ON m.code = h.map WHERE h.hour >= ?"
        )
        only, values = ("", ()) if key is None else (" AND m.id = ? AND m.made = ?", key)
        with self._replacing_damage():
            return self._open().execute(query + only, (oldest, *values)).fetchall()
        return []

    def _last_hours(self, key: MapKey | None) -> dict[MapKey, dict[int, VerdictCounts]]:
        """The counts of the last hours by map and hour, in order."""
        oldest = hour_of(datetime.now(UTC) - timedelta(hours=HOURS - 1))
        found: dict[MapKey, dict[int, VerdictCounts]] = {}
        with self._file:  # so that no counts are on their way from memory to the file
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

    def keep_calibration(self, key: MapKey, report: str, trials: str) -> None:
        """Store the measurements of a map's calibration, in place of earlier ones.

        Args:
            report, trials: JSON.

        Raises:
            StorageFull, StorageFailure: the disk refuses.
        """
        now = datetime.now(UTC).isoformat()
        with self._file, self._replacing_damage():
            connection = self._open()
            with transaction(connection):
                code = _code(connection, key, now)
                connection.execute(
                    "INSERT OR REPLACE INTO calibrations VALUES (?, ?, ?, ?)", (code, now, report, trials)
                )

    def calibration(self, key: MapKey) -> tuple[datetime, str, str] | None:
        """When a map was last measured to be calibrated, the report and the trials; None if it was not.

        Raises:
            StorageFull, StorageFailure: the file cannot be read.
        """
        query = (
            "SELECT at, report, trials FROM calibrations c JOIN maps m ON m.code = c.map WHERE m.id = ? AND m.made = ?"
        )
        with self._file, self._replacing_damage():
            found = self._open().execute(query, key).fetchone()
            return None if found is None else (datetime.fromisoformat(found[0]), found[1], found[2])
        return None

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
                self._keep(taken)
            except BaseException:
                with self._lock:  # add the counts of the meantime to those that could not be written
                    for key, newer in self._counts.items():
                        taken.setdefault(key, AnswerCounts(newer.since)).add(newer)
                    self._counts = taken
                    self._waiting = sum(len(counts.places) for counts in taken.values())
                raise

    def _keep(self, counts: Mapping[MapKey, AnswerCounts]) -> None:
        """Add counts to the stored ones, all or none."""
        with self._replacing_damage():
            self._write(counts)
            return
        with disk_errors("write down the statistics of queries", FILE):
            self._write(counts)  # into a new file

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

    def _write(self, counts: Mapping[MapKey, AnswerCounts]) -> None:
        connection, sizes = self._open(), self._sizes()
        with transaction(connection):
            if sizes is not None:
                for code, *key in connection.execute("SELECT code, id, made FROM maps").fetchall():
                    if tuple(key) not in sizes:
                        connection.execute("DELETE FROM maps WHERE code = ?", (code,))
            for key, counted in counts.items():
                if sizes is None or key in sizes:
                    self._add(connection, key, counted, None if sizes is None else sizes[key])

    def _add(self, connection: sqlite3.Connection, key: MapKey, counted: AnswerCounts, places: int | None) -> None:
        code = _code(connection, key, counted.since)
        connection.executemany(
            "INSERT INTO places VALUES (?1, ?2, ?3, ?4, ?5) ON CONFLICT DO UPDATE SET"
            " best = best + ?3, recognized = recognized + ?4, last = max(last, ?5)",
            [(code, place, count.best, count.recognized, count.last) for place, count in counted.places.items()],
        )
        for week in counted.weeks.values():
            stored = connection.execute(
                "SELECT * FROM weeks WHERE map = ? AND monday = ?", (code, week.monday.isoformat())
            ).fetchone()
            columns = columns_of(week if stored is None else week_of(stored[1:]) + week)
            marks = ", ".join("?" * (len(columns) + 1))
            connection.execute(f"INSERT OR REPLACE INTO weeks VALUES ({marks})", (code, *columns))
        connection.executemany(
            "INSERT INTO hours VALUES (?1, ?2, ?3, ?4, ?5) ON CONFLICT DO UPDATE SET recognized = recognized + ?3,"
            " ambiguous = ambiguous + ?4, unknown = unknown + ?5",
            [
                (code, hour, verdicts["recognized"], verdicts["ambiguous"], verdicts["unknown"])
                for hour, verdicts in counted.hours.items()
            ],
        )
        last = hour_of(datetime.now(UTC) - timedelta(hours=HOURS))
        connection.execute("DELETE FROM hours WHERE map = ? AND hour < ?", (code, last))
        oldest = "SELECT monday FROM weeks WHERE map = ?1 ORDER BY monday DESC LIMIT 1 OFFSET ?2"
        connection.execute(f"DELETE FROM weeks WHERE map = ?1 AND monday <= ({oldest})", (code, MOST_WEEKS))
        (rows,) = connection.execute("SELECT count(*) FROM places WHERE map = ?", (code,)).fetchone()
        if places is not None and rows > places + SPARE_PLACES:
            there = self._present(key[0])
            known = connection.execute("SELECT id FROM places WHERE map = ?", (code,)).fetchall()
            gone = [(code, place) for (place,) in known if place not in there]
            connection.executemany("DELETE FROM places WHERE map = ? AND id = ?", gone)


def _code(connection: sqlite3.Connection, key: MapKey, since: str) -> int:
    """The number of a map in the file, which it gets if it has none."""
    connection.execute("INSERT INTO maps (id, made, since) VALUES (?, ?, ?) ON CONFLICT DO NOTHING", (*key, since))
    (code,) = connection.execute("SELECT code FROM maps WHERE id = ? AND made = ?", key).fetchone()
    return int(code)


def _monday(day: date) -> date:
    return day - timedelta(days=day.weekday())


def hour_of(moment: datetime) -> int:
    """The hour of a moment, counted since 1970 in UTC."""
    return int(moment.timestamp()) // 3600


def columns_of(week: Week) -> tuple[object, ...]:
    """A week as it is stored."""
    verdicts = (week.recognized, week.ambiguous, week.unknown, week.blank)
    sums = (week.score, week.score_squares, week.decision, week.decision_squares)
    return (week.monday.isoformat(), *verdicts, *sums, *week.bins)


def week_of(row: tuple[Any, ...]) -> Week:
    """A stored week."""
    return Week(date.fromisoformat(row[0]), *row[1:9], tuple(row[9:]))  # type: ignore[call-arg]
