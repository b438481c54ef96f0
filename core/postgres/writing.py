"""One write to a map in PostgreSQL."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from core.ledger.maps.connection import MapConnection
from core.ledger.maps.places import StoredPlace
from core.ledger.maps.record import MapState
from core.ledger.maps.writing import Descriptors, Write
from core.maps.records import Enrolment
from core.postgres import rows
from core.postgres.forms import Form


class PostgresWrite(Write):
    """A write whose descriptors, pictures and keypoints are rows of PostgreSQL."""

    def __init__(self, connection: MapConnection, state: MapState) -> None:
        super().__init__(connection, state)
        self._form = Form(state.record)
        self._new: dict[int, tuple[bytes, bytes]] = {}  # descriptors by row, in stored form

    def expect(self, count: int) -> None:
        """Do nothing: no room has to be allocated."""

    def _add_descriptors(self, row: int, item: Enrolment) -> int:
        self._new[row] = self._form.packed(item.descriptor, item.local)
        return 0

    def add_stored(self, frame: NDArray[np.void]) -> int:
        """Take the next row's descriptors as an export file has them; returns 0, for they have no checksum."""
        self._new[self.state.rows] = self._form.divided(frame.tobytes())
        self.state = replace(self.state, rows=self.state.rows + 1)
        return 0

    def _stored_at(self, some: Sequence[int]) -> dict[int, tuple[bytes, bytes]]:
        """The descriptors of rows in stored form, those of this write included."""
        new = {row: self._new[row] for row in some if row in self._new}
        old = [row for row in some if row not in new]
        return new | rows.both_at(self.connection, old) if old else new

    def _descriptors_at(self, some: Sequence[int]) -> list[Descriptors]:
        stored = self._stored_at(some)
        descriptors = self._form.descriptors([stored[row][0] for row in some])
        return list(zip(descriptors, self._form.locals([stored[row][1] for row in some]), strict=True))

    def _let_go(self, stored: StoredPlace) -> None:
        rows.leave_row(self.connection, stored.row, self._revision)

    def _note(self, stored: StoredPlace) -> None:
        """Do nothing: PostgreSQL has the place."""

    def _finish(self) -> None:
        """Store descriptors and the stamp, and give an engine what is new, before the COMMIT that makes it count."""
        rows.put_descriptors(self.connection, self._new, self._made_codes())
        if self.state != self._before:
            rows.note_revision(self.connection, self.state.revision, self.state.stamp)
        self._index()

    def _made_codes(self) -> dict[int, bytes]:
        """The codes of new rows, if the engine has any."""
        return {}

    def _index(self) -> None:
        """Give an engine what is new, before the COMMIT."""
