"""Live events of services that share a ledger: a listener of one hears what happens at all."""

from __future__ import annotations

import asyncio
import json
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing, contextmanager
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest
from sqlalchemy import func, select

from core.ledger import Statement
from service.events.events import Events
from service.events.feed import FeedEvent, Listener
from service.events.relay import TABLES, EventRelay
from service.events.schemas import MapEvent, QueryEvent
from tests.service.scenes import blank, encoded, jpeg
from tests.service.server import Server
from tests.service.shared.services import MAP, fill, two_services

if TYPE_CHECKING:
    from service.shared.database import SharedDatabase
    from tests.servers.postgres import Postgres

pytestmark = [pytest.mark.postgres, pytest.mark.anyio]

SENT = Statement(select(func.count()).select_from(TABLES.metadata.tables["events"]))


def soon(check: Callable[[], Any]) -> Any:
    """What a check gives as soon as it is true."""
    until = time.monotonic() + 20
    while not (found := check()):
        assert time.monotonic() < until
        time.sleep(0.05)
    return found


@contextmanager
def two_relays(database: SharedDatabase, folder: Path) -> Iterator[tuple[Events, Events]]:
    """The events of two services, which take part as long as the block."""
    from service.peers.replica import ServiceReplica  # with it comes what speaks to PostgreSQL

    with ExitStack() as opened:
        found = []
        for name in ("one", "other"):
            replica = opened.enter_context(closing(ServiceReplica(database, folder / name)))
            relay = opened.enter_context(closing(EventRelay(replica, database)))
            found.append(Events(relay=relay))
            opened.callback(found[-1].stop_soon)
            replica.start()
            relay.start()
        yield found[0], found[1]


async def some(listener: Listener, count: int) -> list[FeedEvent]:
    """The next events of a listener."""
    found: list[FeedEvent] = []
    async with asyncio.timeout(20):
        while len(found) < count:
            await listener.changed.wait()
            listener.changed.clear()
            found += listener.read().events
    return found


async def until(check: Callable[[], bool]) -> None:
    """Wait until something is true."""
    async with asyncio.timeout(20):
        while not check():
            await asyncio.sleep(0.01)


def edited(revision: int, map_id: str = "lab") -> MapEvent:
    return MapEvent.now(map_id, change="edited", revision=revision)


def revisions(events: list[FeedEvent]) -> list[int]:
    return [json.loads(event.full)["revision"] for event in events]


async def test_a_listener_hears_the_events_of_its_map_at_all_services(database: SharedDatabase, tmp_path: Path) -> None:
    with two_relays(database, tmp_path) as (one, other):
        one.publish(edited(0))
        with other.listening("lab") as listener:
            await until(lambda: one.heard("lab"))
            assert not one.heard("hall"), "nobody listens to it"
            for revision in range(1, 4):
                one.publish(edited(revision))
                one.publish(edited(revision, "hall"))
            assert revisions(await some(listener, 3)) == [1, 2, 3]
            assert database.execute("count", SENT) == [(3,)]
            other.publish(edited(4))  # which nobody else hears
            assert revisions(await some(listener, 1)) == [4] and not other._shows_pictures("lab", None)
            with one.listening("lab") as here:
                await until(lambda: "lab" in other._elsewhere)
                one.publish(edited(5))
                other.publish(edited(6))
                for each in (here, listener):
                    assert sorted(revisions(await some(each, 2))) == [5, 6]
                one.end("lab")
                await until(lambda: listener.ended)


async def test_a_picture_is_made_where_the_frame_is_for_listeners_elsewhere(
    database: SharedDatabase, tmp_path: Path
) -> None:
    query = QueryEvent.now(
        "lab", operation="query", verdict="unknown", probability=None, place=None, best=None, pose=None, score=None,
        decision=None, threshold=None, reason="empty-map", camera=None, milliseconds={}, revision=1,
    )  # fmt: skip
    with two_relays(database, tmp_path) as (one, other), other.listening("lab") as plain:
        await until(lambda: one.heard("lab"))
        one.publish(query, jpeg(1))
        assert [event.picture for event in await some(plain, 1)] == [None]
        with other.listening("lab", pictures=True):
            await until(lambda: one._shows_pictures("lab", None))
            one.publish(query, jpeg(1))
            (event,) = await some(plain, 1)
            assert event.picture is not None and event.verdict == "unknown" and event.maps == {"lab"}


@pytest.mark.thorough
async def test_events_are_received_although_the_service_hears_of_them_late(
    database: SharedDatabase, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from service.peers.replica import ServiceReplica

    connected, listen = threading.Event(), ServiceReplica._listen

    def listen_late(replica: ServiceReplica) -> None:
        connected.wait(20)
        listen(replica)

    monkeypatch.setattr(ServiceReplica, "_listen", listen_late)
    with two_relays(database, tmp_path) as (one, other), other.listening("lab") as listener:
        await until(lambda: one.heard("lab"))  # as it looks at each beat
        one.publish(edited(1))
        await until(lambda: database.execute("count", SENT) == [(1,)])
        connected.set()
        assert revisions(await some(listener, 1)) == [1]


@pytest.mark.thorough
async def test_services_stop_sending_a_while_after_the_last_listener_has_left(
    database: SharedDatabase, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("service.events.events.LINGER_SECONDS", 0.0)
    with two_relays(database, tmp_path) as (one, other):
        with other.listening("lab"):
            await until(lambda: one.heard("lab"))
        await until(lambda: not one.heard("lab"))


# Two whole services


@contextmanager
def listening(server: Server, map_id: str) -> Iterator[list[tuple[str, dict[str, Any]]]]:
    """The events of a map, as they come."""
    heard: list[tuple[str, dict[str, Any]]] = []
    begun, name = threading.Event(), ""

    def read() -> None:
        nonlocal name
        with server.client.stream("GET", f"/v1/maps/{map_id}/events", timeout=60) as response:
            try:
                for line in response.iter_lines():
                    if line.startswith("event: "):
                        name = line.removeprefix("event: ")
                    elif line.startswith("data: "):
                        heard.append((name, json.loads(line.removeprefix("data: "))))
                        begun.set()
            except Exception as error:  # the server was ended
                heard.append(("ended", {"error": str(error)}))

    thread = threading.Thread(target=read, daemon=True)
    thread.start()
    assert begun.wait(20)
    yield heard


@pytest.mark.thorough
def test_answers_of_one_service_are_shown_by_the_other(
    tmp_path: Path, postgres: Postgres, database: SharedDatabase
) -> None:
    def new_session(server: Server) -> str:
        return str(server.client.post(f"/v1/maps/{MAP}/sessions", json={}).json()["id"])

    with ExitStack() as stack:
        one, other = stack.enter_context(two_services(tmp_path, postgres.address, {}))
        fill(one)
        heard = stack.enter_context(listening(other, MAP))
        begun = []
        while "session" not in [kind for kind, _ in heard]:  # one knows who listens, after a while
            begun.append(new_session(one))
            one.client.delete(f"/v1/maps/{MAP}/sessions/{begun[-1]}").raise_for_status()
            assert len(begun) < 400, "one does not learn who listens"
            time.sleep(0.05)
        asked = [one.query(MAP, jpeg(number)) for number in range(3)]
        blank_one = other.query(MAP, encoded(blank()))
        verdicts = [answer["verdict"] for answer in (*asked, blank_one)]
        told = soon(lambda: len(queries := [event for kind, event in heard if kind == "query"]) == 4 and queries)
        assert sorted(event["verdict"] for event in told) == sorted(verdicts)
        assert {event["best"] for event in told} == {"p0", "p1", "p2", None}
        made = new_session(one)
        soon(lambda: made in [event.get("session") for _, event in heard])
        for server in (one, other):
            page = soon(partial(_answers, server, MAP, 4))
            assert sorted(item["verdict"] for item in page["items"]) == sorted(verdicts)
            soon(partial(_counted, server, MAP, len(verdicts)))
            counted = server.client.get(f"/v1/maps/{MAP}/places/p1/matches").json()
            assert counted["best"] == 1
        one.kill()
        assert _counted(other, MAP, len(verdicts)) and _answers(other, MAP, 4)


def _answers(server: Server, map_id: str, count: int) -> dict[str, Any] | None:
    page: dict[str, Any] = server.client.get(f"/v1/maps/{map_id}/answers").json()
    return page if page["kept"] == count else None


def _counted(server: Server, map_id: str, count: int) -> bool:
    hours = server.client.get(f"/v1/maps/{map_id}/answers").json()["hours"]
    return count == sum(hour[verdict] for hour in hours for verdict in ("recognized", "ambiguous", "unknown"))
