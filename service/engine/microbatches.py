"""The encoder's threads: frames that wait at the same time are encoded in one forward pass, a micro-batch.

No frame waits for others to fill a batch.  A frame that arrives while nothing is being encoded is encoded at once,
alone, with all cores.  Frames that arrive meanwhile are encoded by one thread for each core; each of these takes a few
waiting frames as soon as it has finished its last batch.  So batches grow and shrink with the load, and no core waits
for another.
"""

from __future__ import annotations

import logging
import math
import threading
import time
from collections import deque
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import Future
from contextlib import suppress
from dataclasses import dataclass, field, replace
from typing import Any, Generic, TypeVar

import numpy as np
import torch

from core.errors import InvalidImage
from core.frames.containers import read_header
from core.frames.images import Limits, decode
from core.frames.masks import Mask
from core.frames.preprocessing import Pixels
from core.method.encoder import FRAMES_A_PASS, Encoder, Encoding
from core.threads import compute_alone, cores, each
from service.errors.faults import DeadlineExceeded

Result = TypeVar("Result")

MOST_FRAMES = FRAMES_A_PASS
"""The largest batch that one core encodes in one forward pass.  Larger batches are no faster per frame, and the frames
that arrive next would wait longer."""

MOST_BULK = MOST_FRAMES // 2
"""The largest batch of bulk frames alone: it is smaller, so that the next frame of a robot waits less."""

QUIET_SECONDS = 5.0
"""If no robot has sent a frame for so many seconds, batches of bulk frames have up to ``MOST_FRAMES``, too."""

MOST_PIXELS = 40_000_000
"""The most pixels that are decoded at one time, unless a single frame has more: it bounds the memory."""

BULK_SHARE = 4
"""One place in so many of a batch is reserved for bulk frames, which would otherwise wait as long as robots send."""

log = logging.getLogger("placerec.inference")


@dataclass(frozen=True)
class Encoded:
    """A frame, decoded and encoded.

    encoder: the encoder that has encoded it.
    pixels: uint8 [H, W, 3], BGR.
    milliseconds: spent in ``wait`` (in the queue), ``decode``, ``forward`` (its share of the pass), ``regions`` and
        ``vlad``.
    search_result: what the frame's ``after_encoding`` returned for it; None if it was not called, or failed.
    """

    pixels: Pixels
    encoding: Encoding
    encoder: Encoder
    milliseconds: dict[str, float]
    search_result: Any = None

    def without_pixels(self) -> Encoded:
        """A copy with 0 x 0 pixels, for frames that stay in memory for a while."""
        return replace(self, pixels=np.zeros((0, 0, 3), np.uint8))


AfterEncoding = Callable[[Sequence[Encoded]], Sequence[object]]
"""A function that is called with the frames of one batch once they are encoded, and returns a value for each."""


@dataclass(eq=False)
class QueuedFrame:
    """One frame that waits for the encoder; cancel ``result`` to withdraw it.

    identity: the identity of the encoder.
    data: the bytes of the frame's file.
    mask: the part of the frame that is ignored.
    deadline: the ``time.monotonic`` after which its encoding is not begun any more.
    bulk: whether its request has many frames; such a frame may wait longer than the single frame of a robot.
    from_robot: whether it is a query, after which the robot will probably send the next one soon.
    after_encoding: is called in the encoder's thread with all frames of the batch that have an equal
        ``after_encoding``, if no other frame would have to wait for it: a search done there needs no change of threads.
        It must be hashable and take only milliseconds.
    result: the encoded frame, or the error that kept it from being encoded.
    queued: the ``time.perf_counter`` at which the frame began to wait.
    pixels: the number of pixels by the header of the file, or 0 if that cannot be read.
    """

    identity: str
    data: bytes
    mask: Mask | None
    deadline: float
    bulk: bool = False
    from_robot: bool = True
    after_encoding: AfterEncoding | None = None
    result: Future[Encoded] = field(default_factory=Future)
    queued: float = field(default_factory=time.perf_counter)
    pixels: int = field(init=False, default=0)

    def __post_init__(self) -> None:
        with suppress(Exception):  # decoding will report it
            header = read_header(self.data)
            self.pixels = header.width * header.height


@dataclass(eq=False)
class _Task(Generic[Result]):
    """A function, such as the loading of an encoder, that runs while no frame is encoded."""

    work: Callable[[], Result]
    result: Future[Result] = field(default_factory=Future)


class MicroBatches:
    """The waiting frames and the threads that encode them: one thread that uses all cores, and one for each core.

    Args:
        load: returns the encoder of an identity; it is called in one of the threads.
        limits: the largest frame that is decoded.
        observe: is called with the number of frames of each batch.
    """

    def __init__(self, load: Callable[[str], Encoder], limits: Limits, observe: Callable[[int], None]) -> None:
        self._load, self._limits, self._observe = load, limits, observe
        self._tasks: deque[_Task[Any]] = deque()
        self._robots: deque[QueuedFrame] = deque()
        self._bulk: deque[QueuedFrame] = deque()
        self._passed_over = 0  # batches since the encoder of the first bulk frame was used
        self._last_robot_frame = -math.inf  # time.monotonic
        self._closed = False
        self._known: set[str] = set()  # identities of encoders that were loaded
        self._has_all = False  # the thread that uses all cores is busy
        self._at_work = self._pixels = 0  # single-core threads that are busy, and the pixels of their frames
        self._changed = threading.Lock()
        self._for_all, self._for_one = threading.Condition(self._changed), threading.Condition(self._changed)
        threads = torch.get_num_threads()
        self._cores = threads if threads > 1 else 0
        self._threads = [threading.Thread(target=self._run, name="encoder", daemon=True)]
        for number in range(self._cores):
            arguments = (number if threads == cores() else None,)
            one = threading.Thread(target=self._run_on_core, args=arguments, name=f"encoder-{number}", daemon=True)
            self._threads.append(one)
        for thread in self._threads:
            thread.start()

    def close(self) -> None:
        """Cancel all waiting frames and tasks, and end the threads once they have finished their batches."""
        with self._changed:
            self._closed = True
            waiting: list[QueuedFrame | _Task[Any]] = [*self._tasks, *self._robots, *self._bulk]
            for queue in (self._tasks, self._robots, self._bulk):
                queue.clear()
            self._for_all.notify_all()
            self._for_one.notify_all()
        for one in waiting:
            one.result.cancel()
        for thread in self._threads:
            thread.join()

    def put(self, frames: Iterable[QueuedFrame]) -> None:
        """Add frames to the queue; bulk frames keep their order, and so do the others."""
        with self._changed:
            for frame in frames:
                if self._closed:
                    frame.result.cancel()
                elif frame.bulk:
                    self._bulk.append(frame)
                else:
                    self._robots.append(frame)
                    self._last_robot_frame = time.monotonic() if frame.from_robot else self._last_robot_frame
            self._wake()

    def call(self, work: Callable[[], Result]) -> Future[Result]:
        """Run a function in the thread that uses all cores, before the next frame."""
        task = _Task(work)
        with self._changed:
            if self._closed:
                task.result.cancel()
            self._tasks.append(task)
            self._wake()
        return task.result

    # Which thread works next, and at what

    def _is_for_all(self) -> bool:
        """Whether the thread that uses all cores is next: for a task, for a single frame, or to load an encoder."""
        if self._has_all or self._at_work:
            return False
        count = len(self._robots) + len(self._bulk)
        return bool(self._tasks) or count == 1 or (count > 1 and (not self._cores or not self._knows_encoders()))

    def _is_for_one(self) -> bool:
        """Whether one more of the single-core threads can take frames."""
        count = len(self._robots) + len(self._bulk)
        if not count or self._has_all or self._tasks or self._at_work == self._cores:
            return False
        return (self._at_work > 0 or count > 1) and self._knows_encoders()

    def _knows_encoders(self) -> bool:
        return all(queue[0].identity in self._known for queue in (self._robots, self._bulk) if queue)

    def _wake(self) -> None:
        """Wake the thread that is next, if there is work."""
        if self._is_for_all():
            self._for_all.notify()
        elif self._is_for_one():
            self._for_one.notify()

    def _run(self) -> None:
        while (work := self._next()) is not None:
            if isinstance(work, _Task):
                _settle(work.result, work.work)
            elif work:
                self._encode(work)

    def _next(self) -> _Task[Any] | list[QueuedFrame] | None:
        """The next task or batch for all cores; waits for one; None after ``close``."""
        with self._changed:
            self._has_all = False
            while not (self._closed or self._is_for_all()):
                self._wake()
                self._for_all.wait()
            if self._closed:
                return None
            self._has_all = True
            if self._tasks:
                task = self._tasks.popleft()
                return task if task.result.set_running_or_notify_cancel() else []
            return self._take(MOST_FRAMES)

    def _run_on_core(self, number: int | None) -> None:
        compute_alone(number)
        done: list[QueuedFrame] = []
        while done := self._next_on_core(done):
            self._encode(done)

    def _next_on_core(self, done: Sequence[QueuedFrame]) -> list[QueuedFrame]:
        """The next batch for one core, an equal share of what waits for each free one; empty after ``close``."""
        with self._changed:
            if done:
                self._at_work -= 1
                self._pixels -= sum(frame.pixels for frame in done)
            while not self._closed:
                if self._is_for_one():
                    count = len(self._robots) + len(self._bulk)
                    if taken := self._take(-(-count // (self._cores - self._at_work))):
                        self._at_work += 1
                        self._pixels += sum(frame.pixels for frame in taken)
                        self._wake()
                        return taken
                if not self._is_for_one():  # frames that exceed MOST_PIXELS wait until a batch has ended
                    self._wake()
                self._for_one.wait()
            return []

    def _take(self, share: int) -> list[QueuedFrame]:
        """The next batch, of one encoder: robots' frames first, but a share of it is reserved for bulk frames."""
        first, most = self._first()
        most = min(most, share)
        kept = most // BULK_SHARE if self._robots and self._bulk else 0
        taken: list[QueuedFrame] = []
        pixels = self._pixels
        for queue, limit in ((self._robots, most - kept), (self._bulk, most)):
            passed: list[QueuedFrame] = []
            while queue and len(taken) < limit:
                frame = queue.popleft()
                if frame.identity != first.identity:
                    passed.append(frame)
                elif (taken or self._at_work) and pixels + frame.pixels > MOST_PIXELS:
                    passed.append(frame)
                    break
                elif frame.result.set_running_or_notify_cancel():
                    taken.append(frame)
                    pixels += frame.pixels
            queue.extendleft(reversed(passed))
        return taken

    def _first(self) -> tuple[QueuedFrame, int]:
        """The frame whose encoder is used next, and the largest size of its batch."""
        first = (self._robots or self._bulk)[0]
        most_bulk = MOST_BULK if time.monotonic() - self._last_robot_frame < QUIET_SECONDS else MOST_FRAMES
        if not self._bulk or self._bulk[0].identity == first.identity:
            self._passed_over = 0
            return first, MOST_FRAMES if self._robots else most_bulk
        # A share of a batch is of no use to bulk frames of another encoder: they get one whole batch in so many.
        self._passed_over += 1
        if self._passed_over < BULK_SHARE:
            return first, MOST_FRAMES
        self._passed_over = 0
        return self._bulk[0], most_bulk

    def _encode(self, batch: Sequence[QueuedFrame]) -> None:
        """Set the result, or the error, of each frame of a batch."""
        now = time.monotonic()
        for frame in batch:
            if frame.deadline <= now:
                frame.result.set_exception(deadline_exceeded())
        try:
            self._encode_in_time([frame for frame in batch if frame.deadline > now])
        except Exception as error:  # the encoder cannot be loaded, or this code has a defect
            for frame in batch:
                if not frame.result.done():
                    frame.result.set_exception(error)

    def _encode_in_time(self, batch: Sequence[QueuedFrame]) -> None:
        if not batch:
            return
        began = time.perf_counter()
        encoder = self._load(batch[0].identity)
        self._known.add(batch[0].identity)
        decoded = each(self._decode, batch, torch.get_num_threads())
        shown: list[tuple[QueuedFrame, Pixels, float]] = []
        for frame, (pixels, spent) in zip(batch, decoded, strict=True):
            if isinstance(pixels, Exception):
                frame.result.set_exception(pixels)
            else:
                shown.append((frame, pixels, spent))
        outcomes = _encode_frames(encoder, [pixels for _, pixels, _ in shown], [frame.mask for frame, _, _ in shown])
        if shown:
            self._observe(len(shown))
        made: list[tuple[QueuedFrame, Encoded]] = []
        for (frame, pixels, spent), outcome in zip(shown, outcomes, strict=True):
            if isinstance(outcome, Exception):
                frame.result.set_exception(outcome)
                continue
            times = {"wait": 1e3 * (began - frame.queued), "decode": spent, **outcome.milliseconds}
            made.append((frame, Encoded(pixels, outcome, encoder, times)))
        for frame, encoded in self._with_search_results(made):
            frame.result.set_result(encoded)

    def _with_search_results(self, made: list[tuple[QueuedFrame, Encoded]]) -> list[tuple[QueuedFrame, Encoded]]:
        """Call ``after_encoding``, unless this thread uses all cores and other frames wait for them."""
        if self._has_all and self._cores and (self._robots or self._bulk or self._tasks):
            return made
        results: dict[int, object] = {}
        for after_encoding in {frame.after_encoding for frame, _ in made if frame.after_encoding is not None}:
            group = [(frame, encoded) for frame, encoded in made if frame.after_encoding == after_encoding]
            try:
                returned = after_encoding([encoded for _, encoded in group])
                results |= {id(frame): result for (frame, _), result in zip(group, returned, strict=True)}
            except Exception:  # the search is repeated by Searches, which reports the error
                continue
        return [(frame, replace(encoded, search_result=results.get(id(frame)))) for frame, encoded in made]

    def _decode(self, frame: QueuedFrame) -> tuple[Pixels | Exception, float]:
        """The pixels of a frame, or the error that decoding raised, and the milliseconds that it took."""
        began = time.perf_counter()
        try:
            pixels: Pixels | Exception = decode(frame.data, self._limits)
        except Exception as error:
            if not isinstance(error, InvalidImage):
                log.exception("a frame could not be decoded")
            pixels = error
        return pixels, 1e3 * (time.perf_counter() - began)


def deadline_exceeded() -> DeadlineExceeded:
    """The error of a frame whose deadline passed before its encoding began."""
    return DeadlineExceeded("The deadline of the request passed before its frame was encoded.")


def _encode_frames(
    encoder: Encoder, frames: Sequence[Pixels], masks: Sequence[Mask | None]
) -> list[Encoding | Exception]:
    """Encode frames in one batch; if that fails, encode each alone, so that only the faulty frames fail."""
    if not frames:
        return []
    try:
        return [*encoder.encode_batch(frames, masks)]
    except Exception as error:
        if len(frames) == 1:
            return [error]
        log.warning("a batch of %d frames failed and is encoded one by one: %s", len(frames), error)
    return [
        outcome
        for frame, mask in zip(frames, masks, strict=True)
        for outcome in _encode_frames(encoder, [frame], [mask])
    ]


def _settle(result: Future[Result], work: Callable[[], Result]) -> None:
    try:
        result.set_result(work())
    except BaseException as error:
        result.set_exception(error)
