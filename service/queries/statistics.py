"""Statistics of the answers of each map, by place, by week and by hour.

Answers are counted in memory and written at intervals, so that no query waits for the ledger; a crash loses the counts
since the last writing.  Services that share a ledger add their counts to the same rows, which are the sums of all.
"""

from __future__ import annotations

import logging
import threading
from collections import Counter
from collections.abc import Callable, Mapping
from contextlib import suppress
from datetime import UTC, datetime, timedelta

from core.errors import PlacerecError, UnknownMap
from core.judgement.verdict import Verdict
from core.ledger import Ledger
from core.ledger.disposable import once_more_if_replaced
from core.maps import Map
from core.upkeep.drift import Week
from service.engine.engine import Engine
from service.queries.count_tables import (
    HOURS,
    READ,
    add_counts,
    count_places,
    delete_maps_beside,
    delete_places_beside,
    put_calibration,
    read_calibration,
    read_counts,
    read_hours,
    read_place,
    statistics_file,
)
from service.queries.counts import AnswerCounts, HourCount, PlaceCount, Statistics, VerdictCounts, hour_of, monday_of
from service.queries.given_answers import MapKey
from service.queries.recent_answers import RecentAnswers

MOST_WAITING = 50_000
"""How many places may have counts that are not written yet; while the ledger refuses, further counts are lost."""

SPARE_PLACES = 1000
"""Counts of deleted places are removed once a map has this many more counted places than places."""

SHARED_SECONDS = 2.0
"""A ledger that services share gets their counts and answers at least so often, for each shows those of all."""

WRITE = "write down the statistics of queries"

log = logging.getLogger("placerec.statistics")


def map_key(map_: Map) -> MapKey:
    """The key of a map in the statistics."""
    return map_.record.id, map_.record.created_at.isoformat()


class QueryStatistics:
    """Counts the answers of all maps.  Thread-safe.

    Every method that reads may raise StorageFull or StorageFailure: the ledger refuses, or cannot be reached.

    Args:
        ledger: has the ``TABLES``.
        seconds: the interval between two writings.
        sizes: returns the number of places of every map; the counts of other maps are deleted.  It returns None while
            this is not known.
        present: returns the ids of the places of a map.
        shared: whether other services use the ledger too.  It has the latest answers then, and is not closed here.
    """

    def __init__(
        self,
        ledger: Ledger,
        seconds: float,
        sizes: Callable[[], Mapping[MapKey, int] | None],
        present: Callable[[str], set[str]],
        shared: bool = False,
    ) -> None:
        self._ledger, self._shared = ledger, shared
        self._seconds = min(seconds, SHARED_SECONDS) if shared else seconds
        self._sizes, self._present = sizes, present
        self._lock = threading.Lock()
        self._counts: dict[MapKey, AnswerCounts] = {}
        self._waiting = 0
        self.recent = RecentAnswers(ledger if shared else None)
        """The latest answers."""
        self.lost = 0
        """How many counts were dropped because the ledger refuses."""
        self._writing = threading.Lock()  # held while counts are on their way from memory to the ledger
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="statistics", daemon=True)

    @classmethod
    def of_engine(cls, engine: Engine, shared: Ledger | None = None) -> QueryStatistics:
        """The statistics of all maps of an engine.

        Args:
            shared: the ledger of several services; None: this one has its own, in its data directory.
        """

        def sizes() -> dict[MapKey, int] | None:
            if engine.maps.quarantined():
                return None  # a map that is quarantined may come back
            found = {}
            try:
                records = engine.all_records()
            except PlacerecError:
                return None
            for record in records:
                try:
                    map_ = engine.maps.find(record.id)
                except UnknownMap:
                    continue  # the map was deleted since it was listed
                except PlacerecError:
                    return None
                found[map_key(map_)] = map_.count_places()
            return found

        def present(map_id: str) -> set[str]:
            return {place.id for place in engine.maps.get(map_id).transfer.outline()}

        ledger = statistics_file(engine.settings.data_dir) if shared is None else shared
        return cls(ledger, engine.settings.statistics_seconds, sizes, present, shared is not None)

    def start(self) -> None:
        """Begin to write the counts at intervals."""
        self._thread.start()

    def close(self) -> None:
        """Write the remaining counts and close the file."""
        self._stop.set()
        if self._thread.is_alive():
            self._thread.join()
        with suppress(Exception):
            self.flush()
        if not self._shared:
            self._ledger.close()

    # Counting

    def observe(
        self, key: MapKey, verdict: Verdict, best: str | None, score: float | None, decision: float | None
    ) -> None:
        """Count one answer.

        Args:
            best: the id of the best match; None if there is none (a blank frame, an empty map).
        """
        now = datetime.now(UTC)
        counted = Week.of(monday_of(now.date()), verdict, score, decision)
        with self._lock:
            counts = self._counts.setdefault(key, AnswerCounts(since=now.isoformat()))
            counts.weeks[counted.monday] = counts.weeks.get(counted.monday, Week(counted.monday)) + counted
            counts.hours.setdefault(hour_of(now), Counter())[verdict] += 1
            if best is None:
                return
            if best not in counts.places:
                if self._waiting >= MOST_WAITING:
                    self.lost += 1
                    return
                self._waiting += 1
            seen = PlaceCount(1, int(verdict == "recognized"), now.isoformat(timespec="seconds"))
            counts.places[best] = counts.places.get(best, PlaceCount()) + seen

    def flush(self) -> None:
        """Write the counts, and the answers that others see.

        Raises:
            StorageFull, StorageFailure: the ledger refuses; the counts stay in memory.
        """
        with self._writing:
            self._write_counts()
        self.recent.flush()

    def _write_counts(self) -> None:
        with self._lock:
            taken, self._counts, self._waiting = self._counts, {}, 0
        if not taken:
            return
        try:
            self._write(taken)
        except BaseException:
            with self._lock:  # add the counts of the meantime to those that could not be written
                for key, newer in self._counts.items():
                    taken.setdefault(key, AnswerCounts(newer.since)).add(newer)
                self._counts = taken
                self._waiting = sum(len(counts.places) for counts in taken.values())
            raise

    def _run(self) -> None:
        while not self._stop.wait(self._seconds):
            try:
                self.flush()
            except Exception as error:
                log.error("the statistics of queries cannot be written: %s", error)

    @once_more_if_replaced
    def _write(self, counts: Mapping[MapKey, AnswerCounts]) -> None:
        """Add counts to those of the ledger, all or none."""
        sizes = self._sizes()
        with self._ledger.transaction(WRITE) as connection:
            if sizes is not None:
                delete_maps_beside(connection, sizes)
            for key in sorted(counts):  # in one order, so that no two services wait for one another
                if sizes is None or key in sizes:
                    add_counts(connection, key, counts[key])
                if sizes is not None and key in sizes and count_places(connection, key) > sizes[key] + SPARE_PLACES:
                    delete_places_beside(connection, key, self._present(key[0]))

    # Reading

    @once_more_if_replaced
    def read(self, key: MapKey) -> Statistics:
        """The statistics of a map, including the counts that are not written yet."""
        self.flush()
        with self._ledger.transaction(READ) as connection:
            return read_counts(connection, key)

    @once_more_if_replaced
    def of_place(self, key: MapKey, place_id: str) -> PlaceCount:
        """The counts of one place of a map, including those that are not written yet."""
        self.flush()
        return read_place(self._ledger, key, place_id)

    def hours(self, key: MapKey) -> list[HourCount]:
        """The answers of a map in the last ``HOURS`` hours, including those that are not written yet, in order."""
        found = self._last_hours(key).get(key, {})
        return [
            HourCount(hour=datetime.fromtimestamp(3600 * hour, UTC), **counts.model_dump())
            for hour, counts in found.items()
        ]

    def last_day(self, key: MapKey | None = None) -> dict[MapKey, VerdictCounts]:
        """The answers of the last ``HOURS`` hours, of the maps that had any.

        Args:
            key: of the only map that is wanted; None: all.
        """
        found = self._last_hours(key)
        return {one: sum(hours.values(), VerdictCounts()) for one, hours in found.items()}

    @once_more_if_replaced
    def _last_hours(self, key: MapKey | None) -> dict[MapKey, dict[int, VerdictCounts]]:
        """The counts of the last hours by map and hour, in order."""
        oldest = hour_of(datetime.now(UTC) - timedelta(hours=HOURS - 1))
        with self._writing:
            found = read_hours(self._ledger, oldest, key)
            with self._lock:
                for one, waiting in self._counts.items():
                    if key in (None, one):
                        of_map = found.setdefault(one, {})
                        for hour, verdicts in waiting.hours.items():
                            of_map[hour] = of_map.get(hour, VerdictCounts()) + VerdictCounts.of(verdicts)
        return {
            one: {hour: counts for hour, counts in sorted(hours.items()) if hour >= oldest}
            for one, hours in found.items()
        }

    # Calibrations

    @once_more_if_replaced
    def keep_calibration(self, key: MapKey, report: str, trials: str) -> None:
        """Store the measurements of a map's calibration, in place of earlier ones.

        Args:
            report, trials: JSON.
        """
        now = datetime.now(UTC).isoformat()
        with self._ledger.transaction("store a calibration") as connection:
            put_calibration(connection, key, now, report, trials)

    @once_more_if_replaced
    def calibration(self, key: MapKey) -> tuple[datetime, str, str] | None:
        """When a map was last measured to be calibrated, the report and the trials; None if it was not."""
        with self._ledger.transaction(READ) as connection:
            return read_calibration(connection, key)
