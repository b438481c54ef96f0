"""Leaving a session: a second at most, and the exception that is on its way stays the one."""

from __future__ import annotations

import asyncio
import logging
import socket
from collections.abc import Iterator
from contextlib import contextmanager
from threading import Event

import pytest

from placerec_client import AsyncClient, Client, ConnectionFailed, Map, Retry, problems
from placerec_client._async import sessions as async_sessions
from placerec_client._sync import sessions
from tests.clients.python.fault_proxy import Fault, FaultProxy
from tests.service.scenes import jpeg
from tests.service.server import Server, free_port


class Heads:
    """What happens to requests that end a session; their heads are kept."""

    def __init__(self, fault: Fault) -> None:
        self._fault = fault
        self.seen: list[bytes] = []

    def __call__(self, head: bytes) -> Fault:
        if not head.startswith(b"DELETE "):
            return "none"
        self.seen.append(head)
        return self._fault


@contextmanager
def failing(server: Server, fault: Fault) -> Iterator[tuple[str, Heads]]:
    """A way to the service on which a session begins, but its end comes to grief."""
    heads = Heads(fault)
    with FaultProxy(server.port, choose=heads) as way:
        yield way.url, heads


@pytest.fixture
def unhurried(monkeypatch: pytest.MonkeyPatch) -> None:
    """Leaving waits for whatever comes of it, however slow the machine is."""
    for half in (sessions, async_sessions):
        monkeypatch.setattr(half, "LEAVE_SECONDS", 120.0)


def left_after(head: bytes) -> float:
    """The seconds that the service was given for a request."""
    lines = dict(line.lower().split(b": ", 1) for line in head.split(b"\r\n")[1:] if line)
    return float(lines[b"x-request-timeout"])


def warnings(caplog: pytest.LogCaptureFixture) -> list[logging.LogRecord]:
    return [one for one in caplog.records if (one.name, one.levelno) == ("placerec_client", logging.WARNING)]


@pytest.mark.usefixtures("unhurried")
@pytest.mark.parametrize(("fault", "on_its_way"), [("cut-before", ValueError), ("lose-answer", KeyboardInterrupt)])
def test_a_session_is_left_by_one_attempt(
    server: Server, lab: Map, fault: Fault, on_its_way: type[BaseException], caplog: pytest.LogCaptureFixture
) -> None:
    with (
        failing(server, fault) as (url, heads),
        Client(url, retry=Retry(60)) as client,
        pytest.raises(on_its_way),
        client.maps[lab.id].sessions.begin() as session,
    ):
        raise on_its_way
    assert len(heads.seen) == 1 and 0 < left_after(heads.seen[0]) <= sessions.LEAVE_SECONDS
    (told,) = warnings(caplog)
    assert session.id in told.getMessage() and "did not end it now: " in told.getMessage()


@pytest.mark.parametrize("on_its_way", [KeyboardInterrupt, None])
def test_a_session_is_left_in_a_second_if_nobody_answers(
    server: Server, lab: Map, on_its_way: type[BaseException] | None, caplog: pytest.LogCaptureFixture
) -> None:
    """On a slow machine the second may be over before the request is on its way."""
    with failing(server, "silence") as (url, heads), Client(url, retry=Retry(60)) as client:
        if on_its_way is None:
            with client.maps[lab.id].sessions.begin() as session:
                session.send(jpeg(0, 64, 48))
        else:
            with pytest.raises(on_its_way), client.maps[lab.id].sessions.begin() as session:
                raise on_its_way
    assert len(heads.seen) <= 1 and all(0 < left_after(one) <= 1.0 for one in heads.seen)
    assert sessions.LEAVE_SECONDS == async_sessions.LEAVE_SECONDS == 1.0
    (told,) = warnings(caplog)
    assert session.id in told.getMessage() and "did not end it now: " in told.getMessage()


async def cancelled_within(url: str, map_id: str) -> None:
    async with AsyncClient(url, retry=Retry(60)) as client, client.maps[map_id].sessions.begin():
        task = asyncio.current_task()
        assert task is not None
        task.cancel()  # as Ctrl-C does in asyncio.run
        await asyncio.Event().wait()


@pytest.mark.usefixtures("unhurried")
def test_a_session_is_left_asynchronously(server: Server, lab: Map) -> None:
    with failing(server, "cut-before") as (url, heads):
        with pytest.raises(asyncio.CancelledError):
            asyncio.run(cancelled_within(url, lab.id))
        assert len(heads.seen) == 1


def test_a_session_is_left_asynchronously_if_nobody_answers(server: Server, lab: Map) -> None:
    with failing(server, "silence") as (url, heads):
        with pytest.raises(asyncio.CancelledError):
            asyncio.run(cancelled_within(url, lab.id))
        assert len(heads.seen) <= 1 and all(0 < left_after(one) <= 1.0 for one in heads.seen)


@pytest.mark.usefixtures("unhurried")
def test_the_service_is_gone(server: Server, lab: Map, caplog: pytest.LogCaptureFixture) -> None:
    gone = f"http://127.0.0.1:{free_port()}"
    with pytest.raises(KeyboardInterrupt), Client(gone) as client, client.maps[lab.id].sessions["of-before"]:
        raise KeyboardInterrupt
    assert "cannot be reached" in caplog.text
    with Client(gone, retry=Retry(0)) as client, pytest.raises(ConnectionFailed):
        client.maps[lab.id].sessions["of-before"].delete()  # who asks for it is told


def test_a_name_that_nobody_looks_up_keeps_nobody(monkeypatch: pytest.MonkeyPatch) -> None:
    """Looking up a name has no time limit: it is waited for no longer than for an answer."""
    asked, answered = Event(), Event()

    def look_up(*_: object, **__: object) -> None:
        asked.set()
        answered.wait()
        raise OSError("no name server")

    monkeypatch.setattr(socket, "create_connection", look_up)
    patience = 0.1
    while not asked.is_set():  # on a slow machine the time may be over before the look-up begins
        monkeypatch.setattr(sessions, "LEAVE_SECONDS", patience)
        with pytest.raises(KeyError), Client("http://robot.invalid").maps["lab"].sessions["of-before"]:
            raise KeyError("on its way")
        patience *= 2
    assert not answered.is_set()
    answered.set()


@pytest.mark.usefixtures("unhurried")
def test_a_map_that_was_deleted_took_its_session_along(lab: Map, caplog: pytest.LogCaptureFixture) -> None:
    with lab.sessions.begin():
        lab.delete()
    with pytest.raises(problems.UnknownMap):
        lab.read()
    assert not warnings(caplog)
