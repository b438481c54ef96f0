"""The bounded queue in front of the encoders: a request takes a place, and its frames are encoded within a deadline."""

from __future__ import annotations

import asyncio
import time
from collections.abc import AsyncGenerator, Awaitable, Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass
from typing import Any

from core.errors import UnknownEncoder
from core.frames.images import Limits
from core.frames.masks import Mask
from core.method.catalogue import EncoderCatalogue
from core.method.encoder import Encoder
from core.threads import cores, share_cores
from service.engine.encoder_threads import AHEAD, EncoderThreads
from service.engine.encoders import AfterEncoding, Encoded, QueuedFrame, deadline_exceeded
from service.errors.faults import ClientGone, DeadlineExceeded, EncoderNotInstalled, QueueFull
from service.fairness import Holding, SharedRoom
from service.telemetry.metrics import Metrics

__all__ = ["AfterEncoding", "Encoded", "EncoderQueue", "Outcomes", "RequestDeadline"]

Outcomes = list[tuple[int, Encoded | Exception]]
"""Some frames of a request, each with its index: encoded, or the error that prevented its encoding."""

UNWATCHED = 0.25
"""Seconds after which a connection is watched for a client that hangs up; most frames are encoded by then."""


@dataclass(frozen=True)
class RequestDeadline:
    """When a request stops waiting: at the time ``at`` (``time.monotonic``), or as soon as ``hung_up`` returns."""

    at: float
    hung_up: Callable[[], Awaitable[None]]

    def seconds_left(self) -> float:
        """Seconds until the deadline; negative after it."""
        return self.at - time.monotonic()


class QueuePlace:
    """The place of one request in the queue; it can be taken away while none of its frames is being encoded."""

    def __init__(self) -> None:
        self.frames: list[QueuedFrame] = []
        """The request's frames that wait or are being encoded."""
        self._taken_away = False
        self._holdings: list[tuple[SharedRoom, Holding]] = []

    def enter(self, room: SharedRoom) -> bool:
        """Take a place in a room until ``leave``; False if there is none."""
        holding = Holding(self.give_way)
        self._holdings.append((room, holding))
        return room.take(holding)

    def leave(self) -> None:
        """Leave all rooms."""
        for room, holding in self._holdings:
            room.release(holding)

    def give_way(self) -> bool:
        """Withdraw the frames, and refuse the request; returns False if an encoder is at work on them."""
        waiting = [frame for frame in self.frames if not frame.result.done()]
        if self._taken_away or (self.frames and not waiting) or (waiting and not waiting[0].result.cancel()):
            return False
        self._taken_away = True
        for frame in waiting:
            frame.result.cancel()
        self.leave()
        return True

    def check(self) -> None:
        """Raise QueueFull if the place was taken away."""
        if self._taken_away:
            raise _queue_full()


_PLACE: ContextVar[QueuePlace | None] = ContextVar("place", default=None)
"""The place of the present request; jobs have none."""


class EncoderQueue:
    """Loads encoders and lets them encode frames.  It is used from the event loop.

    Args:
        catalogue: the installed encoders.
        limits: the largest frame that is decoded.
        queue_length: the most requests that may have a place at one time.
        threads: how many threads encode, each a frame of its own; a frame that is alone has all of them.  0: one for
            each core.
    """

    def __init__(
        self, catalogue: EncoderCatalogue, limits: Limits, queue_length: int, threads: int, metrics: Metrics
    ) -> None:
        self._catalogue, self._metrics = catalogue, metrics
        self._room, self._bulk_room = SharedRoom(queue_length), SharedRoom(max(1, queue_length // 2))
        self._loaded: dict[str, Encoder] = {}
        share_cores(threads or cores())
        self.encoders = EncoderThreads(limits)
        self._loader = ThreadPoolExecutor(1, "encoder-loader")

    def close(self) -> None:
        """Cancel the waiting frames and end the encoders; blocks."""
        self._loader.shutdown(cancel_futures=True)
        self.encoders.close()

    def check_room(self) -> None:
        """Raise QueueFull if the caller would get no place; a route calls it before it reads a body."""
        if not self._room.has_room():
            raise _queue_full()

    @property
    def waiting(self) -> int:
        """The number of requests that have a place in the queue now."""
        return self._room.held

    @contextmanager
    def place(self, frames: int = 1) -> Iterator[None]:
        """Hold a place in the queue for one request, whose frames are encoded within the context.

        If the queue is full, the caller that has most places loses its latest one to a caller that has fewer.

        Args:
            frames: the number of frames of the request.  Requests of several frames take longer, so they may have only
                half of the places, and there is always room for requests of a single frame.

        Raises:
            QueueFull: no place is free; raised within the context if the place is lost to another caller.
        """
        place = QueuePlace()
        entered = _PLACE.set(place)
        try:
            self.check_room()
            if frames > 1 and not place.enter(self._bulk_room):
                raise QueueFull(
                    "Too many requests of several frames are waiting for the encoder; send this one again in a moment."
                )
            if not place.enter(self._room):
                raise _queue_full()
            self._metrics.queue.set(self._room.held)
            yield
        finally:
            _PLACE.reset(entered)
            place.leave()
            self._metrics.queue.set(self._room.held)

    async def load(self, identity: str) -> Encoder:
        """The encoder of an identity; it is loaded, and checked against its golden values, when it is first used.

        Raises:
            EncoderNotInstalled: no encoder of this identity is installed.
            InvalidModel: its files are damaged, or it does not reproduce its golden values on this machine.
        """
        if identity in self._loaded:
            return self._loaded[identity]
        return await asyncio.wrap_future(self._loader.submit(self._load, identity))

    def _load(self, identity: str) -> Encoder:
        if identity not in self._loaded:
            try:
                encoder = self._catalogue.get(identity)
            except UnknownEncoder as error:
                raise EncoderNotInstalled(str(error)) from error
            encoder.check_golden()
            self._loaded[identity] = encoder
        return self._loaded[identity]

    async def _load_in_time(self, identity: str, deadline: RequestDeadline) -> Encoder:
        if deadline.seconds_left() <= 0:
            raise deadline_exceeded()
        if identity in self._loaded:
            return self._loaded[identity]
        loading = asyncio.ensure_future(self.load(identity))
        try:
            if (ended := await _ended(loading, deadline)) is not None:
                raise ended
            return loading.result()
        finally:
            loading.cancel()

    async def encode(
        self,
        identity: str,
        data: bytes,
        deadline: RequestDeadline,
        mask: Mask | None = None,
        after_encoding: AfterEncoding | None = None,
        keypoints: bool = False,
    ) -> Encoded:
        """Wait in the queue, then decode and encode one frame; call it within ``place``.

        Args:
            data: the bytes of a JPEG, PNG or WebP file.
            mask: the part of the frame that is ignored.
            keypoints, after_encoding: see :class:`QueuedFrame`.

        Raises:
            DeadlineExceeded, ClientGone: the request ended before the encoding began; the frame was not encoded.
            QueueFull: its place was lost to another caller; the frame was not encoded.
            InvalidImage: the frame cannot be decoded.
            EncoderNotInstalled, InvalidModel: see ``load``.
        """
        encoder = await self._load_in_time(identity, deadline)
        frame = QueuedFrame(encoder, data, mask, deadline.at, keypoints=keypoints, after_encoding=after_encoding)
        place = _place()
        place.frames = [frame]
        self.encoders.put([frame])
        result = asyncio.wrap_future(frame.result)
        try:
            ended = await _ended(result, deadline)
            place.check()
            # A frame whose encoding has begun is finished: dropping it would save nothing.
            if ended is not None and frame.result.cancel():
                raise ended
            encoded = await result
        finally:
            result.cancel()
        self._metrics.observe_stages(encoded.milliseconds)
        return encoded

    async def encode_many(
        self,
        identity: str,
        frames: Sequence[bytes],
        deadline: RequestDeadline,
        masks: Sequence[Mask | None] | None = None,
        keypoints: bool = False,
    ) -> AsyncGenerator[Outcomes]:
        """Encode the frames of a bulk request; call it within ``place``.

        At most ``AHEAD`` of them wait at a time, and robots' frames go first.  When the generator is closed,
        waiting frames leave the queue.

        Args:
            frames: the bytes of the files.
            masks: for each frame the part that is ignored; None: all frames are used whole.
            keypoints: whether the frames' keypoints are wanted, too.

        Yields:
            Frames that are done, with their indices, as they are done.  An error concerns one frame.

        Raises:
            Others: see ``encode``; they concern all frames.
        """
        if not frames:
            return
        encoder = await self._load_in_time(identity, deadline)
        hidden = [None] * len(frames) if masks is None else masks
        open_: dict[asyncio.Future[Encoded], tuple[int, QueuedFrame]] = {}
        begun, bulk, place = 0, len(frames) > 1, _place()
        gone = asyncio.ensure_future(deadline.hung_up())
        try:
            while begun < len(frames) or open_:
                place.check()
                following = range(begun, min(len(frames), begun + AHEAD - len(open_)))
                queued = [QueuedFrame(encoder, frames[i], hidden[i], deadline.at, bulk, keypoints) for i in following]
                self.encoders.put(queued)
                open_ |= {
                    asyncio.wrap_future(frame.result): (i, frame) for i, frame in zip(following, queued, strict=True)
                }
                begun = following.stop
                place.frames = [frame for _, frame in open_.values()]
                waited: set[asyncio.Future[Any]] = {*open_, gone}
                await asyncio.wait(
                    waited, timeout=max(0.0, deadline.seconds_left()), return_when=asyncio.FIRST_COMPLETED
                )
                place.check()
                done = [(future, *open_.pop(future)) for future in [*open_] if future.done()]
                if not done and (begun < len(frames) or any(frame.result.cancel() for _, frame in open_.values())):
                    raise _gone(gone)
                if not done:  # the encoding of all remaining frames was begun before the deadline
                    await asyncio.wait(open_)
                    continue
                for future, _, _ in done:
                    if isinstance(error := future.exception(), DeadlineExceeded):  # in its turn, but too late
                        raise error
                    if error is None:
                        self._metrics.observe_stages(future.result().milliseconds)
                yield [(i, _outcome(future)) for future, i, _ in done]
        finally:
            _forget(gone)
            for future, (_, frame) in open_.items():
                frame.result.cancel()
                future.cancel()


async def _ended(awaited: asyncio.Future[Any], deadline: RequestDeadline) -> Exception | None:
    """Wait for a future; the reason why its request ended before it was done, or None."""
    await asyncio.wait({awaited}, timeout=min(UNWATCHED, deadline.seconds_left()))
    if awaited.done():
        return None
    gone = asyncio.ensure_future(deadline.hung_up())
    try:
        waited: set[asyncio.Future[Any]] = {awaited, gone}
        await asyncio.wait(waited, timeout=max(0.0, deadline.seconds_left()), return_when=asyncio.FIRST_COMPLETED)
        if awaited.done():
            return None
        return _gone(gone)
    finally:
        _forget(gone)


def _place() -> QueuePlace:
    """The place of the present request, or one of no queue, which is never taken away.

    Raises:
        QueueFull: it was taken away.
    """
    place = _PLACE.get() or QueuePlace()
    place.check()
    return place


def _queue_full() -> QueueFull:
    return QueueFull("Too many requests are waiting for the encoder; send this one again in a moment.")


def _outcome(future: asyncio.Future[Encoded]) -> Encoded | Exception:
    error = future.exception()
    if error is None:
        return future.result()
    if isinstance(error, Exception):
        return error
    raise error


def _forget(watching: asyncio.Future[None]) -> None:
    """End the watching of a connection, whose error is of no interest any more."""
    if not watching.cancel() and not watching.cancelled():
        watching.exception()


def _gone(watching: asyncio.Future[None]) -> Exception:
    """Why a request ends, whose connection was watched until its deadline or until the client hung up."""
    if not watching.done():
        return deadline_exceeded()
    error = watching.exception()
    return error if isinstance(error, Exception) else ClientGone("The client hung up before its frame was encoded.")
