"""Tables of one kind with their version: how they are made in either database, and brought up to date."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from sqlalchemy import MetaData
from sqlalchemy.schema import CreateIndex, CreateTable

from core.ledger.statements import DIALECTS, DialectName

Statements = Sequence[str]


@dataclass(frozen=True)
class Tables:
    """The tables of one part of the ledger.

    name: of the part, by which PostgreSQL knows its version.
    version: of the tables.
    metadata: the tables and indexes.
    application_id: names the kind of an SQLite file; 0 for kinds that have none.
    migrations: the statements in each dialect that bring tables of a version to the next one.
    more: statements in each dialect that follow those that make the tables.
    """

    name: str
    version: int
    metadata: MetaData
    application_id: int = 0
    migrations: Mapping[int, Mapping[DialectName, Statements]] = field(default_factory=dict)
    more: Mapping[DialectName, Statements] = field(default_factory=dict)

    def create(self, dialect: DialectName) -> list[str]:
        """The statements that make the tables where there are none."""
        made = []
        for table in self.metadata.sorted_tables:
            made.append(str(CreateTable(table).compile(dialect=DIALECTS[dialect])))
            made += [
                str(CreateIndex(index).compile(dialect=DIALECTS[dialect]))
                for index in sorted(table.indexes, key=lambda index: str(index.name))
                if (only := index._ddl_if) is None or only.dialect == dialect
            ]
        return [*made, *self.more.get(dialect, ())]

    def migrate(self, dialect: DialectName, version: int) -> list[str] | None:
        """The statements that bring tables of an earlier version up to date; None if that is not possible."""
        found: list[str] = []
        for earlier in range(version, self.version):
            if earlier not in self.migrations:
                return None
            found += self.migrations[earlier].get(dialect, ())
        return found if version < self.version else None
