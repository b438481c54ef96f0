"""Statements of SQLAlchemy that are compiled once for each dialect and executed by the driver.

Parameters are bound by name (``bindparam("id")``).  A parameter of :func:`among` is a list.
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Literal

from sqlalchemy import BigInteger, Float, bindparam
from sqlalchemy.dialects import postgresql, sqlite
from sqlalchemy.dialects.postgresql.psycopg import PGDialect_psycopg
from sqlalchemy.dialects.sqlite.pysqlite import SQLiteDialect_pysqlite
from sqlalchemy.ext.compiler import compiles
from sqlalchemy.sql.compiler import SQLCompiler
from sqlalchemy.sql.elements import ClauseElement, ColumnElement
from sqlalchemy.sql.functions import FunctionElement
from sqlalchemy.types import Boolean, LargeBinary, String, TypeEngine

DialectName = Literal["sqlite", "postgresql"]

DIALECTS = {"sqlite": SQLiteDialect_pysqlite(paramstyle="qmark"), "postgresql": PGDialect_psycopg()}  # type: ignore[no-untyped-call]

Insert = Callable[..., Any]
"""``insert`` of a dialect, which alone has ``on_conflict_do_update`` and ``on_conflict_do_nothing``."""

INSERTS: Mapping[str, Insert] = {"sqlite": sqlite.insert, "postgresql": postgresql.insert}

UNFINDABLE = "\x1a"
"""A text that is never stored: no name has a control character."""

_NEVER_STORED = re.compile("[\\x00\\ud800-\\udfff]")
"""A zero character, which PostgreSQL refuses, or half of a surrogate pair, which both refuse."""


@dataclass(frozen=True)
class Compiled:
    """The text of a statement in one dialect.

    returns: whether it gives rows.
    names: of its parameters in the order of their marks; None where they are bound by name.
    constants: values of parameters that the statement itself gives.
    finds: whether it stores no parameter, so that a text that is never stored is one that it does not find.
    """

    text: str
    returns: bool
    names: tuple[str, ...] | None
    constants: Mapping[str, Any]
    finds: bool

    def values(self, given: Mapping[str, Any]) -> Any:
        """The parameters as the driver takes them.

        Raises:
            KeyError: a parameter has no value.
        """
        whole = {**self.constants, **given} if self.constants else given
        if self.finds:
            whole = {name: _findable(value) for name, value in whole.items()}
        return whole if self.names is None else tuple([_plain(whole[name]) for name in self.names])


def _findable(value: Any) -> Any:
    """A value that a database takes: a text that is never stored is replaced, or left out of a list."""
    if isinstance(value, str):
        return UNFINDABLE if _NEVER_STORED.search(value) else value
    if isinstance(value, list) and value and isinstance(value[0], str):
        return [one for one in value if not _NEVER_STORED.search(one)]
    return value


def _plain(value: Any) -> Any:
    """A value as SQLite takes it: a list is JSON."""
    return json.dumps(value) if isinstance(value, list) else value


class Statement:
    """One statement for both dialects; a constant of the module that executes it.

    Args:
        expression: the statement; or, for one that says what to do about a conflict, a function that makes it with the
            dialect's ``insert``.
    """

    def __init__(self, expression: ClauseElement | Callable[[Insert], ClauseElement]) -> None:
        self._expression = expression
        self._compiled: dict[DialectName, Compiled] = {}

    def compiled(self, dialect: DialectName) -> Compiled:
        """Its text in a dialect."""
        if (found := self._compiled.get(dialect)) is None:
            found = self._compiled[dialect] = self._compile(dialect)
        return found

    def _compile(self, name: DialectName) -> Compiled:
        given = self._expression
        expression = given if isinstance(given, ClauseElement) else given(INSERTS[name])
        made = expression.compile(dialect=DIALECTS[name])
        assert isinstance(made, SQLCompiler)
        constants = {key: made.params[key] for bind, key in made.bind_names.items() if not bind.required}
        names = None if made.positiontup is None else tuple(made.positiontup)
        writes = made.isinsert or made.isupdate
        returns = bool(made.effective_returning) if writes or made.isdelete else True
        return Compiled(str(made), returns, names, constants, finds=not writes)


class among(ColumnElement[bool]):  # noqa: N801 – an expression, as SQLAlchemy names its own
    """Whether a column has one of the values of a list, the parameter ``name``: text or whole numbers."""

    inherit_cache = False
    type = Boolean()

    def __init__(self, column: ColumnElement[Any], name: str) -> None:
        self.column, self.name = column, name

    def self_group(self, against: Any = None) -> among:  # else SQLite would compare it with 1
        return self


@compiles(among, "sqlite")
def _among_in_sqlite(element: among, compiler: SQLCompiler, **_: Any) -> str:
    values = compiler.process(bindparam(element.name, type_=String()))
    return f"{compiler.process(element.column)} IN (SELECT value FROM json_each({values}))"


@compiles(among, "postgresql")
def _among_in_postgresql(element: among, compiler: SQLCompiler, **_: Any) -> str:
    values = compiler.process(bindparam(element.name, type_=postgresql.ARRAY(element.column.type)))
    return f"{compiler.process(element.column)} = ANY({values})"


class seconds_now(FunctionElement[float]):  # noqa: N801
    """Seconds since 1970 UTC by the clock of the database: that of the machine, or of PostgreSQL's server."""

    inherit_cache = True
    type = Float(53)
    name = "seconds_now"


@compiles(seconds_now, "sqlite")
def _seconds_in_sqlite(element: seconds_now, compiler: SQLCompiler, **_: Any) -> str:
    return "((julianday('now') - 2440587.5) * 86400.0)"


@compiles(seconds_now, "postgresql")
def _seconds_in_postgresql(element: seconds_now, compiler: SQLCompiler, **_: Any) -> str:
    return "extract(epoch FROM clock_timestamp())::float8"


class greatest(FunctionElement[Any]):  # noqa: N801
    """The largest of its arguments, none of which is NULL."""

    inherit_cache = True
    name = "greatest"


@compiles(greatest, "sqlite")
def _greatest_in_sqlite(element: greatest, compiler: SQLCompiler, **_: Any) -> str:
    return f"max({compiler.process(element.clauses)})"


@compiles(greatest, "postgresql")
def _greatest_in_postgresql(element: greatest, compiler: SQLCompiler, **_: Any) -> str:
    return f"greatest({compiler.process(element.clauses)})"


class joined(FunctionElement[str]):  # noqa: N801
    """The whole numbers of a column of all rows as one text, with commas: an object for each takes far longer."""

    inherit_cache = True
    name = "joined"
    type = String()


@compiles(joined, "sqlite")
def _joined_in_sqlite(element: joined, compiler: SQLCompiler, **_: Any) -> str:
    return f"group_concat({compiler.process(element.clauses)})"


@compiles(joined, "postgresql")
def _joined_in_postgresql(element: joined, compiler: SQLCompiler, **_: Any) -> str:
    return f"string_agg(({compiler.process(element.clauses)})::text, ',')"


class rounded(FunctionElement[float]):  # noqa: N801
    """A number, rounded to some decimal digits."""

    inherit_cache = True
    name = "rounded"
    type = Float(53)


@compiles(rounded, "sqlite")
def _rounded_in_sqlite(element: rounded, compiler: SQLCompiler, **_: Any) -> str:
    return f"round({compiler.process(element.clauses)})"


@compiles(rounded, "postgresql")
def _rounded_in_postgresql(element: rounded, compiler: SQLCompiler, **_: Any) -> str:
    number, digits = element.clauses
    return f"round(({compiler.process(number)})::numeric, {compiler.process(digits)})"


class json_list(FunctionElement[str]):  # noqa: N801
    """The values of a column of all rows, in their order, as a list in JSON: text, numbers and NULL."""

    inherit_cache = True
    name = "json_list"
    type = String()


@compiles(json_list, "sqlite")
def _list_in_sqlite(element: json_list, compiler: SQLCompiler, **_: Any) -> str:
    return f"json_group_array({compiler.process(element.clauses)})"


@compiles(json_list, "postgresql")
def _list_in_postgresql(element: json_list, compiler: SQLCompiler, **_: Any) -> str:
    value = f"coalesce(to_json({compiler.process(element.clauses)})::text, 'null')"
    return f"'[' || coalesce(string_agg({value}, ','), '') || ']'"


def text() -> TypeEngine[str]:
    """Text that both dialects compare by its code points."""
    by_code_points = String().with_variant(postgresql.TEXT(collation="C"), "postgresql")
    return by_code_points.with_variant(sqlite.TEXT(), "sqlite")


def integer() -> TypeEngine[int]:
    """A whole number of 64 bits."""
    return BigInteger().with_variant(sqlite.INTEGER(), "sqlite")


def real() -> TypeEngine[float]:
    """A number of 64 bits."""
    return Float(53).with_variant(sqlite.REAL(), "sqlite")


def binary() -> TypeEngine[bytes]:
    """Bytes."""
    return LargeBinary().with_variant(sqlite.BLOB(), "sqlite")
