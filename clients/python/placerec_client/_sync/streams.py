# Written from _async/streams.py by scripts/client.  Do not edit.
"""The frames of a session over one WebSocket; it is taken up again when it is lost."""

from __future__ import annotations

import json
import time
import uuid
from collections.abc import Callable
from contextlib import ExitStack
from types import TracebackType
from typing import Any, Self, Unpack

from websockets.exceptions import ConnectionClosed, InvalidHandshake, InvalidStatus, WebSocketException
from websockets.sync.client import ClientConnection, connect

from placerec_client import models, parameters, problems
from placerec_client._sync.concurrency import received, sleep
from placerec_client._sync.connection import Connection
from placerec_client._sync.numbering import Numbering
from placerec_client.answers import OVERLOADED, parsed, problem_of
from placerec_client.errors import ConnectionFailed, DeadlineExceeded, PlacerecError, Problem, UnexpectedAnswer
from placerec_client.frames import Frame, frame_bytes
from placerec_client.odometry import Odometry, with_motion
from placerec_client.requests import as_meant, dumps, text_of
from placerec_client.retry import LEAVE_SECONDS, Clock

CONNECT_SECONDS = 5.0
CLOSE_SECONDS = LEAVE_SECONDS / 2
"""How long closing waits for the service; leaving the session, which often follows, has what is left of its second."""

MOST_BYTES = 64 << 20
"""Bytes of an answer."""


class Stream:
    """A WebSocket into a session, made by ``session.stream()``; one at a time for each session.

    It connects when the first frame is sent.  If the connection is lost, the frame is sent again over a new one under
    the same number, so that it counts once.
    """

    def __init__(
        self,
        connection: Connection,
        path: Callable[[], str],
        numbering: Numbering,
        closed: Callable[[float], object],
    ) -> None:
        self._connection, self._path, self._numbering, self._closed = connection, path, numbering, closed
        self._socket: ClientConnection | None = None
        self._opened = ExitStack()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Close the connection; the session goes on."""
        was_open, began = self._socket is not None, time.monotonic()
        self._socket = None
        try:
            self._opened.close()
        finally:
            if was_open:
                self._closed(time.monotonic() - began)

    def send(
        self,
        image: Frame,
        *,
        odometry: Odometry | None = None,
        deadline: float | None = None,
        **options: Unpack[parameters.SendFrame],
    ) -> models.SessionAnswer:
        """Send one frame, and return the belief after it.

        Args:
            image: the frame.
            odometry: as of ``session.send``.
            deadline: seconds after which an answer is of no use.
            options: as of ``session.send``.

        Raises:
            InvalidOdometry: as of ``session.send``.
            Problem: the frame was refused and does not count; the session goes on unless it is ``SessionExpired`` or
                ``UnknownSession``.
        """
        moved = with_motion(options, odometry)
        data = frame_bytes(image)
        with self._numbering.turn(deadline) as left:
            numbered = self._numbering.number(moved, left)
            head = dumps({name: _field(name, value) for name, value in numbered.items() if value is not None})
            return self._answer(head, data, Clock(left(), self._connection.retry))

    def _answer(self, head: str, data: bytes, clock: Clock) -> models.SessionAnswer:
        """The answer to a frame, which is sent again where that may help."""
        while True:
            clock.attempts += 1
            try:
                return self._attempt(head, data, clock)
            except Problem as problem:
                if problem.status not in OVERLOADED or (problem.retry_after is None and not _passes(problem)):
                    raise
                failure: PlacerecError = problem
                pause = clock.pause(problem.retry_after)
            except ConnectionFailed as lost:
                failure, pause = lost, clock.pause()
            if pause is None:
                if clock.deadline is None:
                    raise failure
                raise DeadlineExceeded(f"No answer came within {clock.deadline:g} s: {failure}") from failure
            sleep(pause)

    def _attempt(self, head: str, data: bytes, clock: Clock) -> models.SessionAnswer:
        self._connection.check_open()
        left = clock.left()
        limit = self._connection.timeout if left is None else max(min(self._connection.timeout, left), 0.001)
        try:
            if self._socket is None:
                self._socket = self._connected(min(CONNECT_SECONDS, limit))
            self._socket.send(head)
            self._socket.send(data)
            text = received(self._socket, limit)
        except (ConnectionClosed, OSError, TimeoutError) as error:
            self.close()
            raise ConnectionFailed(f"The stream to {self._connection.name} was lost: {error}.") from error
        except BaseException:
            self.close()  # an answer that comes later must not be taken for that of another frame
            raise
        found = json.loads(text)
        if "problem" in found:
            raise problem_of(found["problem"])
        return parsed(models.SessionAnswer, text)

    def _connected(self, limit: float) -> ClientConnection:
        headers = [(name.decode(), value.decode()) for name, value in self._connection.headers if name != b"Host"]
        headers.append(("X-Request-Id", uuid.uuid4().hex))
        address = "ws" + self._connection.url.removeprefix("http") + self._path()
        try:
            opening = connect(
                address,
                compression=None,
                additional_headers=headers,
                user_agent_header=None,
                open_timeout=limit,
                close_timeout=CLOSE_SECONDS,
                max_size=MOST_BYTES,
                proxy=None,
            )
            return self._opened.enter_context(opening)
        except InvalidStatus as error:
            raise _denied(error) from error
        except (WebSocketException, InvalidHandshake) as error:
            raise ConnectionFailed(f"{self._connection.name} opened no stream: {error}.") from error


def _passes(problem: Problem) -> bool:
    """Whether a problem within a stream, which has no Retry-After, is one that passes."""
    return isinstance(
        problem,
        problems.QueueFull
        | problems.MemoryFull
        | problems.NotReady
        | problems.Stopping
        | problems.DeadlineExceededByService
        | problems.RateExceeded,
    )


def _denied(error: InvalidStatus) -> PlacerecError:
    """The error for a handshake that was refused; another stream may be the one that was just lost."""
    response = error.response
    try:
        body: Any = json.loads(response.body or b"")
    except ValueError:
        body = None
    if not isinstance(body, dict):
        return UnexpectedAnswer(f"The stream was refused with {response.status_code}.", response.status_code)
    after = response.headers.get("Retry-After")
    problem = problem_of(body, response.status_code, float(after) if after and after.isdecimal() else None)
    if isinstance(problem, problems.StreamTaken):
        return ConnectionFailed(problem.detail)
    return problem


def _field(name: str, value: Any) -> Any:
    value = as_meant(name, value)
    return value if isinstance(value, bool | int | float | str) else text_of(name, value)
