"""The encoder's threads, usually one for each core: each takes one waiting frame after the other.

No frame waits for others.  A frame that finds nothing else to do has all cores in its forward pass; of several frames,
each thread takes whole ones, which wait for no other thread.
"""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Iterable
from contextlib import suppress
from dataclasses import replace

from core.errors import InvalidImage
from core.frames.images import Limits, decode
from core.frames.masks import Mask, range_in
from core.frames.preprocessing import Pixels
from core.frames.value_ranges import few_values
from core.geometry.detection import ScaledFrame, keypoints_in
from core.geometry.keypoints import Keypoints
from core.networks.xfeat import packaged_xfeat
from core.threads import allowed_threads, begun, cores, keep_to, processors, use_threads
from service.engine.encoders import Encoded, QueuedFrame, WaitingFrames, deadline_exceeded
from service.errors.faults import DeadlineExceeded

MOST_PIXELS = 40_000_000
"""The most pixels that are decoded at one time, unless a single frame has more: it bounds the memory."""

FEW_PIXELS = 2_000_000
"""Frames of so many pixels are not counted among those, so that they need not wait for the end of a large one."""

AHEAD = 8 * max(2, cores())
"""Frames of one bulk request that wait at a time: enough that the threads never run out of them."""

log = logging.getLogger("placerec.inference")


class EncoderThreads:
    """The waiting frames and the threads that encode them, as many as may compute when this is made.

    Args:
        limits: the largest frame that is decoded.
    """

    def __init__(self, limits: Limits) -> None:
        self._limits = limits
        self._waiting = WaitingFrames()
        self._at_work = self._pixels = 0  # threads that are busy, and the pixels of their frames
        self._closed = False
        self._changed = threading.Condition()
        self._count = allowed_threads()
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
            waiting = self._waiting.clear()
            self._changed.notify_all()
        for frame in waiting:
            frame.result.cancel()
        for thread in self._threads:
            thread.join()

    def put(self, frames: Iterable[QueuedFrame]) -> None:
        """Add frames to the queue; those of one caller and kind stay in their order."""
        with self._changed:
            for frame in frames:
                if frame.pixels > self._limits.max_pixels:  # its header may lie; decoding refuses it at once
                    frame.pixels = 0
                if self._closed:
                    frame.result.cancel()
                else:
                    self._waiting.add(frame)
                    self._changed.notify()

    def _run(self, number: int) -> None:
        one_each = self._count == processors()
        threads = 0
        while (taken := self._next()) is not None:
            frame, alone = taken
            wanted = self._count if alone else 1
            if wanted != threads:  # a thread that begins others has all cores, for they inherit its own
                keep_to(number if one_each and wanted == 1 else None)
                use_threads(threads := wanted)
            began = time.perf_counter()
            self._encode(frame)
            with self._changed:
                self._waiting.settle(frame, 1e3 * (time.perf_counter() - began))
                self._at_work -= 1
                self._pixels -= _counted(frame)
                if self._waiting:  # which may have waited for these pixels
                    self._changed.notify_all()

    def _next(self) -> tuple[QueuedFrame, bool] | None:
        """The next frame, and whether it has all cores; waits for one; None after ``close``."""
        with self._changed:
            while not self._closed:
                frame = self._waiting.first()
                if frame is not None and self._has_room_for(frame):
                    self._waiting.remove_first()
                    if frame.result.set_running_or_notify_cancel():
                        self._waiting.count_turn(frame)
                        self._at_work += 1
                        self._pixels += _counted(frame)
                        return frame, self._at_work == 1 and not self._waiting
                else:
                    self._changed.wait()
            return None

    def _has_room_for(self, frame: QueuedFrame) -> bool:
        more = _counted(frame)
        return not more or not self._at_work or self._pixels + more <= MOST_PIXELS

    def _encode(self, frame: QueuedFrame) -> None:
        """Set the result, or the error, of a frame."""
        began = time.perf_counter()
        try:
            if frame.deadline <= time.monotonic():
                raise deadline_exceeded()
            pixels = decode(frame.data, self._limits, range_in(frame.mask))
            times = {"wait": 1e3 * (began - frame.queued), "decode": 1e3 * (time.perf_counter() - began)}
            spent: dict[str, float] = {}  # by another thread, which may end after a frame without regions is done
            find = begun(lambda: _keypoints(pixels, frame.mask, spent)) if frame.keypoints else None
            encoding = frame.encoder.encode(pixels, frame.mask)
            if frame.bulk:
                encoding = replace(encoding, regions=encoding.regions.without_features())
            if not len(encoding.regions):
                find = None
            times |= encoding.milliseconds
            seen = len(encoding.regions) or range_in(frame.mask) is not None
            few = None if seen else few_values(frame.data)
            encoded = Encoded(pixels, encoding, frame.encoder, times, frame.mask, begun=find, few_values=few)
            if frame.after_encoding is not None:
                with suppress(Exception):  # Searches repeats the search and reports the error
                    encoded = replace(encoded, search_result=frame.after_encoding(encoded))
            if find is not None:
                encoded = replace(encoded, keypoints=find(), milliseconds=times | spent)
        except Exception as error:
            if not isinstance(error, InvalidImage | DeadlineExceeded):
                log.exception("a frame could not be encoded")
            frame.result.set_exception(error)
            return
        frame.result.set_result(encoded)


def _keypoints(pixels: Pixels, mask: Mask | None, times: dict[str, float]) -> Keypoints:
    """The keypoints of a frame; how long it took is noted among its times."""
    began = time.perf_counter()
    found = keypoints_in(packaged_xfeat(), ScaledFrame.of(pixels, mask))
    times["keypoints"] = 1e3 * (time.perf_counter() - began)
    return found


def _counted(frame: QueuedFrame) -> int:
    """The pixels of a frame that count among those that are decoded at one time."""
    return frame.pixels if frame.pixels > FEW_PIXELS else 0
