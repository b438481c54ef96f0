"""A replica that computes nothing: it waits as long as a device would compute, and returns what was encoded once."""

from __future__ import annotations

import asyncio
import os
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from core.method.catalogue import EncoderCatalogue
from core.method.encoder import Encoding, canary_frame
from core.method.regions import Regions
from service.ray_serve.replica import EncoderReplica, ReplicaSettings, ReturnedFrame, SentFrame

WAIT = "wait"
"""The file with the milliseconds of a frame, in the directory of models; it may change meanwhile."""

MADE = "encoding.npz"
"""The file with what is returned for each frame, beside it."""


def prepare(models: Path, encoder: str, milliseconds: float) -> None:
    """Write what waiting replicas read, so that none of them has to load an encoder."""
    models.mkdir(parents=True, exist_ok=True)
    (models / WAIT).write_text(str(milliseconds))
    made = EncoderCatalogue().get(encoder).encode(canary_frame())
    regions = vars(made.regions.without_features())
    np.savez(models / MADE, descriptor=made.descriptor, local=made.local, **regions)


class WaitingReplica(EncoderReplica):
    """Takes its time for one frame after the other, as one device does, and no processor time for them."""

    def __init__(self, settings: ReplicaSettings) -> None:
        self._models, self._device = settings.models, asyncio.Lock()
        with np.load(settings.models / MADE) as made:
            arrays = dict(made)
        descriptor, local = arrays.pop("descriptor"), arrays.pop("local")
        self._made = ReturnedFrame(Encoding(descriptor, local, Regions(**arrays), {}), None, {})

    def pid(self) -> int:
        """The number of this process on its machine."""
        return os.getpid()

    async def encode(self, frames: Sequence[SentFrame]) -> list[ReturnedFrame | Exception]:
        """The same encoding for every frame, after the time of all of them."""
        seconds = float((self._models / WAIT).read_text()) / 1e3
        async with self._device:
            await asyncio.sleep(seconds * len(frames))
        return [self._made] * len(frames)
