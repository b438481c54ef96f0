"""In which thread, and together with which other queries, a query is searched for.

The search itself is :func:`core.recognition.recognition.locate`.  For speed it runs in one of three places:

* in a small map, in the thread that encoded the frame (:class:`SearchAhead`);
* else in a worker's thread, where queries of one map that arrive together share one pass over the places;
* with filters or priors, alone in a worker's thread.
"""

from __future__ import annotations

import asyncio
import time
import weakref
from collections import defaultdict
from collections.abc import Sequence
from contextvars import Context
from dataclasses import dataclass, field

from core.method.encoder import Encoder
from core.recognition.question import Query, Question
from core.recognition.recognition import Answer, answer_to_blank, locate
from core.store import Map
from core.threads import cores
from service.engine.encoders import Encoded
from service.fairness import CALLER, FairQueue
from service.worker_threads import in_thread

MOST_TOGETHER = 8
"""The most queries of one search: more than four save no further time, and the queries that arrive next would wait."""

MOST_AHEAD = 4000
"""The most places of a small map, which is searched in the encoder's thread: that takes a few milliseconds.  One that
is not in memory is searched elsewhere, but each query by itself, for what follows the search takes longer."""

CORES_A_SEARCH = 4
"""One search of a larger map runs at a time for each group of this many cores, because it uses several itself."""

EXPECTED_MILLISECONDS = 10.0
"""The expected time of one query of a search; the real time is counted when it is done."""


@dataclass(frozen=True)
class Answered:
    """An encoded frame and the answer of the map."""

    frame: Encoded
    answer: Answer


@dataclass(frozen=True)
class SearchAhead:
    """A search of a map that is done in the encoder's thread."""

    map_: Map
    question: Question

    def __call__(self, frame: Encoded) -> Answer | None:
        """The answer for a frame; None for a frame that is left to :meth:`Searches.answer`."""
        if not len(frame.encoding.regions) or not self.map_.held:  # it would have to read from the disk
            return None
        (answer,) = locate(self.map_, frame.encoder, [frame.query(self.question)])
        return answer


def search_ahead(map_: Map, question: Question) -> SearchAhead | None:
    """The search to do in the encoder's thread, or None if other frames would wait too long for it."""
    if question.selection is not None or not map_.held or map_.count_places() > MOST_AHEAD:
        return None
    return SearchAhead(map_, question)


@dataclass(frozen=True)
class _SearchKey:
    """Queries with equal keys can share a search; maps and encoders are compared by identity, not by name."""

    map_: Map
    encoder: Encoder


@dataclass
class _Waiting:
    queries: Sequence[Query]
    answer: asyncio.Future[list[Answer]]
    caller: str = field(default_factory=CALLER.get)


class Searches:
    """Searches maps for encoded queries; it is used only from the event loop.

    Whenever a thread is free for a map it takes the queries that wait, so a single query never waits for others.  If
    more wait than one search takes, those of the callers that were served least go first.
    """

    def __init__(self) -> None:
        self._waiting: dict[_SearchKey, FairQueue[_Waiting]] = {}
        self._running: defaultdict[_SearchKey, int] = defaultdict(int)
        self._tasks: set[asyncio.Task[None]] = set()
        self._places: weakref.WeakKeyDictionary[Map, int] = weakref.WeakKeyDictionary()  # as the last search saw them

    def _at_once(self, map_: Map) -> int:
        """How many searches of a map may run at the same time, besides those in encoders' threads."""
        small = self._places.get(map_, MOST_AHEAD + 1) <= MOST_AHEAD
        return cores() if small else max(1, cores() // CORES_A_SEARCH)

    async def answer(self, map_: Map, frames: Sequence[Encoded], question: Question) -> list[Answered]:
        """Answer a question about frames that the map's encoder has encoded, as :class:`SearchAhead` may have done.

        Args:
            frames: they have their pixels, or scaled ones, where they may be verified.

        Raises:
            StorageFailure: the map cannot be read.
        """
        seen = [frame for frame in frames if len(frame.encoding.regions)]
        if len(seen) == 1 and seen[0].search_result is not None:
            found: list[Answer] = [seen[0].search_result]
        else:
            queries = [frame.query(question) for frame in seen]
            found = await self.locate(map_, seen[0].encoder, queries) if seen else []
        answers = iter(found)
        return [
            Answered(
                frame,
                next(answers) if len(frame.encoding.regions) else answer_to_blank(map_, frame.encoder, frame.encoding),
            )
            for frame in frames
        ]

    async def locate(self, map_: Map, encoder: Encoder, queries: Sequence[Query]) -> list[Answer]:
        """Call :func:`core.recognition.recognition.locate` in a thread, for these and other waiting queries at once.

        Args:
            queries: of one question.

        Raises:
            StorageFailure: the map cannot be read.
        """
        question = queries[0].question
        if question.selection is not None:
            return await in_thread(locate, map_, encoder, queries)
        loop = asyncio.get_running_loop()
        key = _SearchKey(map_, encoder)
        parts = [
            _Waiting(queries[start : start + MOST_TOGETHER], loop.create_future())
            for start in range(0, len(queries), MOST_TOGETHER)
        ]
        waiting = self._waiting.setdefault(key, FairQueue())
        for part in parts:
            waiting.add(part.caller, part)
        if self._running[key] < self._at_once(map_):
            self._running[key] += 1
            # Starting a little later lets frames that were encoded at the same time join the search.
            # The search serves several requests, so it must not log under the id of this one.
            loop.call_soon(self._start, key, context=Context())
        if len(parts) == 1:
            return await parts[0].answer
        answers = await asyncio.gather(*(part.answer for part in parts))
        return [answer for part in answers for answer in part]

    def _start(self, key: _SearchKey) -> None:
        task = asyncio.create_task(self._run(key))
        self._tasks.add(task)  # the loop itself holds no reference to a task
        task.add_done_callback(self._tasks.discard)

    async def _run(self, key: _SearchKey) -> None:
        try:
            while together := self._take(key):
                await self._answer(key, together)
        finally:
            self._running[key] -= 1
            if not self._running[key]:
                del self._running[key]
                self._waiting.pop(key, None)

    def _take(self, key: _SearchKey) -> list[_Waiting]:
        """The queries of the next search: an equal share for each thread that the map may use."""
        waiting = self._waiting.get(key, FairQueue[_Waiting]())
        most = min(MOST_TOGETHER, -(-sum(len(one.queries) for one in waiting) // self._at_once(key.map_)))
        taken: list[_Waiting] = []
        count = 0
        while (first := waiting.first()) is not None and (not taken or count + len(first.queries) <= most):
            one = waiting.pop()
            if not one.answer.done():  # else its request was cancelled
                taken.append(one)
                count += len(one.queries)
                waiting.charge(one.caller, EXPECTED_MILLISECONDS * len(one.queries))
        return taken

    async def _answer(self, key: _SearchKey, together: Sequence[_Waiting]) -> None:
        queries = [query for one in together for query in one.queries]
        began = time.perf_counter()
        try:
            CALLER.set(together[0].caller)  # whose turn it is
            answers = await in_thread(locate, key.map_, key.encoder, queries)
        except Exception as error:
            if len(together) > 1:  # search for each alone, so that only the faulty ones fail
                for one in together:
                    await self._answer(key, [one])
            elif not together[0].answer.done():
                together[0].answer.set_exception(error)
            return
        self._places[key.map_] = answers[0].candidates.places
        surplus = 1e3 * (time.perf_counter() - began) / len(queries) - EXPECTED_MILLISECONDS
        remaining = iter(answers)
        for one in together:
            answer = [next(remaining) for _ in one.queries]
            self._waiting[key].charge(one.caller, surplus * len(one.queries))
            if not one.answer.done():
                one.answer.set_result(answer)
