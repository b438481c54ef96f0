"""Copying places from one map to another with their history, and deleting many places at once."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager

from core.maps.place_filter import EVERY_PLACE, PlaceFilter
from core.maps.records import Enrolment, History, Outline
from core.milvus import ledger
from core.milvus.parts.cameras import Access
from core.milvus.writing import Write
from core.places import Place


class MilvusTransfer:
    """Reads, copies and deletes many places of one map at once (:class:`core.maps.transfer.Transfer`).

    Args:
        map_number: of the map.
        reading, writing: begin a transaction that reads the map, and a write to it.
        paused_writes: keeps others from writing.
    """

    def __init__(
        self,
        map_number: int,
        reading: Access,
        writing: Callable[[], AbstractContextManager[Write]],
        paused_writes: Callable[[], AbstractContextManager[None]],
    ) -> None:
        self._map, self._reading, self._writing = map_number, reading, writing
        self.paused_writes = paused_writes

    def outline(self) -> list[Outline]:
        with self._reading() as connection:
            entries = ledger.entries_after(connection, self._map, -1, None, EVERY_PLACE)
        return [entry.outline() for entry in entries]

    def count_without_image(self) -> int:
        with self._reading() as connection:
            return ledger.count_without_image(connection, self._map)

    def sequence_ends(self) -> dict[str | None, int]:
        with self._reading() as connection:
            return ledger.sequence_ends(connection, self._map)

    def find(self, place_ids: Sequence[str]) -> dict[str, tuple[Place, int]]:
        with self._reading() as connection:
            found = ledger.entries_by(connection, self._map, "id", place_ids)
        return {entry.place.id: (entry.place, entry.row) for entry in found}

    def adopt(self, items: Sequence[tuple[Enrolment, History]]) -> None:
        if items:
            with self._writing() as write:
                for item, history in items:
                    write.adopt(item, history)

    def forget(self, frames: Mapping[str, bytes]) -> int:
        if not frames:
            return 0
        count = 0
        with self._writing() as write:
            for entry in write.all_of(PlaceFilter(ids=tuple(frames)), None):
                if entry.digest == frames[entry.place.id]:
                    write.forget(entry)
                    count += 1
        return count
