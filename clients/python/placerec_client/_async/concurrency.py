"""Waiting and working at the same time, for the asynchronous half; ``_sync/concurrency.py`` is its twin."""

from __future__ import annotations

import asyncio
import socket
import threading
import time
from collections.abc import Awaitable, Callable, Generator
from concurrent.futures import Future
from ipaddress import ip_address
from typing import TYPE_CHECKING, Any, Generic, Self, TypeAlias, TypeVar

from placerec_client._http import httpx

if TYPE_CHECKING:
    from websockets.asyncio.client import ClientConnection

Result = TypeVar("Result")

PathWithin: TypeAlias = Callable[[float | None], Awaitable[str]]
"""Finds a path within seconds; None is any time."""


async def sleep(seconds: float) -> None:
    """Wait for this time."""
    await asyncio.sleep(seconds)


async def in_thread(work: Callable[..., Result], *arguments: Any) -> Result:
    """The result of work that blocks, such as reading files."""
    return await asyncio.to_thread(work, *arguments)


async def within(seconds: float, work: Callable[[], Awaitable[Result]]) -> Result:
    """The result of work, awaited for a limited time.

    Raises:
        TimeoutError: there is none yet; the work is broken off.
    """
    async with asyncio.timeout(seconds):
        return await work()


def interruptible(transport: httpx.AsyncHTTPTransport) -> httpx.AsyncHTTPTransport:
    """A transport that is waited for no longer when it is broken off, not even while it looks a name up."""
    pool: Any = transport._pool  # httpx has no parameter for the network
    pool._network_backend = LookingUp(pool._network_backend)
    return transport


class LookingUp:
    """A network of httpcore that looks names up in threads which keep nothing from ending.

    The end of an asyncio loop, and of the process, waits for asyncio's own, however long no name server answers.
    """

    def __init__(self, network: Any) -> None:
        self._network = network

    def __getattr__(self, name: str) -> Any:
        return getattr(self._network, name)

    async def connect_tcp(self, host: str, port: int, timeout: float | None = None, **options: Any) -> Any:
        """Connect to the first address of a host that lets one; each has an equal share of the time that is left."""
        began = time.monotonic()
        addresses = await _addresses(host, port, timeout)
        while True:
            address = addresses.pop(0)
            left = None if timeout is None else (timeout - (time.monotonic() - began)) / (len(addresses) + 1)
            try:
                return await self._network.connect_tcp(address, port, timeout=left, **options)
            except Exception:
                if not addresses:
                    raise


async def _addresses(host: str, port: int, timeout: float | None) -> list[str]:
    """The addresses of a host, one or more, in the order in which they are to be tried; an address has itself."""
    try:
        return [str(ip_address(host))]
    except ValueError:
        pass
    found: Future[list[Any]] = Future()
    found.set_running_or_notify_cancel()  # who waits may be cancelled, the look-up is not

    def look_up() -> None:
        try:
            found.set_result(socket.getaddrinfo(host, port, type=socket.SOCK_STREAM))
        except BaseException as error:
            found.set_exception(error)

    threading.Thread(target=look_up, daemon=True, name="placerec").start()
    try:
        async with asyncio.timeout(timeout):
            return [address[0] for *_, address in await asyncio.wrap_future(found)]
    except TimeoutError as error:
        raise httpx.ConnectTimeout(f"The name {host} was not looked up in time.") from error
    except OSError as error:
        raise httpx.ConnectError(str(error)) from error


class Begun:
    """Begins when it is awaited, once, and is the result."""

    async def _begun(self) -> Self:
        raise NotImplementedError

    def __await__(self) -> Generator[Any, None, Self]:
        return self._begun().__await__()


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
            self._task.exception()  # retrieved, so that asyncio does not report it


Lock = asyncio.Lock


async def acquire(lock: Lock, seconds: float | None) -> None:
    """Take a lock, which those who ask for it get in their order.

    Raises:
        TimeoutError: it has not become free within ``seconds``; None waits for any time.
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
