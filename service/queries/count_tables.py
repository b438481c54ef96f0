"""The tables of counted answers: how counts are added to those of a ledger, and read.

The tables are bounded: they have one row for each place of a map, and for each of some weeks and hours; of the history
of a place as many as :mod:`service.queries.histories.tables` says.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Collection, Mapping
from dataclasses import fields
from datetime import UTC, date, datetime, timedelta
from pathlib import Path
from typing import Any, Final, get_args

from sqlalchemy import Column, ForeignKey, MetaData, Table, UniqueConstraint, bindparam, delete, func, select
from sqlalchemy.schema import CreateTable
from sqlalchemy.sql.elements import ClauseElement, ColumnElement

from core.disk.sqlite_file import DURABLE
from core.judgement.verdict import Verdict
from core.ledger import Ledger, LedgerConnection, Statement, Tables
from core.ledger.disposable import DisposableLedger
from core.ledger.rows import given_rows
from core.ledger.sqlite import file_of
from core.ledger.statements import DIALECTS, DialectName, Insert, among, greatest, integer, real, text
from core.upkeep.drift import SCORE_BINS, Week
from core.upkeep.histories import PlacePeriod
from service.queries.counts import AnswerCounts, PlaceCount, Statistics, VerdictCounts, hour_of
from service.queries.given_answers import MapKey

FILE = "statistics.sqlite"

MOST_WEEKS = 260
"""How many weeks of a map are stored."""

HOURS = 24
"""The hours of the last day, which are counted one by one."""

READ = "read the statistics of queries"

# Tables

_METADATA = MetaData()
_FORM: Final[Mapping[str, Any]] = {"sqlite_strict": True, "sqlite_with_rowid": False}


def _map() -> Column[int]:
    return Column("map", integer(), ForeignKey("counted_maps.code", ondelete="CASCADE"), primary_key=True)


def _numbers(*names: str) -> list[Column[int]]:
    return [Column(name, integer(), nullable=False) for name in names]


def _texts(*names: str) -> list[Column[str]]:
    return [Column(name, text(), nullable=False) for name in names]


_VERDICTS: Final = get_args(Verdict)
_SUMS = "score", "score_squares", "decision", "decision_squares"
_BINS = tuple(f"bin{number}" for number in range(SCORE_BINS))

CODE = Column("code", integer(), primary_key=True, autoincrement=True)
MAPS = Table(
    "counted_maps", _METADATA, CODE, *_texts("id", "made", "since"), UniqueConstraint("id", "made"), sqlite_strict=True
)
_PLACES = Table(
    "place_counts", _METADATA, _map(), Column("id", text(), primary_key=True),
    *_numbers("best", "recognized"), *_texts("last"), **_FORM,
)  # fmt: skip
_WEEKS = Table(
    "week_counts", _METADATA, _map(), Column("monday", text(), primary_key=True), *_numbers(*_VERDICTS, "blank"),
    *(Column(name, real(), nullable=False) for name in _SUMS), *_numbers(*_BINS), **_FORM,
)  # fmt: skip
_HOURS = Table(
    "hour_counts", _METADATA, _map(), Column("hour", integer(), primary_key=True), *_numbers(*_VERDICTS), **_FORM
)
_CALIBRATIONS = Table("calibrations", _METADATA, _map(), *_texts("at", "report", "trials"), **_FORM)

# How each place answered in periods of ``span`` days from ``began`` on (:mod:`service.queries.histories.tables`).
HISTORY = Table(
    "place_history", _METADATA, _map(), Column("id", text(), primary_key=True),
    *(Column(name, integer(), primary_key=True) for name in ("span", "began")),
    *(Column(one.name, real() if one.type == "float" else integer(), nullable=False) for one in fields(PlacePeriod)),
    **_FORM,
)  # fmt: skip
ALARMS = Table(
    "alarms", _METADATA, _map(), Column("alarm", text(), primary_key=True), *_numbers("raised", "count"),
    *_texts("since"), **_FORM,
)  # fmt: skip

# Answers to frames whose place a run knew beyond doubt (:mod:`service.queries.histories.run_trials`).
RUN_TRIALS = Table(
    "run_trials", _METADATA, _map(), *(Column(name, text(), primary_key=True) for name in ("run", "at")),
    *_texts("source", "trials"), **_FORM,
)  # fmt: skip


def _making(*tables: Table) -> Mapping[DialectName, list[str]]:
    """The statements that make tables, in each dialect."""
    return {
        name: [str(CreateTable(table).compile(dialect=DIALECTS[name])) for table in tables]
        for name in get_args(DialectName)
    }


TABLES = Tables("statistics", 5, _METADATA, migrations={3: _making(HISTORY, ALARMS), 4: _making(RUN_TRIALS)})

# Statements

Combination = Callable[[ColumnElement[Any], ColumnElement[Any]], ColumnElement[Any]]
"""Makes the new value of a column of what it has and what it is given."""


def putting(table: Table, combined: Combination) -> Statement:
    """Put the ``rows`` into a table, each combined with the one that it has already."""
    keys = [column.name for column in table.primary_key]

    def made(insert: Insert) -> ClauseElement:
        columns = list(table.columns)
        put = insert(table).from_select([column.name for column in columns], given_rows("rows", columns))
        new = {one.name: combined(one, put.excluded[one.name]) for one in table.columns if one.name not in keys}
        return put.on_conflict_do_update(index_elements=keys, set_=new)

    return Statement(made)


def _added(column: ColumnElement[Any], counted: ColumnElement[Any]) -> ColumnElement[Any]:
    """The sum of two counts, or the later of two moments."""
    return greatest(column, counted) if column is _PLACES.c.last else column + counted


def of_map(table: Table) -> ColumnElement[bool]:
    """Whether a row is of the map with the number ``code``."""
    return table.c.map == bindparam("code")


THE_MAP = MAPS.c.id == bindparam("id"), MAPS.c.made == bindparam("made")

# The row of the map is written either way, and so locked until the transaction ends.
_NUMBER = Statement(
    lambda insert: (
        insert(MAPS)
        .values(id=bindparam("id"), made=bindparam("made"), since=bindparam("since"))
        .on_conflict_do_update(index_elements=["id", "made"], set_={"since": MAPS.c.since})
        .returning(CODE)
    )
)
_ADD_PLACES, _ADD_WEEKS, _ADD_HOURS = (putting(table, _added) for table in (_PLACES, _WEEKS, _HOURS))
_OLDEST = select(_WEEKS.c.monday).where(of_map(_WEEKS)).order_by(_WEEKS.c.monday.desc()).offset(MOST_WEEKS).limit(1)
_DELETE_WEEKS = Statement(
    delete(_WEEKS).where(of_map(_WEEKS), _WEEKS.c.monday <= _OLDEST.correlate(None).scalar_subquery())
)
_DELETE_HOURS = Statement(delete(_HOURS).where(of_map(_HOURS), _HOURS.c.hour < bindparam("oldest")))
_ALL_MAPS = Statement(select(CODE, MAPS.c.id, MAPS.c.made))
_DELETE_MAP = Statement(delete(MAPS).where(bindparam("code") == CODE))
_COUNT_PLACES = Statement(select(func.count()).join_from(_PLACES, MAPS).where(*THE_MAP))
_DELETE_PLACES = Statement(
    delete(_PLACES).where(
        _PLACES.c.map == select(CODE).where(*THE_MAP).scalar_subquery(), ~among(_PLACES.c.id, "present")
    )
)
_DELETE_HISTORIES = Statement(
    delete(HISTORY).where(
        HISTORY.c.map == select(CODE).where(*THE_MAP).scalar_subquery(), ~among(HISTORY.c.id, "present")
    )
)
_MAP = Statement(select(CODE, MAPS.c.since).where(*THE_MAP))
_COUNTS = _PLACES.c.best, _PLACES.c.recognized, _PLACES.c.last
_PLACES_OF_MAP = Statement(select(_PLACES.c.id, *_COUNTS).where(of_map(_PLACES)))
_PLACE = Statement(select(*_COUNTS).join_from(_PLACES, MAPS).where(*THE_MAP, _PLACES.c.id == bindparam("place")))
_WEEKS_OF_MAP = Statement(select(*_WEEKS.columns[1:]).where(of_map(_WEEKS)).order_by(_WEEKS.c.monday))
_COUNTED_HOURS = (
    select(MAPS.c.id, MAPS.c.made, *_HOURS.columns[1:])
    .join_from(_HOURS, MAPS)
    .where(_HOURS.c.hour >= bindparam("oldest"))
)
_HOURS_OF_ALL, _HOURS_OF_MAP = Statement(_COUNTED_HOURS), Statement(_COUNTED_HOURS.where(*THE_MAP))
_PUT_CALIBRATION = putting(_CALIBRATIONS, lambda _, new: new)
_CALIBRATION = Statement(select(*_CALIBRATIONS.columns[1:]).join_from(_CALIBRATIONS, MAPS).where(*THE_MAP))


def statistics_file(directory: Path) -> DisposableLedger:
    """The ledger of one data directory, which this process holds; a damaged file is put aside and made anew."""
    settings = {**DURABLE, "foreign_keys": "ON", "journal_size_limit": 1 << 20}
    readable = ["SELECT last FROM place_counts LIMIT 0"]
    return DisposableLedger(file_of(directory / FILE, TABLES, settings, readable, check_whole=False))


def add_counts(connection: LedgerConnection, key: MapKey, counted: AnswerCounts) -> int:
    """Add counts of a map to those of the ledger, and delete those of weeks and hours that are too old.

    Returns:
        The number of the map in the tables.
    """
    code = number_of(connection, key, counted.since)
    places = [(code, place, count.best, count.recognized, count.last) for place, count in counted.places.items()]
    hours = [(code, hour, *(counts[verdict] for verdict in _VERDICTS)) for hour, counts in counted.hours.items()]
    connection.execute(_ADD_PLACES, rows=json.dumps(places))
    connection.execute(_ADD_WEEKS, rows=json.dumps([_week_row(code, week) for week in counted.weeks.values()]))
    connection.execute(_ADD_HOURS, rows=json.dumps(hours))
    connection.execute(_DELETE_WEEKS, code=code)
    connection.execute(_DELETE_HOURS, code=code, oldest=hour_of(datetime.now(UTC) - timedelta(hours=HOURS)))
    return code


def delete_maps_beside(connection: LedgerConnection, present: Collection[MapKey]) -> None:
    """Delete the counts of all maps but some."""
    found = connection.execute(_ALL_MAPS)
    connection.execute_many(_DELETE_MAP, [{"code": code} for code, *key in found if tuple(key) not in present])


def count_places(connection: LedgerConnection, key: MapKey) -> int:
    """The number of places of a map that have counts."""
    ((count,),) = connection.execute(_COUNT_PLACES, id=key[0], made=key[1])
    return int(count)


def delete_places_beside(connection: LedgerConnection, key: MapKey, present: Collection[str]) -> None:
    """Delete the counts of all places of a map but some."""
    for delete_those in (_DELETE_PLACES, _DELETE_HISTORIES):
        connection.execute(delete_those, id=key[0], made=key[1], present=list(present))


def read_counts(connection: LedgerConnection, key: MapKey) -> Statistics:
    """The counts of a map."""
    found = connection.execute(_MAP, id=key[0], made=key[1])
    if not found:
        return Statistics()
    code, since = found[0]
    places = {place: PlaceCount(*counts) for place, *counts in connection.execute(_PLACES_OF_MAP, code=code)}
    weeks = connection.execute(_WEEKS_OF_MAP, code=code)
    return Statistics(datetime.fromisoformat(since), places, tuple(_week_of(*row) for row in weeks))


def read_place(ledger: Ledger, key: MapKey, place_id: str) -> PlaceCount:
    """The counts of one place of a map."""
    found = ledger.execute(READ, _PLACE, id=key[0], made=key[1], place=place_id)
    return PlaceCount(*found[0]) if found else PlaceCount()


def read_hours(ledger: Ledger, oldest: int, key: MapKey | None) -> dict[MapKey, dict[int, VerdictCounts]]:
    """The counts from an hour on, by map and hour.

    Args:
        key: of the only map that is wanted; None: all.
    """
    if key is None:
        rows = ledger.execute(READ, _HOURS_OF_ALL, oldest=oldest)
    else:
        rows = ledger.execute(READ, _HOURS_OF_MAP, oldest=oldest, id=key[0], made=key[1])
    found: dict[MapKey, dict[int, VerdictCounts]] = {}
    for map_id, made, hour, *counts in rows:
        known = dict(zip(_VERDICTS, counts, strict=True))
        found.setdefault((map_id, made), {})[hour] = VerdictCounts(**known)
    return found


def put_calibration(connection: LedgerConnection, key: MapKey, at: str, report: str, trials: str) -> None:
    """Store the measurements of a map's calibration, in place of earlier ones."""
    code = number_of(connection, key, at)
    connection.execute(_PUT_CALIBRATION, rows=json.dumps([(code, at, report, trials)]))


def read_calibration(connection: LedgerConnection, key: MapKey) -> tuple[datetime, str, str] | None:
    """When a map was last measured to be calibrated, the report and the trials; None if it was not."""
    for at, report, trials in connection.execute(_CALIBRATION, id=key[0], made=key[1]):
        return datetime.fromisoformat(at), report, trials
    return None


def number_of(connection: LedgerConnection, key: MapKey, since: str) -> int:
    """The number of a map in the tables, which it gets if it has none."""
    ((code,),) = connection.execute(_NUMBER, id=key[0], made=key[1], since=since)
    return int(code)


def _week_row(code: int, week: Week) -> tuple[Any, ...]:
    numbers = [getattr(week, name) for name in (*_VERDICTS, "blank", *_SUMS)]
    return code, week.monday.isoformat(), *numbers, *week.bins


def _week_of(monday: str, *counts: Any) -> Week:
    return Week(date.fromisoformat(monday), *counts[:-SCORE_BINS], counts[-SCORE_BINS:])  # type: ignore[call-arg]
