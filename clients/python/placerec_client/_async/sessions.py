"""Sessions: the frames of one robot in order, and the belief about where it is."""

from __future__ import annotations

from collections.abc import AsyncIterator
from contextlib import suppress
from logging import getLogger
from types import TracebackType
from typing import TYPE_CHECKING, Self, Unpack

from placerec_client import models, parameters, problems
from placerec_client._async.concurrency import Begun, within
from placerec_client._async.connection import AsyncConnection
from placerec_client._async.numbering import AsyncNumbering
from placerec_client.frames import Frame, frame_bytes, media_type
from placerec_client.odometry import Odometry, with_motion
from placerec_client.renamed import OldNames, Subscripted
from placerec_client.requests import path_of
from placerec_client.retry import LEAVE_SECONDS, Retry

if TYPE_CHECKING:
    from placerec_client._async.streams import AsyncStream


log = getLogger("placerec_client")


class AsyncSessions(Subscripted):
    """The sessions of a map that have not ended; iterated, in the order of their ids."""

    def __init__(self, connection: AsyncConnection, path: str) -> None:
        self._connection, self._path = connection, path + "/sessions"

    def __getitem__(self, session_id: str) -> AsyncSession:
        return AsyncSession(self._connection, self._path, None, session_id)

    def __aiter__(self) -> AsyncIterator[models.SessionView]:
        return self.list()

    async def list(self) -> AsyncIterator[models.SessionView]:
        """Yield the sessions."""
        async for page in self._connection.pages(models.SessionPage, self._path, {}):
            for item in page.items:
                yield item

    def begin(self, **options: Unpack[parameters.NewSession]) -> AsyncSession:
        """Return a session that begins when it is entered, or at its first call, and ends when it is left.

        Entered once more, it is another one. Leaving takes a second at most, together with a stream in it, and raises
        nothing: of a session that the service did not end in that time the log ``placerec_client`` has a warning, and
        it ends by itself after ``expires_after``. One that is not entered is ended by its ``delete``.

        ::

            async with lab.sessions.begin() as session:
                answer = await session.send(frame)

            session = await lab.sessions.begin()
            answer = await session.send(frame)
            await session.delete()

        Args:
            options: such as ``advance``, ``lag``, ``camera``, ``verify``, ``expires_after``.
        """
        return AsyncSession(self._connection, self._path, options)


class AsyncSession(OldNames, Begun, end="delete"):
    """One session of one robot. It begins once, and its frames are sent one after the other, also by
    ``asyncio.gather`` or several threads.

    Attributes:
        id: of the session; empty before it has begun.
        view: its settings as it has begun here; None before, and if it was begun elsewhere.
    """

    def __init__(
        self,
        connection: AsyncConnection,
        path: str,
        options: parameters.NewSession | None,
        session_id: str | None = None,
    ) -> None:
        self._connection, self._sessions, self._options = connection, path, options
        self.id = session_id or ""
        self.view: models.SessionView | None = None
        self._is_over = False
        self._closing = 0.0  # seconds that closing its last stream took
        if session_id is not None:
            path_of(session_id)  # which refuses what is no name
        self._numbering = AsyncNumbering(connection, self._begun_path, 0 if session_id is None else None)

    def __repr__(self) -> str:
        return f"{type(self).__name__}({self.id!r})" if self.id else f"<{type(self).__name__}, not begun>"

    async def __aenter__(self) -> Self:
        if self._options is not None and self._is_over:
            return await self.begin()
        return await self._begun()

    async def _begun(self) -> Self:
        if not self.id:
            async with self._numbering.turn(None):
                await self._begun_path(None)
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        seconds = LEAVE_SECONDS - min(self._closing, LEAVE_SECONDS / 2)
        self._is_over = True
        try:
            await within(seconds, lambda: self._leave(seconds))
        except Exception as failure:  # whatever it is, the one that is on its way counts more
            silent = isinstance(failure, TimeoutError)
            reason = str(failure) or (f"no answer came within {seconds:.2g} s." if silent else repr(failure))
            log.warning("The session %s was left, but the service did not end it now: %s", self.id, reason)

    async def _leave(self, seconds: float) -> None:
        """End the session by one attempt; one that has ended already, or with its map, is left so."""
        with suppress(problems.UnknownSession, problems.SessionExpired, problems.UnknownMap):
            await self._connection.patient(Retry(0)).request("DELETE", self.path, deadline=seconds)

    async def begin(self) -> Self:
        """Begin the session, and return it with its ``view``.

        If the answer to an attempt is lost, the next one gets the session that it has begun.
        """
        async with self._numbering.turn(None):
            await self._begin(None)
            self._numbering.restart()
        return self

    async def _begin(self, left: float | None) -> None:
        """Begin the session, within these seconds; it has to be the turn of who calls it."""
        self.view = await self._connection.ask(
            models.SessionView, "POST", self._sessions, json=self._options or {}, deadline=left
        )
        self.id = self.view.id
        self._is_over = False

    async def _begun_path(self, left: float | None) -> str:
        """The path of the session, which begins now if it has not begun; it has to be the turn of who calls it."""
        if not self.id:
            await self._begin(left)
        return self.path

    async def delete(self) -> None:
        """Delete the session, for the run is over; one that is gone already, or never began, is no error."""
        if not self.id:
            return
        with suppress(problems.UnknownSession, problems.SessionExpired):
            await self._connection.request("DELETE", self.path)
        self._is_over = True

    async def read(self) -> models.SessionReport:
        """Return the session and the present belief about where its robot is."""
        await self._begun()
        return await self._connection.ask(models.SessionReport, "GET", self.path)

    async def send(
        self,
        image: Frame,
        *,
        odometry: Odometry | None = None,
        deadline: float | None = None,
        request_id: str | None = None,
        **options: Unpack[parameters.SendFrame],
    ) -> models.SessionAnswer:
        """Send one frame, and return the belief after it.

        A frame that is sent again because an answer was lost counts once, by its number.

        Args:
            image: the frame.
            odometry: where odometry says that the robot is; whatever was lost before, the motion since counts once.
            deadline: seconds after which an answer is of no use.
            request_id: under which the service logs the request; made if left out.
            options: such as ``frame`` (the robot's own number of the frame, growing; counted here if left out),
                ``timestamp`` (a clock that jumps is remarked in the answer's ``note``); and, instead of ``odometry``,
                ``forward``, ``left``, ``turn`` since the last frame that the service took in: the session's
                ``last_frame``.

        Raises:
            InvalidOdometry: ``odometry`` is no ``Odometry``, or a motion is no finite number. Nothing was sent.
        """
        moved = with_motion(options, odometry)
        data = frame_bytes(image)
        async with self._numbering.turn(deadline) as left:
            numbered = await self._numbering.number(moved, left)
            return await self._connection.ask(
                models.SessionAnswer,
                "POST",
                self.path + "/frames",
                params=numbered,
                content=data,
                media_type=media_type(data),
                deadline=left(),
                request_id=request_id,
            )

    def stream(self) -> AsyncStream:
        """Return a WebSocket to the session, for frames without a request for each.

        It needs the package websockets, which ``placerec-client[stream]`` brings.

        ::

            async with session.stream() as stream:
                answer = await stream.send(frame)
        """
        from placerec_client._async.streams import AsyncStream

        return AsyncStream(self._connection, lambda: self.path + "/stream", self._numbering, self._stream_closed)

    def _stream_closed(self, seconds: float) -> None:
        self._closing = seconds

    @property
    def path(self) -> str:
        """The path of the session at the service; it has to have begun."""
        return path_of(self.id, below=self._sessions)
