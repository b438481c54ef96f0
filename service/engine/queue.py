"""Frames on their way through the encoder: a place in the bounded queue, a turn, deadline that may end before it."""

from __future__ import annotations

import asyncio
import time
from collections.abc import AsyncGenerator, Awaitable, Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import torch

from core.frames.images import Limits
from core.frames.masks import Mask
from core.method.catalogue import EncoderCatalogue
from core.method.encoder import Encoder
from core.threads import cores, share_cores
from service.engine.microbatches import MOST_FRAMES, Encoded, MicroBatches, Then, Turn, late
from service.errors.faults import ClientGone, QueueFull
from service.telemetry.metrics import Metrics

__all__ = ["Encoded", "EncoderQueue", "Outcomes", "RequestDeadline", "Then"]

Outcomes = list[tuple[int, Encoded | Exception]]
"""What became of some frames of many, each with its index."""

AHEAD = 2 * MOST_FRAMES * max(2, cores())
"""Frames of one bulk request that wait at a time: enough that the encoder never waits for it."""


UNWATCHED = 0.25
"""Seconds for which nobody looks whether the caller of one frame is still there: most have their answer by then."""


@dataclass(frozen=True)
class RequestDeadline:
    """When a request stops waiting: at the time ``at`` (``time.monotonic``), or as soon as ``hung_up`` returns."""

    at: float
    hung_up: Callable[[], Awaitable[None]]

    def seconds_left(self) -> float:
        """Seconds until the deadline; negative after it."""
        return self.at - time.monotonic()


class EncoderQueue:
    """Loads encoders and encodes frames.

    Args:
        catalogue: the installed encoders.
        limits: of a frame.
        queue_length: requests that may be in here at one time.
        threads: of a forward pass; 0 leaves it to torch.
    """

    def __init__(
        self, catalogue: EncoderCatalogue, limits: Limits, queue_length: int, threads: int, metrics: Metrics
    ) -> None:
        self._catalogue, self._metrics = catalogue, metrics
        self._queue_length, self._waiting, self._bulk = queue_length, 0, 0
        self._loaded: dict[str, Encoder] = {}
        share_cores(threads or torch.get_num_threads())
        self._batches = MicroBatches(self._load, limits, metrics.encoded_together.observe)

    def close(self) -> None:
        """Drop what waits and end the thread."""
        self._batches.close()

    def check_room(self) -> None:
        """Raise QueueFull if there is no place in the queue now; cheap, for before a body is read."""
        if self._waiting >= self._queue_length:
            raise QueueFull("Too many requests wait for the encoder; send this one again in a moment.")

    @property
    def waiting(self) -> int:
        """Requests that have a place in the queue now."""
        return self._waiting

    @contextmanager
    def place(self, frames: int = 1) -> Iterator[None]:
        """A place in the queue for one request, whose frames are encoded within.

        Args:
            frames: of the request. Those of many frames, which keep their places for long, may have half of the queue,
                so that there is always room for those of one.

        Raises:
            QueueFull: none is free.
        """
        self.check_room()
        bulk = int(frames > 1)
        if bulk and self._bulk >= max(1, self._queue_length // 2):
            raise QueueFull("Too many requests of many frames wait for the encoder; send this one again in a moment.")
        self._waiting, self._bulk = self._waiting + 1, self._bulk + bulk
        self._metrics.queue.set(self._waiting)
        try:
            yield
        finally:
            self._waiting, self._bulk = self._waiting - 1, self._bulk - bulk
            self._metrics.queue.set(self._waiting)

    async def load(self, identity: str) -> Encoder:
        """The encoder of an identity, loaded and seen to reproduce its golden values.

        Raises:
            UnknownEncoder: none is installed.
            InvalidModel: it is damaged, or gives other values on this machine.
        """
        if identity in self._loaded:
            return self._loaded[identity]
        return await asyncio.wrap_future(self._batches.call(lambda: self._load(identity)))

    def _load(self, identity: str) -> Encoder:
        if identity not in self._loaded:
            encoder = self._catalogue.get(identity)
            encoder.check_golden()
            self._loaded[identity] = encoder
        return self._loaded[identity]

    async def encode(
        self,
        identity: str,
        data: bytes,
        deadline: RequestDeadline,
        mask: Mask | None = None,
        then: Then | None = None,
    ) -> Encoded:
        """Decode and encode one frame when its turn comes; call it within ``place``.

        Args:
            then: as :attr:`Turn.then`.

        Raises:
            DeadlineExceeded, ClientGone: before its turn came; it was not encoded.
            InvalidImage: it cannot be decoded.
            UnknownEncoder, InvalidModel: as for ``load``.
        """
        if deadline.seconds_left() <= 0:
            raise late()
        turn = Turn(identity, data, mask, deadline.at, then=then)
        self._batches.put([turn])
        result = asyncio.wrap_future(turn.result)
        gone: asyncio.Future[Any] | None = None
        try:
            await asyncio.wait({result}, timeout=min(UNWATCHED, deadline.seconds_left()))
            if not result.done():
                gone = asyncio.ensure_future(deadline.hung_up())
                waited: set[asyncio.Future[Any]] = {result, gone}
                left = max(0.0, deadline.seconds_left())
                await asyncio.wait(waited, timeout=left, return_when=asyncio.FIRST_COMPLETED)
            # A frame that the encoder has begun is finished: dropping it would save nothing.
            if not result.done() and turn.result.cancel():
                raise _gone() if gone is not None and gone.done() else late()
            encoded = await result
        finally:
            if gone is not None:
                gone.cancel()
            result.cancel()
        self._metrics.observe_stages(encoded.milliseconds)
        return encoded

    async def encode_many(
        self,
        identity: str,
        frames: Sequence[bytes],
        deadline: RequestDeadline,
        masks: Sequence[Mask | None] | None = None,
    ) -> AsyncGenerator[Outcomes]:
        """Encode the frames of a bulk request, some ahead at a time; call it within ``place``.

        They share forward passes with one another and with what others ask for, and a robot's frame goes first.
        What is given up, for whatever reason, is taken out of the queue.

        Yields:
            What became of frames, with their indices, as they get done: in order but for those that fail. An
            error is that of ``encode`` and one frame's own, or everyone's (a deadline, an encoder that is damaged).
        """
        hidden = [None] * len(frames) if masks is None else masks
        open_: dict[asyncio.Future[Encoded], tuple[int, Turn]] = {}
        begun, bulk = 0, len(frames) > 1
        gone = asyncio.ensure_future(deadline.hung_up())
        try:
            while begun < len(frames) or open_:
                following = range(begun, min(len(frames), begun + AHEAD - len(open_)))
                turns = [Turn(identity, frames[i], hidden[i], deadline.at, bulk, asks=False) for i in following]
                self._batches.put(turns)
                open_ |= {asyncio.wrap_future(turn.result): (i, turn) for i, turn in zip(following, turns, strict=True)}
                begun = following.stop
                waited: set[asyncio.Future[Any]] = {*open_, gone}
                await asyncio.wait(
                    waited, timeout=max(0.0, deadline.seconds_left()), return_when=asyncio.FIRST_COMPLETED
                )
                done = [(future, *open_.pop(future)) for future in [*open_] if future.done()]
                if not done and (begun < len(frames) or any(turn.result.cancel() for _, turn in open_.values())):
                    raise _gone() if gone.done() else late()
                if not done:  # all that is left was begun before the time was up
                    await asyncio.wait(open_)
                    continue
                for future, _, _ in done:
                    if future.exception() is None:
                        self._metrics.observe_stages(future.result().milliseconds)
                yield [(i, _outcome(future)) for future, i, _ in done]
        finally:
            gone.cancel()
            for future, (_, turn) in open_.items():
                turn.result.cancel()
                future.cancel()


def _outcome(future: asyncio.Future[Encoded]) -> Encoded | Exception:
    error = future.exception()
    if error is None:
        return future.result()
    if isinstance(error, Exception):
        return error
    raise error


def _gone() -> ClientGone:
    return ClientGone("The caller hung up before its frame was encoded.")
