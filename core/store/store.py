"""Maps by id, whatever database keeps them."""

from __future__ import annotations

import logging
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager
from typing import TYPE_CHECKING

from core.errors import StoreUnavailable
from core.maps.archives.reading import Archive
from core.maps.archives.unpacking import check_sizes
from core.maps.enrolling import CheckDescriptors, any_descriptors
from core.maps.forms import HALF, NO_LOCAL, Form
from core.maps.records import MapRecord, MapSettings, Precision, VerifyReport
from core.maps.status import Progress, no_progress
from core.places import check_map_id
from core.store.following import uid_of
from core.store.importing import Importing
from core.store.map import Map

if TYPE_CHECKING:
    from core.index.milvus import Milvus

log = logging.getLogger(__name__)


class Store(ABC):
    """Maps by id.  Any thread may call any method.

    milvus: has the codes of large maps; None: memory has those of all.
    """

    milvus: Milvus | None

    def _drop_codes(self, gone: MapRecord) -> None:
        """Have Milvus drop the codes of a map that was deleted; if it cannot be reached, they are of no use there."""
        if self.milvus is not None:
            try:
                self.milvus.drop(lambda uid: uid == uid_of(gone))
            except StoreUnavailable as error:
                log.warning("Milvus keeps the codes of map %s, which was deleted: %s", gone.id, error)

    def create(
        self,
        map_id: str,
        encoder_identity: str,
        dimension: int,
        settings: MapSettings | None = None,
        local_shape: tuple[int, int] = NO_LOCAL,
        unlisted: bool = False,
        precision: Precision = HALF,
    ) -> Map:
        """Make an empty map for the descriptors of one encoder; it is durable when this returns.

        Args:
            dimension, local_shape: of the encoder's descriptors, D and (C, L).
            unlisted: only :meth:`unlisted` finds the map, also after a restart, until it is published.
            precision: how its descriptors are stored; this cannot be changed later.

        Raises:
            InvalidIdentifier: the id is malformed.
            MapExists: the id is taken, possibly by a damaged map.
            ValueError: descriptors that nothing can hold.
            StorageFull, StorageFailure.
        """
        check_map_id(map_id)
        Form(precision, dimension, local_shape)
        return self._make(
            MapRecord.new(map_id, encoder_identity, dimension, local_shape, precision, settings), unlisted
        )

    def import_map(
        self,
        archive: Archive,
        map_id: str,
        advance: Callable[[int, int], None],
        check_picture: Callable[[bytes], None],
        most_picture_bytes: int,
        before_listing: Callable[[int], None],
        check_descriptors: CheckDescriptors = any_descriptors,
    ) -> None:
        """Make a map of an export file; it is listed, and durable, when this returns, and not before.

        Args:
            map_id: of the new map; it may differ from that in the file.
            advance: called with the number of places done and of all; its exceptions end the work.
            check_picture: raises InvalidImage for bytes that must not be shown as a picture.
            most_picture_bytes: a larger picture is refused before it is read.
            before_listing: called with the number of places, their looks apart, when the map is complete; its
                exceptions end the work.
            check_descriptors: says which descriptors the map's encoder can have given.

        Raises:
            InvalidArchive: the file is damaged, or its content is not valid for a map.
            InvalidIdentifier, MapExists, StorageFull, StorageFailure: nothing of the map is left.
        """
        check_map_id(map_id)
        check_sizes(archive.manifest)
        made = MapRecord.model_validate({**archive.manifest.map.model_dump(), "id": map_id})
        with self._building(made) as map_:
            importing = Importing(
                archive, advance, check_picture, most_picture_bytes, map_.writing, map_.review, check_descriptors
            )
            importing.fill()
            before_listing(importing.places)

    @abstractmethod
    def _make(self, made: MapRecord, unlisted: bool) -> Map:
        """Make an empty map, durably."""

    @abstractmethod
    def _building(self, made: MapRecord) -> AbstractContextManager[Map]:
        """A map that the block fills; it is listed, durably, when the block ends without an error, and else removed."""

    @abstractmethod
    def get(self, map_id: str) -> Map:
        """A map, ready for use.

        Raises:
            UnknownMap, MapQuarantined, StorageFailure.
        """

    @abstractmethod
    def find(self, map_id: str) -> Map:
        """A map whose record and number of places can be used; the rest may have to be read first.

        Raises:
            UnknownMap, MapQuarantined, StorageFailure.
        """

    @abstractmethod
    def opened(self, map_id: str) -> Map | None:
        """A map that is ready for use, if that is known without waiting; else None."""

    @abstractmethod
    def unlisted(self) -> Mapping[str, Map]:
        """The maps that are being built, by id."""

    @abstractmethod
    def abandoned(self) -> list[str]:
        """The ids of the unlisted maps that nobody builds unless a job of this service does.

        None of a store that several services use, which removes abandoned maps by itself.
        """

    @abstractmethod
    def publish(self, map_id: str) -> Map:
        """List a map that was being built and is now complete; durable when this returns.

        Raises:
            UnknownMap: no map of this id is being built.
            StorageFull, StorageFailure.
        """

    @abstractmethod
    def abandon(self, map_id: str) -> None:
        """Delete a map that was being built; nothing happens if there is none.

        Raises:
            StorageFull, StorageFailure: the map is still there.
        """

    @abstractmethod
    def quarantined(self) -> dict[str, str]:
        """Why maps are out of service, by id; this does not wait."""

    @abstractmethod
    def verify(self, map_id: str, progress: Progress = no_progress) -> VerifyReport:
        """Read all of a map again, whether it is in service or quarantined, and report what is damaged.

        Raises:
            UnknownMap, StorageFailure.
        """

    @abstractmethod
    def check_writable(self) -> None:
        """Raise unless maps could be read and written now.

        Raises:
            StorageFull, StorageFailure.
        """

    @property
    @abstractmethod
    def open_maps(self) -> int:
        """How many maps are open."""

    @abstractmethod
    def records(self, cursor: str | None, limit: int) -> tuple[list[MapRecord], str | None]:
        """A page of the maps' records by id, without quarantined maps, and the cursor of the next page.

        Raises:
            InvalidCursor.
        """

    @abstractmethod
    def delete(self, map_id: str) -> None:
        """Delete a map, which may be quarantined; the deletion is durable when this returns.

        Raises:
            UnknownMap, StorageFull, StorageFailure.
        """

    @abstractmethod
    def close(self) -> None:
        """Wait for the reads and writes under way, and refuse further ones."""
