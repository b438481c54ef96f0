"""Copying places from one map to another with their history, and deleting many places at once."""

from __future__ import annotations

import sqlite3
import threading
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager

from core.maps.records import Enrolment, History, Outline
from core.places import Place
from core.storage.cameras import Access
from core.storage.database import ledger
from core.storage.writing import Write

_OUTLINE = (
    "SELECT p.number, p.id, p.row, p.digest, p.picture, p.camera, s.name, p.ordinal, p.updated_at"
    " FROM places p JOIN sequences s ON s.code = p.sequence ORDER BY p.number"
)


class Transfer:
    """Reads, copies and deletes many places of one map at once (:class:`core.maps.transfer.Transfer`).

    Any thread may use it.  Every method may raise what ``reading`` and ``writing`` raise.

    Args:
        reading, writing: open a connection to the map's database, and begin a write to the map.
        lock: is held during every write to the map.
    """

    def __init__(self, reading: Access[sqlite3.Connection], writing: Access[Write], lock: threading.RLock) -> None:
        self._reading, self._writing, self._lock = reading, writing, lock

    def outline(self) -> list[Outline]:
        with self._reading() as connection:
            return [Outline(*values) for values in connection.execute(_OUTLINE).fetchall()]

    def count_without_image(self) -> int:
        with self._reading() as connection:
            (count,) = connection.execute("SELECT count(*) FROM places WHERE picture != 'image'").fetchone()
        return int(count)

    def sequence_ends(self) -> dict[str | None, int]:
        with self._reading() as connection:
            return dict(connection.execute("SELECT name, next_ordinal FROM sequences").fetchall())

    def find(self, place_ids: Sequence[str]) -> dict[str, tuple[Place, int]]:
        with self._reading() as connection:
            found = [ledger.find(connection, place_id) for place_id in place_ids]
        return {stored.place.id: (stored.place, stored.row) for stored in found if stored is not None}

    def adopt(self, items: Sequence[tuple[Enrolment, History]]) -> None:
        if items:
            with self._writing() as write:
                write.expect(len(items))
                for item, history in items:
                    write.adopt(item, history)

    def forget(self, frames: Mapping[str, bytes]) -> int:
        if not frames:
            return 0
        count = 0
        with self._writing() as write:
            for place_id, digest in frames.items():
                stored = ledger.find(write.connection, place_id)
                if stored is not None and stored.digest == digest:
                    write.forget(stored)
                    count += 1
        return count

    @contextmanager
    def paused_writes(self) -> Iterator[None]:
        with self._lock:
            yield
