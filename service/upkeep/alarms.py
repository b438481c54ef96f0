"""Alarms: trends of a map that reach the number that its settings name become events, once when they do and once after.

Whoever writes counts checks the maps that they are of, and the database says whose check has changed an alarm first, so
that of services that share one only one tells it.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Collection
from typing import get_args

from core.errors import PlacerecError, UnknownMap
from core.maps import AlarmName, AlarmSetting
from core.store import Map
from service.engine.engine import Engine
from service.events.schemas import NO_ASKER, AlarmEvent
from service.queries.given_answers import MapKey
from service.queries.statistics import QueryStatistics, map_key
from service.upkeep.trends import cleared, sentence, trends_of

SHARE = 0.01
"""Checks take at most this share of one processor: after each, a map is left alone for a while."""

MOST_NAMED = 10
"""Places that an event names."""

log = logging.getLogger("placerec.alarms")


class Alarms:
    """Checks the alarms of maps; one thread uses it.

    Args:
        clock: seconds, never going back.
    """

    def __init__(
        self, engine: Engine, statistics: QueryStatistics, clock: Callable[[], float] = time.monotonic
    ) -> None:
        self._engine, self._statistics, self._clock = engine, statistics, clock
        self._next: dict[MapKey, float] = {}

    def check(self, maps: Collection[MapKey]) -> None:
        """Check the alarms of some maps, but for those that were checked just before.

        Raises:
            StorageFull, StorageFailure: the ledger refuses.
        """
        for key in maps:
            if self._clock() < self._next.get(key, 0.0):
                continue
            try:
                map_ = self._engine.maps.find(key[0])
            except UnknownMap:
                self._next.pop(key, None)
                continue
            if map_key(map_) != key:
                continue
            began = self._clock()
            try:
                self.check_map(map_)
            except PlacerecError as error:
                log.warning("the alarms of map %s cannot be checked: %s", key[0], error)
            self._next[key] = self._clock() + (self._clock() - began) / SHARE

    def check_map(self, map_: Map) -> None:
        """Check the alarms of a map; those that its settings no longer name are cleared.

        Raises:
            MapQuarantined, StorageFull, StorageFailure, UnknownMap.
        """
        key, setting = map_key(map_), map_.record.alarms
        raised = {name for name, _, _ in self._statistics.alarms(key)}
        if setting == AlarmSetting() and not raised:
            return
        statistics = self._statistics.read(key)
        found = trends_of(map_, self._statistics.histories(key), statistics.places)
        for name in get_args(AlarmName):
            limit, places = getattr(setting, name), found.places(name)
            is_raised = limit is not None and len(places) >= limit
            if is_raised != (name in raised) and self._statistics.put_alarm(key, name, is_raised, len(places)):
                self._tell(map_, name, is_raised, limit, places)

    def _tell(self, map_: Map, name: AlarmName, is_raised: bool, limit: int | None, places: list[str]) -> None:
        record = map_.record
        said = sentence(record, name, len(places)) if is_raised else cleared(len(places))
        log.log(
            logging.WARNING if is_raised else logging.INFO,
            "alarm %s of map %s is %s: %s", name, record.id, "raised" if is_raised else "cleared", said,
            extra={"map": record.id},
        )  # fmt: skip
        event = AlarmEvent.now(
            record.id, NO_ASKER, alarm=name, raised=is_raised, count=len(places), limit=limit, sentence=said,
            places=places[:MOST_NAMED],
        )  # fmt: skip
        self._engine.events.publish(event)
