"""One map in PostgreSQL, searched by FAISS in the memory of each service."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import nullcontext

from core.geometry.keypoints import Keypoints, keypoints_of
from core.index import Coder
from core.ledger.maps import frames
from core.ledger.maps.connection import MapConnection
from core.ledger.maps.record import MapState
from core.ledger.postgres import PostgresLedger
from core.maps.records import COMPACT_FROM
from core.maps.selection import Selection
from core.maps.status import IndexStatus, Progress, no_progress
from core.postgres import rows
from core.postgres.forms import Form
from core.postgres.map import PostgresMap
from core.postgres.search.cache import RowCache
from core.postgres.search.following import DESCRIPTORS_AT_ONCE, FollowedMap, tier_of
from core.postgres.writing import PostgresWrite
from core.storage.search.scopes import Chooser
from core.storage.search.snapshot import SearchScope, Snapshot
from core.storage.search.tiers import tier_for, unopened


class CodedWrite(PostgresWrite):
    """A write that stores the codes of its rows."""

    def _made_codes(self) -> dict[int, bytes]:
        if not self._new:
            return {}
        descriptors = self._form.descriptors([descriptor for descriptor, _ in self._new.values()])
        codes = Coder.of(self.record.dimension).encode(descriptors)
        return {row: code.tobytes() for row, code in zip(self._new, codes, strict=True)}


class CodedMap(PostgresMap):
    """The places of one environment (:class:`core.maps.store.Map`).

    Args:
        cache: of rows of all maps.
        Others: as of :class:`core.postgres.map.PostgresMap`.
    """

    def __init__(self, database: PostgresLedger, state: MapState, cache: RowCache) -> None:
        super().__init__(database, state)
        self._cache = cache
        self._followed = FollowedMap(database, cache, state.number)

    @property
    def held(self) -> bool:
        """False: a query asks PostgreSQL for the revision."""
        return False

    def snapshot(self) -> Snapshot:
        """All places at this moment, for searching; later writes do not change the snapshot."""
        if (held := self._followed.as_of(self.latest())) is not None:
            return held.snapshot
        with self.viewing() as (connection, state):
            return self._followed.up_to_date(connection, state).snapshot

    def scope(self, selection: Selection | None = None) -> SearchScope:
        if not selection:
            return SearchScope(self.snapshot())
        with self.viewing() as (connection, state):
            snapshot = self._followed.up_to_date(connection, state).snapshot
            return Chooser(snapshot, lambda: nullcontext(connection)).scope(selection)

    def keypoints_at(self, wanted: Sequence[int]) -> list[Keypoints | None]:
        held = self._followed.held
        if held is None:
            return super().keypoints_at(wanted)
        keys = {int(row): (held.source.generation, "keypoints", int(row)) for row in wanted}
        cached = self._cache.get(list(keys.values()))
        found = {row: keypoints_of(cached[key]) for row, key in keys.items() if key in cached}
        if missing := [row for row in keys if row not in found]:
            with self._glancing() as connection:
                read = frames.keypoints_at(connection, missing)
            self._cache.put({keys[row]: one.record() for row, one in read.items()})
            found |= read
        return [found.get(int(row)) for row in wanted]

    def index_status(self) -> IndexStatus:
        """How the map is searched; a map of few places is read for that."""
        held = self._followed.held
        if held is None and self._state.searched >= COMPACT_FROM:
            return unopened(self.record.index, self._state.searched)
        snapshot = self.snapshot() if held is None or self._state.searched < COMPACT_FROM else held.snapshot
        return IndexStatus(
            setting=self.record.index,
            tier=tier_of(snapshot),
            wanted=tier_for(self.record.index, len(snapshot), tier_of(snapshot)),
            state="ready",
            progress=1,
            rows_indexed=snapshot.coded,
            recall=None,
            bytes_in_memory=snapshot.memory,
        )

    def rebuild_index(self, progress: Progress = no_progress) -> IndexStatus:
        """Compute the codes of all rows again, and store them; searches use the present ones meanwhile.

        Args:
            progress: called with the number of rows done and of all; its exceptions end the work, and the part done
                until then stays.
        """
        coder, form = Coder.of(self.record.dimension), Form(self.record)
        total = self.snapshot().rows
        for first in range(0, total, DESCRIPTORS_AT_ONCE):
            with self.writing() as write:
                some = range(first, min(total, first + DESCRIPTORS_AT_ONCE))
                stored = rows.descriptors_at(write.connection, some)
                if stored:
                    codes = coder.encode(form.descriptors(list(stored.values())))
                    rows.put_codes(write.connection, dict(zip(stored, map(bytes, codes), strict=True)))
            progress(min(total, first + DESCRIPTORS_AT_ONCE), total)
        self._followed = FollowedMap(self.database, self._cache, self.number)
        self.snapshot()
        return self.index_status()

    def _write(self, connection: MapConnection, state: MapState) -> CodedWrite:
        return CodedWrite(connection, state)
