"""Copying places from one map to another with their history, and deleting many places at once."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import AbstractContextManager
from typing import Protocol

from core.maps.records import Enrolment, History, Outline
from core.places import Place


class Transfer(Protocol):
    """Reads, copies and deletes many places of one map at once.  Any thread may use it."""

    def outline(self, looks: bool = False) -> list[Outline]:
        """All places in the order of their enrolment.

        Args:
            looks: their looks as well, each behind its place.
        """

    def count_without_image(self) -> int:
        """How many places and looks keep no original image."""

    def sequence_ends(self) -> dict[str | None, int]:
        """The ordinal that the next place of each sequence will get; the key None is for places without a sequence."""

    def find(self, place_ids: Sequence[str]) -> dict[str, tuple[Place, int]]:
        """Places by id, each with its descriptor row; ids that do not exist are left out.

        Of the address of a look it is its place, with the camera, the time and the picture of its own frame.
        """

    def adopt(self, items: Sequence[tuple[Enrolment, History]]) -> list[str]:
        """Store places of another map with their history, all of them or, if this raises, none.

        Returns:
            The addresses of the looks that were left out, because their places are gone or cannot have them.

        Raises:
            ValueError: a descriptor is of the wrong kind.
            InvalidField, StorageFull, StorageFailure.
        """

    def forget(self, frames: Mapping[str, bytes]) -> int:
        """Delete places in one write, except those that show another frame by now.

        Args:
            frames: by the id of each place, the SHA-256 of its image.

        Returns:
            How many were deleted.
        """

    def paused_writes(self) -> AbstractContextManager[None]:
        """Nobody but this thread writes to the map during the block."""
