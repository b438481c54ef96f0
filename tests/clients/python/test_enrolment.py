"""Two batches under way at a time: whatever happens on the way, places keep their order."""

from __future__ import annotations

import asyncio
import threading
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any
from uuid import uuid4

import httpx
import pytest

from core.places import PLACE_IDS
from placerec_client import (
    AsyncClient,
    Client,
    ConnectionFailed,
    Enrolled,
    InvalidFrame,
    InvalidName,
    InvalidParameter,
    NewPlace,
    Retry,
    batches,
    problems,
)
from placerec_client.frames import Frame
from tests.clients.python.test_retries import problem
from tests.fuzz.encoder import SMALL
from tests.service.map_jobs import wait_until
from tests.service.scenes import jpeg
from tests.service.server import Server


class Mischief(httpx.AsyncBaseTransport):
    """A way to a service on which some batches have other answers than its own, or none.

    Args:
        answers: by the number of the batch, counted from 1 as they are sent.
        lost: the numbers of those that the service takes, but whose answers are lost.
    """

    def __init__(self, answers: Mapping[int, httpx.Response | Exception], lost: Sequence[int] = ()) -> None:
        self._way, self._answers, self._lost = httpx.AsyncHTTPTransport(), answers, lost
        self.sent: list[httpx.QueryParams] = []
        self.under_way = self.most = 0

    async def handle_async_request(self, request: httpx.Request) -> httpx.Response:
        self.sent.append(request.url.params)
        number = len(self.sent)
        if (answer := self._answers.get(number)) is not None:
            await asyncio.sleep(0.2)  # so that the one behind is there before
            if isinstance(answer, Exception):
                raise answer
            return answer
        self.under_way += 1
        self.most = max(self.most, self.under_way)
        try:
            response = await self._way.handle_async_request(request)
            await response.aread()
        finally:
            self.under_way -= 1
        if number in self._lost:
            raise httpx.ReadError("the answer was lost", request=request)
        return response

    async def aclose(self) -> None:
        await self._way.aclose()


def enrol(server: Server, map_id: str, count: int, way: Mischief, patience: float = 120) -> list[Enrolled]:
    places = (NewPlace(f"p{index}", jpeg(index, 64, 48), {"sequence": "walk"}) for index in range(count))
    told: list[Enrolled] = []

    async def work() -> None:
        retry = Retry(patience, first_pause=0.05)
        async with AsyncClient(str(server.client.base_url), transport=way, retry=retry) as client:
            async for one in client.maps[map_id].enrol_each(places, known=()):
                told.append(one)  # noqa: PERF401 # what was told before an error counts

    try:
        asyncio.run(work())
    finally:
        assert [one.place.id for one in told] == [f"p{index}" for index in range(len(told))]
    return told


@pytest.fixture(autouse=True)
def small(monkeypatch: pytest.MonkeyPatch) -> None:
    """Batches that are so small that a few frames make many."""
    monkeypatch.setattr(batches, "FIRST_BATCH", 4)
    monkeypatch.setattr(batches, "LARGEST_BATCH", 4)


@pytest.fixture
def map_id(client: Client) -> str:
    """The id of a new, empty map, whose encoder takes next to no time."""
    return client.maps.create(f"line-{uuid4().hex}", encoder=SMALL).id


@pytest.mark.thorough
def test_two_at_a_time_in_line(server: Server, map_id: str) -> None:
    way = Mischief({})
    told = enrol(server, map_id, 26, way)
    assert list(server.places(map_id)) == [f"p{index}" for index in range(26)]
    assert {one.change for one in told} == {"created"} and len(told) == 26
    assert way.most == 2 and len(way.sent) == 7
    names = [line["batch"] for line in way.sent]
    assert [line.get("after") for line in way.sent] == [None, None, *names[1:-1]]


def test_enrolling_is_done_when_it_is_called(server: Server, url: str, map_id: str) -> None:
    def places(name: str) -> list[NewPlace]:
        return [NewPlace(f"{name}{index}", jpeg(index, 64, 48), {"sequence": name}) for index in range(6)]

    async def work() -> list[Enrolled]:
        async with AsyncClient(url) as client:
            return await client.maps[map_id].enrol(places("b"))

    with Client(url) as client:
        client.maps[map_id].enrol(places("a"))
        assert sorted(server.places(map_id)) == [f"a{index}" for index in range(6)]
    told = asyncio.run(work())
    assert [(one.place.id, one.change) for one in told] == [(f"b{index}", "created") for index in range(6)]
    assert len(server.places(map_id)) == 12


@pytest.mark.thorough
def test_refused_for_a_moment_unreachable_lost_and_out_of_line(server: Server, map_id: str) -> None:
    way = Mischief(
        {
            3: problem(503, "queue-full", **{"Retry-After": "0"}),
            7: httpx.ConnectError("refused"),
            11: problem(409, "batch-out-of-order"),
        },
        lost=[5, 9],
    )
    told = enrol(server, map_id, 60, way)
    assert list(server.places(map_id)) == [f"p{index}" for index in range(60)]
    assert {one.change for one in told} <= {"created", "unchanged"} and len(told) == 60
    assert len(way.sent) > 15  # those that were sent once more


@pytest.mark.thorough
def test_more_than_the_service_takes_at_a_time(server: Server, map_id: str) -> None:
    way = Mischief({4: problem(413, "body-too-large"), 8: problem(503, "deadline-exceeded", **{"Retry-After": "1"})})
    assert len(enrol(server, map_id, 30, way)) == 30
    assert list(server.places(map_id)) == [f"p{index}" for index in range(30)]


@pytest.mark.thorough
@pytest.mark.parametrize("failing", [1, 2, 4])
def test_what_comes_after_a_failure_is_not_stored(server: Server, map_id: str, failing: int) -> None:
    way = Mischief({failing: problem(507, "storage-full")})
    with pytest.raises(problems.StorageFull, match="It is storage-full"):
        enrol(server, map_id, 40, way)
    assert len(way.sent) <= failing + 1
    before = 4 * (failing - 1)
    assert list(server.places(map_id)) == [f"p{index}" for index in range(before)]
    # The same again goes on.
    enrol(server, map_id, 40, Mischief({}))
    assert list(server.places(map_id)) == [f"p{index}" for index in range(40)]


WRONG: list[Any] = ["", ".", "..", "a/b", "\n", 'a"b', "ä ö", "p" * 129, "\ud800", None, 5, b"p", ["p"]]
"""What is no id of a place."""


@pytest.mark.thorough
@pytest.mark.parametrize("known", [None, ()])
def test_a_place_that_cannot_be_sent_fails_alone(
    server: Server, client: Client, map_id: str, known: Sequence[str] | None
) -> None:
    """Nothing of it is sent: the service is not asked about it, and its frame is not read."""

    def unread() -> Frame:
        raise AssertionError("the frame was read")

    lab, picture = client.maps[map_id], jpeg(0, 64, 48)
    lab.places.put("p2", jpeg(2, 64, 48))
    wrong = [NewPlace(name, unread) for name in WRONG]
    unsendable: list[Any] = [{"metadata": {"a": object()}}, {"sequence": b"monday"}, {1: 2}, 5]
    wrong += [NewPlace("p1", picture, fields) for fields in unsendable]
    wrong += [NewPlace("p1", b"", lambda _: {"x": object()}), NewPlace("p1", "no such file")]
    right = [NewPlace(f"p{index}", jpeg(index, 64, 48)) for index in range(len(wrong))]
    given = [place for pair in zip(wrong, right, strict=True) for place in pair]
    told = lab.enrol(given, known=known)
    assert [one.place for one in told] == given
    assert {one.change for one in told[1::2]} <= {"created", "unchanged"}
    assert list(server.places(map_id)) == ["p2", *(f"p{index}" for index in range(len(wrong)) if index != 2)]
    assert {(one.change, one.uploaded) for one in told[::2]} == {(None, False)}
    assert [type(one.error) for one in told[::2]] == [InvalidName] * len(WRONG) + [InvalidParameter] * 5 + [
        InvalidFrame
    ]


def test_the_ids_of_places_are_those_of_the_service() -> None:
    assert batches.PLACE_ID.pattern == PLACE_IDS.pattern


@pytest.mark.thorough
@pytest.mark.parametrize("moment", [9, pytest.param(20, marks=pytest.mark.thorough)])
def test_a_kill_leaves_the_beginning(tmp_path: Path, moment: int) -> None:
    server = Server(tmp_path / "service").wait()
    server.create_map("walk")
    way, ended = Mischief({}), list[BaseException]()

    def send() -> None:
        try:
            enrol(server, "walk", 96, way, patience=0)
        except ConnectionFailed as error:
            ended.append(error)

    sender = threading.Thread(target=send)
    sender.start()
    wait_until(lambda: len(way.sent) >= moment)
    server.kill()
    sender.join(60)
    assert len(ended) == 1
    server = Server(tmp_path / "service").wait()
    kept = list(server.places("walk"))
    assert kept == [f"p{index}" for index in range(len(kept))] and 4 * (moment - 2) <= len(kept) < 96
    enrol(server, "walk", 96, Mischief({}))
    assert list(server.places("walk")) == [f"p{index}" for index in range(96)]
    assert server.stop() == 0
