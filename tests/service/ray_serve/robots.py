"""Robots that ask encoders without a pause, and hold each answer against that of an encoder without Ray."""

from __future__ import annotations

import asyncio
import time
from typing import Self

import numpy as np

from core.frames.images import decode
from core.method.catalogue import DEFAULT_ENCODER, EncoderCatalogue
from service.engine.queue import EncoderQueue, RequestDeadline
from service.errors.faults import NotReady
from tests.service.scenes import jpeg

ROBOTS = 6
PATIENCE = 120.0
"""Seconds that a robot waits for an answer."""


async def stays() -> None:
    """A client that does not hang up."""
    await asyncio.Event().wait()


class Robots:
    """``ROBOTS`` robots that ask until the block ends, which raises what any of them met besides a refusal.

    answered, refused: frames so far.
    """

    def __init__(self, queue: EncoderQueue) -> None:
        self.answered = self.refused = 0
        self._queue = queue
        encoder = EncoderCatalogue().get(DEFAULT_ENCODER)
        self._identity = encoder.identity
        self._wanted = [encoder.encode(decode(jpeg(number))).descriptor for number in range(ROBOTS)]
        self._served = [0] * ROBOTS
        self._over = False
        self._tasks: list[asyncio.Task[None]] = []

    async def __aenter__(self) -> Self:
        self._tasks = [asyncio.create_task(self._ask(number)) for number in range(ROBOTS)]
        await self.all_served()
        return self

    async def __aexit__(self, *raised: object) -> None:
        self._over = True
        await asyncio.gather(*self._tasks)

    async def all_served(self) -> float:
        """Wait until each has had an answer to a frame that it sends from now on; how many seconds that takes."""
        began, before = time.monotonic(), list(self._served)
        while not all(now > then + 1 for now, then in zip(self._served, before, strict=True)):
            if any(task.done() for task in self._tasks):
                await asyncio.gather(*self._tasks)
            await asyncio.sleep(0.02)
        return time.monotonic() - began

    async def _ask(self, number: int) -> None:
        while not self._over:
            deadline = RequestDeadline(time.monotonic() + PATIENCE, stays)
            try:
                found = await self._queue.encode(self._identity, jpeg(number), deadline)
            except NotReady:
                self.refused += 1
                await asyncio.sleep(0.1)
            else:
                np.testing.assert_array_equal(found.encoding.descriptor, self._wanted[number])
                self.answered += 1
                self._served[number] += 1
