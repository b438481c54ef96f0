"""The encoders of a front: it sends frames to the replicas, several in one call where several wait.

A call costs milliseconds of processor time however few frames it has.  So a replica that has nothing to do gets its
share of what waits at once, and one that is at work gets a full batch ahead, or nothing: batches grow with the load,
and no frame waits for company while a replica is free.
"""

from __future__ import annotations

import asyncio
import logging
import os
import signal
import threading
import time
from collections.abc import Callable, Iterable
from concurrent.futures import Future
from contextlib import suppress
from functools import partial
from queue import SimpleQueue
from typing import Any, TypeVar

from core.frames.images import Limits, decode
from core.frames.masks import range_in
from service.engine.encoders import (
    NO_ENCODER,
    Encoded,
    QueuedFrame,
    WaitingFrames,
    deadline_exceeded,
    narrow_values,
)
from service.errors.faults import ClientGone, NotReady
from service.ray_serve.cluster import Cluster, RayUnavailable, caller
from service.ray_serve.loads import LOADS
from service.ray_serve.metrics import CallMetrics
from service.ray_serve.replica import ReturnedFrame, SentFrame
from service.settings import Settings
from service.telemetry.metrics import Metrics

Made = TypeVar("Made")

ATTEMPTS = 4
"""How often a frame is sent at most.  After its first loss it is sent alone, so that it harms no other."""

BACKOFF = 0.1
"""Seconds before a frame is sent for the second time; they double each time."""

GLANCE = 0.25
"""Seconds between two looks whether anybody still waits for the frames of a call; most have ended by then."""

LONGEST_CALL = 60.0
"""Seconds after which a call is given up, and its frames are sent elsewhere: no replica computes longer."""

UNSERVED = 5.0
"""Seconds without a replica after which robots' frames are refused; until then, one may be starting."""

WATCH = 1.0
"""Seconds between two looks at the cluster."""

AWAY = 2.0
"""Seconds between two attempts to reach a cluster."""

LOST = 10.0
"""Seconds without an answer after which a cluster counts as lost, and is left to be joined again."""

LONGEST_END = 10.0
"""Seconds that the end of the service waits for Ray."""

LONGEST_LEAVE = 60.0
"""Seconds that leaving a lost cluster may take; Ray needs some fifteen if nothing of it is there any more."""

LONGEST_START = 180.0
"""Seconds that a Ray may take to start, or a cluster to take its deployment."""

log = logging.getLogger("placerec.ray")


class RayEncoders:
    """The encoders of a Ray cluster, as :class:`service.engine.encoders.Encoders`.

    All it does is done in a thread with an event loop of its own, so the service starts, and says what it waits for,
    while Ray starts or is away.
    """

    def __init__(self, settings: Settings, limits: Limits, metrics: Metrics) -> None:
        self._settings, self._limits = settings, limits
        self._cluster = Cluster(settings, limits)
        self._ray = _RayThread()
        self._handle: Any = None
        self._waiting = WaitingFrames()
        self._sent: set[QueuedFrame] = set()  # on their way, or about to be sent again
        self._running, self._served, self._begun = 0, time.monotonic(), False
        self._state = "the encoders are being started in the Ray cluster"
        self._tasks: set[asyncio.Task[None]] = set()
        self._metrics = CallMetrics(metrics.registry)
        self._loop = asyncio.new_event_loop()
        self._stop = asyncio.Event()
        self._thread = threading.Thread(target=self._run, name="ray-encoders", daemon=True)
        self._thread.start()

    @property
    def ahead(self) -> int:
        """Frames of one bulk request that wait at a time: three full calls of each replica."""
        return 3 * self._settings.ray_batch * max(2, self._running)

    @property
    def state(self) -> str:
        """ "ok" while a replica runs, else why none does."""
        return "ok" if self._running else self._state

    def put(self, frames: Iterable[QueuedFrame]) -> None:
        """Add frames; the event loop of the encoders takes them."""
        added = list(frames)
        try:
            self._loop.call_soon_threadsafe(self._add, added)
        except RuntimeError:  # it is closed
            for frame in added:
                frame.result.cancel()

    def close(self) -> None:
        """Cancel all frames, those on their way too, and leave the cluster; blocks."""
        with suppress(RuntimeError):
            self._loop.call_soon_threadsafe(self._stop.set)
        self._thread.join()

    # Everything below runs in the thread of the loop.

    def _run(self) -> None:
        asyncio.set_event_loop(self._loop)
        try:
            self._loop.run_until_complete(self._watch())
        finally:
            for frame in [*self._waiting.clear(), *self._sent]:
                frame.result.cancel()
            self._loop.run_until_complete(self._end())
            self._loop.close()

    async def _end(self) -> None:
        for task in self._tasks:
            task.cancel()
        await asyncio.gather(*self._tasks, return_exceptions=True)
        await self._leave()

    async def _leave(self) -> None:
        """Leave the cluster; one that has died may keep its thread, but nobody waits for that."""
        await self._stop_calling()
        with suppress(Exception):
            await self._ray.ask(self._cluster.close, LONGEST_END)
            return
        self._cluster.forget()

    async def _stop_calling(self) -> None:
        handle, self._handle = self._handle, None
        if handle is not None:
            with suppress(Exception):
                await asyncio.wait_for(handle.shutdown_async(), 1.0)
        for task in asyncio.all_tasks() - self._tasks - {asyncio.current_task()}:
            task.cancel()  # Ray Serve's own, which would go on asking for what is gone

    async def _watch(self) -> None:
        """Open the cluster, then look at it until the end."""
        answered = time.monotonic()
        while not self._stop.is_set():
            pause = WATCH
            try:
                if self._handle is None:
                    await self._ray.ask(self._cluster.open, LONGEST_START)
                    self._handle = caller()
                    answered = time.monotonic()
                    log.info("joined the Ray cluster", extra={"address": self._cluster.address()})
                found = await self._ray.ask(self._cluster.state, LOST)
            except RayUnavailable as error:
                self._note(0, str(error))
                pause = AWAY
            except Exception as error:
                if time.monotonic() - answered > LOST:
                    why = f"{type(error).__name__} {error}".splitlines()[0][:500]
                    self._note(0, f"the Ray cluster does not answer: {why}")
                    await self._abandon()
            else:
                answered = time.monotonic()
                self._note(found.running, f"no encoder runs in the Ray cluster: {found.problem or 'they start'}")
            self._dispatch()
            with suppress(TimeoutError):
                await asyncio.wait_for(self._stop.wait(), pause)

    async def _abandon(self) -> None:
        """Leave a cluster that is lost; if Ray cannot even do that, end the service, which is then started again."""
        await self._stop_calling()
        leaving = _RayThread()  # the other may wait for an answer for ever
        try:
            await leaving.ask(self._cluster.abandon, LONGEST_LEAVE)
        except Exception as error:
            log.error("the lost Ray cluster cannot be left, so the service ends", extra={"error": repr(error)[:500]})
            self._cluster.forget()
            os.kill(os.getpid(), signal.SIGTERM)
            await self._stop.wait()
        self._ray.end()
        self._ray = leaving

    def _note(self, running: int, problem: str) -> None:
        """Take over what the cluster says."""
        if bool(running) != bool(self._running) or (not running and problem != self._state):
            expected = running or not self._begun
            log.log(logging.INFO if expected else logging.ERROR, "encoders run" if running else problem)
        self._begun = self._begun or bool(running)
        self._running, self._state = running, problem
        self._metrics.replicas.set(running)
        if running:
            self._served = time.monotonic()
        elif self._unserved():
            waiting = self._waiting.clear()
            self._refuse([frame for frame in waiting if not frame.bulk])
            for frame in waiting:
                if frame.bulk:  # of a job, which can wait, or of a request that ends at its deadline
                    self._waiting.add(frame)

    def _unserved(self) -> bool:
        return not self._running and time.monotonic() - self._served > UNSERVED

    def _refuse(self, frames: Iterable[QueuedFrame]) -> None:
        for frame in frames:
            text = f"No frame can be encoded now: {self.state}."
            _fail(frame, NotReady(text, {"encoder": self.state}, NO_ENCODER))

    def _add(self, frames: Iterable[QueuedFrame]) -> None:
        if self._stop.is_set():
            for frame in frames:
                frame.result.cancel()
            return
        for frame in frames:
            if self._unserved() and not frame.bulk:
                self._refuse([frame])
            else:
                self._waiting.add(frame)
        self._dispatch()

    def _dispatch(self) -> None:
        """Send what waits, as far as replicas have nothing to do or a full batch waits for those that have."""
        while self._handle is not None and self._running and len(self._waiting):
            idle = self._running - LOADS.busy
            if idle > 0:
                frames = self._take(min(self._settings.ray_batch, -(-len(self._waiting) // idle)))
            elif len(LOADS) < 2 * self._running and len(self._waiting) >= self._settings.ray_batch:
                frames = self._take(self._settings.ray_batch)
            else:
                return
            if frames:
                self._sent.update(frames)
                now = time.monotonic()
                sent = [_sent(frame, now) for frame in frames]
                LOADS.begin(sent)
                task = self._loop.create_task(self._send(frames, sent))
                self._tasks.add(task)
                task.add_done_callback(partial(self._ended, sent))

    def _ended(self, sent: list[SentFrame], task: asyncio.Task[None]) -> None:
        self._tasks.discard(task)
        LOADS.end(sent)
        self._dispatch()

    def _take(self, most: int) -> list[QueuedFrame]:
        """The next frames that are still wanted; one that was lost before is alone."""
        taken: list[QueuedFrame] = []
        while len(taken) < most and (frame := self._waiting.first()) is not None:
            if taken and (frame.attempts or taken[0].attempts):
                break
            self._waiting.remove_first()
            if frame.result.done():  # its request has ended
                continue
            if frame.deadline <= time.monotonic():
                _fail(frame, deadline_exceeded())
                continue
            self._waiting.count_turn(frame)
            taken.append(frame)
        return taken

    async def _send(self, frames: list[QueuedFrame], sent: list[SentFrame]) -> None:
        """Have frames encoded by one replica, or put them back."""
        self._metrics.frames.observe(len(frames))
        try:
            returned = await self._call(frames, sent)
        except Exception as error:
            self._metrics.lost.inc()
            log.warning("a call to a replica is lost", extra={"frames": len(frames), "error": str(error)[:500]})
            self._again(frames, error)
        else:
            for frame, made in zip(frames, returned, strict=True):
                self._finish(frame, made)

    async def _call(self, frames: list[QueuedFrame], sent: list[SentFrame]) -> list[ReturnedFrame | Exception]:
        """Frames as a replica encodes them; the call is cancelled as soon as nobody waits for any of them.

        Raises:
            TimeoutError: it takes too long.
            Others: Ray's errors when the replica, or the way to it, is gone.
        """
        until = time.monotonic() + LONGEST_CALL
        response = self._handle.remote(sent)
        call = asyncio.ensure_future(_result(response))
        try:
            while not call.done():
                await asyncio.wait({call}, timeout=GLANCE)
                if not call.done() and all(frame.result.done() for frame in frames):
                    return [ClientGone("nobody waits for it any more")] * len(frames)
                if not call.done() and time.monotonic() > until:
                    raise TimeoutError("it took too long")
            if call.cancelled():  # by Ray, when the cluster is left
                raise ConnectionError("the call was given up")
            return call.result()
        finally:
            if not call.done():
                response.cancel()
                call.cancel()

    def _finish(self, frame: QueuedFrame, made: ReturnedFrame | Exception) -> None:
        self._sent.discard(frame)
        if isinstance(made, Exception):
            _fail(frame, made)
            return
        if not frame.result.set_running_or_notify_cancel():
            return
        data, limits, mask = frame.data, self._limits, frame.mask
        computed = {name: spent for name, spent in made.milliseconds.items() if name != "wait"}
        self._waiting.settle(frame, sum(computed.values()))
        wait = max(0.0, 1e3 * (time.perf_counter() - frame.queued) - sum(computed.values()))
        frame.result.set_result(
            Encoded(
                lambda: decode(data, limits, range_in(mask)),
                made.encoding,
                frame.encoder,
                {"wait": wait, **computed},
                mask,
                made.keypoints,
                few_values=narrow_values(frame, made.encoding),
            )
        )

    def _again(self, frames: Iterable[QueuedFrame], error: Exception) -> None:
        """Send frames once more after a while, but no frame too often."""
        for frame in frames:
            frame.attempts += 1
            if frame.attempts == ATTEMPTS:
                self._sent.discard(frame)
                text = f"The frame was lost {ATTEMPTS} times with the process that encoded it: {error}"[:500]
                _fail(frame, NotReady(text, {"encoder": self.state}, NO_ENCODER))
            else:
                self._loop.call_later(BACKOFF * 2 ** (frame.attempts - 1), self._back, frame)

    def _back(self, frame: QueuedFrame) -> None:
        self._sent.discard(frame)
        self._add([frame])


class _RayThread:
    """The thread for all blocking calls of Ray, one after the other.

    It is one as long as Ray answers, since the processes of a local Ray end with the thread that has started them.
    """

    def __init__(self) -> None:
        self._work: SimpleQueue[Callable[[], None] | None] = SimpleQueue()
        threading.Thread(target=self._run, name="ray", daemon=True).start()

    def _run(self) -> None:
        while (work := self._work.get()) is not None:
            work()

    def end(self) -> None:
        """End the thread once it has done its work."""
        self._work.put(None)

    async def ask(self, work: Callable[[], Made], seconds: float) -> Made:
        """Run blocking work, which is left alone if it takes too long.

        Raises:
            TimeoutError: it does.
            Others: the exceptions of the work.
        """
        made: Future[Made] = Future()

        def run() -> None:
            try:
                result = work()
            except Exception as error:
                made.set_exception(error)
            else:
                made.set_result(result)

        self._work.put(run)
        # A shield, since the thread sets its result, wanted or not.
        return await asyncio.wait_for(asyncio.shield(asyncio.wrap_future(made)), seconds)


async def _result(response: Any) -> list[ReturnedFrame | Exception]:
    made: list[ReturnedFrame | Exception] = await response
    return made


def _sent(frame: QueuedFrame, now: float) -> SentFrame:
    return SentFrame(
        frame.encoder.identity,
        frame.data,
        frame.mask,
        frame.deadline - now,
        frame.bulk,
        frame.keypoints,
        frame.features,
        frame.caller,
    )


def _fail(frame: QueuedFrame, error: Exception) -> None:
    if frame.result.set_running_or_notify_cancel():
        frame.result.set_exception(error)
