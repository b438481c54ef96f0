"""Work in threads that is waited for whatever comes."""

from __future__ import annotations

import asyncio
import threading

import pytest
from anyio import CancelScope, CapacityLimiter

from service.worker_threads import to_its_end


async def _until(event: threading.Event) -> None:
    async with asyncio.timeout(10):
        while not event.is_set():
            await asyncio.sleep(0.001)


@pytest.mark.anyio
@pytest.mark.parametrize("fails", [False, True])
async def test_a_task_that_is_cancelled_waits_for_its_thread(fails: bool) -> None:
    begun, asked, may_end, ended = (threading.Event() for _ in range(4))

    def work() -> None:
        begun.set()
        assert may_end.wait(60)
        ended.set()
        if fails:
            raise OSError("nobody hears of it")

    task = asyncio.create_task(to_its_end(work, give_up=asked.set))
    await _until(begun)
    for _ in range(3):
        task.cancel()
        await asyncio.sleep(0.01)
        assert not task.done() and asked.is_set()
    may_end.set()
    with pytest.raises(asyncio.CancelledError):
        await task
    assert ended.is_set()


@pytest.mark.anyio
async def test_it_runs_although_the_task_was_cancelled_before() -> None:
    done: list[int] = []
    limiter = CapacityLimiter(1)
    with CancelScope() as scope:
        scope.cancel()
        await to_its_end(lambda: done.append(1), limiter)
    assert scope.cancelled_caught and done == [1] and limiter.borrowed_tokens == 0


@pytest.mark.anyio
async def test_results_and_errors_are_those_of_the_work() -> None:
    assert await to_its_end(lambda: 7) == 7
    with pytest.raises(ZeroDivisionError):
        await to_its_end(lambda: 1 // 0)
