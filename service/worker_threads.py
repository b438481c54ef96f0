"""Blocking work, that of maps above all, beside the event loop."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from typing import ParamSpec, TypeVar

from anyio import CancelScope, CapacityLimiter, to_thread

Arguments = ParamSpec("Arguments")
Result = TypeVar("Result")


async def in_thread(work: Callable[Arguments, Result], *args: Arguments.args, **kwargs: Arguments.kwargs) -> Result:
    """Run blocking work in a thread of the pool; it is not broken off.

    Whoever waits for it is: a task that is cancelled goes on at once, its work by itself.  So this is for work that
    shares nothing with what its caller does afterwards; :func:`to_its_end` is for the rest.
    """
    return await to_thread.run_sync(lambda: work(*args, **kwargs))


async def to_its_end(
    work: Callable[[], Result],
    limiter: CapacityLimiter | None = None,
    give_up: Callable[[], None] = lambda: None,
) -> Result:
    """Run blocking work in a thread, and wait for its end even if the task is cancelled; then that is told.

    It is run whatever comes, also if the task was cancelled before it had begun.  So no file is closed and nothing
    is cleared away while a thread still writes.

    Args:
        work: an error of it is told unless the task was cancelled.
        limiter: who else may run; the pool of all threads if left out.
        give_up: is called when the task is cancelled; it may ask the work to end soon.
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
                except asyncio.CancelledError:  # a server may say so more than once
                    continue
        if not running.cancelled():
            running.exception()  # it was seen: nobody is to be warned of it
        raise


async def _run(work: Callable[[], Result], limiter: CapacityLimiter | None) -> Result:
    return await to_thread.run_sync(work, limiter=limiter)
