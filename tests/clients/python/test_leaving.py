"""Leaving a session: a second at most, and the exception that is on its way stays the one."""

from __future__ import annotations

import asyncio
import logging
import socket
import threading
from collections.abc import Awaitable, Callable, Iterator
from contextlib import contextmanager
from threading import Event
from typing import Any, TypeVar

import httpx
import pytest

from placerec_client import AsyncClient, Client, ConnectionFailed, Map, Retry, problems
from placerec_client._async import concurrency as async_concurrency
from placerec_client._async import sessions as async_sessions
from placerec_client._async import streams as async_streams
from placerec_client._sync import concurrency, sessions, streams
from placerec_client.retry import LEAVE_SECONDS
from tests.clients.python.fault_proxy import Fault, FaultProxy
from tests.clients.python.moments import Moments
from tests.service.refusing import refusing_server
from tests.service.scenes import jpeg
from tests.service.server import Server, no_service

Result = TypeVar("Result")

SECONDS = 3600.0
"""How long leaving waits here, where nothing may depend on the speed of the machine."""


@pytest.fixture(autouse=True)
def unhurried(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sessions, "LEAVE_SECONDS", SECONDS)
    monkeypatch.setattr(async_sessions, "LEAVE_SECONDS", SECONDS)


def over_at(event: Event, monkeypatch: pytest.MonkeyPatch) -> None:
    """Let the time of leaving be over when something has happened, or cannot happen any more."""

    def within(seconds: float, work: Callable[[], Result]) -> Result:
        assert seconds == SECONDS

        def run() -> Result:
            try:
                return work()
            finally:
                event.set()

        task = concurrency.Task(run)
        event.wait()
        return task.result(0)

    async def within_async(seconds: float, work: Callable[[], Awaitable[Result]]) -> Result:
        assert seconds == SECONDS
        task = asyncio.ensure_future(work())
        task.add_done_callback(lambda _: event.set())
        await asyncio.to_thread(event.wait)
        return await asyncio.wait_for(task, 0)

    monkeypatch.setattr(sessions, "within", within)
    monkeypatch.setattr(async_sessions, "within", within_async)


class Heads:
    """What happens to requests that end a session; their heads are kept."""

    def __init__(self, fault: Fault) -> None:
        self._fault = fault
        self.seen: list[bytes] = []
        self.came = Event()

    def __call__(self, head: bytes) -> Fault:
        if not head.startswith(b"DELETE "):
            return "none"
        self.seen.append(head)
        self.came.set()
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


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("fault", "on_its_way"),
    [("silence", KeyboardInterrupt), ("silence", None), ("cut-before", ValueError), ("lose-answer", KeyboardInterrupt)],
)
def test_a_session_is_left_by_one_attempt(
    server: Server,
    lab: Map,
    fault: Fault,
    on_its_way: type[BaseException] | None,
    caplog: pytest.LogCaptureFixture,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    with failing(server, fault) as (url, heads), Client(url, retry=Retry(60)) as client:
        if fault == "silence":
            over_at(heads.came, monkeypatch)
        if on_its_way is None:
            with client.maps[lab.id].sessions.begin() as session:
                session.send(jpeg(0, 64, 48))
        else:
            with pytest.raises(on_its_way), client.maps[lab.id].sessions.begin() as session:
                raise on_its_way
    assert len(heads.seen) == 1 and 0 < left_after(heads.seen[0]) <= SECONDS
    (told,) = warnings(caplog)
    assert session.id in told.getMessage() and "did not end it now: " in told.getMessage()


@pytest.mark.parametrize("fault", ["silence", "cut-before"])
def test_a_session_is_left_asynchronously(
    server: Server, lab: Map, fault: Fault, monkeypatch: pytest.MonkeyPatch
) -> None:
    async def work(url: str) -> None:
        async with AsyncClient(url, retry=Retry(60)) as client, client.maps[lab.id].sessions.begin():
            task = asyncio.current_task()
            assert task is not None
            task.cancel()  # as Ctrl-C does in asyncio.run
            await asyncio.Event().wait()

    with failing(server, fault) as (url, heads):
        if fault == "silence":
            over_at(heads.came, monkeypatch)
        with pytest.raises(asyncio.CancelledError):
            asyncio.run(work(url))
        assert len(heads.seen) == 1 and left_after(heads.seen[0]) <= SECONDS


class Silent:
    """A WebSocket that refuses a frame, or is broken off, and does not answer when it is closed."""

    def __init__(self, moments: Moments, broken_off: bool, close_timeout: float) -> None:
        self._moments, self._broken_off, self._close_timeout = moments, broken_off, close_timeout

    def __enter__(self) -> Silent:
        return self

    def __exit__(self, *_: object) -> None:
        self._moments.sleep(self._close_timeout)

    def send(self, _: object) -> None:
        pass

    def recv(self, timeout: float | None = None) -> str:
        if self._broken_off:
            raise KeyError("on its way")
        return '{"problem": {"type": "urn:placerec:problem:not-an-image", "status": 422}}'


class AsyncSilent(Silent):
    async def __aenter__(self) -> AsyncSilent:
        return self

    async def __aexit__(self, *_: object) -> None:
        self.__exit__()

    async def send(self, _: object) -> None:  # type: ignore[override]
        pass

    async def recv(self, timeout: float | None = None) -> str:  # type: ignore[override]
        return super().recv()


@pytest.mark.parametrize("half", [Client, AsyncClient])
@pytest.mark.parametrize("broken_off", [False, True])
def test_a_stream_and_its_session_are_left_within_one_second(
    half: Any, broken_off: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    moments, waited = Moments(monkeypatch), list[float]()
    monkeypatch.setattr(streams, "time", moments)
    monkeypatch.setattr(async_streams, "time", moments)
    monkeypatch.setattr(
        streams, "connect", lambda _, close_timeout, **options: Silent(moments, broken_off, close_timeout)
    )
    monkeypatch.setattr(
        async_streams, "connect", lambda _, close_timeout, **options: AsyncSilent(moments, broken_off, close_timeout)
    )
    for module in (sessions, async_sessions):
        monkeypatch.setattr(module, "LEAVE_SECONDS", LEAVE_SECONDS)

    def within(seconds: float, _: object) -> None:
        waited.append(seconds)

    async def within_async(seconds: float, _: object) -> None:
        waited.append(seconds)

    monkeypatch.setattr(sessions, "within", within)
    monkeypatch.setattr(async_sessions, "within", within_async)

    async def work() -> None:
        async with AsyncClient("robot").maps["lab"].sessions["of-before"] as session, session.stream() as stream:
            await stream.send(b"frame", frame=0)

    with pytest.raises(KeyError if broken_off else problems.NotAnImage):
        if half is AsyncClient:
            asyncio.run(work())
        else:
            with Client("robot").maps["lab"].sessions["of-before"] as session, session.stream() as stream:
                stream.send(b"frame", frame=0)
    assert 0.4 < moments.now <= 0.5 and waited == [pytest.approx(1 - moments.now)]


def test_work_that_does_not_end_is_left() -> None:
    assert LEAVE_SECONDS == 1.0
    ended = Event()
    with pytest.raises(TimeoutError):
        concurrency.within(0.01, ended.wait)
    ended.set()

    async def work() -> None:
        with pytest.raises(TimeoutError):
            await async_concurrency.within(0.01, asyncio.Event().wait)

    asyncio.run(work())


def broken(_: httpx.Request) -> httpx.Response:
    raise RuntimeError("a transport of another kind")


def test_whatever_goes_wrong_then_is_only_told(
    caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    async def work() -> None:
        client = AsyncClient("robot", transport=httpx.MockTransport(broken))
        async with client, client.maps["lab"].sessions["of-before"]:
            raise KeyError("on its way")

    with pytest.raises(KeyError):
        asyncio.run(work())
    with Client("robot", transport=httpx.MockTransport(broken)) as client:
        with pytest.raises(KeyError), client.maps["lab"].sessions["of-before"]:
            raise KeyError("on its way")

        def start(_: threading.Thread) -> None:
            raise RuntimeError("can't start new thread")

        monkeypatch.setattr(threading.Thread, "start", start)
        with pytest.raises(KeyError), client.maps["lab"].sessions["of-before"]:
            raise KeyError("on its way")
    told = [one.getMessage().partition("now: ")[2] for one in warnings(caplog)]
    assert told == [*["a transport of another kind"] * 2, "can't start new thread"]


def test_the_service_is_gone(server: Server, lab: Map, caplog: pytest.LogCaptureFixture) -> None:
    with no_service() as gone:
        with pytest.raises(KeyboardInterrupt), Client(gone) as client, client.maps[lab.id].sessions["of-before"]:
            raise KeyboardInterrupt
        assert "cannot be reached" in caplog.text
        with Client(gone, retry=Retry(0)) as client, pytest.raises(ConnectionFailed):
            client.maps[lab.id].sessions["of-before"].delete()  # who asks for it is told


NAME = "robot.invalid"


def name_server(monkeypatch: pytest.MonkeyPatch, look_up: Callable[[], list[str]]) -> None:
    """Let the addresses of a name be found by a function; other names have those that they have."""
    usual = socket.getaddrinfo

    def getaddrinfo(host: Any, port: Any, *rest: Any, **options: Any) -> Any:
        if host not in (NAME, NAME.encode()):
            return usual(host, port, *rest, **options)
        return [one for address in look_up() for one in usual(address, port, *rest, **options)]

    monkeypatch.setattr(socket, "getaddrinfo", getaddrinfo)
    monkeypatch.setenv("no_proxy", "*")


@pytest.mark.parametrize("half", [Client, AsyncClient])
def test_a_name_that_nobody_looks_up_keeps_nobody(half: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """Looking up a name has no time limit: neither leaving nor the end of a loop or of the process waits for it."""
    asked, answered, looking = Event(), Event(), list[threading.Thread]()

    def look_up() -> list[str]:
        looking.append(threading.current_thread())
        asked.set()
        if threading.current_thread().daemon:  # the end of a loop or of the process waits for others
            answered.wait()
        raise OSError("no name server")

    async def work() -> None:
        async with AsyncClient(NAME).maps["lab"].sessions["of-before"]:
            raise KeyError("on its way")

    name_server(monkeypatch, look_up)
    over_at(asked, monkeypatch)
    if half is AsyncClient:
        with pytest.raises(KeyError):
            asyncio.run(work())
    else:
        with pytest.raises(KeyError), Client(NAME).maps["lab"].sessions["of-before"]:
            raise KeyError("on its way")
    (thread,) = looking
    assert thread.daemon and thread.is_alive()
    answered.set()
    thread.join()


def test_every_address_of_a_name_is_tried(monkeypatch: pytest.MonkeyPatch) -> None:
    async def asks(port: str) -> None:
        async with AsyncClient(f"{NAME}:{port}", retry=Retry(0)) as client:
            await client.liveness()

    with refusing_server() as (url, seen):
        port = url.rpartition(":")[2]
        name_server(monkeypatch, lambda: ["127.0.0.2", "127.0.0.1"])  # nobody listens at the first
        with pytest.raises(problems.KeyRefused):
            asyncio.run(asks(port))
        assert seen == [("GET", "/livez")]
        name_server(monkeypatch, lambda: ["127.0.0.2", "127.0.0.3"])
        with pytest.raises(ConnectionFailed, match="cannot be reached"):
            asyncio.run(asks(port))

    def unknown() -> list[str]:
        raise socket.gaierror("Name or service not known")

    name_server(monkeypatch, unknown)
    with pytest.raises(ConnectionFailed, match="Name or service not known"):
        asyncio.run(asks(port))


def test_a_map_that_was_deleted_took_its_session_along(lab: Map, caplog: pytest.LogCaptureFixture) -> None:
    with lab.sessions.begin():
        lab.delete()
    with pytest.raises(problems.UnknownMap):
        lab.read()
    assert not warnings(caplog)
