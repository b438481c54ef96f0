"""The usual scores of recognized frames, by place and by map, in memory: a query reads them without waiting."""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Mapping

from core.judgement.change import UsualScore
from service.queries.given_answers import MapKey

MOST_PLACES = 50_000
"""Places whose usual scores are held in memory; those that answered longest ago go first."""


class UsualScores:
    """The usual scores of recognized frames, by the counts that were written.  Thread-safe."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._maps: dict[MapKey, UsualScore] = {}
        self._places: OrderedDict[tuple[MapKey, str], UsualScore] = OrderedDict()

    def of(self, key: MapKey, place: str) -> UsualScore:
        """The usual score at a place, with that of its map as some frames of it."""
        return self._places.get((key, place), UsualScore()).within(self._maps.get(key, UsualScore()))

    def knows(self, key: MapKey) -> bool:
        """Whether the usual score of a map is known."""
        return key in self._maps

    def put(self, key: MapKey, whole: UsualScore | None, places: Mapping[str, UsualScore]) -> None:
        """Put what is usual at some places, and in their map, if that was read again."""
        with self._lock:
            if whole is not None:
                self._maps[key] = whole
            for place, usual in places.items():
                self._places[key, place] = usual
                self._places.move_to_end((key, place))
            while len(self._places) > MOST_PLACES:
                self._places.popitem(last=False)
