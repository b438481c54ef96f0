"""The order of batches: the next batch is received and encoded while the one before it is still being stored.

The order in which places are stored is their order in the sequence.  A client that names its batches can send two of
them at a time: the later one names the batch that it follows, and is encoded and stored after that one.
"""

from __future__ import annotations

import asyncio
import time
from collections.abc import Iterator
from contextlib import contextmanager
from enum import IntEnum

from service.engine.queue import RequestDeadline
from service.errors.faults import BatchOutOfOrder, ClientGone

MOST_NAMES = 1024
"""How many names of stored batches are remembered."""

GRACE = 5.0
"""Seconds that a batch waits for a batch that has not arrived: it may still arrive, or be sent again."""


class Stage(IntEnum):
    """How far a batch has come; a batch counts as ``ENCODED`` once its last frames wait for the encoder."""

    BEGUN, ENCODED, STORED = range(3)


class BatchOrder:
    """The stages of the batches that are in progress or were stored lately.  It is used only from the event loop."""

    def __init__(self) -> None:
        self._stages: dict[tuple[str, str], Stage] = {}  # by map and batch, in the order of their changes
        self._changed = asyncio.Event()

    @contextmanager
    def enter(
        self, map_id: str, batch: str | None, after: str | None, deadline: RequestDeadline
    ) -> Iterator[BatchTurn]:
        """The turn of a batch; if the context ends without an error, the batch counts as stored.

        Args:
            batch: the name of the batch; None: no batch can follow it.
            after: the name of the batch that it follows; None: it does not wait.
        """
        turn = BatchTurn(self, map_id, batch, after, deadline)
        turn.report(Stage.BEGUN)
        try:
            yield turn
        except BaseException:
            turn.report(None)
            raise
        turn.report(Stage.STORED)

    def stage(self, map_id: str, batch: str) -> Stage | None:
        """How far a batch has come; None if it is neither in progress nor stored lately."""
        return self._stages.get((map_id, batch))

    def change(self, map_id: str, batch: str, stage: Stage | None) -> None:
        """Set the stage of a batch; None: the batch failed.  A batch that was stored stays stored."""
        name = (map_id, batch)
        if self._stages.get(name) == Stage.STORED:
            return
        self._stages.pop(name, None)
        if stage is not None:
            self._stages[name] = stage
        if stage == Stage.STORED:
            for stored in [name for name, stage in self._stages.items() if stage == Stage.STORED][:-MOST_NAMES]:
                del self._stages[stored]
        self._changed.set()
        self._changed = asyncio.Event()

    async def changes(self) -> None:
        """Wait until the stage of a batch changes."""
        await self._changed.wait()


class BatchTurn:
    """The turn of one batch among the others."""

    def __init__(
        self, order: BatchOrder, map_id: str, batch: str | None, after: str | None, deadline: RequestDeadline
    ) -> None:
        self._order, self._deadline = order, deadline
        self._map_id, self._batch, self._after = map_id, batch, after

    def report(self, stage: Stage | None) -> None:
        """Set the stage of this batch, for which the next batch may wait; None: the batch failed and is not stored."""
        if self._batch is not None:
            self._order.change(self._map_id, self._batch, stage)

    async def wait_for(self, stage: Stage) -> None:
        """Wait until the batch that this one follows, if any, has reached a stage.

        Raises:
            BatchOutOfOrder: it did not reach the stage before the deadline, or did not arrive within ``GRACE``.
            ClientGone: the client hung up.
        """
        if self._after is None:
            return
        absent_since = time.monotonic()
        gone = asyncio.ensure_future(self._deadline.hung_up())
        try:
            while (found := self._order.stage(self._map_id, self._after)) is None or found < stage:
                left = self._deadline.seconds_left()
                if found is None:
                    left = min(left, absent_since + GRACE - time.monotonic())
                else:
                    absent_since = time.monotonic()
                if gone.done():
                    raise ClientGone("The client hung up before its batch could be stored.")
                if left <= 0:
                    raise BatchOutOfOrder(f"The batch {self._after!r} is not stored; send this one again once it is.")
                change = asyncio.ensure_future(self._order.changes())
                try:
                    await asyncio.wait({change, gone}, timeout=left, return_when=asyncio.FIRST_COMPLETED)
                finally:
                    change.cancel()
        finally:
            gone.cancel()
