"""A plan of a map: where all its places are, as columns of JSON, which SQLite writes without an object for each."""

from __future__ import annotations

import json
import sqlite3
from collections.abc import Callable
from contextlib import AbstractContextManager

from core.maps.store import HANDED_OVER, HAS_PICTURE

# Metres to the millimetre, degrees of position to a centimetre on the ground.
_OPTIONAL = {
    "x": "round(x, 3)",
    "y": "round(y, 3)",
    "z": "round(z, 3)",
    "latitude": "round(latitude, 7)",
    "longitude": "round(longitude, 7)",
    "heading": "round(heading, 2)",
    "timestamp": "CAST(round((julianday(timestamp) - 2440587.5) * 86400000) AS INTEGER)",
}
_NAMES = (
    "SELECT code, name, row_number() OVER (ORDER BY name) - 1 AS position FROM sequences"
    " WHERE name IS NOT NULL AND EXISTS (SELECT 1 FROM places WHERE sequence = code)"
)
_COLUMNS = (
    "SELECT json_group_array(id), json_group_array(position), json_group_array(flags),"
    f" {', '.join(f'count({name}), json_group_array({value})' for name, value in _OPTIONAL.items())}"
    f" FROM (SELECT p.id, {', '.join(f'p.{name}' for name in _OPTIONAL)}, coalesce(n.position, -1) AS position,"
    f" (p.pose_of IS NOT NULL) * {HANDED_OVER} + (p.picture != 'none') * {HAS_PICTURE} AS flags"
    f" FROM places p LEFT JOIN ({_NAMES}) n ON n.code = p.sequence"
    " WHERE (p.number - 1) % ? = 0 ORDER BY p.number)"
)


class Plan:
    """Reads the plan of one map (:class:`core.maps.store.Plan`).  Any thread may use it.

    Args:
        reading: opens a connection to the map's database; the method may raise what it raises.
    """

    def __init__(self, reading: Callable[[], AbstractContextManager[sqlite3.Connection]]) -> None:
        self._reading = reading

    def columns(self, step: int = 1) -> str:
        with self._reading() as connection:
            connection.execute("BEGIN")  # both queries see the same moment
            try:
                names = connection.execute(f"SELECT name FROM ({_NAMES}) ORDER BY position").fetchall()
                ids, sequence, flags, *optional = connection.execute(_COLUMNS, (step,)).fetchone()
            finally:
                connection.execute("COMMIT")
        columns = {"sequences": json.dumps([name for (name,) in names]), "ids": ids, "sequence": sequence}
        for name, count, values in zip(_OPTIONAL, optional[::2], optional[1::2], strict=True):
            columns[name] = values if count else "null"
        columns["flags"] = flags
        return ",".join(f'"{name}":{values}' for name, values in columns.items())
