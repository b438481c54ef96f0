"""One write to a map that Milvus searches."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from core.ledger.maps.connection import MapConnection
from core.ledger.maps.places import StoredPlace, tokens_of, whereabouts_of
from core.ledger.maps.record import MapState
from core.milvus.collection import Collection, Entity
from core.postgres import rows
from core.postgres.writing import PostgresWrite


class MilvusWrite(PostgresWrite):
    """Gives Milvus an entity of each place that is new, or has changed in anything by which it is searched.

    Args:
        rebuilding: whether entities may go to another collection than the one that has the map's so far.
    """

    def __init__(
        self, connection: MapConnection, state: MapState, collection: Collection, rebuilding: bool = False
    ) -> None:
        super().__init__(connection, state)
        self._collection, self._rebuilding = collection, rebuilding
        self._entities: dict[int, StoredPlace] = {}  # the places that need one, by their numbers

    def _prepared(self, stored: StoredPlace, before: StoredPlace | None, searched: bool) -> StoredPlace:
        waiting = self._entities.get(stored.number)
        if waiting is None and not searched:
            return stored
        if waiting is None:
            if before is not None and before.key is not None:
                rows.leave_key(self.connection, before.key)
            stored = replace(stored, key=rows.new_key(self._connection))
        self._entities[stored.number] = stored
        return stored

    def _let_go(self, stored: StoredPlace) -> None:
        super()._let_go(stored)
        waiting = self._entities.get(stored.number)
        if waiting is not None and waiting.row == stored.row:
            del self._entities[stored.number]  # the place is forgotten
        elif waiting is None and stored.key is not None:
            rows.leave_key(self.connection, stored.key)

    def renew_entity(self, stored: StoredPlace) -> None:
        """Give Milvus the entity of a place again."""
        if stored.number not in self._entities:
            self._put(stored, stored)

    def move(self) -> None:
        """Note that all entities of the map are in Milvus's present collection."""
        self.state = replace(self.state, collection=self._collection.id)

    def _index(self) -> None:
        if not self._entities:
            return
        if not self._rebuilding:
            self._collection.expect(self.state.collection)
            self.state = replace(self.state, collection=self._collection.id)
        self._collection.insert(self.state.number, self._made(list(self._entities.values())))

    def _made(self, places: Sequence[StoredPlace]) -> list[Entity]:
        stored = self._stored_at([place.row for place in places])
        descriptors = self._form.descriptors([stored[place.row][0] for place in places])
        return [
            Entity(
                place.key or 0, place.row, descriptor, whereabouts_of([place]), place.place.camera,
                tokens_of(place.place.metadata),
            )
            for place, descriptor in zip(places, descriptors, strict=True)
        ]  # fmt: skip
