"""Maps whose vectors are in memory, so that all that is in a ledger can be tested in either database."""

from __future__ import annotations

import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from datetime import UTC, datetime
from typing import Any

import numpy as np
from sqlalchemy import bindparam, select

from core.ledger import Ledger, Statement
from core.ledger.maps import frames, record
from core.ledger.maps.connection import MapConnection
from core.ledger.maps.map import LedgerMap
from core.ledger.maps.places import StoredPlace
from core.ledger.maps.record import MapState
from core.ledger.maps.schema import MAPS, METADATA
from core.ledger.maps.writing import Descriptors, Write
from core.maps.records import Enrolment, MapRecord
from tests.core.store.frames import DIMENSION, ENCODER, LOCAL_SHAPE

_CONTENT = {
    name: Statement(select(table).where((table.c.number if table is MAPS else table.c.map) == bindparam("map")))
    for name, table in METADATA.tables.items()
}

MOMENT = datetime(2026, 11, 20, 10, tzinfo=UTC)


def record_of(name: str, **changes: Any) -> MapRecord:
    """The record of a new map."""
    cells, values = LOCAL_SHAPE
    made = {
        "id": name, "encoder": ENCODER, "dimension": DIMENSION, "local_cells": cells, "local_values": values,
        "precision": "half", "revision": 1, "created_at": MOMENT, "updated_at": MOMENT,
    }  # fmt: skip
    return MapRecord.model_validate({**made, **changes})


class MemoryWrite(Write):
    """A write whose descriptors go into a dictionary by row when it is finished."""

    def __init__(self, connection: MapConnection, state: MapState, vectors: dict[int, Descriptors]) -> None:
        super().__init__(connection, state)
        self._vectors = vectors
        self._new: dict[int, Descriptors] = {}

    def expect(self, count: int) -> None:
        pass

    def _add_descriptors(self, row: int, item: Enrolment) -> int:
        self._new[row] = (np.asarray(item.descriptor, np.float32), item.local)
        return row + 1

    def _descriptors_at(self, rows: Sequence[int]) -> list[Descriptors]:
        return [self._new[row] if row in self._new else self._vectors[row] for row in rows]

    def _let_go(self, stored: StoredPlace) -> None:
        frames.delete_frames(self.connection, [stored.row])

    def _note(self, stored: StoredPlace) -> None:
        pass

    def _finish(self) -> None:
        self._vectors.update(self._new)


class MemoryMap(LedgerMap):
    """A map in a ledger, with its vectors in memory."""

    def __init__(self, ledger: Ledger, name: str, **changes: Any) -> None:
        super().__init__()
        self.ledger, self.vectors = ledger, dict[int, Descriptors]()
        self._writes = threading.RLock()
        with ledger.transaction("make a map") as connection:
            self.number = record.create(connection, record_of(name, **changes))

    def now(self) -> MapState:
        """The state of the map."""
        with self._reading() as connection:
            return record.state_of(connection, "gone")

    def content(self) -> dict[str, list[Any]]:
        """All rows of the map by table, in any order that is always the same."""
        with self._reading() as connection:
            return {name: sorted(connection.execute(query), key=repr) for name, query in _CONTENT.items()}

    @property
    def record(self) -> MapRecord:
        return self.now().record

    @property
    def state(self) -> object:
        return self.now().revision

    @contextmanager
    def _reading(self) -> Iterator[MapConnection]:
        with self.ledger.transaction("read") as connection:
            yield MapConnection(connection, self.number)

    @contextmanager
    def _writing(self) -> Iterator[MemoryWrite]:
        with self._writes, self.ledger.transaction("write") as connection:
            of_map = MapConnection(connection, self.number)
            write = MemoryWrite(of_map, record.state_of(of_map, "gone", locked=True), self.vectors)
            yield write
            write.finish()

    @contextmanager
    def paused_writes(self) -> Iterator[None]:
        with self._writes:
            yield
