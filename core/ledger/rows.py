"""Many rows as one parameter, so that one statement inserts them all."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from sqlalchemy import Column, String, bindparam, cast, literal_column, select, true
from sqlalchemy.dialects.postgresql import JSON
from sqlalchemy.ext.compiler import compiles
from sqlalchemy.sql import Select
from sqlalchemy.sql.compiler import SQLCompiler
from sqlalchemy.sql.elements import ColumnElement
from sqlalchemy.sql.functions import GenericFunction


class json_elements(GenericFunction[str]):  # noqa: N801 – an expression, as SQLAlchemy names its own
    """The elements of a JSON list, one a row."""

    inherit_cache = True


@compiles(json_elements, "sqlite")
def _elements_in_sqlite(element: json_elements, compiler: SQLCompiler, **_: Any) -> str:
    return f"json_each({compiler.process(element.clauses)})"


@compiles(json_elements, "postgresql")
def _elements_in_postgresql(element: json_elements, compiler: SQLCompiler, **_: Any) -> str:
    (given,) = element.clauses
    return f"json_array_elements({compiler.process(cast(given, JSON))})"


def given_rows(name: str, columns: Sequence[Column[Any]]) -> Select[Any]:
    """The rows of a list, the parameter ``name``, for ``INSERT … SELECT``.

    The parameter is JSON: a list with a list for each row, which has a value for each of the columns.
    """
    each = json_elements(bindparam(name, type_=String())).table_valued("value", name="given")

    def value(position: int, column: Column[Any]) -> ColumnElement[Any]:
        found: ColumnElement[Any] = each.c.value.op("->>")(literal_column(str(position)))
        return found if isinstance(column.type, String) else cast(found, column.type)

    # SQLite would take an ON CONFLICT for one of a join if there were no condition.
    return select(*(value(position, column) for position, column in enumerate(columns))).where(true())
