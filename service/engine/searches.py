"""In which thread, and together with which other queries, a query is searched for.

The search itself is :func:`core.recognition.recognition.locate`.  For speed it runs in one of three places:

* in a small map, in the thread that encoded the frame (:class:`SearchAhead`);
* else in a worker's thread, where queries of one map that arrive together share one pass over the places;
* with filters or priors, alone in a worker's thread.
"""

from __future__ import annotations

import asyncio
from collections import defaultdict, deque
from collections.abc import Sequence
from contextvars import Context
from dataclasses import dataclass

from anyio import to_thread

from core.maps import Map
from core.maps.selection import Selection
from core.method.encoder import Encoder, Encoding
from core.recognition.recognition import Answer, locate
from core.recognition.verification import Verifier, Verify
from core.threads import cores
from service.engine.encoders import Encoded

MOST_TOGETHER = 8
"""The most queries of one search: more than four save no further time, and the queries that arrive next would wait."""

CORES_A_SEARCH = 4
"""One search of a map runs at a time for each so many cores: the search of a large map uses several cores itself."""

MOST_AHEAD = 4000
"""The most places of a map that is searched in the encoder's thread; such a search takes a few milliseconds."""


@dataclass(frozen=True)
class Recognized:
    """An encoded frame and the answer of the map, which is None for a frame without regions."""

    encoded: Encoded
    answer: Answer | None


@dataclass(frozen=True)
class SearchAhead:
    """A search of a map that is done in the encoder's thread."""

    map_: Map
    k: int
    verify: Verify = "never"
    camera: str | None = None

    def __call__(self, encoded: Encoded) -> Answer | None:
        """The answer for a frame; None for a frame that is left to :meth:`Searches.recognize`."""
        if not len(encoded.encoding.regions) or not self.map_.held:  # it would have to read from the disk
            return None
        verifiers = _verifiers([encoded], self.verify, self.camera)
        (answer,) = locate(self.map_, encoded.encoder, [encoded.encoding], self.k, None, verifiers)
        return answer


def _verifiers(frames: Sequence[Encoded], verify: Verify, camera: str | None) -> list[Verifier | None]:
    """What ``locate`` needs to verify the candidates of each frame."""
    return [None if verify == "never" else Verifier(verify, frame.find_keypoints, camera) for frame in frames]


def search_ahead(
    map_: Map, k: int, selection: Selection | None, verify: Verify = "never", camera: str | None = None
) -> SearchAhead | None:
    """The search to do in the encoder's thread, or None if other frames would wait too long for it."""
    if selection is not None or not map_.held or map_.count_places() > MOST_AHEAD:
        return None
    return SearchAhead(map_, k, verify, camera)


@dataclass(frozen=True)
class _SearchKey:
    """Queries with equal keys can share a search; maps and encoders are compared by identity, not by name."""

    map_: Map
    encoder: Encoder
    k: int


@dataclass
class _Waiting:
    encodings: Sequence[Encoding]
    verifiers: Sequence[Verifier | None]
    answer: asyncio.Future[list[Answer]]


class Searches:
    """Searches maps for encoded queries; it is used only from the event loop.

    Whenever a thread is free for a map it takes the queries that wait, so a single query never waits for others.
    """

    def __init__(self) -> None:
        self._waiting: dict[_SearchKey, deque[_Waiting]] = {}
        self._running: defaultdict[_SearchKey, int] = defaultdict(int)
        self._tasks: set[asyncio.Task[None]] = set()
        self._at_once = max(1, cores() // CORES_A_SEARCH)

    async def recognize(
        self,
        map_: Map,
        frames: Sequence[Encoded],
        k: int,
        selection: Selection | None = None,
        verify: Verify = "never",
        camera: str | None = None,
    ) -> list[Recognized]:
        """Search a map for frames that its encoder has encoded; a result of ``SearchAhead`` is taken as it is.

        Args:
            k: how many matches to list.
            selection: what is known of the place; None: nothing.
            verify: when the candidates are verified; the frames have their pixels then, or are kept scaled.
            camera: the name of the camera that took the frames; None: not known.

        Raises:
            StorageFailure: the map's files cannot be read.
        """
        seen = [frame for frame in frames if len(frame.encoding.regions)]
        if len(seen) == 1 and seen[0].search_result is not None:
            answers: list[Answer] = [seen[0].search_result]
        else:
            encodings = [frame.encoding for frame in seen]
            verifiers = _verifiers(seen, verify, camera)
            answers = await self.locate(map_, seen[0].encoder, encodings, k, selection, verifiers) if seen else []
        remaining = iter(answers)
        return [Recognized(frame, next(remaining) if len(frame.encoding.regions) else None) for frame in frames]

    async def locate(
        self,
        map_: Map,
        encoder: Encoder,
        encodings: Sequence[Encoding],
        k: int,
        selection: Selection | None = None,
        verifiers: Sequence[Verifier | None] | None = None,
    ) -> list[Answer]:
        """Call :func:`core.recognition.recognition.locate` in a thread, for these and other waiting queries at once.

        Args:
            encodings: queries that have regions.
            verifiers: for each query when to verify its candidates; None: never.

        Raises:
            StorageFailure: the map's files cannot be read.
        """
        looks = verifiers or [None] * len(encodings)
        if selection is not None:
            return await to_thread.run_sync(locate, map_, encoder, encodings, k, selection, looks)
        loop = asyncio.get_running_loop()
        key = _SearchKey(map_, encoder, k)
        parts = [
            _Waiting(
                encodings[start : start + MOST_TOGETHER], looks[start : start + MOST_TOGETHER], loop.create_future()
            )
            for start in range(0, len(encodings), MOST_TOGETHER)
        ]
        self._waiting.setdefault(key, deque()).extend(parts)
        if self._running[key] < self._at_once:
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
        self._tasks.add(task)  # the loop itself keeps no task alive
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
        waiting = self._waiting.get(key, deque())
        most = min(MOST_TOGETHER, -(-sum(len(one.encodings) for one in waiting) // self._at_once))
        taken: list[_Waiting] = []
        count = 0
        while waiting and (not taken or count + len(waiting[0].encodings) <= most):
            one = waiting.popleft()
            if not one.answer.done():  # else its request was cancelled
                taken.append(one)
                count += len(one.encodings)
        return taken

    async def _answer(self, key: _SearchKey, together: Sequence[_Waiting]) -> None:
        encodings = [encoding for one in together for encoding in one.encodings]
        verifiers = [verifier for one in together for verifier in one.verifiers]
        try:
            answers = await to_thread.run_sync(locate, key.map_, key.encoder, encodings, key.k, None, verifiers)
        except Exception as error:
            if len(together) > 1:  # search for each alone, so that only the faulty ones fail
                for one in together:
                    await self._answer(key, [one])
            elif not together[0].answer.done():
                together[0].answer.set_exception(error)
            return
        remaining = iter(answers)
        for one in together:
            answer = [next(remaining) for _ in one.encodings]
            if not one.answer.done():
                one.answer.set_result(answer)
