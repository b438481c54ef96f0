"""A replica that computes nothing: it waits as long as a device would compute, and returns what it encoded once."""

from __future__ import annotations

import asyncio
from collections.abc import Sequence

from core.method.encoder import canary_frame
from service.ray_serve.replica import Replica, ReplicaSettings, ReturnedFrame, SentFrame

WAIT = "wait"
"""The file with the milliseconds of a frame, in the directory of models."""


class WaitingReplica(Replica):
    """Takes its time for one frame after the other, as one device does, and no processor time for them."""

    def __init__(self, settings: ReplicaSettings) -> None:
        super().__init__(settings)
        self._seconds = float((settings.models / WAIT).read_text()) / 1e3
        self._device = asyncio.Lock()
        (encoder,) = self._encoders.values()
        self._made = ReturnedFrame(encoder.encode(canary_frame()), None, {"forward": 1e3 * self._seconds})

    async def encode(self, frames: Sequence[SentFrame]) -> list[ReturnedFrame | Exception]:
        """The same encoding for every frame, after the time of all of them."""
        async with self._device:
            await asyncio.sleep(self._seconds * len(frames))
        return [self._made] * len(frames)
