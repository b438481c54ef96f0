"""The load of a service over time: counted by the minute, stored for a week, and put together over services."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import closing
from pathlib import Path

import pytest

from core.errors import StorageFull
from core.ledger import Ledger
from core.ledger.disposable import DisposableLedger
from core.ledger.postgres import PostgresLedger
from service.telemetry.history import FILE, MINUTES, MOST_POINTS, TABLES, LoadHistory
from tests.servers.postgres import Postgres
from tests.service.scenes import jpeg
from tests.service.server import Server

QUERY = "/v1/maps/{map}/query"


class Clock:
    """A clock that goes on when it is told; it begins with a minute."""

    def __init__(self) -> None:
        self.minutes = 30_000_000.0

    def __call__(self) -> float:
        return 60 * self.minutes


Running = Callable[[str], LoadHistory]


@pytest.fixture
def clock() -> Clock:
    return Clock()


@pytest.fixture(params=["sqlite", pytest.param("postgresql", marks=pytest.mark.postgres)])
def running(request: pytest.FixtureRequest, tmp_path: Path, clock: Clock) -> Iterator[Running]:
    """Begins the history of a service of a name; it has what was written before in the same test."""
    ledgers: list[Ledger] = []
    if request.param == "postgresql":
        server: Postgres = request.getfixturevalue("postgres")
        server.empty()

    def begun(name: str) -> LoadHistory:
        history = LoadHistory(tmp_path, clock)
        if request.param == "sqlite":
            history.start()
        else:
            ledgers.append(PostgresLedger(server.address, [TABLES]))
            history.start(ledgers[-1], name)
        return history

    yield begun
    for ledger in ledgers:
        ledger.close()


def test_minutes_are_counted_and_survive_a_restart(running: Running, clock: Clock) -> None:
    history = running("a")
    for verdict in ("recognized", "recognized", "unknown"):
        history.observe_answer(verdict)
    for seconds in (0.02, 0.02, 0.4):
        history.observe_request(QUERY, 200, seconds)
    history.observe_request(QUERY, 503, 0.02)
    history.observe_request("/v1/maps", 200, 9.0)
    clock.minutes += 1
    history.observe_answer("ambiguous")
    clock.minutes += 2
    step, points = history.read(60)
    assert (step, [one.minute - points[0].minute for one in points]) == (1, [0, 1, 3])
    first, second, third = points
    assert (first.recognized, first.ambiguous, first.unknown, first.requests, first.errors) == (2, 0, 1, 4, 1)
    assert first.p50 == pytest.approx(20, rel=0.03) and first.p99 == pytest.approx(400, rel=0.03)
    assert (second.ambiguous, second.requests, second.p50) == (1, 0, None)
    assert third.resident and third.disk_free and third.disk_total and third.disk_free <= third.disk_total
    history.observe_answer("unknown")
    history.close()
    again = running("a")
    again.observe_answer("unknown")
    for seconds in (0.04, 0.04):
        again.observe_request(QUERY, 200, seconds)
    again.write()
    again.observe_request(QUERY, 200, 0.01)
    clock.minutes += 1
    latest = again.read(60)[1]
    assert [one.unknown for one in latest] == [1, 0, 2, 0], "what was counted before the restart is there"
    assert latest[2].p50 == pytest.approx((2 * 40 + 10) / 3, rel=0.03) and latest[2].requests == 3
    assert latest[2].p99 == pytest.approx(40, rel=0.03) and latest[2].resident
    again.close()


def test_what_a_disk_refuses_is_written_later(tmp_path: Path, clock: Clock, monkeypatch: pytest.MonkeyPatch) -> None:
    history = LoadHistory(tmp_path, clock)
    history.start()
    history.observe_answer("unknown")
    with monkeypatch.context() as patched:
        patched.setattr(DisposableLedger, "transaction", refuse)
        with pytest.raises(StorageFull):
            history.write()
    history.observe_answer("unknown")
    assert [one.unknown for one in history.read(5)[1]] == [2]
    assert [one.unknown for one in history.read(5)[1]] == [2], "nothing is counted twice"
    history.close()


def refuse(*_: object, **__: object) -> None:
    """The disk is full."""
    raise StorageFull("no room")


def test_a_week_is_stored_and_given_in_few_points(running: Running, clock: Clock) -> None:
    history = running("a")
    for _ in range(MINUTES // 20 + 30):
        history.observe_answer("recognized")
        clock.minutes += 20
    step, points = history.read(MINUTES)
    assert len(points) <= MOST_POINTS and step == MINUTES / MOST_POINTS
    assert sum(one.recognized for one in points) == pytest.approx(MINUTES // 20, abs=1)
    assert {one.minute % step for one in points} == {0}
    history.close()


@pytest.mark.postgres
def test_services_are_put_together(postgres: Postgres, tmp_path: Path, clock: Clock) -> None:
    postgres.empty()
    with closing(PostgresLedger(postgres.address, [TABLES])) as ledger:
        services = [LoadHistory(tmp_path, clock) for _ in range(2)]
        for number, one in enumerate(services):
            one.start(ledger, f"service-{number}")
            one.observe_answer("recognized")
            for _ in range(3 * number + 1):
                one.observe_request(QUERY, 200, 0.01 * (number + 1))
            one.write()
        (point,) = services[0].read(5)[1]
        assert (point.recognized, point.requests) == (2, 5)
        assert point.p50 == pytest.approx((10 + 4 * 20) / 5, rel=0.03) and point.p99 == pytest.approx(20, rel=0.03)
        single = services[0].read(5)[1][0].resident or 0
        assert single > 1.5 * 10**7, "the memory of both"
        for one in services:
            one.close()


def test_a_damaged_file_is_put_aside(tmp_path: Path, clock: Clock) -> None:
    (tmp_path / FILE).write_bytes(b"no database at all")
    history = LoadHistory(tmp_path, clock)
    history.start()
    history.observe_answer("unknown")
    assert [one.unknown for one in history.read(5)[1]] == [1]
    assert list(tmp_path.glob(f"{FILE}.damaged*"))
    history.close()


def test_the_service_tells_its_load_without_the_requests_of_the_console(server: Server, traverse: str) -> None:
    def told(name: str) -> int:
        return sum(server.client.get("/v1/service/history", params={"hours": 1}).json()[name])

    def listed() -> int:
        operations = server.client.get("/v1/service").json()["requests"]["operations"]
        return sum(one["count"] for one in operations if one["path"] == QUERY)

    before, answered = told("requests"), sum(told(name) for name in ("recognized", "ambiguous", "unknown"))
    known = listed()
    header = {"Content-Type": "image/jpeg"}
    for more in ({}, {}, {"X-Placerec-Console": "1"}):
        path = f"/v1/maps/{traverse}/query"
        assert server.client.post(path, content=jpeg(1), headers=header | more).status_code == 200
    assert told("requests") == before + 2 and listed() == known + 2
    assert sum(told(name) for name in ("recognized", "ambiguous", "unknown")) == answered + 2
    assert server.client.get("/v1/service/history", params={"hours": 169}).status_code == 422
