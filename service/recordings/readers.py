"""The children that read the bags of jobs: some of them stay while their jobs let those of other maps go first."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager

from service.jobs.context import JobContext, JobGivesWay
from service.recordings.reader import Order, Reader

MOST_WAITING = 4
"""Children that stay while their jobs wait; each may take 2 GiB, and opens its bag meanwhile."""


class Turns:
    """When the job that reads a bag lets those of other maps go first.

    Each turn does at least one step, however long it takes, so that the job ends; and the bag may be opened over
    several, if the child stays meanwhile.

    Args:
        stays: whether there is room for the child while the job waits.
    """

    def __init__(self, context: JobContext, stays: bool) -> None:
        self._context, self._stays, self._stepped = context, stays, False

    def check(self, opening: bool) -> None:
        """For while the child is waited for.

        Raises:
            JobCancelled, JobInterrupted, JobGivesWay.
        """
        self._context.check_cancelled()
        if opening and (self._stays or self._stepped):
            self._context.give_way()

    def begin_step(self) -> None:
        """Before a frame is looked at or taken; raises JobGivesWay."""
        if self._stepped:
            self._context.give_way()

    def end_step(self) -> None:
        """Note that this was done, and will not be done again."""
        self._stepped = True


class Readers:
    """The children that have not ended.  Thread-safe."""

    def __init__(self) -> None:
        self._lock, self._waiting, self._closed = threading.Lock(), dict[str, Reader](), False

    @contextmanager
    def reading(self, context: JobContext, order: Order) -> Iterator[tuple[Reader, Turns]]:
        """The child of a job: the one that has stayed, or a new one.

        It stays when the block is left with JobGivesWay, if there is room, and is ended otherwise.
        """
        with self._lock:
            reader = self._waiting.pop(context.id, None)
            turns = Turns(context, len(self._waiting) < MOST_WAITING)
        reader = reader or Reader(order, turns.check)
        reader.check = turns.check
        try:
            yield reader, turns
        except JobGivesWay:
            if not self._stays(context.id, reader):
                reader.close()
            raise
        except BaseException:
            reader.close()
            raise
        reader.close()

    def _stays(self, job_id: str, reader: Reader) -> bool:
        with self._lock:
            if self._closed or len(self._waiting) >= MOST_WAITING:
                return False
            self._waiting[job_id] = reader
            return True

    def end(self, job_id: str) -> None:
        """End the child of a job that has ended while it waited."""
        with self._lock:
            reader = self._waiting.pop(job_id, None)
        if reader is not None:
            reader.close()

    def close(self) -> None:
        """End all children that wait, and those that would."""
        with self._lock:
            self._closed, waiting = True, list(self._waiting)
        for job_id in waiting:
            self.end(job_id)
