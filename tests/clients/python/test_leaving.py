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


def left_after(head: bytes) -> float:
    """The seconds that the service was given for a request."""
    lines = dict(line.lower().split(b": ", 1) for line in head.split(b"\r\n")[1:] if line)
    return float(lines[b"x-request-timeout"])


def warnings(caplog: pytest.LogCaptureFixture) -> list[logging.LogRecord]:
    return [one for one in caplog.records if (one.name, one.levelno) == ("placerec_client", logging.WARNING)]


@pytest.mark.parametrize(
    ("fault", "on_its_way"),
    [("silence", KeyboardInterrupt), ("silence", None), ("cut-before", ValueError), ("lose-answer", KeyboardInterrupt)],
)
def test_a_session_is_left_by_one_attempt(
    server: Server, lab: Map, fault: Fault, on_its_way: type[BaseException] | None, caplog: pytest.LogCaptureFixture
) -> None:
    with failing(server, fault) as (url, heads), Client(url, retry=Retry(60)) as client:
        if on_its_way is None:
            with client.maps[lab.id].sessions.begin() as session:
                session.send(jpeg(0, 64, 48))
        else:
            with pytest.raises(on_its_way), client.maps[lab.id].sessions.begin() as session:
                raise on_its_way
    assert len(heads.seen) == 1 and 0 < left_after(heads.seen[0]) <= sessions.LEAVE_SECONDS == 1.0
    (told,) = warnings(caplog)
    assert session.id in told.getMessage() and "did not end it now: " in told.getMessage()


@pytest.mark.parametrize("fault", ["silence", "cut-before"])
def test_a_session_is_left_asynchronously(server: Server, lab: Map, fault: Fault) -> None:
    async def work(url: str) -> None:
        async with AsyncClient(url, retry=Retry(60)) as client, client.maps[lab.id].sessions.begin():
            task = asyncio.current_task()
            assert task is not None
            task.cancel()  # as Ctrl-C does in asyncio.run
            await asyncio.Event().wait()

    with failing(server, fault) as (url, heads):
        with pytest.raises(asyncio.CancelledError):
            asyncio.run(work(url))
        assert len(heads.seen) == 1 and left_after(heads.seen[0]) <= sessions.LEAVE_SECONDS


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

    monkeypatch.setattr(sessions, "LEAVE_SECONDS", 0.1)
    monkeypatch.setattr(socket, "create_connection", look_up)
    with pytest.raises(KeyError), Client("http://robot.invalid").maps["lab"].sessions["of-before"]:
        raise KeyError("on its way")
    assert asked.is_set() and not answered.is_set()
    answered.set()


def test_a_map_that_was_deleted_took_its_session_along(lab: Map, caplog: pytest.LogCaptureFixture) -> None:
    with lab.sessions.begin():
        lab.delete()
    with pytest.raises(problems.UnknownMap):
        lab.read()
    assert not warnings(caplog)
