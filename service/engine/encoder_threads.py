"""The encoder's threads, usually one for each core: each takes one waiting frame after the other.

No frame waits for others.  A frame that finds nothing else to do has all cores in its forward pass; of several frames,
each thread takes whole ones, which wait for no other thread.
"""

from __future__ import annotations

import logging
import threading
import time
from collections import deque
from collections.abc import Callable, Iterable
from concurrent.futures import Future
from contextlib import suppress
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import torch

from core.errors import InvalidImage
from core.frames.containers import read_header
from core.frames.images import Limits, decode
from core.frames.masks import Mask
from core.frames.preprocessing import Pixels
from core.geometry.detection import ScaledFrame, keypoints_in
from core.geometry.keypoints import Keypoints
from core.method.encoder import Encoder, Encoding
from core.networks.xfeat import packaged_xfeat
from core.threads import cores, keep_to, use_threads
from service.errors.faults import DeadlineExceeded

MOST_PIXELS = 40_000_000
"""The most pixels that are decoded at one time, unless a single frame has more: it bounds the memory."""

BULK_SHARE = 4
"""One frame in so many is a bulk frame while robots' frames wait, or bulk would wait as long as robots send."""

log = logging.getLogger("placerec.inference")


@dataclass(frozen=True)
class Encoded:
    """A frame, decoded and encoded.

    encoder: the encoder that has encoded it.
    pixels: uint8 [H, W, 3], BGR.
    milliseconds: spent in ``wait`` (in the queue), ``decode``, ``forward``, ``regions``, ``vlad`` and ``keypoints``.
    mask: the part of the frame that was ignored.
    keypoints: its keypoints, if they were asked for.
    search_result: what the frame's ``after_encoding`` returned for it; None if it had none, or that failed.
    """

    pixels: Pixels
    encoding: Encoding
    encoder: Encoder
    milliseconds: dict[str, float]
    mask: Mask | None = None
    keypoints: Keypoints | None = None
    search_result: Any = None
    _scaled: ScaledFrame | None = None

    @property
    def scaled(self) -> ScaledFrame:
        """The frame as keypoints are found in it."""
        return self._scaled or ScaledFrame.of(self.pixels, self.mask)

    def find_keypoints(self) -> Keypoints:
        """The frame's keypoints; unless they were asked for, this takes about 20 ms."""
        return keypoints_in(packaged_xfeat(), self.scaled) if self.keypoints is None else self.keypoints

    def without_pixels(self, keep_scaled: bool = False) -> Encoded:
        """A copy with 0 x 0 pixels, for frames that stay in memory for a while.

        Args:
            keep_scaled: keep what keypoints are found in, at most 0.7 MB.
        """
        return replace(self, pixels=np.zeros((0, 0, 3), np.uint8), _scaled=self.scaled if keep_scaled else None)


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
    result: the encoded frame, or the error that kept it from being encoded.
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
    result: Future[Encoded] = field(default_factory=Future)
    queued: float = field(default_factory=time.perf_counter)
    pixels: int = field(init=False, default=0)

    def __post_init__(self) -> None:
        with suppress(Exception):  # decoding will report it
            header = read_header(self.data)
            self.pixels = header.width * header.height


class EncoderThreads:
    """The waiting frames and the threads that encode them, as many as torch has when this is made.

    Args:
        limits: the largest frame that is decoded.
    """

    def __init__(self, limits: Limits) -> None:
        self._limits = limits
        self._robots: deque[QueuedFrame] = deque()
        self._bulk: deque[QueuedFrame] = deque()
        self._passed_over = 0  # robots' frames that were taken while bulk frames waited
        self._at_work = self._pixels = 0  # threads that are busy, and the pixels of their frames
        self._closed = False
        self._changed = threading.Condition()
        self._count = torch.get_num_threads()
        self._threads = [
            threading.Thread(target=self._run, args=(number,), name=f"encoder-{number}", daemon=True)
            for number in range(self._count)
        ]
        for thread in self._threads:
            thread.start()

    def close(self) -> None:
        """Cancel all waiting frames, and end the threads once they have finished theirs."""
        with self._changed:
            self._closed = True
            waiting = [*self._robots, *self._bulk]
            self._robots.clear()
            self._bulk.clear()
            self._changed.notify_all()
        for frame in waiting:
            frame.result.cancel()
        for thread in self._threads:
            thread.join()

    def put(self, frames: Iterable[QueuedFrame]) -> None:
        """Add frames to the queue; bulk frames keep their order, and so do the others."""
        with self._changed:
            for frame in frames:
                if frame.pixels > self._limits.max_pixels:  # its header may lie; decoding refuses it at once
                    frame.pixels = 0
                if self._closed:
                    frame.result.cancel()
                else:
                    (self._bulk if frame.bulk else self._robots).append(frame)
                    self._changed.notify()

    def _run(self, number: int) -> None:
        one_each = self._count == cores()
        threads = 0
        while (taken := self._next()) is not None:
            frame, alone = taken
            wanted = self._count if alone else 1
            if wanted != threads:  # a thread that begins others has all cores, for they inherit its own
                keep_to(number if one_each and wanted == 1 else None)
                use_threads(threads := wanted)
            self._encode(frame)
            with self._changed:
                self._at_work -= 1
                self._pixels -= frame.pixels
                if self._robots or self._bulk:  # which may have waited for these pixels
                    self._changed.notify_all()

    def _next(self) -> tuple[QueuedFrame, bool] | None:
        """The next frame, and whether it has all cores; waits for one; None after ``close``."""
        with self._changed:
            while not self._closed:
                queue = self._queue()
                if queue and (not self._at_work or self._pixels + queue[0].pixels <= MOST_PIXELS):
                    frame = queue.popleft()
                    if frame.result.set_running_or_notify_cancel():
                        self._passed_over = 0 if frame.bulk else self._passed_over + bool(self._bulk)
                        self._at_work += 1
                        self._pixels += frame.pixels
                        return frame, self._at_work == 1 and not self._robots and not self._bulk
                else:
                    self._changed.wait()
            return None

    def _queue(self) -> deque[QueuedFrame]:
        """The queue whose turn it is: robots' frames first, but a share is reserved for bulk frames."""
        bulk_next = not self._robots or (self._bulk and self._passed_over >= BULK_SHARE - 1)
        return self._bulk if bulk_next else self._robots

    def _encode(self, frame: QueuedFrame) -> None:
        """Set the result, or the error, of a frame."""
        began = time.perf_counter()
        try:
            if frame.deadline <= time.monotonic():
                raise deadline_exceeded()
            pixels = decode(frame.data, self._limits)
            decoded = time.perf_counter()
            encoding = frame.encoder.encode(pixels, frame.mask)
            encoded_at = time.perf_counter()
            wanted = frame.keypoints and len(encoding.regions) > 0
            keypoints = keypoints_in(packaged_xfeat(), ScaledFrame.of(pixels, frame.mask)) if wanted else None
        except Exception as error:
            if not isinstance(error, InvalidImage | DeadlineExceeded):
                log.exception("a frame could not be encoded")
            frame.result.set_exception(error)
            return
        times = {"wait": 1e3 * (began - frame.queued), "decode": 1e3 * (decoded - began), **encoding.milliseconds}
        if wanted:
            times["keypoints"] = 1e3 * (time.perf_counter() - encoded_at)
        encoded = Encoded(pixels, encoding, frame.encoder, times, frame.mask, keypoints)
        if frame.after_encoding is not None:
            with suppress(Exception):  # Searches repeats the search and reports the error
                encoded = replace(encoded, search_result=frame.after_encoding(encoded))
        frame.result.set_result(encoded)


def deadline_exceeded() -> DeadlineExceeded:
    """The error of a frame whose deadline passed before its encoding began."""
    return DeadlineExceeded("The deadline of the request passed before its frame was encoded.")
