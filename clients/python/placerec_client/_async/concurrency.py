"""Waiting and working at the same time, for the asynchronous half; ``_sync/concurrency.py`` is its twin."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable
from typing import TYPE_CHECKING, Any, Generic, TypeVar

if TYPE_CHECKING:
    from websockets.asyncio.client import ClientConnection

    from placerec_client._http import httpx

Result = TypeVar("Result")


async def sleep(seconds: float) -> None:
    """Wait so long."""
    await asyncio.sleep(seconds)


async def in_thread(work: Callable[..., Result], *arguments: Any) -> Result:
    """The result of work that blocks, such as reading files."""
    return await asyncio.to_thread(work, *arguments)


async def within(seconds: float, work: Callable[[], Awaitable[Result]]) -> Result:
    """The result of work that is waited for so long.

    Raises:
        TimeoutError: there is none yet; the work is broken off.
    """
    async with asyncio.timeout(seconds):
        return await work()


def interruptible(transport: httpx.AsyncHTTPTransport) -> httpx.AsyncHTTPTransport:
    """A transport that is waited for no longer when it is broken off, not even while it looks a name up."""
    from placerec_client._lookup import Backend  # with httpcore, which httpx imports no sooner either

    transport._pool._network_backend = Backend()  # httpx has no parameter for it
    return transport


class Task(Generic[Result]):
    """Work that goes on while other things are done."""

    def __init__(self, work: Callable[[], Awaitable[Result]]) -> None:
        async def run() -> Result:
            return await work()

        self._task = asyncio.create_task(run())

    async def result(self) -> Result:
        """Wait for the end of the work; return its result or raise its error."""
        await asyncio.wait({self._task})
        return self._task.result()

    async def end(self) -> None:
        """Break the work off, whatever comes of it."""
        self._task.cancel()
        await asyncio.wait({self._task})
        if not self._task.cancelled():
            self._task.exception()  # seen, so that nobody is told that it was not


Lock = asyncio.Lock


async def acquire(lock: Lock, seconds: float | None) -> None:
    """Take a lock, which those who ask for it get in their order.

    Raises:
        TimeoutError: it has not become free within so many seconds; None waits for any time.
    """
    async with asyncio.timeout(seconds):
        await lock.acquire()


async def received(socket: ClientConnection, seconds: float) -> str | bytes:
    """The next message of a WebSocket.

    Raises:
        TimeoutError: none has come.
    """
    async with asyncio.timeout(seconds):
        return await socket.recv()
