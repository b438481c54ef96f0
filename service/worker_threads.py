"""Blocking work, mostly of maps, in threads beside the event loop."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from typing import ParamSpec, TypeVar

from anyio import CancelScope, CapacityLimiter, to_thread

Arguments = ParamSpec("Arguments")
Result = TypeVar("Result")


async def in_thread(work: Callable[Arguments, Result], *args: Arguments.args, **kwargs: Arguments.kwargs) -> Result:
    """Run blocking work in a thread of the pool, which is never interrupted.

    A task that is cancelled does not wait for it: it continues at once, and the work ends by itself.  So use this only
    for work that shares nothing with what its caller does afterwards, and :func:`to_its_end` otherwise.
    """
    return await to_thread.run_sync(lambda: work(*args, **kwargs))


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
    return await to_thread.run_sync(work, limiter=limiter)
