"""The numbers of a session's frames, by which a frame that is sent again counts once."""

from __future__ import annotations

from placerec_client import models, parameters
from placerec_client._async.connection import AsyncConnection


class AsyncNumbering:
    """Counts the frames of one session.

    Args:
        connection: to the service.
        path: of the session.
        first: the next number; None for a session that was begun elsewhere, which is asked for its last number.
    """

    def __init__(self, connection: AsyncConnection, path: str, first: int | None) -> None:
        self._connection, self._path, self._next = connection, path, first

    async def number(self, options: parameters.SendFrame) -> parameters.SendFrame:
        """Return the options of a frame with its number: the caller's own, or the next one."""
        given = options.get("frame")
        if given is None:
            if self._next is None:
                last = (await self._connection.ask(models.SessionReport, "GET", self._path)).last_frame
                self._next = 0 if last is None else last + 1
            given = self._next
        self._next = given + 1
        return {**options, "frame": given}
