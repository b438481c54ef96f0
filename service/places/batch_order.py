"""Batches that are stored one after the other, though the next is read and encoded while the one before is stored.

The order of enrolment is the order of places in their sequence. A sender that names its batches can have two of them
under way: the later one says after which it comes, is encoded behind it, and is stored only then.
"""

from __future__ import annotations

import asyncio
import time
from collections.abc import Iterator
from contextlib import contextmanager
from enum import IntEnum

from service.engine.queue import RequestDeadline
from service.errors.faults import BatchOutOfOrder, ClientGone

KEPT = 1024
"""Names of batches that were stored; of two that come one after the other, the first is among the latest."""

GRACE = 5.0
"""Seconds that a batch waits for one that is not under way: it may be on its way, or be sent once more."""


class Stage(IntEnum):
    """How far a batch has come; ``ENCODED`` also when only its last frames wait for the encoder."""

    BEGUN, ENCODED, STORED = range(3)


class BatchOrder:
    """Which batches are under way, and which are stored. Used from the event loop alone."""

    def __init__(self) -> None:
        self._stages: dict[tuple[str, str], Stage] = {}  # by map and batch; in the order of their last change
        self._changed = asyncio.Event()

    @contextmanager
    def enter(self, map_id: str, batch: str | None, after: str | None, deadline: RequestDeadline) -> Iterator[Sequel]:
        """A batch of this name in line, behind another; left without an error, it is stored.

        Args:
            batch: None: nobody can come after it.
            after: None: it waits for nobody.
        """
        sequel = Sequel(self, map_id, batch, after, deadline)
        sequel.reach(Stage.BEGUN)
        try:
            yield sequel
        except BaseException:
            sequel.reach(None)
            raise
        sequel.reach(Stage.STORED)

    def stage(self, map_id: str, batch: str) -> Stage | None:
        """How far a batch has come; None if it is neither under way nor stored lately."""
        return self._stages.get((map_id, batch))

    def change(self, map_id: str, batch: str, stage: Stage | None) -> None:
        """Note how far a batch has come, or that it is gone; one that was stored once stays so."""
        name = (map_id, batch)
        if self._stages.get(name) == Stage.STORED:
            return
        self._stages.pop(name, None)
        if stage is not None:
            self._stages[name] = stage
        if stage == Stage.STORED:
            for stored in [name for name, stage in self._stages.items() if stage == Stage.STORED][:-KEPT]:
                del self._stages[stored]
        self._changed.set()
        self._changed = asyncio.Event()

    async def changes(self) -> None:
        """Wait until a batch comes further."""
        await self._changed.wait()


class Sequel:
    """One batch in line."""

    def __init__(
        self, line: BatchOrder, map_id: str, batch: str | None, after: str | None, deadline: RequestDeadline
    ) -> None:
        self._line, self._deadline = line, deadline
        self._map_id, self._batch, self._after = map_id, batch, after

    def reach(self, stage: Stage | None) -> None:
        """Tell those behind how far this batch has come; None: it ends here, and is not stored."""
        if self._batch is not None:
            self._line.change(self._map_id, self._batch, stage)

    async def wait_for(self, stage: Stage) -> None:
        """Wait until the batch before, if there is one, has come so far.

        Raises:
            BatchOutOfOrder: it has not in time, or is not even under way.
            ClientGone: the caller hung up.
        """
        if self._after is None:
            return
        absent_since = time.monotonic()
        gone = asyncio.ensure_future(self._deadline.hung_up())
        try:
            while (found := self._line.stage(self._map_id, self._after)) is None or found < stage:
                left = self._deadline.seconds_left()
                if found is None:
                    left = min(left, absent_since + GRACE - time.monotonic())
                else:
                    absent_since = time.monotonic()
                if gone.done():
                    raise ClientGone("The caller hung up before its batch could be stored.")
                if left <= 0:
                    raise BatchOutOfOrder(f"The batch {self._after!r} is not stored; send this one again once it is.")
                change = asyncio.ensure_future(self._line.changes())
                try:
                    await asyncio.wait({change, gone}, timeout=left, return_when=asyncio.FIRST_COMPLETED)
                finally:
                    change.cancel()
        finally:
            gone.cancel()
