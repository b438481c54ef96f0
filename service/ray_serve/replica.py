"""One process that encodes: it has encoders, threads and a queue of its own, as a service without Ray has."""

from __future__ import annotations

import asyncio
import os
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from core.errors import InvalidImage, PlacerecError
from core.frames.images import Limits
from core.frames.masks import Mask
from core.geometry.keypoints import Keypoints
from core.method.catalogue import EncoderCatalogue
from core.method.encoder import Encoder, Encoding
from core.networks.backbone import Device
from core.networks.xfeat import packaged_xfeat
from core.threads import share_cores
from service.engine.encoder_threads import EncoderThreads
from service.engine.encoders import QueuedFrame
from service.errors.faults import DeadlineExceeded


@dataclass(frozen=True)
class ReplicaSettings:
    """The settings of a replica.

    models: directory of encoders besides the packaged ones, at the same path on every machine; it need not exist.
    encoder: the name of the encoder that is loaded at the start; others are loaded with their first frame.
    threads: how many frames are encoded at a time.
    """

    models: Path
    encoder: str
    device: Device
    limits: Limits
    threads: int


@dataclass(frozen=True)
class SentFrame:
    """A frame on its way to a replica.

    identity: of the encoder.
    keypoints, features: outputs wanted besides descriptors.
    seconds: until its deadline, from the moment at which it was sent; clocks of two machines need not agree.
    caller: the caller whose turn it takes.
    """

    identity: str
    data: bytes
    mask: Mask | None
    seconds: float
    bulk: bool
    keypoints: bool
    features: bool
    caller: str


@dataclass(frozen=True)
class ReturnedFrame:
    """An encoded frame on its way back; ``milliseconds`` are those of :class:`service.engine.encoders.Encoded`."""

    encoding: Encoding
    keypoints: Keypoints | None
    milliseconds: dict[str, float]


class EncoderReplica:
    """The encoders of one process.

    Raises:
        UnknownEncoder, InvalidModel: the encoder to start with cannot be used here.
    """

    def __init__(self, settings: ReplicaSettings) -> None:
        self._catalogue = EncoderCatalogue(settings.models, settings.device)
        self._encoders: dict[str, Encoder] = {}
        self._loading = asyncio.Lock()
        share_cores(settings.threads)
        self._threads = EncoderThreads(settings.limits)
        self._load(self._catalogue.resolve(settings.encoder))
        packaged_xfeat()

    def pid(self) -> int:
        """The number of this process on its machine."""
        return os.getpid()

    async def encode(self, frames: Sequence[SentFrame]) -> list[ReturnedFrame | Exception]:
        """Decode and encode frames, each by its encoder: for each what became of it.

        A frame is given up at its deadline, and all that are not begun when the call is cancelled.
        """
        arrived = time.monotonic()
        queued: list[QueuedFrame | Exception] = []
        for frame in frames:
            try:
                encoder = await self._encoder(frame.identity)
            except PlacerecError as error:
                queued.append(error)
            else:
                until = arrived + frame.seconds
                queued.append(
                    QueuedFrame(
                        encoder,
                        frame.data,
                        frame.mask,
                        until,
                        frame.bulk,
                        frame.keypoints,
                        frame.features,
                        caller=frame.caller,
                    )
                )
        waiting = [frame for frame in queued if isinstance(frame, QueuedFrame)]
        self._threads.put(waiting)
        try:
            await asyncio.wait([asyncio.wrap_future(frame.result) for frame in waiting]) if waiting else None
        except asyncio.CancelledError:
            for given_up in waiting:
                given_up.result.cancel()
            raise
        return [one if isinstance(one, Exception) else _returned(one) for one in queued]

    async def _encoder(self, identity: str) -> Encoder:
        if identity not in self._encoders:
            async with self._loading:
                await asyncio.to_thread(self._load, identity)
        return self._encoders[identity]

    def _load(self, identity: str) -> None:
        if identity not in self._encoders:
            encoder = self._catalogue.get(identity)
            encoder.check_golden()
            self._encoders[identity] = encoder


def _returned(frame: QueuedFrame) -> ReturnedFrame | Exception:
    error = frame.result.exception()
    if error is None:
        encoded = frame.result.result()
        return ReturnedFrame(encoded.encoding, encoded.keypoints, encoded.milliseconds)
    if isinstance(error, InvalidImage | DeadlineExceeded):
        return error
    # Its class may not be one that the front has, or that can be sent; the log of this process has all of it.
    return RuntimeError(f"a frame could not be encoded: {type(error).__name__}: {error}")
