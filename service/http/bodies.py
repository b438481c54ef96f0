"""Request bodies: their bytes are limited, counted and timed as they arrive; JSON is read strictly."""

from __future__ import annotations

import asyncio
import json
import math
import time
from collections.abc import AsyncIterator
from typing import Any

from starlette.requests import Request
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from service.errors.faults import BodyTooLarge, ClientGone, DeadlineExceeded, InvalidRequest, MalformedBody, MemoryFull
from service.settings import Settings

PIECE_BYTES = 1 << 20
"""Size of the pieces in which a body is written to disk as it arrives."""


class UploadMemory:
    """Counts the bytes of bodies that all requests together hold in memory."""

    def __init__(self, capacity: int) -> None:
        self.capacity, self.held = capacity, 0

    def take(self, size: int) -> None:
        """Count ``size`` bytes more.

        Raises:
            MemoryFull: they would exceed the capacity; none is counted.
        """
        self.check(size)
        self.held += size

    def check(self, size: int) -> None:
        """Raise MemoryFull unless ``size`` bytes have room now."""
        if self.held + size > self.capacity:
            raise MemoryFull("Too many uploads are under way. Send the request again in a moment.")

    def release(self, size: int) -> None:
        """Count ``size`` bytes fewer."""
        self.held -= size


class Intake:
    """The receiving side of one request, which replaces its ``receive``.

    A route may change ``limit`` (bytes) and ``deadline`` (``time.monotonic``) before it reads the body.

    Args:
        scope, receive: of the ASGI request.
        limit: most bytes of the body.
        deadline: when the whole body must have arrived.
        memory: counts the bytes that are held.
        idle: most seconds without a byte.
    """

    def __init__(
        self,
        scope: Scope,
        receive: Receive,
        limit: int,
        deadline: float,
        memory: UploadMemory,
        idle: float = math.inf,
    ) -> None:
        self.limit, self.deadline, self.idle = limit, deadline, idle
        self.size, self.complete = 0, False
        self.held = 0
        """Bytes of this body that count as held in memory."""
        self._is_held = True
        self._receive, self._memory = receive, memory
        lengths = [value for name, value in scope["headers"] if name == b"content-length"]
        self._announced = int(lengths[0]) if lengths and lengths[0].isdigit() else 0

    async def __call__(self) -> Message:
        """The next message.

        Raises:
            BodyTooLarge: the body is longer than the limit, or its Content-Length is.
            MemoryFull: the uploads under way leave no room for the body.
            DeadlineExceeded: the body did not arrive in time.
            ClientGone: the connection was closed before the end of the body.
        """
        if self.complete:
            return await self._receive()
        self._check(self._announced)
        if self._is_held:
            self._memory.check(max(0, self._announced - self.size))
        left = self.deadline - time.monotonic()
        try:
            async with asyncio.timeout(min(left, self.idle)):
                message = await self._receive()
        except TimeoutError:
            if self.idle < left:
                raise DeadlineExceeded(f"No byte of the body arrived for {self.idle:g} seconds.") from None
            raise DeadlineExceeded("The body did not arrive in time.") from None
        if message["type"] != "http.request":
            raise ClientGone("The connection was closed before the end of the body.")
        arrived = len(message.get("body", b""))
        self._check(self.size + arrived)
        if self._is_held:
            self._memory.take(arrived)
            self.held += arrived
        self.size += arrived
        self.complete = not message.get("more_body", False)
        return message

    def pass_on(self, limit: int, seconds: float) -> None:
        """Allow a longer body, which the route writes to disk as it arrives and does not hold in memory.

        Args:
            limit: most bytes.
            seconds: from now until the whole body must have arrived; ``idle`` still applies.
        """
        self.limit, self.deadline, self._is_held = limit, time.monotonic() + seconds, False

    async def hung_up(self) -> None:
        """Return when the client has closed the connection; call it once the body was read."""
        while (await self())["type"] == "http.request":
            pass

    def _check(self, size: int) -> None:
        if size > self.limit:
            raise BodyTooLarge(f"The body has more than {self.limit} bytes, the limit of this resource.")


class BodyLimit:
    """ASGI middleware that puts an :class:`Intake` before each request, with the limits of a JSON body."""

    def __init__(self, app: ASGIApp, settings: Settings, memory: UploadMemory) -> None:
        self.app, self.settings, self.memory = app, settings, memory

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http":
            await self.app(scope, receive, send)
            return
        state = scope["state"]
        deadline = state["started"] + self.settings.request_timeout
        idle = self.settings.read_timeout
        intake = Intake(scope, receive, self.settings.max_json_bytes, deadline, self.memory, idle)
        state["intake"] = intake
        try:
            await self.app(scope, intake, send)
        finally:
            state["bytes_in"] = intake.size
            self.memory.release(intake.held)


async def in_pieces(chunks: AsyncIterator[bytes]) -> AsyncIterator[bytes]:
    """Join the chunks of a body to pieces of at least ``PIECE_BYTES``; the last piece has the rest and may be empty."""
    gathered = bytearray()
    async for chunk in chunks:
        gathered += chunk
        if len(gathered) >= PIECE_BYTES:
            yield bytes(gathered)
            gathered.clear()
    yield bytes(gathered)


def intake_of(request: Request) -> Intake:
    """The intake of a request."""
    intake: Intake = request.state.intake
    return intake


def parse_json(data: bytes | str, what: str) -> Any:
    """Parse JSON; numbers may still be infinite and strings may contain lone surrogates.

    Raises:
        MalformedBody: the text is not JSON, or is nested too deeply.
    """
    try:
        return json.loads(data)
    except RecursionError:
        raise MalformedBody(f"{what} is nested too deeply.") from None
    except ValueError as error:
        raise MalformedBody(f"{what} is not valid JSON: {error}.") from error


def json_size(value: Any, what: str) -> int:
    """The length in bytes of a value as JSON text.

    Raises:
        InvalidRequest: the value cannot be written as JSON in UTF-8, because a number is not finite or a string
            contains a lone surrogate.
    """
    try:
        return len(json.dumps(value, allow_nan=False, ensure_ascii=False, separators=(",", ":")).encode())
    except RecursionError:
        raise InvalidRequest(f"{what} is nested too deeply.") from None
    except UnicodeEncodeError:
        raise InvalidRequest(f"{what} contains half a character (a lone surrogate).") from None
    except ValueError:
        raise InvalidRequest(f"{what} contains a number that is not finite.") from None
