"""The numbers of a session's frames, by which a frame that is sent again counts once."""

from __future__ import annotations

import time
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from operator import index

from placerec_client import models, parameters, problems
from placerec_client._async.concurrency import Lock, PathWithin, acquire
from placerec_client._async.connection import AsyncConnection
from placerec_client.answers import OVERLOADED
from placerec_client.errors import DeadlineExceeded, InvalidParameter, Problem
from placerec_client.requests import seconds_of

LARGEST = 2**53
"""The largest number of a frame that the service takes."""


class AsyncNumbering:
    """Counts the frames of one session, which are sent one after the other, whoever sends them.

    Args:
        connection: to the service.
        begun: returns the path of the session within the seconds that it gets, having begun the session if need be.
        first: the next number; None for a session that was begun elsewhere, whose last number is requested.
    """

    def __init__(self, connection: AsyncConnection, begun: PathWithin, first: int | None) -> None:
        self._connection, self._begun, self._next = connection, begun, first
        self._lock = Lock()

    def restart(self) -> None:
        """Count from 0 again, for another session has begun."""
        self._next = 0

    @asynccontextmanager
    async def turn(self, deadline: float | None) -> AsyncIterator[Callable[[], float | None]]:
        """Wait for the frames before; yield a function: the seconds left until the deadline, or None.

        A frame that the service refuses within leaves the next number as it was.

        Raises:
            InvalidParameter: the deadline is no number.
            DeadlineExceeded: those before have taken longer; the frame has no number and was not sent.
        """
        if deadline is not None:
            deadline = seconds_of("deadline", deadline)
        began = time.monotonic()
        try:
            await acquire(self._lock, deadline)
        except TimeoutError as error:
            raise DeadlineExceeded(f"The frames before took longer than {deadline:g} s.") from error
        before = self._next
        try:
            yield lambda: None if deadline is None else max(deadline - round(time.monotonic() - began, 3), 0.0)
        except (Problem, InvalidParameter) as error:
            if isinstance(error, problems.FrameOutOfOrder) and self._next != before:
                self._next = None  # another one has sent frames since: the service is queried for its last number
            elif (
                getattr(error, "status", None) not in OVERLOADED
            ):  # before which an attempt may have been lost and counted
                self._next = before
            raise
        finally:
            self._lock.release()

    async def number(self, options: parameters.SendFrame, left: Callable[[], float | None]) -> parameters.SendFrame:
        """Return the options of a frame with its number: the caller's own, or the next one.

        Raises:
            InvalidParameter: the caller's own is no whole number.
            DeadlineExceeded: the service did not send its last number within the seconds that were left.
        """
        given = options.get("frame")
        path = await self._begun(left())
        if given is None:
            if self._next is None:
                report = await self._connection.ask(models.SessionReport, "GET", path, deadline=left())
                last = report.last_frame
                self._next = 0 if last is None else last + 1
            if self._next > LARGEST:
                self._next = 0  # which the service takes for a counter that begins anew
            given = self._next
        try:
            given = index(given)
        except TypeError as error:
            raise InvalidParameter(f"frame has to be a whole number, not {ascii(given)[:140]}.") from error
        self._next = max(given + 1, self._next or 0)
        return {**options, "frame": given}
