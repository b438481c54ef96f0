"""Looking up the sequences of a map by name and its rows by metadata, for filtered searches."""

from __future__ import annotations

import json
import sqlite3
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager

import numpy as np
from numpy.typing import NDArray

from core.maps.place_filter import Scalar

FEW = 5000
"""Up to this number, rows are looked up one by one, which is faster than reading all rows with a value."""

# A value "f" that is looked for, and a value "v" of a place that is equal.
WANTED = (
    " v.key = f.key AND v.kind = CASE f.type WHEN 'true' THEN 'boolean' WHEN 'false' THEN 'boolean'"
    " WHEN 'integer' THEN 'number' WHEN 'real' THEN 'number' ELSE f.type END AND v.value = coalesce(f.atom, 0)"
)
# All rows as one text: a Python object for each takes several times as long.
_ALL = f"SELECT group_concat(v.row) FROM json_each(?) f JOIN place_values v ON{WANTED}"
_AMONG = (
    "SELECT group_concat(v.row) FROM json_each(?) f CROSS JOIN json_each(?) r CROSS JOIN place_values v"
    f" ON{WANTED} AND v.row = r.value"
)


class Attributes:
    """Looks up sequences and rows in the database of one map.  Any thread may use it.

    Args:
        reading: opens a connection to the map's database; every method may raise what it raises.
    """

    def __init__(self, reading: Callable[[], AbstractContextManager[sqlite3.Connection]]) -> None:
        self._reading = reading

    def sequence_codes(self, names: Sequence[str]) -> dict[str, int]:
        """The codes of sequences (``Whereabouts.sequence``) by name; names that do not exist are left out."""
        query = "SELECT name, code FROM sequences WHERE name IN (SELECT value FROM json_each(?))"
        with self._reading() as connection:
            return dict(connection.execute(query, (json.dumps(list(names)),)).fetchall())

    def oldest_of_last(self, sequence: int, frames: int) -> int | None:
        """The smallest ordinal among the ``frames`` places of a sequence enrolled last; None if it has no places."""
        query = "SELECT min(ordinal) FROM (SELECT ordinal FROM places WHERE sequence = ? ORDER BY number DESC LIMIT ?)"
        with self._reading() as connection:
            (ordinal,) = connection.execute(query, (sequence, frames)).fetchone()
        return None if ordinal is None else int(ordinal)

    def rows_with(self, metadata: Mapping[str, Scalar], among: NDArray[np.int64] | None = None) -> NDArray[np.int64]:
        """Rows of the places whose metadata has these values under these keys: int64 [n], ascending.

        Numbers are compared as numbers (1 equals 1.0), and true is not 1.  Only values at the top level are found, and
        only text of at most ``schema.LONGEST_INDEXED`` characters.

        Args:
            metadata: at least one key with its value.
            among: the rows to choose from; None: all.
        """
        found = None if among is None else np.unique(among)
        with self._reading() as connection:
            for key, value in metadata.items():
                query, values = _ALL, [json.dumps({key: value})]
                if found is not None and len(found) <= FEW:
                    query, values = _AMONG, [*values, json.dumps(found.tolist())]
                (text,) = connection.execute(query, values).fetchone()
                rows = np.fromstring(text or "", np.int64, sep=",")
                rows = rows if np.all(rows[1:] > rows[:-1]) else np.unique(rows)  # the index has them in order
                found = rows if found is None else np.intersect1d(found, rows, assume_unique=True)
        assert found is not None
        return found
