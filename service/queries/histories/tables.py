"""The history of places in the tables of counted answers, and the alarms that it has raised.

A place has a row for each day of this week and the last one, for each of the WEEKS weeks before, and one for all that
came earlier, if it answered then: at most 14 + WEEKS + 1.  Days that are over become part of their week, and weeks
part of what was earlier, when the first counts of a day are written.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import astuple, dataclass
from datetime import date, datetime, timedelta
from typing import Any

from sqlalchemy import bindparam, case, delete, func, literal, select, update
from sqlalchemy.sql.elements import ClauseElement, ColumnElement

from core.judgement.change import UsualScore
from core.ledger import LedgerConnection, Statement
from core.ledger.statements import Insert, among
from core.maps import AlarmName
from core.upkeep.histories import AnswerHistory, Histories, PlacePeriod
from service.queries.count_tables import ALARMS, HISTORY, MAPS, THE_MAP, number_of, of_map, putting
from service.queries.counts import monday_of
from service.queries.given_answers import MapKey

WEEKS = 12
"""How many weeks of a place are stored one by one, before this one and the last."""

DAY, WEEK, EARLIER = 1, 7, 0
"""Spans of rows, in days; what is earlier has none."""

_H = HISTORY.c
_SUMS = HISTORY.columns[4:]

_ADD = putting(HISTORY, lambda column, counted: column + counted)
_OLDEST = Statement(select(func.min(_H.began)).where(of_map(HISTORY), _H.span == DAY))
_PART = (of_map(HISTORY), _H.span == bindparam("part"), _H.began >= bindparam("first"), _H.began < bindparam("end"))
_is_good = case(
    (_H.passed > 0, case((2 * (_H.passed - _H.missed) >= _H.passed, 1), else_=0)),
    else_=case((2 * _H.recognized >= _H.best, 1), else_=0),
)
_counted = {
    "days": case((_H.span == DAY, 1), else_=_H.days),
    "good": case((_H.span == DAY, _is_good), else_=_H.good),
}


def _folding(insert: Insert) -> ClauseElement:
    """Add the rows of a part to those of a longer span."""
    sums: list[ColumnElement[Any]] = [func.sum(_counted.get(one.name, one)) for one in _SUMS]
    span, began = (literal(0, type_=_H.span.type) + bindparam(name, type_=_H.span.type) for name in ("span", "began"))
    rows = select(_H.map, _H.id, span, began, *sums).where(*_PART).group_by(_H.map, _H.id)
    put = insert(HISTORY).from_select([one.name for one in HISTORY.columns], rows)
    return put.on_conflict_do_update(
        index_elements=["map", "id", "span", "began"],
        set_={one.name: one + put.excluded[one.name] for one in _SUMS},
    )


_FOLD, _DELETE = Statement(_folding), Statement(delete(HISTORY).where(*_PART))
_ALL = Statement(select(*HISTORY.columns[1:]).join_from(HISTORY, MAPS).where(*THE_MAP))
_SCORES = func.sum(_H.recognized), func.sum(_H.score)
_USUAL = Statement(select(_H.id, *_SCORES).where(of_map(HISTORY), among(_H.id, "places")).group_by(_H.id))
_USUAL_OF_ALL = Statement(select(*_SCORES).where(of_map(HISTORY)))


def add_periods(connection: LedgerConnection, code: int, periods: Mapping[tuple[str, date], PlacePeriod]) -> None:
    """Add the periods of days to the history of the places of a map.

    Args:
        code: the number of the map.
    """
    rows = [(code, place, DAY, day.toordinal(), *astuple(one)) for (place, day), one in periods.items()]
    connection.execute(_ADD, rows=json.dumps(rows))


def fold(connection: LedgerConnection, code: int, today: date) -> None:
    """Make days that are over part of their week, and weeks that are long over part of what was earlier."""
    monday = monday_of(today) - timedelta(days=WEEK)
    while (oldest := connection.execute(_OLDEST, code=code)[0][0]) is not None and oldest < monday.toordinal():
        week = monday_of(date.fromordinal(oldest)).toordinal()
        _move(connection, code, DAY, week, week + WEEK, WEEK, week)
    _move(connection, code, WEEK, 0, (monday - timedelta(weeks=WEEKS)).toordinal(), EARLIER, 0)


def _move(connection: LedgerConnection, code: int, part: int, first: int, end: int, span: int, began: int) -> None:
    connection.execute(_FOLD, code=code, part=part, first=first, end=end, span=span, began=began)
    connection.execute(_DELETE, code=code, part=part, first=first, end=end)


def read_histories(connection: LedgerConnection, key: MapKey) -> Histories:
    """The histories of the places of a map."""
    found: dict[str, tuple[dict[date, PlacePeriod], dict[date, PlacePeriod], list[PlacePeriod]]] = {}
    for place, span, began, *sums in connection.execute(_ALL, id=key[0], made=key[1]):
        days, weeks, earlier = found.setdefault(place, ({}, {}, []))
        if span == EARLIER:
            earlier.append(PlacePeriod(*sums))
        else:
            (days if span == DAY else weeks)[date.fromordinal(began)] = PlacePeriod(*sums)
    return {place: AnswerHistory(days, weeks, *earlier) for place, (days, weeks, earlier) in found.items()}


def read_usual(
    connection: LedgerConnection, code: int, places: list[str], whole: bool
) -> tuple[UsualScore | None, dict[str, UsualScore]]:
    """The usual scores of recognized frames of some places, and of the map if they are wanted."""
    found = connection.execute(_USUAL, code=code, places=places)
    of_places = {place: _usual(count, total) for place, count, total in found}
    if not whole:
        return None, of_places
    ((count, total),) = connection.execute(_USUAL_OF_ALL, code=code)
    return _usual(count, total), of_places


def _usual(count: Any, total: Any) -> UsualScore:
    """The usual score by its sums: None of no rows, and in PostgreSQL a decimal number of whole ones."""
    return UsualScore(int(count or 0), float(total or 0.0))


# Alarms

_RAISE = Statement(
    lambda insert: (
        put := insert(ALARMS).values({one.name: bindparam(f"new_{one.name}") for one in ALARMS.columns})
    ).on_conflict_do_update(
        index_elements=["map", "alarm"],
        set_={name: put.excluded[name] for name in ("raised", "count", "since")},
        where=ALARMS.c.raised == 0,
    )
)
_CLEAR = Statement(
    update(ALARMS)
    .values(raised=0, count=bindparam("new_count"), since=bindparam("new_since"))
    .where(of_map(ALARMS), ALARMS.c.alarm == bindparam("name"), ALARMS.c.raised == 1)
)
_RAISED = Statement(
    select(ALARMS.c.alarm, ALARMS.c.count, ALARMS.c.since)
    .join_from(ALARMS, MAPS)
    .where(*THE_MAP, ALARMS.c.raised == 1)
    .order_by(ALARMS.c.alarm)
)

_ALL_ALARMS = Statement(
    select(MAPS.c.id, MAPS.c.made, ALARMS.c.alarm, ALARMS.c.raised, ALARMS.c.count, ALARMS.c.since)
    .join_from(ALARMS, MAPS)
    .where((ALARMS.c.raised == 1) | (ALARMS.c.since >= bindparam("after")))
    .order_by(ALARMS.c.raised.desc(), ALARMS.c.since.desc())
)


@dataclass(frozen=True)
class AlarmState:
    """An alarm of a map.

    is_raised: or it was, and is cleared.
    count: of places or stretches, when it was raised or cleared.
    since: when that was.
    """

    map: MapKey
    alarm: AlarmName
    is_raised: bool
    count: int
    since: datetime


def put_alarm(
    connection: LedgerConnection, key: MapKey, alarm: AlarmName, is_raised: bool, count: int, now: datetime
) -> bool:
    """Raise or clear an alarm of a map; whether that is a change, which only one of several services sees."""
    code, since = number_of(connection, key, now.isoformat()), now.isoformat()
    if is_raised:
        given = {"new_map": code, "new_alarm": alarm, "new_raised": 1, "new_count": count, "new_since": since}
        return connection.change(_RAISE, **given) > 0
    return connection.change(_CLEAR, code=code, name=alarm, new_count=count, new_since=since) > 0


def read_alarms(connection: LedgerConnection, key: MapKey) -> list[tuple[AlarmName, int, datetime]]:
    """The alarms of a map that are raised: their names, the counts that raised them, and since when."""
    found = connection.execute(_RAISED, id=key[0], made=key[1])
    return [(alarm, count, datetime.fromisoformat(since)) for alarm, count, since in found]


def read_all_alarms(connection: LedgerConnection, after: datetime) -> list[AlarmState]:
    """The alarms of all maps that are raised, and then those that were cleared after a moment; the latest first."""
    return [
        AlarmState((map_id, made), alarm, bool(raised), count, datetime.fromisoformat(since))
        for map_id, made, alarm, raised, count, since in connection.execute(_ALL_ALARMS, after=after.isoformat())
    ]
