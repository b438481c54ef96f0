"""One write to a map in PostgreSQL."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from core.ledger.maps.connection import MapConnection
from core.ledger.maps.frames import StoredPicture
from core.ledger.maps.places import StoredPlace
from core.ledger.maps.record import MapState
from core.ledger.maps.writing import Descriptors, Write
from core.maps.records import Enrolment
from core.postgres import rows
from core.postgres.forms import Form
from core.postgres.pictures.stored import new_object

if TYPE_CHECKING:
    from core.postgres.pictures.objects import Objects


class PostgresWrite(Write):
    """A write whose descriptors, pictures and keypoints are rows of PostgreSQL.

    Args:
        objects: where pictures are put; None: in PostgreSQL.
    """

    def __init__(self, connection: MapConnection, state: MapState, objects: Objects | None) -> None:
        super().__init__(connection, state)
        self._objects, self._form = objects, Form(state.record)
        self._new: dict[int, tuple[bytes, bytes]] = {}  # descriptors by row, in stored form
        self._pictures: dict[str, bytes] = {}  # by the names of their objects
        self._object_key: tuple[str, int] | None = None

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

    def picture_to_store(self, picture: bytes) -> StoredPicture:
        """A picture as its row has it; an object is stored at the end of the write."""
        if self._objects is None:
            return picture
        if self._object_key is None:
            self._object_key = rows.new_object_key(self._connection)
        made = new_object(*self._object_key, picture)
        self._pictures[made.name] = picture
        return made

    def _finish(self) -> None:
        """Store descriptors, and give the object store what is new, before the COMMIT that makes it count.

        Raises:
            StorageFull, StorageFailure: one of them refuses; nothing counts of what they may have taken.
        """
        rows.put_descriptors(self.connection, self._new, self._made_codes())
        if self.state != self._before:
            rows.note_revision(self.connection, self.state.revision, self.state.stamp)
        if self._objects is None or not self._pictures:
            self._index()
            return
        try:
            self._objects.put(self._pictures)
            self._index()
        except BaseException:
            self._objects.discard(list(self._pictures))
            raise

    def _made_codes(self) -> dict[int, bytes]:
        """The codes of new rows, if the engine has any."""
        return {}

    def _index(self) -> None:
        """Give an engine what is new, before the COMMIT."""
