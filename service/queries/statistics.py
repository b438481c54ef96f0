"""Statistics of the answers of each map, by place, by week and by hour.

Answers are counted in memory and written at intervals, so that no query waits for the ledger; a crash loses the counts
since the last writing.  Services that share a ledger add their counts to the same rows, which are the sums of all.
"""

from __future__ import annotations

import logging
import threading
from collections import Counter
from collections.abc import Callable, Collection, Mapping
from contextlib import suppress
from datetime import UTC, date, datetime, timedelta
from functools import partial

from core.errors import PlacerecError, StorageFull, UnknownMap
from core.judgement.change import UsualScore
from core.judgement.verdict import Verdict
from core.ledger import Ledger
from core.ledger.disposable import once_more_if_replaced
from core.maps import AlarmName
from core.store import Map
from core.upkeep.drift import Week
from core.upkeep.histories import Histories, PlacePeriod
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
from service.queries.counts import (
    AnswerCounts,
    HourCount,
    PassedBy,
    PlaceCount,
    Statistics,
    VerdictCounts,
    hour_of,
    monday_of,
)
from service.queries.given_answers import MapKey
from service.queries.histories.lost_robots import LostRobot, LostRobots, lost_robots_file
from service.queries.histories.run_trials import RunTrials, forget_run_trials, put_run_trials, read_run_trials
from service.queries.histories.tables import (
    AlarmState,
    add_periods,
    fold,
    put_alarm,
    read_alarms,
    read_all_alarms,
    read_histories,
    read_usual,
)
from service.queries.histories.usual_scores import UsualScores
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
        shared: whether other services use the ledger too.  It has the latest answers then, and which robots are lost,
            and is not closed here.
        robots: has which robots are lost, if no other service uses it; None: that is in memory alone.
    """

    def __init__(
        self,
        ledger: Ledger,
        seconds: float,
        sizes: Callable[[], Mapping[MapKey, int] | None],
        present: Callable[[str], set[str]],
        shared: bool = False,
        robots: Ledger | None = None,
    ) -> None:
        self._ledger, self._shared = ledger, shared
        self._seconds = min(seconds, SHARED_SECONDS) if shared else seconds
        self._sizes, self._present = sizes, present
        self._lock = threading.Lock()
        self._counts: dict[MapKey, AnswerCounts] = {}
        self._waiting = 0
        self._folded: dict[MapKey, date] = {}
        self._usual = UsualScores()
        self.on_written: Callable[[Collection[MapKey]], None] = lambda maps: None
        """Called by the thread that writes, with the maps whose counts were written since."""
        self._written: set[MapKey] = set()
        self.recent = RecentAnswers(ledger if shared else None)
        """The latest answers."""
        self.robots = LostRobots(ledger if shared else robots)
        """The robots, by what they are told, and so which of them are lost."""
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

        directory, seconds = engine.settings.data_dir, engine.settings.statistics_seconds
        if shared is not None:
            return cls(shared, seconds, sizes, present, shared=True)
        return cls(statistics_file(directory), seconds, sizes, present, robots=lost_robots_file(directory))

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
            self.robots.close()

    # Counting

    def observe(
        self,
        key: MapKey,
        verdict: Verdict,
        best: str | None,
        score: float | None,
        decision: float | None,
        period: PlacePeriod | None = None,
        passed: PassedBy | None = None,
    ) -> None:
        """Count one answer.

        Args:
            best: the id of the best match; None if there is none (a blank frame, an empty map).
            period: what is counted of the best match besides; None: nothing.
            passed: the place that a run was sure to be at; None: it was not, or there is no run.
        """
        now = datetime.now(UTC)
        counted = Week.of(monday_of(now.date()), verdict, score, decision)
        with self._lock:
            counts = self._counts.setdefault(key, AnswerCounts(since=now.isoformat()))
            counts.weeks[counted.monday] = counts.weeks.get(counted.monday, Week(counted.monday)) + counted
            counts.hours.setdefault(hour_of(now), Counter())[verdict] += 1
            if best is not None and self._has_room(counts, best, now.date()):
                recognized = int(verdict == "recognized")
                seen = PlaceCount(1, recognized, now.isoformat(timespec="seconds"))
                counts.places[best] = counts.places.get(best, PlaceCount()) + seen
                counts.add_period(best, now.date(), period or PlacePeriod(1, recognized))
            if passed is not None and self._has_room(counts, passed.place, now.date()):
                counts.add_period(passed.place, now.date(), PlacePeriod(passed=1, missed=int(passed.missed)))

    def _has_room(self, counts: AnswerCounts, place: str, day: date) -> bool:
        """Whether a place may be counted before the next writing; if not, a count is lost."""
        if (place, day) in counts.periods:
            return True
        if self._waiting >= MOST_WAITING:
            self.lost += 1
            return False
        self._waiting += 1
        return True

    def usual(self, map_: Map) -> Callable[[str], UsualScore]:
        """Returns the usual score at a place of a map, by the counts that were written; nothing is waited for."""
        return partial(self._usual.of, map_key(map_))

    def flush(self) -> None:
        """Write the counts, and the answers that others see.

        Raises:
            StorageFull, StorageFailure: the ledger refuses; the counts stay in memory.
        """
        with self._writing:
            self._write_counts()
        self.robots.flush()
        self.recent.flush()

    def _flush_if_room(self) -> None:
        """The same before something is read; what has no room on the disk waits in memory, and is left out."""
        with suppress(StorageFull):
            self.flush()

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
                self._waiting = sum(counts.waiting for counts in taken.values())
            raise
        with self._lock:
            self._written |= taken.keys()

    def _run(self) -> None:
        with suppress(
            PlacerecError
        ):  # the files are made while there is room, so that they can be read when it is gone
            self.last_day()
            self.lost_robots()
        while not self._stop.wait(self._seconds):
            try:
                self.flush()
            except Exception as error:
                log.error("the statistics of queries cannot be written: %s", error)
                continue
            with self._lock:
                written, self._written = self._written, set()
            try:
                self.on_written(written)
            except Exception as error:
                log.error("whether maps have changed cannot be said: %s", error)

    @once_more_if_replaced
    def _write(self, counts: Mapping[MapKey, AnswerCounts]) -> None:
        """Add counts to those of the ledger, all or none."""
        sizes, today = self._sizes(), datetime.now(UTC).date()
        usual, folded = {}, {}
        with self._ledger.transaction(WRITE) as connection:
            if sizes is not None:
                delete_maps_beside(connection, sizes)
            for key in sorted(counts):  # in one order, so that no two services wait for one another
                if sizes is None or key in sizes:
                    code = add_counts(connection, key, counts[key])
                    add_periods(connection, code, counts[key].periods)
                    if is_new_day := self._folded.get(key) != today:
                        fold(connection, code, today)
                        folded[key] = today
                    usual[key] = read_usual(connection, code, list(counts[key].places), is_new_day)
                if sizes is not None and key in sizes and count_places(connection, key) > sizes[key] + SPARE_PLACES:
                    delete_places_beside(connection, key, self._present(key[0]))
        self._folded |= folded
        for key, (whole, places) in usual.items():
            self._usual.put(key, whole, places)

    # Reading

    @once_more_if_replaced
    def read(self, key: MapKey) -> Statistics:
        """The statistics of a map, including the counts that are not written yet."""
        self._flush_if_room()
        with self._ledger.transaction(READ) as connection:
            return read_counts(connection, key)

    @once_more_if_replaced
    def of_place(self, key: MapKey, place_id: str) -> PlaceCount:
        """The counts of one place of a map, including those that are not written yet."""
        self._flush_if_room()
        return read_place(self._ledger, key, place_id)

    def hours(self, key: MapKey) -> list[HourCount]:
        """The answers of a map in the last ``HOURS`` hours, including those that are not written yet, in order."""
        return self.hours_of_all(key).get(key, [])

    def hours_of_all(self, key: MapKey | None = None) -> dict[MapKey, list[HourCount]]:
        """The same of every map that had any answers, or of the only map that is wanted."""
        return {
            one: [
                HourCount(hour=datetime.fromtimestamp(3600 * hour, UTC), **counts.model_dump())
                for hour, counts in hours.items()
            ]
            for one, hours in self._last_hours(key).items()
        }

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

    def lost_robots(self) -> list[LostRobot]:
        """The robots of all maps that are lost, and those that were within a day; the latest first."""
        self._flush_if_room()
        return self.robots.alarms()

    # Histories

    @once_more_if_replaced
    def histories(self, key: MapKey) -> Histories:
        """How the places of a map answered over time, including what is not written yet."""
        self._flush_if_room()
        with self._ledger.transaction(READ) as connection:
            return read_histories(connection, key)

    @once_more_if_replaced
    def put_alarm(self, key: MapKey, alarm: AlarmName, is_raised: bool, count: int) -> bool:
        """Raise or clear an alarm of a map; whether that is a change, which only one of several services sees."""
        with self._ledger.transaction("raise an alarm") as connection:
            return put_alarm(connection, key, alarm, is_raised, count, datetime.now(UTC))

    @once_more_if_replaced
    def alarms(self, key: MapKey) -> list[tuple[AlarmName, int, datetime]]:
        """The alarms of a map that are raised: their names, the counts that raised them, and since when."""
        with self._ledger.transaction(READ) as connection:
            return read_alarms(connection, key)

    @once_more_if_replaced
    def alarms_of_all(self, after: datetime) -> list[AlarmState]:
        """The alarms of all maps that are raised, and then those that were cleared after a moment; the latest first."""
        with self._ledger.transaction(READ) as connection:
            return read_all_alarms(connection, after)

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

    # Runs

    @once_more_if_replaced
    def keep_run_trials(self, key: MapKey, ran: RunTrials) -> None:
        """Store what a run says of a map's answers, beside what the runs before it said."""
        now = datetime.now(UTC).isoformat()
        with self._ledger.transaction("store the trials of a run") as connection:
            put_run_trials(connection, key, now, ran)

    @once_more_if_replaced
    def run_trials(self, key: MapKey) -> list[RunTrials]:
        """The trials of the latest runs of a map, oldest first."""
        with self._ledger.transaction(READ) as connection:
            return read_run_trials(connection, key)

    @once_more_if_replaced
    def forget_run_trials(self, key: MapKey, run: str) -> None:
        """Delete the trials of a run."""
        with self._ledger.transaction("forget the trials of a run") as connection:
            forget_run_trials(connection, key, run)
