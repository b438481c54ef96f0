"""Alarms of a map: raised once when a trend reaches its number, cleared once after, and told to those who listen."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import closing
from datetime import UTC, date, datetime, timedelta
from pathlib import Path

import pytest

from core.ledger.postgres import PostgresLedger
from core.maps import AlarmSetting
from core.store import Map
from core.upkeep.histories import PlacePeriod
from service.app.runtime import Runtime
from service.events.schemas import AlarmEvent, Event
from service.queries import recent_answers
from service.queries.count_tables import TABLES, number_of
from service.queries.counts import PassedBy
from service.queries.histories.tables import add_periods
from service.queries.statistics import QueryStatistics, map_key
from service.upkeep.alarms import Alarms
from service.upkeep.trends import trends_of, trends_view
from tests.servers.postgres import Postgres
from tests.service.engines import ENCODER, enrolments, runtime_at
from tests.service.map_jobs import wait_until


def today() -> date:
    return datetime.now(UTC).date()


def remember(statistics: QueryStatistics, map_: Map, periods: Mapping[tuple[str, int], PlacePeriod]) -> None:
    """Write histories, by the place and how many days ago it was."""
    with statistics._ledger.transaction("remember") as connection:
        code = number_of(connection, map_key(map_), datetime.now(UTC).isoformat())
        of_days = {(place, today() - timedelta(days=ago)): one for (place, ago), one in periods.items()}
        add_periods(connection, code, of_days)


CHANGED = {("p2", ago): PlacePeriod(best=6, passed=6, missed=6, verified=6, inliers=12) for ago in (0, 1)}
USUAL = {(f"p{n}", 0): PlacePeriod(best=9, recognized=9, verified=9, inliers=540) for n in (0, 1, 6)}
WORSE = {("p3", ago): PlacePeriod(best=5, recognized=0 if ago < 6 else 5) for ago in range(12)}


@pytest.fixture
def runtime(tmp_path: Path) -> Iterator[Runtime]:
    with runtime_at(tmp_path) as running:
        yield running


@pytest.fixture
def lab(runtime: Runtime) -> Map:
    map_ = runtime.engine.maps.create("lab", ENCODER, 512)
    map_.enrol(enrolments(0, 8, "p", "monday", 512))
    return map_


@pytest.fixture
def told(runtime: Runtime, monkeypatch: pytest.MonkeyPatch) -> list[AlarmEvent]:
    """The alarms that were told."""
    found: list[AlarmEvent] = []

    def publish(event: Event) -> None:
        assert isinstance(event, AlarmEvent)
        found.append(event)

    monkeypatch.setattr(runtime.engine.events, "publish", publish)
    return found


def test_an_alarm_is_told_once_when_it_is_raised_and_once_when_it_is_cleared(
    runtime: Runtime, lab: Map, told: list[AlarmEvent], caplog: pytest.LogCaptureFixture
) -> None:
    statistics = runtime.statistics
    remember(statistics, lab, {**CHANGED, **USUAL, **WORSE})
    alarms = Alarms(runtime.engine, statistics)
    alarms.check_map(lab)
    assert told == [] and statistics.alarms(map_key(lab)) == [], "the map has no alarms"
    lab.edit({"alarms": AlarmSetting(changed_places=1, worse_places=2)})
    for _ in range(3):
        alarms.check_map(lab)
    (event,) = told
    assert (event.alarm, event.raised, event.count, event.limit, event.places) == ("changed_places", True, 1, 1, ["p2"])
    assert event.sentence.startswith("1 place has changed. Add a look of each place as it is now, or set")
    assert event.key is None and "alarm changed_places of map lab is raised" in caplog.text
    ((name, count, since),) = statistics.alarms(map_key(lab))
    assert (name, count) == ("changed_places", 1) and abs(since - datetime.now(UTC)) < timedelta(minutes=5)
    again = Alarms(runtime.engine, statistics)  # as after a restart
    again.check_map(lab)
    assert len(told) == 1
    lab.edit({"alarms": AlarmSetting(changed_places=2)})
    for _ in range(2):
        again.check_map(lab)
    assert [(one.alarm, one.raised, one.limit) for one in told[1:]] == [("changed_places", False, 2)]
    assert statistics.alarms(map_key(lab)) == []
    lab.edit({"alarms": AlarmSetting(changed_places=1)})
    again.check_map(lab)
    lab.edit({"alarms": AlarmSetting()})
    again.check_map(lab)
    assert [one.raised for one in told[2:]] == [True, False] and told[-1].limit is None


def test_all_three_trends_raise_alarms(runtime: Runtime, lab: Map, told: list[AlarmEvent]) -> None:
    walked = {(f"p{n}", 40): PlacePeriod(best=3, recognized=3) for n in range(8)}
    remember(runtime.statistics, lab, {**walked, **CHANGED, **WORSE, **USUAL})
    lab.edit({"alarms": AlarmSetting(changed_places=1, worse_places=1, quiet_stretches=1)})
    Alarms(runtime.engine, runtime.statistics).check_map(lab)
    assert {one.alarm: one.places for one in told} == {"worse_places": ["p3"], "changed_places": ["p2"]}, "too few"
    lab.enrol(enrolments(8, 3, "p", "monday", 512))
    remember(runtime.statistics, lab, {(f"p{n}", 40): PlacePeriod(best=3, recognized=3) for n in (8, 9, 10)})
    Alarms(runtime.engine, runtime.statistics).check_map(lab)
    assert [(one.alarm, one.places) for one in told[2:]] == [("quiet_stretches", ["p7"])]


def test_writing_counts_checks_the_alarms_of_their_maps(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PLACEREC_STATISTICS_SECONDS", "0.1")
    with runtime_at(tmp_path) as runtime:
        map_ = runtime.engine.maps.create("lab", ENCODER, 512)
        map_.enrol(enrolments(0, 8, "p", "monday", 512))
        map_.edit({"alarms": AlarmSetting(changed_places=1)})
        remember(runtime.statistics, map_, {("p2", 1): CHANGED["p2", 1], **USUAL})
        key = map_key(map_)
        for _ in range(6):
            runtime.statistics.observe(key, "unknown", None, None, None, passed=PassedBy("p2", missed=True))
        runtime.statistics.start()
        wait_until(lambda: [name for name, _, _ in runtime.statistics.alarms(key)] == ["changed_places"])


def test_checks_take_a_small_share_of_the_time(runtime: Runtime, lab: Map, monkeypatch: pytest.MonkeyPatch) -> None:
    now, checks = 100.0, 0
    alarms = Alarms(runtime.engine, runtime.statistics, lambda: now)

    def check_map(_: Map) -> None:
        nonlocal now, checks
        now, checks = now + 0.5, checks + 1

    monkeypatch.setattr(alarms, "check_map", check_map)
    for at in (100, 110, 149, 151, 160):
        now = at
        alarms.check([map_key(lab)])
    assert checks == 2
    alarms.check([("gone", "2026-11-20T09:00:00+00:00")])
    assert checks == 2


def test_the_report_says_in_sentences_what_has_changed_and_what_to_do(runtime: Runtime, lab: Map) -> None:
    walked = {(f"p{n}", 40): PlacePeriod(best=3, recognized=3) for n in range(8)}
    remember(runtime.statistics, lab, {**walked, **CHANGED, **WORSE, ("p0", 0): USUAL["p0", 0]})
    statistics = runtime.statistics
    counted = statistics.read(map_key(lab))
    found = trends_of(lab, statistics.histories(map_key(lab)), counted.places)
    report = trends_view(lab.record, found, [], 20)
    assert report.worse[0].sentence == (
        "p3 gets worse: of the 7 days of the last week on which robots were there, it was recognized in most frames on "
        "1; before, on 6 of 6."
    )
    assert report.changed[0].sentence == (
        "p2 has changed: robots that were sure to be there passed it with 12 frames in the last 7 days, and 12 of them "
        "were not recognized."
    )
    (stretch,) = report.quiet
    assert (stretch.first, stretch.last, stretch.places) == ("p4", "p7", 4)
    assert stretch.sentence.startswith("Nobody drives from p4 to p7 any more: the last robot was there on ")
    assert set(report.advice) == {"worse_places", "changed_places", "quiet_stretches"}
    lab.edit({"learning": lab.record.learning.model_copy(update={"mode": "propose"})})
    assert "they wait for review" in trends_view(lab.record, found, [], 20).advice["changed_places"]
    none = trends_view(lab.record, found, [], 0)
    assert (none.worse, none.worse_count) == ([], 1)


@pytest.mark.postgres
def test_of_services_that_share_a_ledger_one_tells_an_alarm(postgres: Postgres) -> None:
    postgres.empty()
    key = ("lab", "2026-11-20T09:00:00+00:00")
    with closing(PostgresLedger(postgres.address, [TABLES, recent_answers.TABLES])) as ledger:
        services = [QueryStatistics(ledger, 3600, lambda: None, lambda _: set(), shared=True) for _ in range(2)]
        assert [one.put_alarm(key, "worse_places", True, 3) for one in services] == [True, False]
        assert [one.put_alarm(key, "worse_places", False, 0) for one in services] == [True, False]
        assert services[0].put_alarm(key, "worse_places", True, 4) and len(services[1].alarms(key)) == 1
        for one in services:
            one.close()
