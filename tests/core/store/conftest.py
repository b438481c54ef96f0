"""A store in each of the two databases; PostgreSQL where it is installed."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path

import psycopg
import pytest

from core.ledger.maps import rows
from core.maps import MapSettings
from core.store import Directory, Map, Store
from core.store.cluster import Cluster
from core.store.file import MapFile
from tests.core.store.frames import DIMENSION, ENCODER, LOCAL_SHAPE
from tests.servers.postgres import Postgres

ROWS = 4

OpenStore = Callable[[], Store]

on_both = pytest.mark.parametrize(
    "database", ["sqlite", pytest.param("postgresql", marks=pytest.mark.postgres)], indirect=True
)
"""Marks tests that are run with a data directory and with PostgreSQL; others are run with a data directory."""


@pytest.fixture
def directory(tmp_path: Path) -> Path:
    return tmp_path / "data"


@pytest.fixture
def database(request: pytest.FixtureRequest) -> str:
    return str(getattr(request, "param", "sqlite"))


@pytest.fixture
def open_store(database: str, directory: Path, request: pytest.FixtureRequest) -> Iterator[OpenStore]:
    """Opens the store of the test with segments of four rows, so that a few places fill some.

    A data directory can be opened again when it was closed.
    """
    opened: list[Store] = []
    server: Postgres | None = request.getfixturevalue("postgres") if database == "postgresql" else None

    def made() -> Store:
        store: Store = (
            Directory(directory, rows_per_segment=ROWS)
            if server is None
            else Cluster(server.address, rows_per_segment=ROWS)
        )
        opened.append(store)
        return store

    yield made
    for store in opened:
        store.close()
    if server is not None:
        with psycopg.connect(server.address) as connection, suppress(psycopg.errors.UndefinedTable):
            connection.execute("DELETE FROM maps")


@pytest.fixture
def store(open_store: OpenStore) -> Store:
    return open_store()


@pytest.fixture
def atlas(store: Store) -> Directory:
    """The store of a test that is about a data directory."""
    assert isinstance(store, Directory)
    return store


@pytest.fixture
def lab(store: Store) -> Map:
    return store.create("lab", ENCODER, DIMENSION, MapSettings(), local_shape=LOCAL_SHAPE)


@pytest.fixture
def at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """Have what no place names any more deleted with the write by which it died, and not a while later."""
    monkeypatch.setattr(rows, "LEFT_SECONDS", -1)  # clocks of databases are coarse


def execute(map_: Map, *statements: str) -> None:
    """Change rows of a map, of the only one in its database, behind its back."""
    with map_._transaction() as connection:
        for statement in statements:
            connection.whole.driver.execute(statement)  # type: ignore[attr-defined]


def file_of(map_: Map) -> MapFile:
    """The file of a map of a data directory."""
    assert isinstance(map_.database, MapFile)
    return map_.database
