"""Statistics and latest answers of any number of services together.

Each service counts in memory and adds its counts to the common ones at intervals, so that no query waits.  The counts
of all are sums; counts that a service has not added yet are shown by it alone, and lost in its crash.
"""

from __future__ import annotations

import json
import threading
from collections import deque
from collections.abc import Mapping
from datetime import UTC, datetime, timedelta
from typing import Any

from psycopg import Connection
from pydantic import TypeAdapter

from core.upkeep.drift import Week
from service.engine.engine import Engine
from service.queries.given_answers import MOST, MOST_OF_MAP, GivenAnswer, MapKey, RecentAnswers
from service.queries.statistics import (
    HOURS,
    MOST_WEEKS,
    SPARE_PLACES,
    AnswerCounts,
    PlaceCount,
    QueryStatistics,
    Statistics,
    columns_of,
    hour_of,
    week_of,
)
from service.shared.database import SharedDatabase

LONGEST_SECONDS = 2.0
"""Counts and answers are added to the common ones at least so often."""

_ANSWER = TypeAdapter(GivenAnswer)


class SharedAnswers(RecentAnswers):
    """The latest answers of each map, of all services."""

    def __init__(self, database: SharedDatabase) -> None:
        super().__init__()
        self._database = database
        self._waiting: deque[tuple[MapKey, GivenAnswer]] = deque(maxlen=MOST)
        self._writing = threading.Lock()

    def add(self, key: MapKey, answer: GivenAnswer) -> None:
        self._waiting.append((key, answer))

    def of_map(self, key: MapKey) -> list[GivenAnswer]:
        """The answers of a map, the latest first.

        Raises:
            StorageFull, StorageFailure: PostgreSQL cannot be reached, or refuses.
        """
        self.flush()
        query = "SELECT answer FROM service.answers WHERE map = %s AND made = %s ORDER BY number DESC LIMIT %s"
        found = self._database.query("read the latest answers", query, (*key, MOST_OF_MAP))
        return [_ANSWER.validate_json(text) for (text,) in found]

    def flush(self) -> None:
        """Add the answers that wait; raises as :meth:`of_map`, and keeps them."""
        with self._writing:
            taken = [self._waiting.popleft() for _ in range(len(self._waiting))]
            if not taken:
                return
            columns = [[key[0] for key, _ in taken], [key[1] for key, _ in taken]]
            texts = [_ANSWER.dump_json(answer).decode() for _, answer in taken]
            keys = sorted({key for key, _ in taken})
            try:
                with self._database.text_transaction("write down answers") as connection:
                    query = (
                        "INSERT INTO service.answers (map, made, answer)"
                        " SELECT * FROM unnest(%s::text[], %s::text[], %s::text[])"
                    )
                    connection.execute(query, (*columns, texts))
                    for key in keys:
                        connection.execute(_TRIM_MAP, {"map": key[0], "made": key[1], "most": MOST_OF_MAP})
                    connection.execute(_TRIM, {"most": MOST})
            except BaseException:
                self._waiting.extendleft(reversed(taken))
                raise


_TRIM_MAP = (
    "DELETE FROM service.answers WHERE map = %(map)s AND made = %(made)s AND number <= (SELECT number FROM"
    " service.answers WHERE map = %(map)s AND made = %(made)s ORDER BY number DESC OFFSET %(most)s LIMIT 1)"
)
_TRIM = (
    "DELETE FROM service.answers WHERE number <="
    " (SELECT number FROM service.answers ORDER BY number DESC OFFSET %(most)s LIMIT 1)"
)


class SharedStatistics(QueryStatistics):
    """Counts the answers of all maps, over all services.  Thread-safe.

    Every method that reads may raise StorageFull or StorageFailure: PostgreSQL cannot be reached, or refuses.
    """

    _common: SharedDatabase
    _answers: SharedAnswers

    @classmethod
    def of_services(cls, engine: Engine, database: SharedDatabase) -> SharedStatistics:
        """The statistics of all maps."""
        made = cls.of_engine(engine)
        assert isinstance(made, cls)
        made.share(database)
        return made

    def share(self, database: SharedDatabase) -> None:
        """Say where the common counts are, before anything is counted."""
        self._seconds = min(self._seconds, LONGEST_SECONDS)
        self._common, self._answers = database, SharedAnswers(database)
        self.recent = self._answers

    def flush(self) -> None:
        super().flush()
        self._answers.flush()

    def read(self, key: MapKey) -> Statistics:
        self.flush()
        found = self._read("SELECT code, since FROM service.counted_maps WHERE id = %s AND made = %s", *key)
        if not found:
            return Statistics()
        code, since = found[0]
        places = self._read("SELECT id, best, recognized, last FROM service.place_counts WHERE map = %s", code)
        weeks = self._read("SELECT monday, counts FROM service.week_counts WHERE map = %s ORDER BY monday", code)
        counts = {place: PlaceCount(*values) for place, *values in places}
        return Statistics(datetime.fromisoformat(since), counts, tuple(week_of((at, *rest)) for at, rest in weeks))

    def of_place(self, key: MapKey, place_id: str) -> PlaceCount:
        self.flush()
        query = (
            "SELECT best, recognized, last FROM service.place_counts p JOIN service.counted_maps m ON m.code = p.map"
            " WHERE m.id = %s AND m.made = %s AND p.id = %s"
        )
        found = self._read(query, *key, place_id)
        return PlaceCount(*found[0]) if found else PlaceCount()

    def keep_calibration(self, key: MapKey, report: str, trials: str) -> None:
        now = datetime.now(UTC).isoformat()
        query = (
            "INSERT INTO service.calibrations VALUES (%s, %s, %s, %s) ON CONFLICT (map) DO UPDATE"
            " SET at = excluded.at, report = excluded.report, trials = excluded.trials"
        )
        with self._common.text_transaction("keep a calibration") as connection:
            connection.execute(query, (_code(connection, key, now), now, report, trials))

    def calibration(self, key: MapKey) -> tuple[datetime, str, str] | None:
        query = (
            "SELECT at, report, trials FROM service.calibrations c JOIN service.counted_maps m ON m.code = c.map"
            " WHERE m.id = %s AND m.made = %s"
        )
        found = self._read(query, *key)
        return (datetime.fromisoformat(found[0][0]), found[0][1], found[0][2]) if found else None

    def _stored_hours(self, oldest: int, key: MapKey | None) -> list[tuple[Any, ...]]:
        query = (
            "SELECT m.id, m.made, h.hour, h.recognized, h.ambiguous, h.unknown FROM service.hour_counts h"
            " JOIN service.counted_maps m ON m.code = h.map WHERE h.hour >= %s"
        )
        only, values = ("", ()) if key is None else (" AND m.id = %s AND m.made = %s", key)
        return self._read(query + only, oldest, *values)

    def _read(self, query: str, *values: Any) -> list[tuple[Any, ...]]:
        return self._common.query("read the statistics of queries", query, values)

    def _keep(self, counts: Mapping[MapKey, AnswerCounts]) -> None:
        sizes = self._sizes()
        with self._common.text_transaction("write down the statistics of queries") as connection:
            if sizes is not None:
                for code, *key in connection.execute("SELECT code, id, made FROM service.counted_maps").fetchall():
                    if tuple(key) not in sizes:
                        connection.execute("DELETE FROM service.counted_maps WHERE code = %s", (code,))
            for key in sorted(counts):  # in one order, so that no two services wait for one another
                if sizes is None or key in sizes:
                    self._add_counts(connection, key, counts[key], None if sizes is None else sizes[key])

    def _add_counts(self, connection: Connection[Any], key: MapKey, counted: AnswerCounts, places: int | None) -> None:
        code = _code(connection, key, counted.since)
        found = sorted(counted.places.items())
        connection.execute(
            "INSERT INTO service.place_counts AS p SELECT %s, * FROM unnest(%s::text[], %s::bigint[], %s::bigint[],"
            " %s::text[]) ON CONFLICT (map, id) DO UPDATE SET best = p.best + excluded.best,"
            " recognized = p.recognized + excluded.recognized, last = greatest(p.last, excluded.last)",
            (
                code,
                [place for place, _ in found],
                [count.best for _, count in found],
                [count.recognized for _, count in found],
                [count.last for _, count in found],
            ),
        )
        for week in counted.weeks.values():
            _add_week(connection, code, week)
        for hour, verdicts in counted.hours.items():
            connection.execute(
                "INSERT INTO service.hour_counts AS h VALUES (%s, %s, %s, %s, %s) ON CONFLICT (map, hour) DO UPDATE SET"
                " recognized = h.recognized + excluded.recognized, ambiguous = h.ambiguous + excluded.ambiguous,"
                " unknown = h.unknown + excluded.unknown",
                (code, hour, verdicts["recognized"], verdicts["ambiguous"], verdicts["unknown"]),
            )
        last = hour_of(datetime.now(UTC) - timedelta(hours=HOURS))
        connection.execute("DELETE FROM service.hour_counts WHERE map = %s AND hour < %s", (code, last))
        oldest = "SELECT monday FROM service.week_counts WHERE map = %s ORDER BY monday DESC LIMIT 1 OFFSET %s"
        query = f"DELETE FROM service.week_counts WHERE map = %s AND monday <= ({oldest})"
        connection.execute(query, (code, code, MOST_WEEKS))
        ((rows,),) = connection.execute("SELECT count(*) FROM service.place_counts WHERE map = %s", (code,)).fetchall()
        if places is not None and rows > places + SPARE_PLACES:
            there = list(self._present(key[0]))
            query = "DELETE FROM service.place_counts WHERE map = %s AND id <> ALL(%s)"
            connection.execute(query, (code, there))


def _code(connection: Connection[Any], key: MapKey, since: str) -> int:
    """The number of a map, which is locked until the transaction ends."""
    query = "INSERT INTO service.counted_maps (id, made, since) VALUES (%s, %s, %s) ON CONFLICT DO NOTHING"
    connection.execute(query, (*key, since))
    query = "SELECT code FROM service.counted_maps WHERE id = %s AND made = %s FOR UPDATE"
    ((code,),) = connection.execute(query, key).fetchall()
    return int(code)


def _add_week(connection: Connection[Any], code: int, week: Week) -> None:
    query = "SELECT counts FROM service.week_counts WHERE map = %s AND monday = %s"
    monday = week.monday.isoformat()
    for (stored,) in connection.execute(query, (code, monday)).fetchall():
        week = week_of((monday, *stored)) + week
    query = (
        "INSERT INTO service.week_counts VALUES (%s, %s, %s) ON CONFLICT (map, monday) DO UPDATE"
        " SET counts = excluded.counts"
    )
    connection.execute(query, (code, monday, json.dumps(columns_of(week)[1:])))
