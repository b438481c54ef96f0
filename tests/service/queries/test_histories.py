"""Histories of places: they are bounded, add up over services, and survive restarts and folding."""

from __future__ import annotations

import sqlite3
from contextlib import closing
from datetime import UTC, date, datetime, timedelta
from pathlib import Path

import pytest

from core.judgement.change import UsualScore
from core.ledger import Ledger
from core.upkeep.histories import AnswerHistory, PlacePeriod
from service.queries.count_tables import FILE, TABLES, number_of, statistics_file
from service.queries.counts import PassedBy, monday_of
from service.queries.given_answers import MapKey
from service.queries.histories import usual_scores
from service.queries.histories.tables import WEEKS, add_periods, fold
from service.queries.histories.usual_scores import UsualScores
from tests.service.queries.test_statistics import LAB, Counting, Maps, counting, in_folder, maps

__all__ = ["counting", "maps"]

DAY = PlacePeriod(best=4, recognized=3, probability=2.5, score=0.9, verified=1, inliers=30, passed=2, missed=1)


def remember(ledger: Ledger, days: list[date], place: str = "p1", key: MapKey = LAB) -> None:
    with ledger.transaction("remember") as connection:
        code = number_of(connection, key, datetime.now(UTC).isoformat())
        add_periods(connection, code, {(place, day): DAY for day in days})


def folded(ledger: Ledger, today: date, key: MapKey = LAB) -> None:
    with ledger.transaction("fold") as connection:
        fold(connection, number_of(connection, key, datetime.now(UTC).isoformat()), today)


def test_answers_and_passes_are_counted_by_day(counting: Counting) -> None:
    counted = counting()
    seen = PlacePeriod(best=1, recognized=1, probability=0.9, score=0.4, verified=1, inliers=50)
    counted.observe(LAB, "recognized", "p1", 0.5, 2.0, seen, PassedBy("p1", missed=False))
    counted.flush()
    counted.observe(LAB, "unknown", "p2", 0.1, 0.2, PlacePeriod(best=1, probability=0.2), PassedBy("p1", missed=True))
    today = datetime.now(UTC).date()
    found = counted.histories(LAB)
    assert found["p1"] == AnswerHistory({today: seen + PlacePeriod(passed=2, missed=1)})
    assert found["p2"] == AnswerHistory({today: PlacePeriod(best=1, probability=0.2)})
    counted.close()
    again = counting()
    assert again.histories(LAB) == found and again.read(LAB).places.keys() == {"p1", "p2"}
    again.close()


def test_days_become_weeks_and_weeks_what_was_earlier_and_nothing_is_lost(counting: Counting) -> None:
    counted, today = counting(), date(2026, 11, 26)
    days = [today - timedelta(days=ago) for ago in range(200)]
    remember(counted._ledger, days)
    for _ in range(2):  # another service folds as well
        folded(counted._ledger, today)
    found = counted.histories(LAB)["p1"]
    monday = monday_of(today)
    assert sorted(found.days) == sorted(day for day in days if day >= monday - timedelta(days=7))
    weeks = [monday - timedelta(weeks=2 + ago) for ago in range(WEEKS)]
    assert set(found.weeks) == set(weeks)
    assert all(week == _times(DAY, 7, days=7, good=7) for week in found.weeks.values())
    whole = found.before(date.max)
    assert whole == _times(DAY, 200, days=200, good=200) and len(found.days) + len(found.weeks) + 1 <= 14 + WEEKS + 1
    counted.close()


def _times(one: PlacePeriod, count: int, days: int, good: int) -> PlacePeriod:
    total = PlacePeriod(days=days, good=good)
    for _ in range(count):
        total = total + one
    rounded = {name: pytest.approx(getattr(total, name)) for name in ("probability", "score")}
    return PlacePeriod(**{**total.__dict__, **rounded})


def test_a_map_that_is_used_again_after_a_long_time_is_folded_by_its_first_counts(counting: Counting) -> None:
    counted = counting()
    old = datetime.now(UTC).date() - timedelta(days=60)
    remember(counted._ledger, [old])
    assert set(counted.histories(LAB)["p1"].days) == {old}
    counted.observe(LAB, "recognized", "p1", 0.5, 2.0)
    found = counted.histories(LAB)["p1"]
    assert old not in found.days and set(found.weeks) == {monday_of(old)}
    counted.close()


def test_histories_of_deleted_places_and_maps_are_dropped(counting: Counting, maps: Maps) -> None:
    counted = counting()
    remember(counted._ledger, [datetime.now(UTC).date()], "gone")
    for number in range(1100):
        counted.observe(LAB, "recognized", f"p{number}", 0.5, 2.0)
    assert "gone" not in counted.histories(LAB) and counted.histories(LAB).keys() == maps.present
    maps.sizes = {}
    counted.observe(LAB, "recognized", "p1", 0.5, 2.0)
    assert counted.histories(LAB) == {}
    counted.close()


def test_usual_scores_are_known_once_counts_are_written_and_after_a_restart(tmp_path: Path, maps: Maps) -> None:
    usual = UsualScores()
    usual.put(LAB, UsualScore(100, 30.0), {"p1": UsualScore(20, 10.0)})
    assert usual.of(LAB, "p2").count == 4 and usual.of(LAB, "p2").mean == pytest.approx(0.3)
    assert usual.of(LAB, "p1").mean == pytest.approx((10 + 1.2) / 24)
    counted = in_folder(tmp_path, maps)
    for _ in range(12):
        counted.observe(LAB, "recognized", "p1", 0.5, 2.0, PlacePeriod(best=1, recognized=1, score=0.25))
    assert counted._usual.of(LAB, "p1") == UsualScore(), "a query waits for nothing"
    counted.flush()
    assert counted._usual.of(LAB, "p1").count == 16 and counted._usual.of(LAB, "p1").mean == pytest.approx(0.25)
    counted.close()
    again = in_folder(tmp_path, maps)
    again.observe(LAB, "unknown", "p2", 0.1, 0.1)
    again.flush()
    assert again._usual.of(LAB, "p2").mean == pytest.approx(0.25)
    again.close()


def test_the_memory_of_usual_scores_is_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(usual_scores, "MOST_PLACES", 3)
    usual = UsualScores()
    for number in range(5):
        usual.put(LAB, None, {f"p{number}": UsualScore(1, 0.5)})
    assert [usual.of(LAB, f"p{number}").count for number in range(5)] == [0, 0, 1, 1, 1]


def test_statistics_of_the_version_before_get_the_new_tables(tmp_path: Path, maps: Maps) -> None:
    counted = in_folder(tmp_path, maps)
    counted.observe(LAB, "recognized", "p1", 0.5, 2.0)
    counted.close()
    with closing(sqlite3.connect(tmp_path / FILE)) as connection:
        later = ("place_history", "alarms", "run_trials")
        connection.executescript(";".join(f"DROP TABLE {table}" for table in later) + "; PRAGMA user_version = 3;")
    again = in_folder(tmp_path, maps)
    again.observe(LAB, "recognized", "p1", 0.5, 2.0)
    assert again.read(LAB).places["p1"].best == 2 and again.histories(LAB)["p1"].before(date.max).best == 1
    again.close()
    with closing(statistics_file(tmp_path)) as ledger, ledger.transaction("read") as connection:
        assert connection.driver.execute("PRAGMA user_version").fetchone() == (TABLES.version,)
