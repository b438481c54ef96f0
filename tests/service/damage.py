"""Damage to the file of a map."""

from __future__ import annotations

import sqlite3
from contextlib import closing
from pathlib import Path


def damage(data: Path, map_id: str) -> None:
    """Change one byte of the descriptor of a map's first frame; no service may be using the data directory."""
    with closing(sqlite3.connect(data / "maps" / map_id / "map.sqlite")) as driver, driver:
        row, content = driver.execute("SELECT row, bytes FROM descriptors ORDER BY row LIMIT 1").fetchone()
        changed = bytes([content[0] ^ 1]) + content[1:]
        driver.execute("UPDATE descriptors SET bytes = ? WHERE row = ?", (changed, row))
