"""The encoder's threads: frames that wait together are encoded together, a few to a forward pass and a pass to a core.

They never wait for company: a frame that comes while nothing is encoded is begun at once, alone and with all cores.
Those that come meanwhile are taken by the cores, each of which takes the next few when it has done its last:
passes grow with the load and shrink with it again, and no core waits for another.
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
"""Frames of one batch, which one core encodes with one forward pass. More would gain nothing, and keep those who come
next waiting for longer."""

MOST_BULK = MOST_FRAMES // 2
"""The same where all frames are of bulk requests, so that a robot's frame comes in between soon …"""

QUIET_SECONDS = 5.0
"""… unless no robot has asked for so long."""

MOST_PIXELS = 40_000_000
"""Pixels of all frames at work, where they are more than one: it bounds the memory of what is decoded at one time."""

BULK_SHARE = 4
"""One frame in so many of a batch is kept for bulk requests, which would otherwise wait for as long as robots ask."""

log = logging.getLogger("placerec.inference")


@dataclass(frozen=True)
class Encoded:
    """A frame, decoded and encoded.

    pixels: H x W x 3 uint8, BGR.
    milliseconds: of ``wait`` (in the queue), ``decode``, ``forward`` (its share), ``regions``, ``vlad``.
    followed: what the turn's ``then`` gave for it; None where it was not called, or failed.
    """

    pixels: Pixels
    encoding: Encoding
    encoder: Encoder
    milliseconds: dict[str, float]
    followed: Any = None

    def without_pixels(self) -> Encoded:
        """The same with 0 x 0 pixels: for frames that are kept for a while."""
        return replace(self, pixels=np.zeros((0, 0, 3), np.uint8))


Then = Callable[[Sequence[Encoded]], Sequence[object]]
"""What is to be done with frames that were encoded together; gives something for each."""


@dataclass(eq=False)
class Turn:
    """One frame that waits for the encoder, with the bytes of its file; cancel ``result`` to give it up.

    deadline: ``time.monotonic`` after which it is not begun any more.
    bulk: it is one of many of its request, and may wait longer than a robot's one frame.
    asks: a robot asks by it where it is, and will most likely ask again soon.
    pixels: how many the frame has by its header, which is read where nobody waits for it; 0 where it cannot be.
    then: may be called where the frame was encoded, with all frames of the same batch whose ``then`` is equal to it: it
        spares who asks the way through two more threads.  It is to take milliseconds, and must be hashable.
    """

    identity: str
    data: bytes
    mask: Mask | None
    deadline: float
    bulk: bool = False
    asks: bool = True
    then: Then | None = None
    result: Future[Encoded] = field(default_factory=Future)
    queued: float = field(default_factory=time.perf_counter)
    pixels: int = field(init=False, default=0)

    def __post_init__(self) -> None:
        with suppress(Exception):  # of whatever kind: it will show
            header = read_header(self.data)
            self.pixels = header.width * header.height


@dataclass(eq=False)
class _Errand(Generic[Result]):
    """Something else for the encoder's thread to do, while no frame is encoded."""

    work: Callable[[], Result]
    result: Future[Result] = field(default_factory=Future)


class MicroBatches:
    """Queue and threads: one that has all cores, for a frame alone, and others of which each has a core of its own.

    Args:
        load: gives the encoder of an identity; called in a thread of them.
        limits: of a frame.
        observe: is told the number of frames of each batch.
    """

    def __init__(self, load: Callable[[str], Encoder], limits: Limits, observe: Callable[[int], None]) -> None:
        self._load, self._limits, self._observe = load, limits, observe
        self._errands: deque[_Errand[Any]] = deque()
        self._robots: deque[Turn] = deque()
        self._bulk: deque[Turn] = deque()
        self._passed_over = 0  # batches since a bulk request's encoder had its turn
        self._robot_asked = -math.inf  # time.monotonic
        self._closed = False
        self._known: set[str] = set()  # identities of encoders that were loaded
        self._has_all = False  # the thread that has all cores is at work, and no other
        self._at_work = self._pixels = 0  # threads with a core of their own, and what they are at
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
        """Drop what waits, and end the threads when they have finished what they are at."""
        with self._changed:
            self._closed = True
            waiting: list[Turn | _Errand[Any]] = [*self._errands, *self._robots, *self._bulk]
            for queue in (self._errands, self._robots, self._bulk):
                queue.clear()
            self._for_all.notify_all()
            self._for_one.notify_all()
        for one in waiting:
            one.result.cancel()
        for thread in self._threads:
            thread.join()

    def put(self, turns: Iterable[Turn]) -> None:
        """Let frames wait for their turn; those of one kind keep their order."""
        with self._changed:
            for turn in turns:
                if self._closed:
                    turn.result.cancel()
                elif turn.bulk:
                    self._bulk.append(turn)
                else:
                    self._robots.append(turn)
                    self._robot_asked = time.monotonic() if turn.asks else self._robot_asked
            self._wake()

    def call(self, work: Callable[[], Result]) -> Future[Result]:
        """Let the thread that has all cores do something else before the next frame."""
        errand = _Errand(work)
        with self._changed:
            if self._closed:
                errand.result.cancel()
            self._errands.append(errand)
            self._wake()
        return errand.result

    # Whose turn it is

    def _is_for_all(self) -> bool:
        """Whether the thread that has all cores is to do what is next: errands, a frame alone, an unknown encoder."""
        if self._has_all or self._at_work:
            return False
        count = len(self._robots) + len(self._bulk)
        return bool(self._errands) or count == 1 or (count > 1 and (not self._cores or not self._knows_encoders()))

    def _is_for_one(self) -> bool:
        """Whether one more of the others is to take frames."""
        count = len(self._robots) + len(self._bulk)
        if not count or self._has_all or self._errands or self._at_work == self._cores:
            return False
        return (self._at_work > 0 or count > 1) and self._knows_encoders()

    def _knows_encoders(self) -> bool:
        return all(queue[0].identity in self._known for queue in (self._robots, self._bulk) if queue)

    def _wake(self) -> None:
        """Wake who is to do what is next, if anyone is and sleeps."""
        if self._is_for_all():
            self._for_all.notify()
        elif self._is_for_one():
            self._for_one.notify()

    def _run(self) -> None:
        while (work := self._next()) is not None:
            if isinstance(work, _Errand):
                _settle(work.result, work.work)
            elif work:
                self._encode(work)

    def _next(self) -> _Errand[Any] | list[Turn] | None:
        """What to do now with all cores; waits for it; None at the end."""
        with self._changed:
            self._has_all = False
            while not (self._closed or self._is_for_all()):
                self._wake()
                self._for_all.wait()
            if self._closed:
                return None
            self._has_all = True
            if self._errands:
                errand = self._errands.popleft()
                return errand if errand.result.set_running_or_notify_cancel() else []
            return self._take(MOST_FRAMES)

    def _run_on_core(self, number: int | None) -> None:
        compute_alone(number)
        done: list[Turn] = []
        while done := self._next_on_core(done):
            self._encode(done)

    def _next_on_core(self, done: Sequence[Turn]) -> list[Turn]:
        """The next batch for one core, an equal share for each that is free; waits for it; empty at the end."""
        with self._changed:
            if done:
                self._at_work -= 1
                self._pixels -= sum(turn.pixels for turn in done)
            while not self._closed:
                if self._is_for_one():
                    count = len(self._robots) + len(self._bulk)
                    if taken := self._take(-(-count // (self._cores - self._at_work))):
                        self._at_work += 1
                        self._pixels += sum(turn.pixels for turn in taken)
                        self._wake()
                        return taken
                if not self._is_for_one():  # what does not fit beside what is at work waits for its end
                    self._wake()
                self._for_one.wait()
            return []

    def _take(self, share: int) -> list[Turn]:
        """The next batch: frames of one encoder, that of whoever is first; robots before bulk, which keeps a share."""
        first, most = self._first()
        most = min(most, share)
        kept = most // BULK_SHARE if self._robots and self._bulk else 0
        taken: list[Turn] = []
        pixels = self._pixels
        for queue, limit in ((self._robots, most - kept), (self._bulk, most)):
            passed: list[Turn] = []
            while queue and len(taken) < limit:
                turn = queue.popleft()
                if turn.identity != first.identity:
                    passed.append(turn)
                elif (taken or self._at_work) and pixels + turn.pixels > MOST_PIXELS:
                    passed.append(turn)
                    break
                elif turn.result.set_running_or_notify_cancel():
                    taken.append(turn)
                    pixels += turn.pixels
            queue.extendleft(reversed(passed))
        return taken

    def _first(self) -> tuple[Turn, int]:
        """Whose encoder is next, and how many frames it is to have at most."""
        first = (self._robots or self._bulk)[0]
        most_bulk = MOST_BULK if time.monotonic() - self._robot_asked < QUIET_SECONDS else MOST_FRAMES
        if not self._bulk or self._bulk[0].identity == first.identity:
            self._passed_over = 0
            return first, MOST_FRAMES if self._robots else most_bulk
        # A share of a batch is of no use to who needs another encoder: one batch in so many is theirs.
        self._passed_over += 1
        if self._passed_over < BULK_SHARE:
            return first, MOST_FRAMES
        self._passed_over = 0
        return self._bulk[0], most_bulk

    def _encode(self, batch: Sequence[Turn]) -> None:
        """Settle each turn of a batch, one way or the other."""
        now = time.monotonic()
        for turn in batch:
            if turn.deadline <= now:
                turn.result.set_exception(late())
        try:
            self._encode_in_time([turn for turn in batch if turn.deadline > now])
        except Exception as error:  # the encoder cannot be loaded, or there is a defect of ours
            for turn in batch:
                if not turn.result.done():
                    turn.result.set_exception(error)

    def _encode_in_time(self, batch: Sequence[Turn]) -> None:
        if not batch:
            return
        began = time.perf_counter()
        encoder = self._load(batch[0].identity)
        self._known.add(batch[0].identity)
        decoded = each(self._decode, batch, torch.get_num_threads())
        shown: list[tuple[Turn, Pixels, float]] = []
        for turn, (pixels, spent) in zip(batch, decoded, strict=True):
            if isinstance(pixels, Exception):
                turn.result.set_exception(pixels)
            else:
                shown.append((turn, pixels, spent))
        outcomes = _encode_frames(encoder, [pixels for _, pixels, _ in shown], [turn.mask for turn, _, _ in shown])
        if shown:
            self._observe(len(shown))
        made: list[tuple[Turn, Encoded]] = []
        for (turn, pixels, spent), outcome in zip(shown, outcomes, strict=True):
            if isinstance(outcome, Exception):
                turn.result.set_exception(outcome)
                continue
            times = {"wait": 1e3 * (began - turn.queued), "decode": spent, **outcome.milliseconds}
            made.append((turn, Encoded(pixels, outcome, encoder, times)))
        for turn, encoded in self._followed(made):
            turn.result.set_result(encoded)

    def _followed(self, made: list[tuple[Turn, Encoded]]) -> list[tuple[Turn, Encoded]]:
        """Go on with what is to come next, unless that would keep other cores from someone who waits."""
        if self._has_all and self._cores and (self._robots or self._bulk or self._errands):
            return made
        after: dict[int, object] = {}
        for then in {turn.then for turn, _ in made if turn.then is not None}:
            group = [(turn, encoded) for turn, encoded in made if turn.then == then]
            try:
                given = then([encoded for _, encoded in group])
                after |= {id(turn): what for (turn, _), what in zip(group, given, strict=True)}
            except Exception:  # it is done once more in its own place, and told there
                continue
        return [(turn, replace(encoded, followed=after.get(id(turn)))) for turn, encoded in made]

    def _decode(self, turn: Turn) -> tuple[Pixels | Exception, float]:
        """The pixels of a frame or why there are none, and milliseconds."""
        began = time.perf_counter()
        try:
            pixels: Pixels | Exception = decode(turn.data, self._limits)
        except Exception as error:
            if not isinstance(error, InvalidImage):
                log.exception("a frame could not be decoded")
            pixels = error
        return pixels, 1e3 * (time.perf_counter() - began)


def late() -> DeadlineExceeded:
    """The error of a frame whose time was up before its turn."""
    return DeadlineExceeded("The request's time was up before its frame was encoded.")


def _encode_frames(
    encoder: Encoder, frames: Sequence[Pixels], masks: Sequence[Mask | None]
) -> list[Encoding | Exception]:
    """Encode frames together; if that fails each by itself, so that only those fail whose fault it is."""
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
