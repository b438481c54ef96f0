"""Request bodies: their bytes are limited, counted and timed as they arrive; JSON is read strictly."""

from __future__ import annotations

import asyncio
import json
import math
import time
from collections.abc import AsyncIterator
from typing import Any

from starlette.datastructures import Headers
from starlette.requests import Request
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from core.names import composed
from service.errors.faults import (
    BodyTooLarge,
    ClientGone,
    DeadlineExceeded,
    InvalidRequest,
    MalformedBody,
    MemoryFull,
    UnsupportedMediaType,
)
from service.fairness import Holding, SharedRoom
from service.http.digests import StatedDigests
from service.settings import Settings

PIECE_BYTES = 1 << 20
"""Size of the pieces in which a body is written to disk as it arrives."""


class UploadMemory(SharedRoom):
    """Counts the bytes of bodies that all requests together hold in memory, and by caller.

    When the memory is full, the caller that holds most of it loses its latest upload to one that holds less.
    """

    def hold(self, holding: Holding, size: int) -> None:
        """Count ``size`` bytes more.

        Raises:
            MemoryFull: there is no room for them; none is counted.
        """
        if not self.take(holding, size):
            raise memory_full()

    def check(self, holding: Holding, size: int) -> None:
        """Raise MemoryFull unless there is room for ``size`` bytes more now."""
        if not self.has_room(size, holding.share, holding.caller):
            raise memory_full()


def memory_full() -> MemoryFull:
    """The error of a body for which there is no room, or not any more."""
    return MemoryFull("Too many uploads are under way. Send the request again in a moment.")


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
        self.size, self.complete, self.answered = 0, False, False
        self.holding = Holding(self._give_way)
        """The bytes of this body that are held in memory."""
        self._digest_headers: tuple[str, ...] = ("Content-Digest", "Repr-Digest")
        self._is_held, self._given_way = True, False
        self._receiving: asyncio.Timeout | None = None
        self._receive, self._memory = receive, memory
        self._headers = Headers(scope=scope)
        self._digests: StatedDigests | None = None
        length = self._headers.get("content-length", "")
        self._announced = int(length) if length.isdecimal() else 0

    async def __call__(self) -> Message:
        """The next message.

        Raises:
            BodyTooLarge: the body is longer than the limit, or its Content-Length is.
            MemoryFull: the uploads under way leave no room for the body, or not any more.
            DeadlineExceeded: the body did not arrive in time.
            ClientGone: the connection was closed before the end of the body, and nothing was answered yet.
            UnsupportedMediaType: the body is compressed.
            InvalidRequest: its digest is malformed.
            DigestMismatch: the whole body has another digest; this comes in place of its last bytes.
        """
        if self.complete or self.answered:  # who sends an answer only waits for the client to go away
            return await self._next(None)
        digests = self._stated_digests()
        self._check(self._announced)
        if self._is_held:
            self._memory.check(self.holding, max(0, self._announced - self.size))
        left = self.deadline - time.monotonic()
        try:
            message = await self._next(min(left, self.idle))
        except TimeoutError:
            if self.answered:
                return await self._next(None)
            if self.idle < left:
                raise DeadlineExceeded(f"No byte of the body arrived for {self.idle:g} seconds.") from None
            raise DeadlineExceeded("The body did not arrive in time.") from None
        if self.answered:
            return message
        if message["type"] != "http.request":
            raise ClientGone("The connection was closed before the end of the body.")
        arrived = len(message.get("body", b""))
        self._check(self.size + arrived)
        if self._is_held and arrived:
            self._memory.hold(self.holding, arrived)
        self.size += arrived
        digests.add(message.get("body", b""))
        if not message.get("more_body", False):
            digests.check()
            self.complete = True
        return message

    def _stated_digests(self) -> StatedDigests:
        """The digests that the head of the request states of its body, once its coding is known to be none."""
        if self._digests is None:
            codings = self._headers.get("content-encoding", "")
            if coding := next((one for one in codings.split(",") if one.strip().lower() not in ("", "identity")), None):
                raise UnsupportedMediaType(
                    f"Content-Encoding: {coding.strip()[:40]!r} is not taken here; send the body as it is.",
                    {"Accept-Encoding": "identity"},
                )
            self._digests = StatedDigests()
            for header in self._digest_headers:
                self._digests.expect(header, ",".join(self._headers.getlist(header)))
        return self._digests

    def is_piece(self) -> None:
        """Leave ``Repr-Digest`` unchecked: the body is a piece of a file, and that is the digest of the whole."""
        self._digest_headers = ("Content-Digest",)

    async def _next(self, seconds: float | None) -> Message:
        """The next message of the server; raises TimeoutError, or MemoryFull as soon as the body has given way."""
        if self._given_way:
            raise memory_full()
        try:
            async with asyncio.timeout(seconds) as self._receiving:
                return await self._receive()
        except TimeoutError:
            if self._given_way:
                raise memory_full() from None
            raise
        finally:
            self._receiving = None

    def _give_way(self) -> bool:
        """Refuse the rest of the body, and the request where it still waits for the encoder."""
        self._given_way = True
        if self._receiving is not None and not self._receiving.expired():
            self._receiving.reschedule(asyncio.get_running_loop().time())
        return True

    def pass_on(self, limit: int, seconds: float) -> None:
        """Allow a longer body, which the route writes to disk as it arrives and does not hold in memory.

        Args:
            limit: most bytes.
            seconds: from now until the whole body must have arrived; ``idle`` still applies.
        """
        self.limit, self.deadline, self._is_held = limit, time.monotonic() + seconds, False

    async def hung_up(self) -> None:
        """Return when the client has closed the connection; call it once the body was read.

        Raises:
            MemoryFull: the memory that the body holds is left to another caller.
        """
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

        async def sending(message: Message) -> None:
            intake.answered = True
            await send(message)

        try:
            await self.app(scope, intake, sending)
        finally:
            state["bytes_in"] = intake.size
            self.memory.release(intake.holding)


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


def read_json(data: bytes | str, **options: Any) -> Any:
    """The value of JSON, whose texts and names are in their one form (:func:`core.names.composed`).

    Args:
        options: of ``json.loads``.

    Raises:
        ValueError: it is not JSON, or has two names in an object that look the same.
        RecursionError.
    """
    value = json.loads(data, **options)
    escaped = "\\u" in data if isinstance(data, str) else b"\\u" in data
    return composed(value) if escaped or not data.isascii() else value


def parse_json(data: bytes | str, what: str) -> Any:
    """Parse JSON, its texts in their one form; numbers may still be infinite, and strings may contain lone surrogates.

    Raises:
        MalformedBody: the text is not JSON, is nested too deeply, or has two names in an object that look the same.
    """
    try:
        return read_json(data)
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
