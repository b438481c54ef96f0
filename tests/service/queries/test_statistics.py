"""Statistics of answers: each answer counts once, the file is bounded, and little is lost by a crash."""

from __future__ import annotations

import itertools
import sqlite3
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from datetime import UTC, date, datetime, timedelta, tzinfo
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from sqlalchemy import func, select

from core.errors import StorageFailure
from core.ledger import Ledger, Statement
from core.ledger.disposable import DisposableLedger
from core.ledger.postgres import PostgresLedger
from core.upkeep.drift import Week
from service.queries import count_tables, recent_answers, statistics
from service.queries.count_tables import FILE, MOST_WEEKS, TABLES, statistics_file
from service.queries.counts import AnswerCounts, PlaceCount, VerdictCounts
from service.queries.given_answers import MapKey
from service.queries.statistics import SPARE_PLACES, QueryStatistics
from tests.servers.postgres import Postgres

LAB: MapKey = ("lab", "2026-11-20T09:00:00+00:00")
HALL: MapKey = ("hall", "2026-11-20T09:00:00+00:00")

NUMBERS = itertools.count()

Counting = Callable[[], QueryStatistics]


class Maps:
    """The maps that there are, as the counting sees them."""

    def __init__(self) -> None:
        self.sizes: dict[MapKey, int] | None = {LAB: 10, HALL: 10}
        self.present = {f"p{n}" for n in range(10)}


@pytest.fixture
def maps() -> Maps:
    return Maps()


def in_folder(folder: Path, maps: Maps) -> QueryStatistics:
    return QueryStatistics(statistics_file(folder), 3600, lambda: maps.sizes, lambda _: maps.present)


@pytest.fixture(params=["sqlite", pytest.param("postgresql", marks=pytest.mark.postgres)])
def counting(request: pytest.FixtureRequest, tmp_path: Path, maps: Maps) -> Iterator[Counting]:
    """Begins to count in a ledger; it has what was counted before in the same test."""
    ledgers: list[Ledger] = []
    if request.param == "postgresql":
        server: Postgres = request.getfixturevalue("postgres")
        server.empty()

    def begun() -> QueryStatistics:
        if request.param == "sqlite":
            return in_folder(tmp_path, maps)
        ledgers.append(PostgresLedger(server.address, [TABLES, recent_answers.TABLES]))
        return QueryStatistics(ledgers[-1], 3600, lambda: maps.sizes, lambda _: maps.present, shared=True)

    yield begun
    for ledger in ledgers:
        ledger.close()


def test_counts_survive_a_restart(counting: Counting) -> None:
    first = counting()
    assert first.read(LAB).since is None and first.read(LAB).weeks == ()
    for _ in range(3):
        first.observe(LAB, "recognized", "p1", 0.5, 2.0)
    first.observe(LAB, "unknown", "p1", 0.1, 0.2)
    first.observe(LAB, "unknown", None, None, None)
    first.observe(HALL, "ambiguous", "p2", 0.4, 1.0)
    first.close()
    again = counting()
    found = again.read(LAB)
    assert found.since is not None
    assert {place: (count.best, count.recognized) for place, count in found.places.items()} == {"p1": (4, 3)}
    (week,) = found.weeks
    assert (week.queries, week.recognized, week.unknown, week.blank) == (5, 3, 2, 1)
    assert week.mean_score() == pytest.approx(1.6 / 4) and week.bins[10] == 3 and week.bins[2] == 1
    again.observe(LAB, "recognized", "p1", 0.5, 2.0)
    assert again.read(LAB).places["p1"].best == 5
    again.close()


@pytest.mark.thorough
@given(st.lists(st.tuples(st.sampled_from(["p1", "p2", None]), st.booleans()), max_size=40))
@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], max_examples=25)
def test_the_moments_of_writing_do_not_matter(
    counting: Counting, maps: Maps, answers: list[tuple[str | None, bool]]
) -> None:
    maps.sizes, key = None, ("lab", str(next(NUMBERS)))
    counted = counting()
    for place, flush in answers:
        counted.observe(key, "recognized" if place else "unknown", place, 0.5 if place else None, None)
        if flush:
            counted.flush()
    found = counted.read(key)
    for name in ("p1", "p2"):
        expected = sum(place == name for place, _ in answers)
        assert (found.places[name].best if name in found.places else 0) == expected
    assert sum(week.queries for week in found.weeks) == len(answers)
    counted.close()


def test_counts_of_deleted_maps_are_dropped_and_of_quarantined_maps_kept(counting: Counting, maps: Maps) -> None:
    counted = counting()
    counted.observe(LAB, "recognized", "p1", 0.5, 2.0)
    counted.flush()
    maps.sizes = None  # some map is out of service: who knows which ones there are
    counted.observe(HALL, "recognized", "p1", 0.5, 2.0)
    assert counted.read(LAB).places
    maps.sizes = {HALL: 10}
    counted.observe(HALL, "recognized", "p1", 0.5, 2.0)
    assert counted.read(LAB).places == {} and counted.read(HALL).places["p1"].best == 2
    counted.close()


def test_counts_of_deleted_places_are_dropped(counting: Counting, maps: Maps) -> None:
    counted = counting()
    for n in range(10 + SPARE_PLACES + 5):
        counted.observe(LAB, "recognized", f"p{n}", 0.5, 2.0)
    assert set(counted.read(LAB).places) == maps.present
    counted.close()


def test_old_weeks_are_dropped(counting: Counting) -> None:
    counted = counting()
    monday = date(2020, 1, 6)
    weeks = {m: Week.of(m, "unknown", 0.1, 0.1) for m in (monday + timedelta(weeks=n) for n in range(MOST_WEEKS + 9))}
    counted._counts[LAB] = AnswerCounts("2020-01-06T00:00:00+00:00", {}, weeks)
    found = counted.read(LAB).weeks
    assert [week.monday for week in found] == sorted(weeks)[9:]
    counted.close()


def test_memory_is_bounded_while_the_disk_refuses(tmp_path: Path, maps: Maps, monkeypatch: pytest.MonkeyPatch) -> None:
    counted, disk = refusable(tmp_path, maps)
    counted.flush()
    monkeypatch.setattr(statistics, "MOST_WAITING", 20)
    disk.execute("PRAGMA query_only = ON")
    for n in range(30):
        counted.observe(LAB, "recognized", f"p{n % 10}-{n}", 0.5, 2.0)
        if n % 7 == 0:
            with pytest.raises(StorageFailure, match="disk refused"):
                counted.flush()
    assert counted.lost == 10 and len(counted._counts[LAB].places) == 20
    counted.observe(LAB, "recognized", "p0-0", 0.5, 2.0)  # one that waits already
    disk.execute("PRAGMA query_only = OFF")
    found = counted.read(LAB)
    assert len(found.places) == 20 and found.places["p0-0"].best == 2
    assert sum(week.queries for week in found.weeks) == 31, "queries are all counted"
    counted.close()


def refusable(folder: Path, maps: Maps) -> tuple[QueryStatistics, sqlite3.Connection]:
    """Statistics in a folder, and the connection that they write with."""
    counted = in_folder(folder, maps)
    assert counted.read(LAB).since is None  # which opens the file
    assert isinstance(counted._ledger, DisposableLedger) and counted._ledger._opened is not None
    return counted, counted._ledger._opened._connection.driver


def test_a_damaged_file_is_put_aside(tmp_path: Path, maps: Maps) -> None:
    (tmp_path / FILE).write_bytes(b"no database at all" * 100)
    counted = in_folder(tmp_path, maps)
    counted.observe(LAB, "recognized", "p1", 0.5, 2.0)
    assert counted.read(LAB).places["p1"].best == 1
    counted.close()
    assert len(list(tmp_path.glob(f"{FILE}.damaged-*"))) == 1


def test_damage_that_is_found_later_loses_no_count_that_waits(tmp_path: Path, maps: Maps) -> None:
    counted, disk = refusable(tmp_path, maps)
    counted.observe(LAB, "recognized", "p1", 0.5, 2.0)
    counted.flush()
    disk.execute("UPDATE counted_maps SET since = 'never'")
    counted.observe(LAB, "recognized", "p2", 0.5, 2.0)
    assert counted.read(LAB).since is None, "what could not be read is put aside"
    counted.observe(LAB, "recognized", "p2", 0.5, 2.0)
    counted.close()
    sound = (tmp_path / FILE).read_bytes()
    (tmp_path / FILE).write_bytes(sound[:4096] + bytes(len(sound) - 4096))  # the schema is sound, its tables are not
    counted.observe(LAB, "recognized", "p3", 0.5, 2.0)
    assert set(counted.read(LAB).places) == {"p3"}
    counted.close()


# The last day


class Now(datetime):
    """A clock that is set by hand."""

    moment = datetime(2026, 11, 22, 18, 30, tzinfo=UTC)

    @classmethod
    def now(cls, tz: tzinfo | None = None) -> datetime:  # type: ignore[override]
        return cls.moment


def test_the_last_day_is_counted_by_the_hour(counting: Counting, monkeypatch: pytest.MonkeyPatch) -> None:
    for module in (statistics, count_tables):
        monkeypatch.setattr(module, "datetime", Now)
    monkeypatch.setattr(Now, "moment", Now.moment)  # set back at the end
    counted = counting()
    counted.observe(LAB, "recognized", "p1", 0.5, 2.0)
    counted.flush()
    counted.observe(LAB, "unknown", None, None, None)
    counted.observe(HALL, "ambiguous", "p2", 0.5, 2.0)
    assert counted.last_day() == {LAB: VerdictCounts(recognized=1, unknown=1), HALL: VerdictCounts(ambiguous=1)}
    Now.moment += timedelta(hours=2)
    counted.observe(LAB, "recognized", "p1", 0.5, 2.0)
    counted.close()
    again = counting()
    assert [(one.hour.hour, one.recognized, one.unknown) for one in again.hours(LAB)] == [(18, 1, 1), (20, 1, 0)]
    Now.moment += timedelta(hours=22)
    assert [(one.hour.hour, one.recognized) for one in again.hours(LAB)] == [(20, 1)], "18:30 is 24 hours ago"
    assert again.last_day(HALL) == {} and again.last_day(LAB) == {LAB: VerdictCounts(recognized=1)}
    Now.moment += timedelta(days=3)
    again.observe(LAB, "recognized", "p1", 0.5, 2.0)
    again.close()
    count = Statement(select(func.count()).select_from(TABLES.metadata.tables["hour_counts"]))
    assert counting()._ledger.execute("count", count) == [(2,)]


def test_counts_of_one_place(counting: Counting) -> None:
    counted = counting()
    counted.observe(LAB, "recognized", "p1", 0.5, 2.0)
    first = counted.of_place(LAB, "p1")
    counted.observe(LAB, "unknown", "p1", 0.1, 0.2)
    found = counted.of_place(LAB, "p1")
    assert (found.best, found.recognized) == (2, 1)
    assert datetime.fromisoformat(found.last) >= datetime.fromisoformat(first.last)
    assert counted.of_place(LAB, "p2") == counted.of_place(HALL, "p1") == PlaceCount()
    counted.close()


def test_statistics_of_an_older_version_are_put_aside_whole(
    tmp_path: Path, maps: Maps, caplog: pytest.LogCaptureFixture
) -> None:
    with closing(sqlite3.connect(tmp_path / FILE)) as connection:
        connection.execute("PRAGMA journal_mode = WAL")
        connection.execute("CREATE TABLE maps (code INTEGER PRIMARY KEY, id TEXT NOT NULL) STRICT")
        connection.execute("PRAGMA user_version = 1")
    before = (tmp_path / FILE).read_bytes()
    counted = in_folder(tmp_path, maps)
    counted.observe(LAB, "recognized", "p1", 0.5, 2.0)
    assert counted.of_place(LAB, "p1").best == 1
    counted.close()
    (aside,) = tmp_path.glob("*damaged*")
    assert aside.read_bytes() == before
    assert f"before the first release of placerec (schema 1, this one knows {TABLES.version})" in caplog.text


# Services that share a ledger


@pytest.mark.thorough
@pytest.mark.postgres
def test_services_add_their_counts_to_the_same_rows(postgres: Postgres, maps: Maps) -> None:
    postgres.empty()
    with closing(PostgresLedger(postgres.address, [TABLES, recent_answers.TABLES])) as ledger:
        services = [
            QueryStatistics(ledger, 3600, lambda: maps.sizes, lambda _: maps.present, shared=True) for _ in range(4)
        ]

        def count(statistics: QueryStatistics) -> None:
            for number in range(60):
                statistics.observe(LAB, "recognized", f"p{number % 7}", 0.5, 2.0)
                statistics.observe(HALL, "unknown", None, None, None)
                statistics.flush()

        with ThreadPoolExecutor(4) as threads:
            list(threads.map(count, services))
        for one in services:
            assert sum(place.best for place in one.read(LAB).places.values()) == 240
            assert [week.bins[10] for week in one.read(LAB).weeks] == [240]
            assert one.last_day() == {LAB: VerdictCounts(recognized=240), HALL: VerdictCounts(unknown=240)}
            one.close()
