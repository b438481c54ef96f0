"""Changes of a map by other means than the map."""

from __future__ import annotations

import sqlite3
from contextlib import closing
from pathlib import Path

from core.store import Map
from core.store.file import MapFile


def edit(changed: Map | Path, *statements: str) -> int:
    """Execute statements in the file of a map, or of a folder; the number of rows that they changed."""
    if isinstance(changed, Map):
        assert isinstance(changed.database, MapFile)
        changed = changed.database.folder
    with closing(sqlite3.connect(changed / "map.sqlite")) as connection, connection:
        return sum(connection.execute(statement).rowcount for statement in statements)
