"""Waiting and working at the same time, for the synchronous half; ``_async/concurrency.py`` is its twin."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from concurrent.futures import Future
from typing import TYPE_CHECKING, Any, Generic, TypeAlias, TypeVar

if TYPE_CHECKING:
    from websockets.sync.client import ClientConnection

    from placerec_client._http import httpx

Result = TypeVar("Result")

PathWithin: TypeAlias = Callable[[float | None], str]
"""Finds a path within seconds; None is any time."""

END_SECONDS = 10.0
"""How long work that is broken off is waited for: a thread cannot be stopped, but its request has an end."""


def sleep(seconds: float) -> None:
    """Wait so long."""
    time.sleep(seconds)


def in_thread(work: Callable[..., Result], *arguments: Any) -> Result:
    """The result of work that blocks; here everything does."""
    return work(*arguments)


def within(seconds: float, work: Callable[[], Result]) -> Result:
    """The result of work that is waited for so long, in a thread: looking up a name, for one, has no other end.

    Raises:
        TimeoutError: there is none yet; the work goes on behind.
    """
    return Task(work).result(seconds)


def interruptible(transport: httpx.HTTPTransport) -> httpx.HTTPTransport:
    """A transport as it is: here ``within`` does not wait for it."""
    return transport


class Begun:
    """Nothing here: what the asynchronous half awaits to begin it begins at its first call."""


class Task(Generic[Result]):
    """Work that goes on in a thread of its own, which does not keep the process from ending."""

    def __init__(self, work: Callable[[], Result]) -> None:
        self._future: Future[Result] = Future()

        def run() -> None:
            try:
                self._future.set_result(work())
            except BaseException as error:
                self._future.set_exception(error)

        self._thread = threading.Thread(target=run, daemon=True, name="placerec")
        self._thread.start()

    def result(self, seconds: float | None = None) -> Result:
        """Wait for the end of the work; return its result or raise its error, or TimeoutError after ``seconds``."""
        return self._future.result(seconds)

    def end(self) -> None:
        """Wait for a moment that the work ends, whatever comes of it."""
        self._thread.join(END_SECONDS)


Lock = threading.Lock


def acquire(lock: threading.Lock, seconds: float | None) -> None:
    """Take a lock.

    Raises:
        TimeoutError: it has not become free in time; None waits for any time.
    """
    if not lock.acquire(timeout=-1 if seconds is None else min(max(seconds, 0.0), threading.TIMEOUT_MAX)):
        raise TimeoutError


def received(socket: ClientConnection, seconds: float) -> str | bytes:
    """The next message of a WebSocket.

    Raises:
        TimeoutError: none has come.
    """
    return socket.recv(timeout=seconds)
