"""One pass for the images of several threads: those that wait while a batch is computed are the next batch."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Sequence
from concurrent.futures import Future
from dataclasses import dataclass, field
from queue import SimpleQueue

import numpy as np

from core.networks.backbone import Array, Pass


@dataclass(eq=False)
class _Call:
    """The images of one caller; ``taken`` says that a thread computes them or has done so."""

    images: Array
    taken: bool = False
    result: Future[tuple[Array, ...]] = field(default_factory=Future)


class GatheredPass:
    """A network's pass that takes the images of its callers together; it is called like the network.  Thread-safe.

    It has no threads of its own and waits for nobody: a caller that finds a lane free computes those that wait, its own
    images included.  So a single caller has a batch of its own, and under load batches grow by themselves.

    Args:
        lanes: passes that may run at the same time, each by one caller.
        most: images of one batch, unless a single call has more.
    """

    def __init__(self, lanes: Sequence[Pass], most: int) -> None:
        self._most = most
        self._waiting: deque[_Call] = deque()
        self._changing = threading.Lock()
        self._lanes: SimpleQueue[Pass] = SimpleQueue()
        for lane in lanes:
            self._lanes.put(lane)

    def __call__(self, images: Array) -> tuple[Array, ...]:
        """float32 [B, H, W, 3] to one float32 [B, X, Y, K] for each output.

        Raises:
            Exception: the error that the pass raised on the batch that these images were in.
        """
        call = _Call(images)
        with self._changing:
            self._waiting.append(call)
        while not call.taken:
            lane = self._lanes.get()
            try:
                if not call.taken:  # otherwise those that wait find this lane themselves
                    _compute(lane, self._take())
            finally:
                self._lanes.put(lane)
        return call.result.result()

    def _take(self) -> list[_Call]:
        """The calls of the next batch, which have one shape but for the number of images."""
        taken: list[_Call] = []
        room = self._most
        with self._changing:
            while self._waiting and (not taken or self._fits(taken[0], room)):
                call = self._waiting.popleft()
                call.taken = True
                room -= len(call.images)
                taken.append(call)
        return taken

    def _fits(self, first: _Call, room: int) -> bool:
        images = self._waiting[0].images
        return len(images) <= room and images.shape[1:] == first.images.shape[1:]


def _compute(lane: Pass, calls: Sequence[_Call]) -> None:
    try:
        outputs = lane(np.concatenate([call.images for call in calls]))
        ends = np.cumsum([len(call.images) for call in calls])[:-1]
        parts = [np.split(output, ends) for output in outputs]
    except Exception as error:
        for call in calls:
            call.result.set_exception(error)
        return
    for call, *own in zip(calls, *parts, strict=True):
        call.result.set_result(tuple(own))
