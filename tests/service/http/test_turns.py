"""The protocol with an application of a few lines: whose turn it is, and who is cut off."""

from __future__ import annotations

import asyncio
import contextlib
import functools
import socket
from collections.abc import AsyncIterator, Callable
from typing import Any

import pytest
import uvicorn
import uvloop
from uvicorn.server import ServerState

from service.http.bodies import UploadMemory
from service.http.connections import Connections, untaken
from service.http.http_connection import HttpConnection
from service.settings import Settings
from service.telemetry.metrics import Metrics
from tests.service.wire import get, post

LARGE = bytes(3_000_000)
CLOSE = "Connection: close"


async def application(scope: Any, _receive: Any, send: Any) -> None:
    """Answers /large with much and anything else with little, and reads no body."""
    body = LARGE if scope["path"] == "/large" else b"small"
    length = (b"content-length", str(len(body)).encode())
    await send({"type": "http.response.start", "status": 200, "headers": [length]})
    await send({"type": "http.response.body", "body": body})


class Caller:
    """One connection, which takes no more than it says."""

    def __init__(self, connection: socket.socket) -> None:
        self._socket, self._loop = connection, asyncio.get_running_loop()

    async def send(self, data: bytes) -> None:
        await self._loop.sock_sendall(self._socket, data)

    async def read(self, size: int, pause: float = 0) -> int:
        """How many of ``size`` bytes come before the end, with a pause after each 128 KiB."""
        found = 0
        while found < size and (piece := await self._loop.sock_recv(self._socket, min(131_072, size - found))):
            found += len(piece)
            await asyncio.sleep(pause * len(piece) / 131_072)
        return found

    async def answer(self, pause: float = 0) -> int:
        """The length of the next answer's body, as far as it comes."""
        head = b""
        while not head.endswith(b"\r\n\r\n"):
            piece = await self._loop.sock_recv(self._socket, 1)
            if not piece:
                return -1
            head += piece
        return await self.read(int(head.split(b"content-length: ")[1].split(b"\r\n")[0]), pause)


@contextlib.asynccontextmanager
async def serving(**limits: Any) -> AsyncIterator[tuple[Connections, Any]]:
    """The register of a server whose system keeps little of what is written, and a function that connects to it."""
    settings = Settings(**limits)
    connections = Connections(settings, UploadMemory(1_000_000), Metrics())
    config = uvicorn.Config(application, lifespan="off", log_config=None, timeout_keep_alive=1, ws="none")
    config.load()
    made = functools.partial(HttpConnection, connections=connections, config=config, server_state=ServerState())
    listener = socket.create_server(("127.0.0.1", 0))
    listener.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, 65_536)
    loop = asyncio.get_running_loop()
    with contextlib.ExitStack() as sockets:

        async def dial() -> Caller:
            one = sockets.enter_context(socket.socket())
            one.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 131_072)
            one.setblocking(False)
            await loop.sock_connect(one, listener.getsockname())
            return Caller(one)

        server = await loop.create_server(lambda: made(app_state={}, _loop=loop), sock=listener)
        yield connections, dial
        server.close()


def ended(connections: Connections, reason: str) -> float:
    return float(connections._ended.labels(reason)._value.get())


@pytest.fixture(params=["asyncio", "uvloop"])
def run(request: pytest.FixtureRequest) -> Callable[[Any], Any]:
    """Runs a coroutine in one kind of event loop."""
    factory = asyncio.new_event_loop if request.param == "asyncio" else uvloop.new_event_loop

    def runs(coroutine: Any) -> Any:
        with asyncio.Runner(loop_factory=factory) as runner:
            return runner.run(asyncio.wait_for(coroutine, 60))

    return runs


@pytest.mark.thorough
def test_who_reads_slowly_and_steadily_gets_all_and_who_stops_is_cut_off(run: Callable[[Any], Any]) -> None:
    async def slow() -> None:
        async with serving(write_timeout=2) as (connections, dial):
            kept, closed, stops = await dial(), await dial(), await dial()
            await kept.send(get("/large"))
            await closed.send(get("/large", CLOSE))
            await stops.send(get("/large", CLOSE))
            # Longer than twice the write timeout, and than the time between two requests; all of it is written at once.
            assert set(await asyncio.gather(kept.answer(0.2), closed.answer(0.2))) == {len(LARGE)}
            assert ended(connections, "write-timeout") == 1 and ended(connections, "idle") == 0
            assert await stops.answer() < len(LARGE) and await closed.read(1) == 0
            await kept.send(get("/small"))
            assert await kept.answer() == 5
            assert await kept.read(1) == 0 and ended(connections, "idle") == 1, "its time began when it had read"

    run(slow())


def test_who_has_not_read_its_answer_is_not_waiting(run: Callable[[Any], Any]) -> None:
    async def crowded() -> None:
        async with serving(max_connections=2, write_timeout=5) as (connections, dial):
            reading, idle = await dial(), await dial()
            await reading.send(get("/large"))
            await idle.send(get("/small"))
            assert await idle.answer() == 5
            assert (len(connections), connections.waiting) == (2, 1)
            new = await dial()
            assert await idle.read(1) == 0, "it made room"
            await new.send(get("/small"))
            assert await new.answer() == 5 and await reading.answer() == len(LARGE)
            await asyncio.sleep(0)
            assert (len(connections), connections.waiting) == (2, 2)

    run(crowded())


@pytest.mark.thorough
def test_when_the_rest_of_a_refused_body_has_come_the_connection_goes_on(run: Callable[[Any], Any]) -> None:
    async def refused() -> None:
        async with serving(read_timeout=0.3, head_timeout=0.3) as (connections, dial):
            whole, half = await dial(), await dial()
            for caller in (whole, half):
                await caller.send(post("/refused", b"a" * 10, length=20))
                assert await caller.answer() == 5
            await whole.send(b"a" * 10)
            assert await half.read(1) == 0 and ended(connections, "unread-body") == 1
            await asyncio.sleep(0.2)
            await whole.send(get("/small"))
            assert await whole.answer() == 5

    run(refused())


def test_heads_that_begin_and_end_in_one_piece_are_not_taken_for_one_without_end(run: Callable[[Any], Any]) -> None:
    async def ahead() -> None:
        async with serving(max_url_bytes=2000, max_header_bytes=4000) as (_, dial):
            caller, request = await dial(), get("/small?" + "x" * 1800)
            await caller.send(request[:100])
            await asyncio.sleep(0.05)
            await caller.send(request[100:] + request * 4 + request[:100])
            assert [await caller.answer() for _ in range(5)] == [5] * 5
            await caller.send(request[100:])
            assert await caller.answer() == 5

    run(ahead())


def test_what_lies_in_the_systems_buffer_is_not_taken(run: Callable[[Any], Any]) -> None:
    async def written() -> None:
        with socket.create_server(("127.0.0.1", 0)) as listener, socket.socket() as reader:
            reader.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 65_536)
            reader.connect(listener.getsockname())
            reader.setblocking(False)
            loop = asyncio.get_running_loop()
            transport, _ = await loop.connect_accepted_socket(asyncio.Protocol, listener.accept()[0])
            transport.write(bytes(400_000))
            assert max(transport.get_write_buffer_size(), 100_000) < untaken(transport) <= 400_000
            assert await Caller(reader).read(400_000) == 400_000
            while untaken(transport):
                await asyncio.sleep(0.01)
            transport.close()
            assert await Caller(reader).read(1) == 0

    run(written())
