"""Sessions: frames are counted once, over HTTP and over a WebSocket that is lost."""

from __future__ import annotations

import threading

import pytest

from placerec_client import Client, ConnectionFailed, Map, PlacerecError, Retry, problems
from tests.clients.python.fault_proxy import FaultProxy
from tests.service.scenes import jpeg
from tests.service.server import Server


@pytest.fixture
def walk(lab: Map) -> Map:
    for number in range(4):
        lab.places.put(f"p{number}", jpeg(number, 64, 48), x=2 * number, y=0, sequence="walk")
    return lab


def test_a_frame_whose_answer_is_lost_counts_once(server: Server, walk: Map) -> None:
    with FaultProxy(server.port, share=0.6, seed=3, faults=("lose-answer", "cut-answer", "duplicate")) as way:
        with Client(way.url, retry=Retry(60, 0.02, 0.2)) as client, client.maps[walk.id].sessions.begin() as session:
            answers = [session.send(jpeg(number % 4, 64, 48)) for number in range(12)]
            assert [one.frames for one in answers] == list(range(1, 13))
            assert session.read().frames == 12
        assert way.happened["lose-answer"] + way.happened["cut-answer"] > 3


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


def test_a_session_that_was_begun_elsewhere_goes_on(walk: Map) -> None:
    with walk.sessions.begin() as session:
        session.send(jpeg(0, 64, 48), frame=41)
        other = walk.sessions[session.id]
        with other.stream() as stream:
            assert stream.send(jpeg(1, 64, 48)).frame == 42
        assert session.send(jpeg(1, 64, 48), frame=42).repeated
        with pytest.raises(problems.FrameOutOfOrder):
            session.send(jpeg(1, 64, 48), frame=7)


def test_what_ends(walk: Map) -> None:
    session = walk.sessions.begin()
    with pytest.raises(PlacerecError, match="has not begun"):
        session.send(jpeg(0, 64, 48))
    session.begin()
    with session.stream() as stream:
        stream.send(jpeg(0, 64, 48))
        session.end()
        with pytest.raises((problems.SessionExpired, problems.UnknownSession)):
            stream.send(jpeg(1, 64, 48))
    session.end()


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
