"""Encoding for jobs: whoever waits for an answer goes first."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable, Coroutine, Sequence
from contextlib import aclosing
from typing import Any, TypeVar

from core.frames.masks import Mask
from service.engine.engine import Engine
from service.engine.queue import Encoded, Patience
from service.errors.faults import ClientGone
from service.jobs.context import JobContext

Result = TypeVar("Result")

POLL_SECONDS = 0.2
"""A job that is to stop gives its frames up within this time."""

STANDING_BACK_SECONDS = 1.0
"""While requests wait for the encoder a job holds its frames back, but not for longer: it is to end some day."""

LONGEST_SECONDS = 3600.0


def stand_back(engine: Engine, context: JobContext) -> None:
    """Wait while requests wait for the encoder, up to a bound.

    Raises:
        JobCancelled, JobInterrupted.
    """
    until = time.monotonic() + STANDING_BACK_SECONDS
    context.check_cancelled()
    while engine.inference.waiting and time.monotonic() < until:
        context.pause(0.01)


def run_behind(engine: Engine, context: JobContext, work: Callable[[Patience], Coroutine[Any, Any, Result]]) -> Result:
    """Run a coroutine that waits for the encoder, behind the requests that wait for it; blocks the job's thread.

    Args:
        work: what to run, with the patience of the job: it ends when the job is to stop.

    Raises:
        JobCancelled, JobInterrupted.
    """

    async def stopped() -> None:
        while not context.is_to_stop:
            await asyncio.sleep(POLL_SECONDS)

    stand_back(engine, context)
    patience = Patience(time.monotonic() + LONGEST_SECONDS, stopped)
    try:
        return asyncio.run_coroutine_threadsafe(work(patience), engine.loop).result()
    except ClientGone:
        context.check_cancelled()
        raise


def encode_behind(
    engine: Engine, context: JobContext, identity: str, frames: Sequence[bytes], masks: Sequence[Mask | None]
) -> list[Encoded | Exception]:
    """What becomes of frames, in their order, without their pixels; blocks the job's thread.

    They take no place in the queue, which is for requests, and join forward passes as bulk does.

    Raises:
        JobCancelled, JobInterrupted.
    """

    async def encode(patience: Patience) -> list[Encoded | Exception]:
        made: dict[int, Encoded | Exception] = {}
        async with aclosing(engine.inference.encode_many(identity, frames, patience, masks)) as outcomes:
            async for some in outcomes:
                for index, outcome in some:
                    made[index] = outcome if isinstance(outcome, Exception) else outcome.without_pixels()
        return [made[index] for index in range(len(frames))]

    return run_behind(engine, context, encode)
