"""The frames between the queue and the threads that encode: each waits in :class:`WaitingFrames` until one takes it,
and becomes an :class:`Encoded`.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from concurrent.futures import Future
from contextlib import suppress
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from core.frames.containers import read_header
from core.frames.masks import Mask
from core.frames.preprocessing import Pixels
from core.frames.value_ranges import ValueRange
from core.geometry.detection import ScaledFrame, keypoints_in
from core.geometry.keypoints import Keypoints
from core.method.encoder import Encoder, Encoding
from core.networks.xfeat import packaged_xfeat
from core.recognition.framings import FrameReframing
from core.recognition.question import Query, Question
from service.errors.faults import DeadlineExceeded
from service.fairness import CALLER, FairQueue

BULK_SHARE = 4
"""One frame in this many is a bulk frame while robots' frames wait, or bulk would wait as long as robots send."""

ENCODING_MILLISECONDS, MEGAPIXEL_MILLISECONDS = 20.0, 10.0
"""The expected time of a frame, and of each million of its pixels; the real time is counted when it is done."""


@dataclass(frozen=True)
class Encoded:
    """A frame, decoded and encoded.

    pixels: uint8 [H, W, 3], BGR.
    encoding: the regions of a bulk frame, which nobody explains, have no features.
    encoder: the encoder that has encoded it.
    milliseconds: spent in ``wait`` (in the queue), ``decode``, ``forward``, ``regions``, ``vlad`` and ``keypoints``.
    mask: the part of the frame that was ignored.
    keypoints: its keypoints, if they were requested.
    begun: waits for the keypoints that are still being found.
    few_values: of a frame of 16 bits without regions, its lowest and highest value, if its camera has no range.
    search_result: what the frame's ``after_encoding`` returned for it; None if it had none, or that failed.
    """

    pixels: Pixels
    encoding: Encoding
    encoder: Encoder
    milliseconds: dict[str, float]
    mask: Mask | None = None
    keypoints: Keypoints | None = None
    search_result: Any = None
    begun: Callable[[], Keypoints] | None = None
    few_values: ValueRange | None = None
    _scaled: ScaledFrame | None = None

    @property
    def scaled(self) -> ScaledFrame:
        """The frame as keypoints are found in it."""
        return self._scaled or ScaledFrame.of(self.pixels, self.mask)

    def find_keypoints(self) -> Keypoints:
        """The frame's keypoints; unless they were requested, this takes about 10 ms."""
        if self.keypoints is not None:
            return self.keypoints
        return keypoints_in(packaged_xfeat(), self.scaled) if self.begun is None else self.begun()

    def query(self, question: Question) -> Query:
        """A question about the frame, which has regions."""
        return Query(self.encoding, question, self.find_keypoints, FrameReframing(self.encoder, lambda: self.scaled))

    def without_pixels(self, keep_scaled: bool = False) -> Encoded:
        """A copy with 0 x 0 pixels, for frames that stay in memory for a while.

        Args:
            keep_scaled: retain the scaled pixels in which keypoints are found, at most 0.3 MB.
        """
        scaled = self.scaled if keep_scaled else None
        return replace(self, pixels=np.zeros((0, 0, 3), np.uint8), begun=None, _scaled=scaled)


AfterEncoding = Callable[[Encoded], object]
"""A function that is called with a frame once it is encoded."""


@dataclass(eq=False)
class QueuedFrame:
    """One frame that waits to be encoded; cancel ``result`` to withdraw it.

    data: the bytes of the frame's file.
    mask: the part of the frame that is ignored.
    deadline: the ``time.monotonic`` after which its encoding is not begun any more.
    bulk: whether its request has many frames; such a frame may wait longer than the single frame of a robot.
    keypoints: whether the frame's keypoints are wanted, too.
    after_encoding: is called in the encoder's thread: a search done there needs no change of threads.  It must take
        only milliseconds.
    result: the encoded frame, or the error that prevented its encoding.
    caller: the caller whose turn it takes.
    queued: the ``time.perf_counter`` at which the frame began to wait.
    pixels: the number of pixels by the header of the file, or 0 if that cannot be read.
    """

    encoder: Encoder
    data: bytes
    mask: Mask | None
    deadline: float
    bulk: bool = False
    keypoints: bool = False
    after_encoding: AfterEncoding | None = None
    caller: str = field(default_factory=CALLER.get)
    result: Future[Encoded] = field(default_factory=Future)
    queued: float = field(default_factory=time.perf_counter)
    pixels: int = field(init=False, default=0)

    def __post_init__(self) -> None:
        with suppress(Exception):  # decoding will report it
            header = read_header(self.data)
            self.pixels = header.width * header.height

    @property
    def expected(self) -> float:
        """Milliseconds that it is expected to keep an encoder busy."""
        return ENCODING_MILLISECONDS + MEGAPIXEL_MILLISECONDS * self.pixels / 1e6


class WaitingFrames:
    """Frames in the order of their turns.  Not thread-safe.

    Robots' frames go first, but a share is reserved for bulk frames.  Of either kind, the frame of the caller that was
    served least goes first.
    """

    def __init__(self) -> None:
        self._robots, self._bulk = FairQueue[QueuedFrame](), FairQueue[QueuedFrame]()
        self._passed_over = 0  # robots' frames that were taken while bulk frames waited

    def __len__(self) -> int:
        return len(self._robots) + len(self._bulk)

    def add(self, frame: QueuedFrame) -> None:
        """Add a frame behind those of its caller and kind."""
        self._queue_of(frame).add(frame.caller, frame)

    def first(self) -> QueuedFrame | None:
        """The frame whose turn it is; None if none waits."""
        return self._queue().first()

    def remove_first(self) -> None:
        """Remove the frame whose turn it is."""
        self._queue().pop()

    def count_turn(self, frame: QueuedFrame) -> None:
        """Note that a frame, which was removed, is being encoded."""
        self._passed_over = 0 if frame.bulk else self._passed_over + bool(self._bulk)
        self._queue_of(frame).charge(frame.caller, frame.expected)

    def settle(self, frame: QueuedFrame, milliseconds: float) -> None:
        """Note how long a frame, whose turn was counted, kept an encoder busy."""
        self._queue_of(frame).charge(frame.caller, milliseconds - frame.expected)

    def clear(self) -> list[QueuedFrame]:
        """Remove all frames, and return them."""
        return [*self._robots.clear(), *self._bulk.clear()]

    def _queue_of(self, frame: QueuedFrame) -> FairQueue[QueuedFrame]:
        return self._bulk if frame.bulk else self._robots

    def _queue(self) -> FairQueue[QueuedFrame]:
        """The queue whose turn it is."""
        bulk_next = not self._robots or (self._bulk and self._passed_over >= BULK_SHARE - 1)
        return self._bulk if bulk_next else self._robots


def deadline_exceeded() -> DeadlineExceeded:
    """The error of a frame whose deadline passed before its encoding began."""
    return DeadlineExceeded("The deadline of the request passed before its frame was encoded.")
