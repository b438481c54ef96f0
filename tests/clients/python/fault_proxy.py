"""A proxy between a client and the service that cuts, delays and duplicates what passes, as a bad network does."""

from __future__ import annotations

import asyncio
import random
import re
import threading
from collections import Counter
from collections.abc import Callable, Sequence
from concurrent.futures import Future
from contextlib import suppress
from types import TracebackType
from typing import Literal, Self, TypeAlias

Fault = Literal["none", "cut-before", "cut-request", "lose-answer", "cut-answer", "delay", "duplicate", "silence"]
FAULTS: tuple[Fault, ...] = ("cut-before", "cut-request", "lose-answer", "cut-answer", "delay", "duplicate")
DELAY_SECONDS = 0.2
_LENGTH = re.compile(rb"(?i)\r\ncontent-length: *(\d+)")
_CHUNKED = re.compile(rb"(?i)\r\ntransfer-encoding: *chunked")
_UPGRADE = re.compile(rb"(?i)\r\nupgrade: *websocket")
_CREATES = re.compile(rb"POST /v1/maps/[^/ ]+/(sessions|align|prune|merge|rebuild|keypoints|re-encode|verify) ")
"""Requests of which the service makes something new each time; a proxy that repeats these makes two."""

Reader: TypeAlias = asyncio.StreamReader
Writer: TypeAlias = asyncio.StreamWriter


class FaultProxy:
    """Listens on a port of its own, in a thread of its own, and passes requests on to the service.

    Args:
        port: of the service.
        share: of the requests that something happens to.
        seed: of what happens when.
        faults: what happens.
        messages: how many chunks pass through a WebSocket, either way, before it is cut.
    """

    def __init__(
        self,
        port: int,
        share: float = 0.3,
        seed: int = 0,
        faults: Sequence[Fault] = FAULTS,
        messages: int = 12,
        choose: Callable[[bytes], Fault] | None = None,
    ) -> None:
        self._service, self._share, self._faults, self._messages = port, share, faults, messages
        self._random = random.Random(seed)
        self._choose = choose or self._by_chance
        self._tasks: set[asyncio.Task[None]] = set()
        self.happened: Counter[str] = Counter()
        """How often each fault has happened, and how many requests came."""

    def __enter__(self) -> Self:
        self._loop = asyncio.new_event_loop()
        ready: Future[int] = Future()
        self._thread = threading.Thread(target=self._run, args=(ready,), daemon=True)
        self._thread.start()
        self.port = ready.result(10)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._loop.call_soon_threadsafe(self._stopped.set)
        self._thread.join(10)

    @property
    def url(self) -> str:
        """Where the client finds the service."""
        return f"http://127.0.0.1:{self.port}"

    def _run(self, ready: Future[int]) -> None:
        asyncio.set_event_loop(self._loop)
        self._loop.run_until_complete(self._serve(ready))
        self._loop.close()

    async def _serve(self, ready: Future[int]) -> None:
        self._stopped = asyncio.Event()
        server = await asyncio.start_server(self._connected, "127.0.0.1", 0)
        ready.set_result(int(server.sockets[0].getsockname()[1]))
        await self._stopped.wait()
        server.close()
        for task in self._tasks:
            task.cancel()
        await asyncio.gather(*self._tasks, return_exceptions=True)

    def _by_chance(self, head: bytes) -> Fault:
        if self._random.random() >= self._share:
            return "none"
        fault = self._random.choice(list(self._faults))
        return "none" if fault == "duplicate" and _CREATES.match(head) else fault

    async def _connected(self, reader: Reader, writer: Writer) -> None:
        task = asyncio.current_task()
        assert task is not None
        self._tasks.add(task)
        try:
            with suppress(OSError, asyncio.IncompleteReadError):
                while await self._pass(reader, writer):
                    pass
        finally:
            self._tasks.discard(task)
            writer.transport.abort()

    async def _pass(self, reader: Reader, writer: Writer) -> bool:
        """Pass one request and its answer on; whether the connection goes on."""
        head = await reader.readuntil(b"\r\n\r\n")
        self.happened["requests"] += 1
        if _UPGRADE.search(head):
            await self._stream(head, reader, writer)
            return False
        request = head + await _body(head, reader)
        fault = self._choose(head)
        self.happened[fault] += 1
        if fault == "cut-before":
            return False
        if fault == "silence":
            await reader.read()  # until the client hangs up
            return False
        if fault == "cut-request":
            await self._send(request[: len(request) // 2])
            return False
        answer = await self._send(request)
        if fault == "lose-answer":
            return False
        if fault == "duplicate":
            await self._send(request)
        if fault == "delay":
            await asyncio.sleep(DELAY_SECONDS)
        if fault == "cut-answer":
            writer.write(answer[: len(answer) // 2])
            await writer.drain()
            await asyncio.sleep(0.01)  # so that it leaves before the connection ends
            return False
        writer.write(answer)
        await writer.drain()
        return True

    async def _send(self, request: bytes) -> bytes:
        """The service's answer to a request, which may be cut off."""
        reader, writer = await asyncio.open_connection("127.0.0.1", self._service)
        try:
            writer.write(request)
            await writer.drain()
            if len(request) < _whole(request):
                return b""
            head = await reader.readuntil(b"\r\n\r\n")
            return head + await _body(head, reader)
        finally:
            writer.transport.abort()

    async def _stream(self, head: bytes, reader: Reader, writer: Writer) -> None:
        """Pass a WebSocket on until so many chunks have passed."""
        there, back = await asyncio.open_connection("127.0.0.1", self._service)
        back.write(head)
        left = self._random.randint(2, self._messages)

        async def flow(source: Reader, target: Writer) -> None:
            nonlocal left
            while left and (chunk := await source.read(1 << 16)):
                left -= 1
                target.write(chunk)
                await target.drain()

        flows = [asyncio.ensure_future(flow(reader, back)), asyncio.ensure_future(flow(there, writer))]
        await asyncio.wait(flows, return_when=asyncio.FIRST_COMPLETED)
        self.happened["cut-stream"] += not left
        for one in flows:
            one.cancel()
        back.transport.abort()


def _whole(request: bytes) -> int:
    """The length of a request that has a length."""
    head, _, _ = request.partition(b"\r\n\r\n")
    length = _LENGTH.search(head)
    return len(head) + 4 + (int(length[1]) if length else 0)


async def _body(head: bytes, reader: Reader) -> bytes:
    if length := _LENGTH.search(head):
        return await reader.readexactly(int(length[1]))
    if not _CHUNKED.search(head):
        return b""
    found = b""
    while True:
        line = await reader.readuntil(b"\r\n")
        found += line + await reader.readexactly(int(line, 16) + 2)
        if int(line, 16) == 0:
            return found
