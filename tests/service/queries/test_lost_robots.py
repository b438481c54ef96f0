"""Robots that are lost: what raises and clears an alarm is what the robot was told, several times and for a while."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from datetime import UTC, datetime, timedelta
from pathlib import Path

import httpx
import pytest

from core.judgement.verdict import Verdict
from core.ledger import Ledger
from core.ledger.postgres import PostgresLedger
from service.access.audit import Asker
from service.access.roles import ANONYMOUS, Principal
from service.app.runtime import Runtime
from service.queries import recent_answers
from service.queries.count_tables import TABLES, statistics_file
from service.queries.given_answers import GivenAnswer, MapKey, QueriedFrame
from service.queries.histories import lost_robots
from service.queries.histories.lost_robots import LostRobot
from service.queries.statistics import QueryStatistics, map_key
from service.sessions.schemas import NewSession
from service.upkeep.fleet import FleetState, read_fleet
from tests.servers.postgres import Postgres
from tests.service.engines import ENCODER, runtime_at
from tests.service.scenes import jpeg
from tests.service.server import Server

LAB: MapKey = ("lab", "2026-11-20T09:00:00+00:00")
BEGIN = datetime(2026, 11, 28, 10, 0, tzinfo=UTC)

LETTERS: dict[str, Verdict] = {"R": "recognized", "A": "ambiguous", "U": "unknown"}


def given(at: datetime, verdict: Verdict, run: Verdict | None = None, session: str | None = None) -> GivenAnswer:
    """An answer to a robot with a key."""
    values: dict[str, object] = dict.fromkeys(GivenAnswer._fields)
    values |= {"at": at, "verdict": verdict, "run": run, "place": "p7" if verdict == "recognized" else None}
    values |= {"frame": QueriedFrame("front", session), "matches": (), "asker": Asker("robot-7", "k7")}
    return GivenAnswer(**values)  # type: ignore[arg-type]


def send(
    statistics: QueryStatistics,
    runs: str,
    frames: str | None = None,
    begin: datetime = BEGIN,
    every: float = 10.0,
    session: str | None = None,
    key: MapKey = LAB,
) -> datetime:
    """Answers at a pace in seconds, by the first letters of their verdicts; the moment of the last one.

    Args:
        runs: what the robot was told.
        frames: what each frame said by itself; None: the robot has no run, and was told that.
    """
    at = begin
    for number, letter in enumerate(runs):
        at = begin + timedelta(seconds=number * every)
        single, run = (LETTERS[letter], None) if frames is None else (LETTERS[frames[number]], LETTERS[letter])
        answer = given(at, single, run, session)
        statistics.recent.add(key, answer)
        statistics.robots.observe(key, answer)
    return at


Counting = Callable[[], QueryStatistics]


@pytest.fixture(params=["sqlite", pytest.param("postgresql", marks=pytest.mark.postgres)])
def counting(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Counting]:
    """Begins to count in a ledger; it has what was counted before in the same test."""
    ledgers: list[Ledger] = []
    if request.param == "postgresql":
        server: Postgres = request.getfixturevalue("postgres")
        server.empty()

    def begun() -> QueryStatistics:
        shared = request.param == "postgresql"
        if shared:
            ledgers.append(PostgresLedger(server.address, [TABLES, recent_answers.TABLES, lost_robots.TABLES]))
            return QueryStatistics(ledgers[-1], 3600, lambda: {LAB: 10}, lambda _: set(), shared)
        robots = lost_robots.lost_robots_file(tmp_path)
        return QueryStatistics(statistics_file(tmp_path), 3600, lambda: {LAB: 10}, lambda _: set(), robots=robots)

    yield begun
    for ledger in ledgers:
        ledger.close()


def lost(statistics: QueryStatistics) -> LostRobot | None:
    """The only alarm, if there is one."""
    return next(iter(statistics.lost_robots()), None)


@pytest.mark.parametrize(
    ("runs", "frames", "raised"),
    [
        ("UUUU", None, True),
        ("UUUU", "UURU", True),  # a stray frame that is recognized by itself, in a run that stays lost
        ("UUUU", "RRRR", True),
        ("RRRR", "UUUU", False),  # a run that knows where it is, of frames that say nothing
        ("UUU", None, False),  # twenty seconds
        ("UURUU", None, False),
        ("AUAU", None, True),
        ("UUUURRU", None, True),  # two of them do not clear it
        ("UUUURRR", None, False),
        ("UUUURRRUU", None, False),
    ],
)
def test_an_alarm_is_raised_late_and_cleared_late_by_what_the_robot_was_told(
    counting: Counting, runs: str, frames: str | None, raised: bool
) -> None:
    statistics = counting()
    send(statistics, runs, frames, session=None if frames is None else "s-1")
    found = lost(statistics)
    assert (found is not None and found.until is None) == raised
    if found is not None and raised:
        assert (found.since, found.key, found.camera) == (BEGIN, "robot-7", "front")
    statistics.close()


def test_many_frames_within_a_blink_raise_nothing(counting: Counting) -> None:
    statistics = counting()
    send(statistics, "U" * 100, every=0.1)
    assert lost(statistics) is None
    statistics.close()


def test_an_alarm_survives_a_restart_and_is_cleared_by_whichever_service_hears_the_robot(counting: Counting) -> None:
    first = counting()
    end = send(first, "RUUUUU")
    raised = lost(first)
    assert raised is not None and raised.place == "p7" and raised.since == BEGIN + timedelta(seconds=10)
    first.close()
    second = counting()
    assert lost(second) == raised
    later = send(second, "UUUU", begin=end + timedelta(seconds=10))
    again = lost(second)
    assert again is not None and again.since == raised.since, "it is the same one"
    second.close()
    third = counting()
    cleared = send(third, "RRR", begin=later + timedelta(seconds=10))
    found = lost(third)
    assert found is not None and (found.since, found.until) == (raised.since, cleared)
    third.robots.forget(LAB)
    assert lost(third) is None
    third.close()


# As the fleet tells it


@pytest.fixture
def runtime(tmp_path: Path) -> Iterator[Runtime]:
    with runtime_at(tmp_path) as running:
        running.engine.maps.create("lab", ENCODER, 8)
        yield running


def fleet(runtime: Runtime, principal: Principal = ANONYMOUS) -> FleetState:
    return read_fleet(runtime.engine, runtime.sessions, runtime.statistics, principal)


def test_the_fleet_tells_who_is_lost_and_for_a_day_who_was(runtime: Runtime) -> None:
    map_, statistics = runtime.engine.maps.get("lab"), runtime.statistics
    key = map_key(map_)
    statistics.observe(key, "unknown", None, None, None)
    session = runtime.sessions.create(map_, NewSession()).id
    begin = datetime.now(UTC) - timedelta(minutes=5)
    end = send(statistics, "RUUUUU", "RUUURU", begin, session=session, key=key)
    state = fleet(runtime)
    (robot,) = state.robots
    assert (robot.verdict, robot.place, robot.lost_since) == ("unknown", "p7", begin + timedelta(seconds=10))
    assert robot.verdicts == ["unknown", "recognized", "unknown", "unknown", "unknown", "recognized"]
    (alarm,) = state.lost
    assert alarm.raised and (alarm.since, alarm.cleared_at) == (begin + timedelta(seconds=10), None)
    assert (alarm.session, alarm.place, alarm.last_at, alarm.name) == (session, "p7", end, "robot-7")
    (alarm,) = fleet(runtime, Principal("guest", "k", "query", None)).lost
    assert alarm.name is None, "names are for keys of the role enrol"
    assert fleet(runtime, Principal("guest", "k", "query", frozenset({"yard"}))).lost == []

    cleared = send(statistics, "RRR", "RRR", end + timedelta(seconds=10), session=session, key=key)
    state = fleet(runtime)
    assert state.robots[0].lost_since is None
    (alarm,) = state.lost
    assert not alarm.raised and alarm.cleared_at == cleared


def test_an_alarm_of_a_run_that_is_over_is_listed_for_a_day(runtime: Runtime) -> None:
    map_, statistics = runtime.engine.maps.get("lab"), runtime.statistics
    key = map_key(map_)
    statistics.observe(key, "unknown", None, None, None)
    now = datetime.now(UTC)
    send(statistics, "UUUU", "UUUU", now - timedelta(hours=2), session="s-over", key=key)
    (alarm,) = fleet(runtime).lost
    assert not alarm.raised and alarm.cleared_at is None, "nobody is there any more"
    send(statistics, "UUUU", "UUUU", now - timedelta(hours=30), session="s-older", key=key)
    assert [one.session for one in fleet(runtime).lost] == ["s-over"]


# What a person tries


def test_what_is_tried_in_the_console_is_answered_and_counted_nowhere(server: Server, map_id: str) -> None:
    server.enrol(map_id, "p1", jpeg(1))
    server.client.patch(f"/v1/maps/{map_id}", json={"review": None})
    url = server.client.base_url
    with httpx.Client(base_url=url, headers={"X-Placerec-Console": "1"}, timeout=60) as console:
        kind = {"Content-Type": "image/jpeg"}
        for path in (f"/v1/maps/{map_id}/query", f"/v1/query?maps={map_id}"):
            answer = console.post(path, content=jpeg(1), headers=kind)
            assert answer.status_code == 200 and answer.json()["place"] is not None, answer.text
    assert counted(server, map_id) == (0, 0, 0, 0)
    server.query(map_id, jpeg(1))
    assert counted(server, map_id) == (1, 1, 1, 1)


def counted(server: Server, map_id: str) -> tuple[int, int, int, int]:
    """How many answers of a map the lists, the statistics, the metrics and the fleet know."""
    listed = server.client.get(f"/v1/maps/{map_id}/answers").json()["items"]
    health = server.client.get(f"/v1/maps/{map_id}/health").json()["answers"]["queries"]
    metrics = [line for line in server.client.get("/metrics").text.splitlines() if f'map="{map_id}"' in line]
    verdicts = sum(float(line.rsplit(" ", 1)[1]) for line in metrics if line.startswith("placerec_verdicts_total"))
    robots = [one for one in server.client.get("/v1/fleet").json()["robots"] if one["map"] == map_id]
    return len(listed), health, int(verdicts), len(robots)
