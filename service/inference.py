"""The encoder's turn: one frame at a time in a thread of its own, behind a bounded queue.

torch uses every core for one frame, so frames are encoded one after the other; the event loop only
waits.  Grouping waiting frames into one forward pass belongs here, in ``Inference.encode``.
"""

from __future__ import annotations

import asyncio
import time
from collections.abc import Awaitable, Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, TypeVar

import torch

from core.encoder import Encoder, Encoding
from core.encoders import EncoderCatalogue
from core.images import Limits, decode
from core.preprocessing import Pixels
from service.faults import ClientGone, DeadlineExceeded, QueueFull
from service.metrics import Metrics

Result = TypeVar("Result")


@dataclass(frozen=True)
class Encoded:
    """A frame, decoded and encoded.

    pixels: H x W x 3 uint8, BGR.
    milliseconds: of ``wait`` (in the queue), ``decode``, ``forward``, ``regions``, ``vlad``.
    """

    pixels: Pixels
    encoding: Encoding
    encoder: Encoder
    milliseconds: dict[str, float]


@dataclass(frozen=True)
class Patience:
    """How long a caller waits: until ``deadline`` (``time.monotonic``) or until ``hung_up`` returns."""

    deadline: float
    hung_up: Callable[[], Awaitable[None]]

    def left(self) -> float:
        """Seconds until the deadline; negative after it."""
        return self.deadline - time.monotonic()


class Inference:
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
        self._catalogue, self._limits, self._metrics = catalogue, limits, metrics
        self._queue_length, self._waiting = queue_length, 0
        self._loaded: dict[str, Encoder] = {}
        if threads:
            torch.set_num_threads(threads)
        self._worker = ThreadPoolExecutor(1, "encoder")

    def close(self) -> None:
        """Drop what waits and end the thread."""
        self._worker.shutdown(wait=True, cancel_futures=True)

    def check_room(self) -> None:
        """Raise QueueFull if there is no place in the queue now; cheap, for before a body is read."""
        if self._waiting >= self._queue_length:
            raise QueueFull("Too many requests wait for the encoder; send this one again in a moment.")

    @contextmanager
    def place_in_queue(self) -> Iterator[None]:
        """A place in the queue for one request, whose frames are encoded one by one within.

        Raises:
            QueueFull: none is free.
        """
        self.check_room()
        self._waiting += 1
        self._metrics.queue.set(self._waiting)
        try:
            yield
        finally:
            self._waiting -= 1
            self._metrics.queue.set(self._waiting)

    async def load(self, identity: str) -> Encoder:
        """The encoder of an identity, loaded and seen to reproduce its golden values.

        Raises:
            UnknownEncoder: none is installed.
            InvalidModel: it is damaged, or gives other values on this machine.
        """
        if identity in self._loaded:
            return self._loaded[identity]
        return await asyncio.wrap_future(self._worker.submit(self._load, identity))

    def _load(self, identity: str) -> Encoder:
        if identity not in self._loaded:
            encoder = self._catalogue.get(identity)
            encoder.check_golden()
            self._loaded[identity] = encoder
        return self._loaded[identity]

    async def encode(self, identity: str, data: bytes, patience: Patience) -> Encoded:
        """Decode and encode one frame when its turn comes; call it within ``place_in_queue``.

        Raises:
            DeadlineExceeded, ClientGone: before its turn came; it was not encoded.
            InvalidImage: it cannot be decoded.
            UnknownEncoder, InvalidModel: as for ``load``.
        """
        queued = time.perf_counter()

        def work() -> Encoded:
            return self._encode(identity, data, 1e3 * (time.perf_counter() - queued))

        encoded = await self._in_turn(work, patience)
        self._metrics.observe_stages(encoded.milliseconds)
        return encoded

    def _encode(self, identity: str, data: bytes, wait: float) -> Encoded:
        encoder = self._load(identity)
        began = time.perf_counter()
        pixels = decode(data, self._limits)
        decoded = 1e3 * (time.perf_counter() - began)
        encoding = encoder.encode(pixels)
        return Encoded(pixels, encoding, encoder, {"wait": wait, "decode": decoded, **encoding.milliseconds})

    async def _in_turn(self, work: Callable[[], Result], patience: Patience) -> Result:
        if patience.left() <= 0:
            raise DeadlineExceeded("The request's time was up before its frame was encoded.")
        job = self._worker.submit(work)
        result = asyncio.wrap_future(job)
        gone = asyncio.ensure_future(patience.hung_up())
        try:
            waited: set[asyncio.Future[Any]] = {result, gone}
            await asyncio.wait(waited, timeout=patience.left(), return_when=asyncio.FIRST_COMPLETED)
            # A frame that the encoder has begun is finished: dropping it would save nothing.
            if not result.done() and job.cancel():
                if gone.done():
                    raise ClientGone("The caller hung up before its frame was encoded.")
                raise DeadlineExceeded("The request's time was up before its frame was encoded.")
            return await result
        finally:
            gone.cancel()
            result.cancel()
