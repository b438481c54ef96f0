"""Sessions: frames are counted once, over HTTP and over a WebSocket that is lost."""

from __future__ import annotations

import asyncio
import inspect
import math
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import replace
from typing import Any

import httpx
import numpy as np
import pytest

from placerec_client import (
    AsyncClient,
    Client,
    ConnectionFailed,
    DeadlineExceeded,
    InvalidOdometry,
    Map,
    Odometry,
    Retry,
    Session,
    UnexpectedAnswer,
    models,
    problems,
)
from placerec_client.parameters import SendFrame
from tests.clients.python.fault_proxy import Fault, FaultProxy
from tests.clients.python.moments import Moments
from tests.service.refusing import Seen, refusing_server
from tests.service.scenes import jpeg
from tests.service.server import Server


@pytest.fixture(scope="module")
def refusing() -> Iterator[tuple[str, Seen]]:
    with refusing_server() as server:
        yield server


@pytest.fixture
def walk(lab: Map) -> Map:
    for number in range(4):
        lab.places.put(f"p{number}", jpeg(number, 64, 48), x=2 * number, y=0, sequence="walk")
    return lab


@pytest.mark.thorough
def test_a_frame_whose_answer_is_lost_counts_once(server: Server, walk: Map) -> None:
    with FaultProxy(server.port, share=0.6, seed=3, faults=("lose-answer", "cut-answer", "duplicate")) as way:
        with Client(way.url, retry=Retry(60, 0.02, 0.2)) as client, client.maps[walk.id].sessions.begin() as session:
            answers = [session.send(jpeg(number % 4, 64, 48)) for number in range(12)]
            assert [one.frames for one in answers] == list(range(1, 13))
            assert session.read().frames == 12
        assert way.happened["lose-answer"] + way.happened["cut-answer"] > 3


@pytest.mark.thorough
def test_a_stream_is_taken_up_again(server: Server, walk: Map) -> None:
    with FaultProxy(server.port, share=0, messages=5) as way, Client(way.url, retry=Retry(60, 0.02, 0.2)) as client:
        with client.maps[walk.id].sessions.begin() as session, session.stream() as stream:
            for number in range(10):
                answer = stream.send(jpeg(number % 4, 64, 48), forward=2.0 if number else None)
                assert (answer.frame, answer.frames) == (number, number + 1)
            with pytest.raises(problems.NotAnImage):
                stream.send(b"no picture")
            assert stream.send(jpeg(0, 64, 48)).frames == 11, "a refused frame does not count"
        assert way.happened["cut-stream"] > 1


WAY = (0, 1, 2, 3, 2, 1, 0, 1, 2, 3)
"""The places before which the robot stands, one after the other; it drives back and forth."""


def odometry_at(place: int) -> Odometry:
    """Odometry that began askew, somewhere else."""
    grown = 0.01 * place
    return Odometry(3.0, 2.0 * place - 8, 90.0, [grown, 0, 0, 0, grown, 0, 0, 0, 0], "morning")


@pytest.mark.thorough
@pytest.mark.parametrize("patience", [0, 60])
def test_odometry_counts_once_whatever_is_lost(server: Server, walk: Map, patience: float) -> None:
    fates: list[Fault] = ["none", "lose-answer", "cut-request", "lose-answer", "lose-answer", "cut-before", "none"]

    def fate(head: bytes) -> Fault:
        return fates.pop(0) if fates and b"/frames" in head else "none"

    with (
        FaultProxy(server.port, choose=fate) as way,
        Client(way.url, retry=Retry(patience, 0.02, 0.2)) as client,
        client.maps[walk.id].sessions.begin() as session,
        walk.sessions.begin() as expected,
    ):
        last: int | None = None
        for number, place in enumerate(WAY):
            told, frame = None, jpeg(place, 64, 48)
            with suppress(ConnectionFailed):
                told = session.send(frame, odometry=odometry_at(place))
            report = session.read()
            if report.last_frame != number:
                assert told is None
                continue
            motion: SendFrame = {"frame": number}
            if last is not None:
                deviation = max(0.0, 0.01 * (place - WAY[last])) ** 0.5
                motion |= {"forward": 2.0 * (place - WAY[last]), "deviation": deviation}
            true = expected.send(frame, **motion)
            last = number
            for found in (report.belief, told or report.belief):
                assert found.candidates[0].place.id == true.candidates[0].place.id
                assert found.candidates[0].probability == pytest.approx(true.candidates[0].probability, abs=1e-5)
        assert last == len(WAY) - 1 and not fates and true.motion == "odometry"
        assert report.frames == (len(WAY) if patience else len(WAY) - 2)


@pytest.mark.thorough
def test_a_stream_that_is_cut_counts_odometry_once(server: Server, walk: Map) -> None:
    with FaultProxy(server.port, share=0, messages=5) as way, Client(way.url, retry=Retry(60, 0.02, 0.2)) as client:
        sessions = client.maps[walk.id].sessions
        with sessions.begin() as session, session.stream() as stream, walk.sessions.begin() as expected:
            for number, place in enumerate(WAY):
                told = stream.send(jpeg(place, 64, 48), odometry=replace(odometry_at(place), covariance=None))
                motion: SendFrame = {"forward": 2.0 * (place - WAY[number - 1])} if number else {}
                true = expected.send(jpeg(place, 64, 48), **motion)
                assert (told.frames, told.motion) == (true.frames, true.motion)
                assert [one.place.id for one in told.candidates] == [one.place.id for one in true.candidates]
                assert told.unknown == pytest.approx(true.unknown, abs=1e-5)
        assert way.happened["cut-stream"] > 1


@pytest.mark.parametrize("half", [Client, AsyncClient])
def test_a_motion_that_is_none_is_refused_before_it_is_sent(refusing: tuple[str, Seen], half: Any) -> None:
    url, seen = refusing

    async def refused(**options: Any) -> str:
        session = half(url, retry=Retry(0)).maps["lab"].sessions["s"]
        for send in (session.send, session.stream().send):
            with pytest.raises(InvalidOdometry) as told:
                if inspect.isawaitable(sent := send(jpeg(1, 64, 48), frame=1, **options)):
                    await sent
        return str(told.value)

    for pose in ((1, 2, 3), [1, 2, 3], {"x": 1}, 4):
        said = asyncio.run(refused(odometry=pose))
        assert said.startswith(f"odometry has to be an Odometry, not a {type(pose).__name__}: give Odometry(x, y, head")
    for name in ("forward", "left", "turn"):
        for value in ((1, 2), "1", True, float("nan"), float("-inf"), 1e6, np.array([1.0])):
            assert f"{name} has to be a finite number of " in asyncio.run(refused(**{name: value}))
    assert seen == []


def test_odometry_is_what_the_service_takes() -> None:
    whole: dict[str, Any] = {"x": 1.0, "y": 2.0, "heading": 450.0}
    square = [0.1, 0.0, 0.0, 0.0, 0.1, 0.0, 0.0, 0.0, 0.01]
    for name in whole:
        for value in (None, "1", True, (1,), float("nan"), float("inf"), 1e9, np.array([1.0])):
            with pytest.raises(
                InvalidOdometry, match=f"^{name} has to be a finite number of (metres|degrees), at most 1"
            ):
                Odometry(**{**whole, name: value})
    for wrong in ([1.0], "123456789", 3.0, [*square[:8], float("nan")], [*square[:8], -1.0], [0.1, 5.0, *square[2:]]):
        with pytest.raises(InvalidOdometry, match=r"^covariance has to be "):
            Odometry(**whole, covariance=wrong)  # type: ignore[arg-type]
    for origin in (7, "x" * 129):
        with pytest.raises(InvalidOdometry, match=r"^origin has to be "):
            Odometry(**whole, origin=origin)  # type: ignore[arg-type]


def test_numbers_of_numpy_and_any_turn_are_taken(walk: Map) -> None:
    pose = Odometry(np.float32(1.5), np.array(2.0), np.int64(-720), np.eye(3).ravel())  # type: ignore[arg-type]
    with walk.sessions.begin() as session, session.stream() as stream:
        assert session.send(jpeg(0, 64, 48), odometry=pose).frames == 1
        assert stream.send(jpeg(1, 64, 48), odometry=replace(pose, heading=370.0)).motion == "odometry"


FIRST_CALLS: dict[str, Callable[[Session], object]] = {
    "begin": lambda session: session.begin(),
    "send": lambda session: session.send(jpeg(1, 64, 48)),
    "read": lambda session: session.read(),
    "stream": lambda session: session.stream().send(jpeg(1, 64, 48)),
}


@pytest.mark.parametrize("call", FIRST_CALLS)
def test_a_session_begins_at_its_first_call(lab: Map, call: str) -> None:
    session = lab.sessions.begin(lag=2)
    session.delete()  # there is none
    assert not session.id and "not begun" in repr(session) and list(lab.sessions) == []
    FIRST_CALLS[call](session)
    assert session.view is not None and session.view.id == session.id and session.view.lag == 2
    assert session.read().id == session.id
    session.delete()


def test_a_session_begins_once_whoever_sends_first(url: str, walk: Map) -> None:
    session = walk.sessions.begin()
    with ThreadPoolExecutor(4) as pool:
        answers = list(pool.map(lambda number: session.send(jpeg(number, 64, 48)), range(4)))
    assert sorted(one.frames for one in answers) == [1, 2, 3, 4]
    assert [one.id for one in walk.sessions] == [session.id]

    async def work() -> None:
        async with AsyncClient(url) as client:
            sessions = client.maps[walk.id].sessions
            awaited = await sessions.begin(lag=1)
            assert awaited.id and awaited is await awaited
            unbegun = sessions.begin()
            found = await asyncio.gather(*(unbegun.send(jpeg(number, 64, 48)) for number in range(4)))
            assert sorted(one.frames for one in found) == [1, 2, 3, 4]
            assert {one.id async for one in sessions} == {session.id, awaited.id, unbegun.id}

    asyncio.run(work())


def test_beginning_takes_of_the_deadline_of_the_frame(lab: Map, monkeypatch: pytest.MonkeyPatch) -> None:
    with lab.sessions.begin() as begun:
        assert begun.view is not None
        view = begun.view.model_dump_json()
    moments, requests = Moments(monkeypatch), list[tuple[str, float]]()

    def slow(request: httpx.Request) -> httpx.Response:
        requests.append((request.url.path.rpartition("/")[2], float(request.headers["X-Request-Timeout"])))
        moments.now += 0.125
        return httpx.Response(418 if request.url.path.endswith("frames") else 201, content=view)

    with Client("robot", transport=httpx.MockTransport(slow)) as client, pytest.raises(UnexpectedAnswer):
        client.maps["lab"].sessions.begin().send(b"frame", deadline=0.5)
    assert requests == [("sessions", 0.5), ("frames", 0.375)]


def test_a_session_that_is_entered_once_more_is_another_one(url: str, lab: Map) -> None:
    session, ids = lab.sessions.begin(lag=2), list[str]()
    for _ in range(2):
        with session:
            assert session.send(jpeg(1, 64, 48)).frame == 0
            assert session.read().lag == 2
            ids.append(session.id)
        with pytest.raises((problems.SessionExpired, problems.UnknownSession)):
            session.read()
    with session.begin():  # it is not begun twice
        ids.append(session.id)
        session.delete()
    assert len(set(ids)) == 3 and list(lab.sessions) == []

    async def work() -> None:
        async with AsyncClient(url) as client:
            again = client.maps[lab.id].sessions.begin()
            for _ in range(2):
                async with again:
                    assert (await again.send(jpeg(1, 64, 48))).frame == 0

    asyncio.run(work())


def test_a_session_that_was_begun_elsewhere_goes_on(walk: Map) -> None:
    with walk.sessions.begin() as session:
        session.send(jpeg(0, 64, 48), frame=41)
        other = walk.sessions[session.id]
        with other.stream() as stream:
            assert stream.send(jpeg(1, 64, 48)).frame == 42
        assert session.send(jpeg(1, 64, 48), frame=42).repeated
        with pytest.raises(problems.FrameOutOfOrder):
            session.send(jpeg(1, 64, 48), frame=7)


@pytest.mark.thorough
@pytest.mark.parametrize("streamed", [False, True])
def test_a_refused_frame_leaves_the_numbers_alone(walk: Map, streamed: bool) -> None:
    frame = jpeg(0, 64, 48)
    with walk.sessions.begin() as session, session.stream() as stream:
        send = (stream if streamed else session).send
        assert [send(frame).frame for _ in range(3)] == [0, 1, 2]
        with pytest.raises(problems.FrameOutOfOrder):
            send(frame, frame=1)
        with pytest.raises(problems.NotAnImage):
            send(b"no picture")
        with pytest.raises(problems.NotAnImage):
            send(b"no picture", frame=9)
        assert send(frame).frame == 3
        assert send(frame, frame=3).repeated
        assert send(frame).frame == 4
        # Another one has sent frames since: the number that was refused is not given again and again.
        walk.sessions[session.id].send(frame, frame=20)
        with pytest.raises(problems.FrameOutOfOrder):
            send(frame)
        assert send(frame).frame == 21


@pytest.mark.thorough
@pytest.mark.parametrize("streamed", [False, True])
def test_frames_at_the_same_time_are_sent_in_their_order(url: str, walk: Map, streamed: bool) -> None:
    async def work() -> list[models.SessionAnswer]:
        async with AsyncClient(url) as client, client.maps[walk.id].sessions.begin() as session:
            stream = session.stream()
            send = stream.send if streamed else session.send
            try:
                return await asyncio.gather(*(send(jpeg(number % 4, 64, 48)) for number in range(8)))
            finally:
                await stream.close()

    answers = asyncio.run(work())
    assert [(one.frame, one.frames) for one in answers] == [(number, number + 1) for number in range(8)]


def test_frames_of_several_threads_are_sent_one_after_the_other(walk: Map) -> None:
    with walk.sessions.begin() as session, ThreadPoolExecutor(4) as pool:
        answers = list(pool.map(lambda number: session.send(jpeg(number, 64, 48)), range(4)))
    assert sorted((one.frame, one.frames) for one in answers) == [(number, number + 1) for number in range(4)]


def test_a_frame_whose_turn_does_not_come_in_time() -> None:
    """It has no number and is not sent; the deadline begins with the call, not with its turn."""
    moment = asyncio.Event()
    asked: list[httpx.Request] = []

    async def slow(request: httpx.Request) -> httpx.Response:
        asked.append(request)
        await moment.wait()
        return httpx.Response(418)

    async def work() -> None:
        async with AsyncClient("robot", transport=httpx.MockTransport(slow)) as client:
            session = client.maps["lab"].sessions["of-before"]
            first = asyncio.create_task(session.send(b"first", frame=0))
            await asyncio.sleep(0)  # it is under way
            with pytest.raises(DeadlineExceeded, match=r"frames before took longer than 0\.05 s"):
                await session.send(b"second", deadline=0.05)
            moment.set()
            with pytest.raises(UnexpectedAnswer):
                await first
            with pytest.raises(UnexpectedAnswer):
                await session.send(b"third")

    asyncio.run(work())
    assert [request.url.params["frame"] for request in asked] == ["0", "1"]


@pytest.mark.parametrize("streamed", [False, True])
def test_the_last_number_is_requested_within_the_deadline(streamed: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    moments = Moments(monkeypatch)

    def refuse(_: httpx.Request) -> httpx.Response:
        raise httpx.ConnectError("refused")

    with Client("robot", transport=httpx.MockTransport(refuse)) as client:
        session = client.maps["lab"].sessions["of-before"]
        with pytest.raises(DeadlineExceeded):
            (session.stream() if streamed else session).send(b"frame", deadline=0.3)
    assert moments.now < 0.3


def test_the_frame_has_what_its_number_left_of_the_deadline(lab: Map, monkeypatch: pytest.MonkeyPatch) -> None:
    with lab.sessions.begin() as begun:
        report = begun.read().model_dump_json()
    moments, asked = Moments(monkeypatch), list[tuple[str, float]]()

    def slow(request: httpx.Request) -> httpx.Response:
        asked.append((request.method, float(request.headers["X-Request-Timeout"])))
        moments.now += 0.125
        return httpx.Response(200 if request.method == "GET" else 418, content=report)

    with Client("robot", transport=httpx.MockTransport(slow)) as client, pytest.raises(UnexpectedAnswer):
        client.maps["lab"].sessions["of-before"].send(b"frame", deadline=0.5)
    assert asked == [("GET", 0.5), ("POST", 0.375)]


@pytest.mark.parametrize("deadline", [math.inf, 1e10])
def test_a_deadline_may_be_as_late_as_one_likes(url: str, lab: Map, deadline: float) -> None:
    with lab.sessions.begin() as session, session.stream() as stream:
        assert session.send(jpeg(0, 64, 48), deadline=deadline).frames == 1
        assert stream.send(jpeg(1, 64, 48), deadline=deadline).frames == 2

    async def work() -> None:
        async with (
            AsyncClient(url) as client,
            client.maps[lab.id].sessions.begin() as session,
            session.stream() as stream,
        ):
            assert (await session.send(jpeg(0, 64, 48), deadline=deadline)).frames == 1
            assert (await stream.send(jpeg(1, 64, 48), deadline=deadline)).frames == 2

    asyncio.run(work())


def test_what_ends(walk: Map) -> None:
    session = walk.sessions.begin()
    with session.stream() as stream:
        stream.send(jpeg(0, 64, 48))
        session.delete()
        with pytest.raises((problems.SessionExpired, problems.UnknownSession)):
            stream.send(jpeg(1, 64, 48))
    session.delete()


@pytest.mark.thorough
def test_one_stream_at_a_time(server: Server, walk: Map) -> None:
    with walk.sessions.begin() as session, session.stream() as first:
        first.send(jpeg(0, 64, 48))
        with Client(str(server.client.base_url), retry=Retry(0)) as client:
            other = client.maps[walk.id].sessions[session.id]
            with other.stream() as second, pytest.raises(ConnectionFailed, match="Another connection streams"):
                second.send(jpeg(1, 64, 48))
        # The one that is lost may be the client's own: it waits until the service has noticed.
        with session.stream() as third:
            threading.Timer(0.5, first.close).start()
            assert third.send(jpeg(1, 64, 48)).frames == 2
