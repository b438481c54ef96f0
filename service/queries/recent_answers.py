"""The latest answers of each map: in memory, or of all services that share a ledger."""

from __future__ import annotations

import threading
from collections import OrderedDict, deque
from collections.abc import Callable
from contextlib import suppress
from datetime import datetime

from pydantic import ConfigDict, TypeAdapter
from sqlalchemy import Column, Index, MetaData, Table, bindparam, delete, insert, select
from sqlalchemy.sql import ColumnElement

from core.errors import StorageFull
from core.ledger import Ledger, Statement, Tables
from core.ledger.statements import among, integer, text
from service.queries.given_answers import GivenAnswer, MapKey

MOST_OF_MAP = 500
"""Answers of one map that are stored."""

MOST = 20_000
"""Answers of all maps together; those of the map that was queried least recently go first."""

_METADATA = MetaData()
_ANSWERS = Table(
    "answers",
    _METADATA,
    Column("number", integer(), primary_key=True, autoincrement=True),
    *(Column(name, text(), nullable=False) for name in ("map", "made", "answer")),
)
Index("answers_of_map", _ANSWERS.c.map, _ANSWERS.c.made, _ANSWERS.c.number)
TABLES = Tables("answers", 1, _METADATA, more={"postgresql": ["ALTER TABLE answers SET UNLOGGED"]})
"""A crash of the server forgets the answers, as a restart of a service without it does."""

_OF_MAP = _ANSWERS.c.map == bindparam("id"), _ANSWERS.c.made == bindparam("made")
_LATEST = select(_ANSWERS.c.number).order_by(_ANSWERS.c.number.desc())


def _deletion_beyond(*only: ColumnElement[bool]) -> Statement:
    """Delete all answers but the latest ``most``."""
    latest = _LATEST.where(*only).limit(1).offset(bindparam("most")).correlate(None)
    return Statement(delete(_ANSWERS).where(_ANSWERS.c.number <= latest.scalar_subquery(), *only))


_ADD = Statement(
    insert(_ANSWERS).values(map=bindparam("id"), made=bindparam("made"), answer=bindparam("answer")).inline()
)
_READ = Statement(select(_ANSWERS.c.answer).where(*_OF_MAP).order_by(_ANSWERS.c.number.desc()).limit(bindparam("most")))
_NUMBERED = Statement(select(_ANSWERS.c.number, _ANSWERS.c.answer).where(*_OF_MAP))
_OLDEST = Statement(select(_ANSWERS.c.number, _ANSWERS.c.answer).order_by(_ANSWERS.c.number).limit(bindparam("most")))
_DELETE = Statement(delete(_ANSWERS).where(among(_ANSWERS.c.number, "numbers")))
_TRIM_MAP, _TRIM = _deletion_beyond(*_OF_MAP), _deletion_beyond()

_JSON = TypeAdapter(GivenAnswer, config=ConfigDict(defer_build=True))


class RecentAnswers:
    """The latest answers of each map, bounded in number.  Any thread may use it.

    Args:
        ledger: has the answers of all services that share it, where they come with the next ``flush``; None: the
            answers are in memory alone.
    """

    def __init__(self, ledger: Ledger | None = None) -> None:
        self._ledger = ledger
        self._stored: OrderedDict[MapKey, deque[GivenAnswer]] = OrderedDict()
        self._count = 0
        self._lock = threading.Lock()
        self._writing = threading.Lock()  # held while answers are on their way to the ledger

    def add(self, key: MapKey, answer: GivenAnswer) -> None:
        """Store an answer of a map."""
        with self._lock:
            self._add(key, answer)

    def _add(self, key: MapKey, answer: GivenAnswer) -> None:
        of_map = self._stored.get(key)
        if of_map is None:
            of_map = self._stored[key] = deque(maxlen=MOST_OF_MAP)
        else:
            self._stored.move_to_end(key)
        self._count += len(of_map) < MOST_OF_MAP
        of_map.append(answer)
        while self._count > MOST:
            self._count -= len(self._stored.popitem(last=False)[1])

    def of_map(self, key: MapKey) -> list[GivenAnswer]:
        """The answers of a map, the latest first.

        Raises:
            StorageFull, StorageFailure: the ledger refuses, or cannot be reached.
        """
        if self._ledger is None:
            with self._lock:
                return list(reversed(self._stored.get(key, ())))
        with suppress(StorageFull):  # what has no room waits in memory, and is left out
            self.flush()
        found = self._ledger.execute("read the latest answers", _READ, id=key[0], made=key[1], most=MOST_OF_MAP)
        return [_JSON.validate_json(answer) for (answer,) in found]

    def forget(self, key: MapKey, wanted: Callable[[GivenAnswer], bool]) -> int:
        """Drop the answers of a map that fulfil a condition; returns how many.

        Raises:
            StorageFull, StorageFailure: as :meth:`of_map`.
        """
        with self._lock:
            count = self._drop(key, wanted)
        if self._ledger is None:
            return count
        self.flush()
        found = self._ledger.execute("read the latest answers", _NUMBERED, id=key[0], made=key[1])
        gone = [number for number, answer in found if wanted(_JSON.validate_json(answer))]
        if gone:
            self._ledger.change("delete answers", _DELETE, numbers=gone)
        return count + len(gone)

    def _drop(self, key: MapKey, wanted: Callable[[GivenAnswer], bool]) -> int:
        before = self._stored.get(key, ())
        left = deque((one for one in before if not wanted(one)), maxlen=MOST_OF_MAP)
        if key in self._stored:
            self._stored[key] = left
        self._count -= len(before) - len(left)
        return len(before) - len(left)

    def forget_before(self, moment: datetime) -> None:
        """Drop the answers of all maps from before a moment.

        Raises:
            StorageFull, StorageFailure: as :meth:`of_map`.
        """
        with self._lock:
            for key in list(self._stored):
                self._drop(key, lambda one: one.at < moment)
        if self._ledger is not None:
            found = self._ledger.execute("read the oldest answers", _OLDEST, most=MOST)
            gone = []
            for number, answer in found:
                if _JSON.validate_json(answer).at >= moment:
                    break  # numbers rise with time
                gone.append(number)
            if gone:
                self._ledger.change("delete answers", _DELETE, numbers=gone)

    def flush(self) -> None:
        """Add the answers to the ledger, if there is one; raises as :meth:`of_map`, and they stay in memory."""
        if self._ledger is None:
            return
        with self._writing:
            with self._lock:
                taken, self._stored, self._count = self._stored, OrderedDict(), 0
            try:
                if taken:
                    _write(self._ledger, taken)
            except BaseException:
                with self._lock:
                    newer, self._stored, self._count = self._stored, OrderedDict(), 0
                    for part in (taken, newer):
                        for key, answers in part.items():
                            for answer in answers:
                                self._add(key, answer)
                raise


def _write(ledger: Ledger, answers: OrderedDict[MapKey, deque[GivenAnswer]]) -> None:
    rows = [
        {"id": key[0], "made": key[1], "answer": _JSON.dump_json(answer).decode()}
        for key, of_map in answers.items()
        for answer in of_map
    ]
    with ledger.transaction("write down answers") as connection:
        connection.execute_many(_ADD, rows)
        for key in sorted(answers):  # in one order, so that no two services wait for one another
            connection.execute(_TRIM_MAP, id=key[0], made=key[1], most=MOST_OF_MAP)
        connection.execute(_TRIM, most=MOST)
