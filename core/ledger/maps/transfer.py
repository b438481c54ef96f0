"""Copying places from one map to another with their history, and deleting many places at once."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager

from core.ledger.maps import places, sequences
from core.ledger.maps.connection import Reading
from core.ledger.maps.writing import Write
from core.maps.records import Enrolment, History, Outline
from core.places import Place


class Transfer:
    """Reads, copies and deletes many places of one map at once.

    Any thread may use it.  Every method may raise what ``reading`` and ``writing`` raise.

    Args:
        reading, writing: begin a transaction that reads the map, and a write to it.
        paused_writes: keeps others from writing.
    """

    def __init__(
        self,
        reading: Reading,
        writing: Callable[[], AbstractContextManager[Write]],
        paused_writes: Callable[[], AbstractContextManager[None]],
    ) -> None:
        self._reading, self._writing, self.paused_writes = reading, writing, paused_writes

    def outline(self, looks: bool = False) -> list[Outline]:
        """All places in the order of their enrolment.

        Args:
            looks: their looks as well, each behind its place.
        """
        with self._reading() as connection:
            return places.outlines(connection, looks)

    def count_without_image(self) -> int:
        """How many places and looks keep no original image."""
        with self._reading() as connection:
            return places.count_without_image(connection)

    def sequence_ends(self) -> dict[str | None, int]:
        """The ordinal that the next place of each sequence will get; the key None is for places without a sequence."""
        with self._reading() as connection:
            return sequences.ends(connection)

    def find(self, place_ids: Sequence[str]) -> dict[str, tuple[Place, int]]:
        """Places by id, each with its descriptor row; ids that do not exist are left out.

        Of the address of a look it is its place, with the camera, the time and the picture of its own frame.
        """
        with self._reading() as connection:
            found = places.of_ids(connection, place_ids)
        return {place_id: (stored.of_frame(), stored.row) for place_id, stored in found.items()}

    def adopt(self, items: Sequence[tuple[Enrolment, History]]) -> list[str]:
        """Store places of another map with their history, all of them or, if this raises, none.

        Returns:
            The addresses of the looks that were left out, because their places are gone or cannot have them.

        Raises:
            ValueError: a descriptor is of the wrong kind.
            InvalidField, StorageFull, StorageFailure.
        """
        if not items:
            return []
        with self._writing() as write:
            return [item.id for item, history in items if not write.adopt(item, history)]

    def forget(self, frames: Mapping[str, bytes]) -> int:
        """Delete places in one write, except those that show another frame by now.

        Args:
            frames: by the id of each place, the SHA-256 of its image.

        Returns:
            How many were deleted.
        """
        if not frames:
            return 0
        with self._writing() as write:
            found = places.of_ids(write.connection, list(frames))
            going = [stored for place_id, stored in found.items() if stored.digest == frames[place_id]]
            going.sort(key=lambda stored: stored.look_of is None)  # a place takes its looks along
            for stored in going:
                write.forget(stored)
        return len(going)
