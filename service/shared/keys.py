"""Keys that any number of services share."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import datetime
from typing import Any, ClassVar

from psycopg import Connection

from core.errors import StorageFailure, StorageFull
from service.access.keys import COLUMNS, Key, KeyNarrowing, KeyRecords, KeyWatch, key_of, row_of, text_of
from service.errors.faults import KeysUnreadable
from service.shared.database import SharedDatabase

_ALL = f"SELECT {', '.join(COLUMNS)} FROM service.keys ORDER BY created_at, id"
_VERSION = "SELECT number FROM service.versions WHERE name = 'keys'"
_CHANGE = "UPDATE service.versions SET number = number + 1 WHERE name = 'keys'"


class SharedKeys(KeyRecords):
    """The keys of all services.  Any thread may use it.

    A change locks the version of the keys, so that one comes after the other.
    """

    remote: ClassVar[bool] = True

    def __init__(self, database: SharedDatabase) -> None:
        self.database = database

    def exists(self) -> bool:
        return bool(self._execute("SELECT 1 FROM service.keys LIMIT 1"))

    def all(self) -> list[Key]:
        return [key_of(row) for row in self._execute(_ALL)]

    def note_uses(self, moments: dict[str, datetime]) -> None:
        query = (
            "UPDATE service.keys k SET last_used_at = greatest(coalesce(k.last_used_at, ''), u.moment)"
            " FROM unnest(%s::text[], %s::text[]) AS u (id, moment) WHERE k.id = u.id"
        )
        self._execute(query, list(moments), [text_of(moment) for moment in moments.values()])

    def watch(self) -> KeyWatch:
        return _Watch(self)

    @contextmanager
    def changing(self) -> Iterator[KeyNarrowing]:
        with _refusals(), self.database.text_transaction("change the keys") as connection:
            connection.execute(_CHANGE)
            yield _Changes(connection)

    def _prepare(self) -> None:
        pass

    def version(self) -> int:
        """A number that grows with every change."""
        return int(self._execute(_VERSION)[0][0])

    def _execute(self, query: str, *values: Any) -> list[tuple[Any, ...]]:
        with _refusals():
            return self.database.query("use the keys", query, values)


@dataclass(frozen=True)
class _Changes:
    connection: Connection[Any]

    def read(self) -> list[Key]:
        return [key_of(row) for row in self.connection.execute(_ALL).fetchall()]

    def put(self, key: Key) -> None:
        names, marks = ", ".join(COLUMNS), ", ".join(["%s"] * len(COLUMNS))
        again = ", ".join(f"{name} = excluded.{name}" for name in COLUMNS if name != "id")
        query = f"INSERT INTO service.keys ({names}) VALUES ({marks}) ON CONFLICT (id) DO UPDATE SET {again}"
        self.connection.execute(query, row_of(key))


class _Watch:
    """Asks for the version of the keys."""

    def __init__(self, keys: SharedKeys) -> None:
        self._keys = keys
        self._version: int | None = None

    def has_changed(self, demanded: bool) -> bool:
        return self._keys.version() != self._version

    def read(self) -> list[Key] | None:
        version = self._keys.version()  # before the keys: later changes are read again
        found = self._keys.all()
        self._version = version
        return found or None

    def close(self) -> None:
        self._version = None


@contextmanager
def _refusals() -> Iterator[None]:
    try:
        yield
    except (StorageFull, StorageFailure) as error:
        raise KeysUnreadable(f"The keys cannot be used: {error}") from error
