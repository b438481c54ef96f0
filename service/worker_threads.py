"""Blocking work, mostly of maps, in threads beside the event loop, for which callers wait in turns."""

from __future__ import annotations

import asyncio
import time
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from typing import ParamSpec, TypeVar

from anyio import CancelScope, CapacityLimiter, to_thread
from anyio.lowlevel import RunVar

from service.fairness import CALLER, FairQueue

Arguments = ParamSpec("Arguments")
Result = TypeVar("Result")


class ThreadTurns:
    """The turns of callers at the threads of the pool.  It is used from one event loop.

    Args:
        most: how many pieces of work run at a time.
    """

    def __init__(self, most: int) -> None:
        self._free = most
        self._waiting = FairQueue[asyncio.Future[None]]()

    @property
    def waiting(self) -> int:
        """How many pieces of work wait for their turn."""
        return len(self._waiting)

    @asynccontextmanager
    async def turn(self, caller: str) -> AsyncIterator[None]:
        """Wait for a turn, and hold it."""
        if self._free > 0:
            self._free -= 1
            self._waiting.pass_by(caller)
        else:
            await self._wait(caller)
        began = time.perf_counter()
        try:
            yield
        finally:
            self._waiting.charge(caller, 1e3 * (time.perf_counter() - began))
            self._pass_on()

    async def _wait(self, caller: str) -> None:
        turn = asyncio.get_running_loop().create_future()
        self._waiting.add(caller, turn)
        try:
            await turn
        except asyncio.CancelledError:
            if turn.done() and not turn.cancelled():
                self._pass_on()
            raise

    def _pass_on(self) -> None:
        while len(self._waiting):
            turn = self._waiting.pop()
            if not turn.done():
                turn.set_result(None)
                return
        self._free += 1


_TURNS: RunVar[ThreadTurns] = RunVar("thread turns")


def thread_turns() -> ThreadTurns:
    """The turns of the running event loop, as many at a time as its pool has threads."""
    try:
        return _TURNS.get()
    except LookupError:
        turns = ThreadTurns(int(to_thread.current_default_thread_limiter().total_tokens))
        _TURNS.set(turns)
        return turns


async def in_thread(work: Callable[Arguments, Result], *args: Arguments.args, **kwargs: Arguments.kwargs) -> Result:
    """Run blocking work in a thread of the pool, which is never interrupted.

    A task that is cancelled does not wait for it: it continues at once, and the work ends by itself.  So use this only
    for work that shares nothing with what its caller does afterwards, and :func:`to_its_end` otherwise.
    """
    return await _run(lambda: work(*args, **kwargs), None)


async def to_its_end(
    work: Callable[[], Result],
    limiter: CapacityLimiter | None = None,
    give_up: Callable[[], None] = lambda: None,
) -> Result:
    """Run blocking work in a thread, and wait for its end even if the task is cancelled.

    The work is always run, even if the task is cancelled before it has begun.  So no file is closed or removed while a
    thread still writes to it.

    Args:
        work: the function to run; its error is raised unless the task was cancelled.
        limiter: limits how many threads run; that of the whole pool if left out.
        give_up: is called when the task is cancelled; it may ask the work to end soon.

    Raises:
        CancelledError: the task was cancelled; the work has ended.
    """
    running = asyncio.create_task(_run(work, limiter))
    try:
        return await asyncio.shield(running)
    except asyncio.CancelledError:
        give_up()
        with CancelScope(shield=True):
            while not running.done():
                try:
                    await asyncio.wait({running})
                except asyncio.CancelledError:  # a server may cancel more than once
                    continue
        if not running.cancelled():
            running.exception()  # retrieved, so that asyncio does not warn of it
        raise


async def _run(work: Callable[[], Result], limiter: CapacityLimiter | None) -> Result:
    if limiter is not None:
        return await to_thread.run_sync(work, limiter=limiter)
    async with thread_turns().turn(CALLER.get()):
        return await to_thread.run_sync(work)
