"""When and where the frames of requests are searched for in a map.

What a search does is said by :func:`core.recognition.recognition.locate`; here is only who does it when:

* a frame of a small map is searched for in the thread that encoded it (:class:`SearchAhead`);
* searches of one map that come together share a thread, so that each place is read from memory once for all of them;
* a search with filters has a thread of its own.
"""

from __future__ import annotations

import asyncio
from collections import defaultdict, deque
from collections.abc import Sequence
from contextvars import Context
from dataclasses import dataclass

from anyio import to_thread

from core.method.encoder import Encoder, Encoding
from core.recognition.recognition import Answer, locate
from core.recognition.selection import Selection
from core.storage import Map
from core.threads import cores
from service.engine.microbatches import Encoded

MOST_TOGETHER = 8
"""Queries of one search: from four on the map is read no faster for each, and whoever comes next waits for all."""

CORES_A_SEARCH = 4
"""So many cores of the machine allow one more search of the same map at a time; each takes several for a large map."""


MOST_AHEAD = 4000
"""Places of a map that is searched in the encoder's thread, which takes some milliseconds."""


@dataclass(frozen=True)
class Recognized:
    """A frame that was encoded and searched for; ``located`` is None for a frame without regions."""

    encoded: Encoded
    located: Answer | None


@dataclass(frozen=True)
class SearchAhead:
    """The search for frames in a map, done in the encoder's thread; frames with equal searches share one."""

    map_: Map
    k: int

    def __call__(self, encoded: Sequence[Encoded]) -> list[list[Answer] | None]:
        """What was found for each frame; None for a frame that is left to :meth:`Searches.recognize`."""
        seen = [one for one in encoded if len(one.encoding.regions)]
        if not seen or not self.map_.snapshot().holds:  # it would have to be read from the disk
            return [None] * len(encoded)
        found = iter(locate(self.map_, seen[0].encoder, [one.encoding for one in seen], self.k))
        return [[next(found)] if len(one.encoding.regions) else None for one in encoded]


def search_ahead(map_: Map, k: int, selection: Selection | None) -> SearchAhead | None:
    """The search to do in the encoder's thread, or None where other frames might wait long for it."""
    if selection is not None or map_.count_places() > MOST_AHEAD:
        return None
    return SearchAhead(map_, k)


@dataclass(frozen=True)
class _Purpose:
    """What searches must have in common to be one; maps and encoders are themselves, not what they are called."""

    map_: Map
    encoder: Encoder
    k: int


@dataclass
class _Waiting:
    encodings: Sequence[Encoding]
    answer: asyncio.Future[list[Answer]]


class Searches:
    """Takes what has come whenever a thread is free for a map, so that one query alone never waits for company.

    Used from the event loop alone.
    """

    def __init__(self) -> None:
        self._waiting: dict[_Purpose, deque[_Waiting]] = {}
        self._running: defaultdict[_Purpose, int] = defaultdict(int)
        self._tasks: set[asyncio.Task[None]] = set()
        self._at_once = max(1, cores() // CORES_A_SEARCH)

    async def recognize(
        self, map_: Map, frames: Sequence[Encoded], k: int, selection: Selection | None = None
    ) -> list[Recognized]:
        """Search for frames that the map's encoder has encoded, unless they were searched for where they were encoded.

        Raises:
            StorageFailure: the map's files cannot be read.
        """
        seen = [frame for frame in frames if len(frame.encoding.regions)]
        if len(seen) == 1 and seen[0].followed is not None:
            located: list[Answer] = seen[0].followed
        else:
            encodings = [frame.encoding for frame in seen]
            located = await self.locate(map_, seen[0].encoder, encodings, k, selection) if seen else []
        remaining = iter(located)
        return [Recognized(frame, next(remaining) if len(frame.encoding.regions) else None) for frame in frames]

    async def locate(
        self, map_: Map, encoder: Encoder, encodings: Sequence[Encoding], k: int, selection: Selection | None = None
    ) -> list[Answer]:
        """What :func:`core.recognition.recognition.locate` gives, in a thread and together with what others ask for.

        Raises:
            StorageFailure: the map's files cannot be read.
        """
        if selection is not None:
            return await to_thread.run_sync(locate, map_, encoder, encodings, k, selection)
        loop = asyncio.get_running_loop()
        purpose = _Purpose(map_, encoder, k)
        parts = [
            _Waiting(encodings[start : start + MOST_TOGETHER], loop.create_future())
            for start in range(0, len(encodings), MOST_TOGETHER)
        ]
        self._waiting.setdefault(purpose, deque()).extend(parts)
        if self._running[purpose] < self._at_once:
            self._running[purpose] += 1
            # Not before the others whose frames left the encoder in the same moment have come as well.
            # It is nobody's search alone, so it says in the log of none that it was for it.
            loop.call_soon(self._start, purpose, context=Context())
        if len(parts) == 1:
            return await parts[0].answer
        answers = await asyncio.gather(*(part.answer for part in parts))
        return [located for answer in answers for located in answer]

    def _start(self, purpose: _Purpose) -> None:
        task = asyncio.create_task(self._run(purpose))
        self._tasks.add(task)  # the loop itself keeps no task alive
        task.add_done_callback(self._tasks.discard)

    async def _run(self, purpose: _Purpose) -> None:
        try:
            while together := self._take(purpose):
                await self._answer(purpose, together)
        finally:
            self._running[purpose] -= 1
            if not self._running[purpose]:
                del self._running[purpose]
                self._waiting.pop(purpose, None)

    def _take(self, purpose: _Purpose) -> list[_Waiting]:
        """What to search for next: an equal share for each of the threads that a map may have."""
        waiting = self._waiting.get(purpose, deque())
        most = min(MOST_TOGETHER, -(-sum(len(one.encodings) for one in waiting) // self._at_once))
        taken: list[_Waiting] = []
        count = 0
        while waiting and (not taken or count + len(waiting[0].encodings) <= most):
            one = waiting.popleft()
            if not one.answer.done():  # its request was given up
                taken.append(one)
                count += len(one.encodings)
        return taken

    async def _answer(self, purpose: _Purpose, together: Sequence[_Waiting]) -> None:
        encodings = [encoding for one in together for encoding in one.encodings]
        try:
            located = await to_thread.run_sync(locate, purpose.map_, purpose.encoder, encodings, purpose.k)
        except Exception as error:
            if len(together) > 1:  # only those fail whose fault it is
                for one in together:
                    await self._answer(purpose, [one])
            elif not together[0].answer.done():
                together[0].answer.set_exception(error)
            return
        remaining = iter(located)
        for one in together:
            answer = [next(remaining) for _ in one.encodings]
            if not one.answer.done():
                one.answer.set_result(answer)
