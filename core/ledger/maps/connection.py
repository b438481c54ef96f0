"""A connection to one map: every statement gets the map's number."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager
from typing import Any

from core.ledger.database import LedgerConnection
from core.ledger.statements import Statement


class MapConnection:
    """A connection that gives every statement the parameter ``map``.

    Args:
        connection: within a transaction, or for single statements.
        map_number: of the map.
    """

    def __init__(self, connection: LedgerConnection, map_number: int) -> None:
        self.whole, self.map = connection, map_number

    def execute(self, statement: Statement, **values: Any) -> list[tuple[Any, ...]]:
        """Execute a statement; the rows that it gives."""
        return self.whole.execute(statement, map=self.map, **values)

    def pages(self, statement: Statement, size: int, **values: Any) -> Iterator[list[tuple[Any, ...]]]:
        """Execute a statement within a transaction; the rows that it gives, up to ``size`` at a time."""
        return self.whole.pages(statement, size, map=self.map, **values)

    def execute_many(self, statement: Statement, values: Sequence[Mapping[str, Any]]) -> None:
        """Execute a statement once for each of some sets of values."""
        self.whole.execute_many(statement, [{"map": self.map, **one} for one in values])

    def change(self, statement: Statement, **values: Any) -> int:
        """Execute a statement; the number of rows that it inserted, updated or deleted."""
        return self.whole.change(statement, map=self.map, **values)

    def one(self, statement: Statement, **values: Any) -> tuple[Any, ...] | None:
        """The first row that a statement gives; None if it gives none."""
        found = self.whole.execute(statement, map=self.map, **values)
        return found[0] if found else None


Reading = Callable[[], AbstractContextManager[MapConnection]]
"""Begins a transaction that reads a map, and raises if the map is gone."""
