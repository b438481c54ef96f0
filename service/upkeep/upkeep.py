"""Looking after maps: the kinds of jobs there are, and the counting of answers."""

from __future__ import annotations

import asyncio
from contextlib import suppress
from functools import partial
from typing import TYPE_CHECKING, Protocol

from core.errors import MapExists, MapQuarantined, PlacerecError, UnknownMap
from core.judgement.verdict import Verdict
from core.storage import Map
from service.errors.faults import TooManyMaps
from service.maps import calibration as calibrating
from service.maps import rebuilding
from service.places import bulk_enrolment
from service.upkeep import merging, pruning, reencoding
from service.upkeep.statistics import MapKey, QueryStatistics

if TYPE_CHECKING:
    from collections.abc import Sequence

    from service.engine.engine import Engine


class _Placed(Protocol):
    @property
    def id(self) -> str: ...


class _Matched(Protocol):
    @property
    def place(self) -> _Placed: ...


class Answer(Protocol):
    """What is counted of an answer to a query."""

    @property
    def verdict(self) -> Verdict: ...
    @property
    def score(self) -> float | None: ...
    @property
    def decision(self) -> float | None: ...
    @property
    def matches(self) -> Sequence[_Matched]: ...


class Upkeep:
    """What the service does for its maps besides answering."""

    def __init__(self, engine: Engine) -> None:
        self._engine = engine
        settings = engine.settings
        self.statistics = QueryStatistics(
            settings.data_dir, settings.statistics_seconds, self._sizes, self._places_present
        )
        self.examining = asyncio.Lock()
        """Held while a map is examined."""
        engine.jobs.register(reencoding.KIND, partial(reencoding.reencode, engine))
        engine.jobs.register(pruning.KIND, partial(pruning.prune, engine))
        engine.jobs.register(merging.KIND, partial(merging.merge, engine))
        engine.jobs.register(rebuilding.REBUILD, partial(rebuilding.rebuild, engine))
        engine.jobs.register(rebuilding.VERIFY, partial(rebuilding.verify, engine))
        engine.jobs.register(calibrating.KIND, partial(calibrating.calibrate, engine))
        engine.jobs.register(
            bulk_enrolment.KIND, partial(bulk_enrolment.enrol_staged, engine), partial(bulk_enrolment.discard, engine)
        )

    def start(self) -> None:
        """Clear away what no job will finish; call it before the jobs start."""
        open_ = [job.arguments for job in self._engine.jobs.all() if not job.ended]
        unfinished = {arguments.get("to") for arguments in open_}
        self._engine.staging.clean({arguments["form"] for arguments in open_ if "form" in arguments})
        for map_id in self._engine.atlas.unlisted():
            if map_id not in unfinished:
                with suppress(PlacerecError):  # at another start
                    self._engine.atlas.abandon(map_id)
        self.statistics.start()

    def check_room(self) -> None:
        """See that there is room for one more map; those that are damaged or being made count as well.

        Raises:
            TooManyMaps: there is none.
        """
        engine, most = self._engine, self._engine.settings.max_maps
        count = len(engine.all_records()) + len(engine.atlas.quarantined()) + len(engine.atlas.unlisted())
        if count >= most:
            raise TooManyMaps(f"There are {count} maps of at most {most}; delete one that is not needed.")

    def check_free(self, map_id: str) -> None:
        """See that a map of this id can be made.

        Raises:
            MapExists: there is one, or a job is to make one.
            TooManyMaps: there are as many as there may be.
        """
        self.check_room()
        engine = self._engine
        pending = {job.arguments.get("to") for job in engine.jobs.all() if not job.ended}
        if map_id in pending or map_id in engine.atlas.unlisted():
            raise MapExists(f"A map {map_id!r} is being made.")
        try:
            engine.atlas.find(map_id)
        except UnknownMap:
            return
        except MapQuarantined:
            pass
        raise MapExists(f"There is a map {map_id!r} already.")

    def close(self) -> None:
        """Write down what was counted."""
        self.statistics.close()

    def observe(self, map_id: str, answer: Answer) -> None:
        """Count an answer, which takes some tens of microseconds and fails nobody's query."""
        with suppress(PlacerecError):  # the map was deleted in between
            key = key_of(self._engine.atlas.find(map_id))
            best = answer.matches[0].place.id if answer.matches else None
            self.statistics.observe(key, answer.verdict, best, answer.score, answer.decision)

    def _sizes(self) -> dict[MapKey, int] | None:
        """Places by map; None while one is out of service, for it may come back."""
        if self._engine.atlas.quarantined():
            return None
        sizes = {}
        for record in self._engine.all_records():
            try:
                map_ = self._engine.atlas.find(record.id)
            except UnknownMap:
                continue  # deleted since it was listed
            except PlacerecError:
                return None
            sizes[key_of(map_)] = map_.count_places()
        return sizes

    def _places_present(self, map_id: str) -> set[str]:
        return {place.id for place in self._engine.atlas.get(map_id).transfer.outline()}


def key_of(map_: Map) -> MapKey:
    """By what the statistics know a map."""
    return map_.record.id, map_.record.created_at.isoformat()
