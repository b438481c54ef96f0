"""The interfaces of a store of maps, of one of its maps, and of that map at one moment.

These are interfaces; :mod:`core.storage` implements them in a data directory.  Recognition knows nothing else of where
maps are stored, and ``docs/explanation/stores.md`` says why the interfaces are as they are.

Whatever stores it, a descriptor stands in a *row* of its map: a number that is given to one frame of one place and is
never used again.  A search returns rows.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from datetime import datetime
from pathlib import Path
from typing import Any, Protocol, overload

import numpy as np
from numpy.typing import NDArray

from core.geometry.keypoints import Keypoints
from core.maps.archives.reading import Archive
from core.maps.archives.writing import Advance, Expect, Exported
from core.maps.cameras import Cameras
from core.maps.counterparts import Counterparts
from core.maps.enrolling import CheckDescriptors, any_descriptors
from core.maps.place_filter import EVERY_PLACE, PlaceFilter
from core.maps.records import (
    Change,
    Enrolment,
    MapRecord,
    MapSettings,
    PicturedPlace,
    Precision,
    SameFrame,
    SequenceSummary,
    VerifyReport,
)
from core.maps.review import Review
from core.maps.selection import Selection
from core.maps.status import ErasureReport, IndexStatus, Progress, StorageStatus, no_progress
from core.maps.transfer import Transfer
from core.places import Look, Neighborhood, Place, PlaceFields, Whereabouts

Rows = NDArray[np.int64]

HANDED_OVER, HAS_PICTURE = 1, 2
"""Flags of a place in a plan: its pose is that of another place; a picture of its frame is stored."""

Ranking = tuple[Rows, NDArray[np.float32]]
"""Rows, best first, and their inner products."""


Reject = Callable[[int, Exception], None]
"""Is called with the position of an item of many and the reason why it is not taken; it may raise, to refuse all."""


def refuse_all(_position: int, error: Exception) -> None:
    """Refuse all items because of one."""
    raise error


def merged(a: Ranking, b: Ranking) -> Ranking:
    """The rows of two rankings of one map, best first."""
    rows, first = np.unique(np.concatenate([a[0], b[0]]), return_index=True)
    products = np.concatenate([a[1], b[1]])[first]
    order = np.argsort(-products, kind="stable")
    return rows[order], products[order]


class Scope(Protocol):
    """The places that a query may find, at one moment, and their prior before the frame is compared."""

    @property
    def snapshot(self) -> Snapshot:
        """The map at that moment."""

    def search(self, descriptors: NDArray[np.float32]) -> list[Ranking]:
        """Rank the places of the scope by inner product, equal ones by row (equation 3.12).

        Args:
            descriptors: the queries, float32 [B, D], finite.

        Returns:
            For each query rows, int64 [n], and their inner products, float32 [n], best first: of all places or, in a
            large map, of the best, and of the best of those that a prior favours.
        """

    def search_elsewhere(
        self, descriptor: NDArray[np.float32], ranking: Ranking, best: int, neighborhood: Neighborhood | None
    ) -> Ranking:
        """The best places of the scope that are not in a ranking and not the same place as the row ``best``.

        Args:
            descriptor: of the query, float32 [D].
            ranking: the result of :meth:`search` for it.
            neighborhood: which places are the same place; None: also the best places that are, unless the ranking has
                them.

        Returns:
            No rows if there are no such places.  Further frames of views that the ranking has may be left out.
        """

    def weights_at(self, rows: Rows) -> NDArray[np.float64] | None:
        """The log prior of rows that a search returned, float64 [n], at most 0; None if nothing speaks for places."""

    # For work on all places of a map; a query does not need it.

    def living_rows(self) -> Rows:
        """The rows of the places of the scope, int64 [n], ascending."""


class Snapshot(Protocol):
    """The places of a map at one moment.  Later writes do not change it; any thread may use it."""

    def __len__(self) -> int:
        """How many places there are."""

    def whereabouts_at(self, rows: Rows) -> Whereabouts:
        """Where and when the frames of some rows were taken, in the order of ``rows``."""

    def descriptors_at(self, rows: Rows) -> NDArray[np.float32]:
        """The descriptors of rows: float32 [k, D].

        Raises:
            UnknownPlace: the place of a row was deleted since, together with its data.
        """

    def locals_at(self, rows: Rows) -> NDArray[np.int8]:
        """The local descriptors of rows: int8 [k, C, L].

        Raises:
            UnknownPlace: the place of a row was deleted since, together with its data.
        """

    # For work on all places of a map, such as its calibration; a query needs none of these.

    @property
    def rows(self) -> int:
        """All rows are below this number."""

    @property
    def alive(self) -> NDArray[np.bool_]:
        """Whether each row belongs to a place: bool [rows]."""

    @property
    def whereabouts(self) -> Whereabouts:
        """Where and when the frames of all rows were taken, including rows that belong to no place."""

    def among(self, allowed: NDArray[np.bool_]) -> Scope:
        """The places of some rows, bool [rows], as a scope without a prior; only living rows count."""


class Exporter(Protocol):
    """Writes export files of one map.  Any thread may use it."""

    def state(self) -> object | None:
        """A value that is the same as long as nothing is written to the map; None where that is not known."""

    def write(
        self, path: Path, advance: Advance = lambda _written: None, expect: Expect = lambda _size: None
    ) -> Exported:
        """Write the present state of the map as a new file, which a crash may lose; nothing is left if this raises.

        Raises:
            UnknownMap, MapQuarantined: the map was deleted meanwhile, or is damaged.
            StorageFull, StorageFailure.
        """


class Plan(Protocol):
    """Reads the plan of one map: where all its places are.  Any thread may use it."""

    def columns(self, step: int = 1) -> str:
        """The places in the order of their enrolment as the members of a JSON object, without its braces.

        The members: ``sequences``, the names of the traverses; arrays with a value for each place: ``ids``,
        ``sequence`` (index into ``sequences``, -1 without one) and ``flags`` (:data:`HANDED_OVER`,
        :data:`HAS_PICTURE`); and ``x``, ``y``, ``z`` (metres), ``latitude``, ``longitude``, ``heading`` (degrees) and
        ``timestamp`` (milliseconds since 1970 UTC), each an array with null where a place has no value, or null if no
        place has one.

        Args:
            step: about one place in every ``step`` is listed.
        """


class Map(Protocol):
    """The places of one environment.  Any thread may call any method.

    A write that has returned is durable and seen by every later read and search; one that raises has changed nothing.
    Any method may raise MapQuarantined, StorageFailure and UnknownMap; methods that write may also raise StorageFull.
    """

    @property
    def record(self) -> MapRecord:
        """The map's record as of its last edit."""

    @property
    def cameras(self) -> Cameras:
        """The cameras of the map."""

    @property
    def transfer(self) -> Transfer:
        """Reads, copies and deletes many places at once."""

    @property
    def counterparts(self) -> Counterparts:
        """Where places have counterparts in other traverses."""

    @property
    def review(self) -> Review:
        """The frames that are stored to be reviewed."""

    @property
    def plan(self) -> Plan:
        """Where all places are."""

    @property
    def exporter(self) -> Exporter:
        """Writes the map as a file."""

    @property
    def is_open(self) -> bool:
        """Whether the map is ready for use; this does not wait."""

    @property
    def held(self) -> bool:
        """Whether a search of the map needs neither the disk nor another process; this does not wait."""

    @property
    def state(self) -> object:
        """A value that is the same until the map is written to."""

    def open(self) -> None:
        """Have the map ready for use."""

    # Searching

    def snapshot(self) -> Snapshot:
        """All places at this moment."""

    def scope(self, selection: Selection | None = None) -> Scope:
        """The places that a query may find at this moment; None: all."""

    def places_at(self, rows: Sequence[int]) -> list[Place | None]:
        """The places of rows that a search returned; None where a place was deleted or got another frame since.

        Of the row of a look it is its place, with the camera and the picture of the look, which it names.
        """

    def keypoints_at(self, rows: Sequence[int]) -> list[Keypoints | None]:
        """The keypoints of those places; None also where none are stored."""

    def glances_at(self, rows: Sequence[int]) -> NDArray[np.int8]:
        """The best keypoints of those places, int8 [n, 64, 64] (``core.geometry.matching``); zeros where are none."""

    def rows_of(self, place_ids: Sequence[str]) -> list[int | None]:
        """The rows of places; None where there is no such place."""

    # Reading

    def count_places(self) -> int:
        """How many places the map has; their looks do not count."""

    def place(self, place_id: str) -> Place:
        """One place.

        Raises:
            UnknownPlace.
        """

    def places(
        self, cursor: str | None, limit: int, wanted: PlaceFilter = EVERY_PLACE
    ) -> tuple[list[Place], str | None]:
        """A page of places in the order of their enrolment, and the cursor of the next page.

        Raises:
            InvalidCursor.
        """

    def ids_of(self, wanted: PlaceFilter, most: int) -> list[str]:
        """The ids of the places that fulfil some conditions, in the order of their enrolment.

        Raises:
            TooManyToDelete: there are more than ``most``.
        """

    def digest(self, place_id: str) -> bytes | None:
        """SHA-256 (32 bytes) of the image of a place; None if there is no such place."""

    def sequences(self, cursor: str | None, limit: int) -> tuple[list[SequenceSummary], str | None]:
        """A page of sequences by name, and the cursor of the next page.

        Raises:
            InvalidCursor.
        """

    def unknown_sequences(self, names: Sequence[str]) -> set[str]:
        """Those of the names that no sequence has."""

    def without_keypoints(self, after: int, limit: int) -> list[PicturedPlace]:
        """Places that keep their image or a thumbnail, and no keypoints or damaged ones.

        Args:
            after: the number of the last place of the page before; 0 for the first page.
            limit: how many places are listed at most; fewer if there are no further ones.
        """

    def picture(self, place_id: str) -> bytes | None:
        """The stored picture of a place's frame, as the place's ``picture`` says; None if it is gone or has none.

        Raises:
            StorageFailure: the picture is missing or damaged.
        """

    def thumbnail(self, place_id: str) -> bytes:
        """A small JPEG of a place.

        Raises:
            UnknownPlace: there is no such place.
            NoThumbnail: the map keeps no picture of it, or one that cannot be shown.
            StorageFailure: the picture is missing or damaged.
            MemoryError: its pixels do not fit into memory.
        """

    # How it is stored

    def index_status(self) -> IndexStatus:
        """How the map is searched; this does not wait."""

    def rebuild_index(self, progress: Progress = no_progress) -> IndexStatus:
        """Build the index again from the descriptors; searches use the present one meanwhile.

        Args:
            progress: called with the number of rows that are done and of all; if it raises, nothing changes.
        """

    def drop_pictures(self, before: datetime, most: int) -> int:
        """Delete the pictures of up to ``most`` places that were enrolled before a moment; returns how many there were.

        The places stay, and so do their keypoints.
        """

    def erase(self, progress: Progress = no_progress) -> ErasureReport:
        """Overwrite or remove what places that were deleted, and former frames, have left where the map is stored.

        Afterwards no file of the map has bytes of their pictures, descriptors or keypoints.  In PostgreSQL and Milvus
        the rows are gone, and it is theirs to use their room again.

        Args:
            progress: called with the number of rows done and of all; its exceptions end the work, which can be done
                again.

        Raises:
            MapBusy: what was deleted is still being read; try again.
        """

    def storage_status(self) -> StorageStatus:
        """How much room the map takes."""

    # Writing

    @overload
    def enrol(self, items: Sequence[Enrolment]) -> Sequence[tuple[Place, Change]]: ...

    @overload
    def enrol(
        self, items: Sequence[Enrolment | SameFrame], reject: Reject = ...
    ) -> Sequence[tuple[Place, Change] | None]: ...

    def enrol(
        self, items: Sequence[Enrolment | SameFrame], reject: Reject = refuse_all
    ) -> Sequence[tuple[Place, Change] | None]:
        """Store frames as places, or as looks of places, in the order given, all of them or, if this raises, none.

        An id that exists keeps its place and creation time: if the frame's digest is the same, only its fields are
        stored (``unchanged``, ``updated``), otherwise its frame is ``replaced``, and the looks that the place learnt
        from runs are gone.  An id may occur twice.

        Args:
            reject: is called with the position of an item whose coordinates are of the kind that the map does not have
                (MixedCoordinates); unless it raises, the others are stored.

        Returns:
            The place of each item and what changed.  None for a SameFrame whose place is gone or shows another frame,
            and for an item that was rejected.

        Raises:
            InvalidIdentifier, InvalidField: an id or metadata that cannot be stored.
            MixedCoordinates: by ``reject``, if it is left out.
            UnknownPlace, RepeatedLook, LookNameTaken, TooManyLooks: a look is of no place, or of one that cannot have
                it.
            NoRegions: a descriptor is all zero.
            ValueError: descriptors or a digest of the wrong kind.
        """

    def set_fields(self, place_id: str, fields: PlaceFields) -> tuple[Place, Change]:
        """Replace all fields of a place; its frame stays.

        Raises:
            UnknownPlace, InvalidField, MixedCoordinates.
        """

    def patch(self, place_id: str, changes: Mapping[str, Any]) -> Place:
        """Apply a merge patch (RFC 7396) to pose, timestamp, sequence and metadata.

        Raises:
            UnknownPlace, InvalidField, MixedCoordinates.
        """

    def add_keypoints(self, found: Sequence[tuple[PicturedPlace, Keypoints]]) -> int:
        """Store the keypoints of places that :meth:`without_keypoints` listed, in one write.

        A place that is gone, shows another frame by now, or has got its keypoints meanwhile stays as it is; so do all
        places of a map whose setting ``verification`` is off.

        Returns:
            How many were stored.
        """

    def forget(self, place_id: str) -> None:
        """Delete a place with its looks.

        Raises:
            UnknownPlace.
        """

    def looks(self, place_id: str) -> list[Look]:
        """The looks of a place besides its first, in the order in which they were added.

        Raises:
            UnknownPlace: there is no such place.
        """

    def all_looks(
        self, cursor: str | None, limit: int, run: str | None = None
    ) -> tuple[list[tuple[str, Look]], str | None]:
        """A page of the looks of all places, each with the id of its place, in the order in which they were added.

        Args:
            run: only those that were learnt from it; None: all.

        Raises:
            InvalidCursor.
        """

    def forget_look(self, place_id: str, look: str) -> None:
        """Delete a look of a place.

        Raises:
            UnknownPlace, UnknownLook.
        """

    def forget_looks(self, addresses: Sequence[str]) -> int:
        """Delete looks by address, all that there are or, if this raises, none; returns how many there were."""

    def learnt_looks(self) -> dict[int, Look]:
        """The looks that were learnt from runs, by row."""

    def count_learnt(self) -> int:
        """How many places were learnt from runs, or have looks that were."""

    def count_served(self, counts: Mapping[int, tuple[int, int, int]]) -> None:
        """Add to how looks have served, by row: frames won rightly, won wrongly, and passed; in one write.

        Rows that are no look's any more are left out.
        """

    def withdraw(self, rows: Sequence[int]) -> int:
        """Delete learnt looks by row, all or, if this raises, none; returns how many were there."""

    def learn(self, look: Enrolment, instead: Sequence[int], most_places: int | None = None) -> tuple[Change, int]:
        """Add a learnt look to a place, and delete learnt looks to make room for it, all or, if this raises, nothing.

        Args:
            instead: the rows of the looks that go.
            most_places: how many places of the map may be learnt, or have learnt looks; None: all.

        Returns:
            What changed, and how many looks were deleted; none if the place has the look.

        Raises:
            UnknownPlace, RepeatedLook, LookNameTaken, NoRegions, ValueError: as of :meth:`enrol`.
            TooManyLooks: the place, or the map, may not have it.
        """

    def forget_learnt(self, run: str | None, since: datetime | None = None, until: datetime | None = None) -> int:
        """Delete the looks that were learnt from a run or in a period, all or, if this raises, none.

        Args:
            run: None: any.
            since, until: when they were added, the end apart; None: there is no bound.

        Returns:
            How many there were.
        """

    def forget_new_ground(self, run: str) -> int:
        """Delete the places that were learnt from a run, all or, if this raises, none; returns how many there were."""

    def forget_all(self, wanted: PlaceFilter, most: int) -> list[str]:
        """Delete the places that fulfil some conditions, all or none; returns their ids.

        Raises:
            TooManyToDelete: there are more than ``most``.
        """

    def forget_sequence(self, name: str) -> int:
        """Delete all places of a sequence; returns how many.

        Raises:
            UnknownSequence: there is none.
        """

    def edit(self, changes: Mapping[str, Any], expected_revision: int | None = None) -> MapRecord:
        """Change settings or the calibration; the revision grows by one if anything changes.

        Raises:
            InvalidField: a field is unknown or fixed, or its value is not allowed.
            RevisionMismatch: the record is not at ``expected_revision``.
        """


class Store(Protocol):
    """Maps by id.  Any thread may call any method."""

    def create(
        self,
        map_id: str,
        encoder_identity: str,
        dimension: int,
        settings: MapSettings | None = None,
        local_shape: tuple[int, int] = (0, 0),
        unlisted: bool = False,
        precision: Precision = "half",
    ) -> Map:
        """Make an empty map for the descriptors of one encoder; it is durable when this returns.

        Args:
            dimension, local_shape: of the encoder's descriptors, D and (C, L).
            unlisted: only :meth:`unlisted` finds the map, also after a restart, until it is published.
            precision: how its descriptors are stored; this cannot be changed later.

        Raises:
            InvalidIdentifier: the id is malformed.
            MapExists: the id is taken, possibly by a damaged map.
            StorageFull, StorageFailure.
        """

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

    @property
    def open_maps(self) -> int:
        """The number of maps that are ready for use; this does not wait."""

    def get(self, map_id: str) -> Map:
        """A map, ready for use.

        Raises:
            UnknownMap, MapQuarantined, StorageFailure.
        """

    def find(self, map_id: str) -> Map:
        """A map whose record and number of places can be used; the rest may have to be read first.

        Raises:
            UnknownMap, MapQuarantined, StorageFailure.
        """

    def opened(self, map_id: str) -> Map | None:
        """A map that is ready for use, if that is known without waiting; else None."""

    def unlisted(self) -> Mapping[str, Map]:
        """The maps that are being built, by id."""

    def abandoned(self) -> list[str]:
        """The ids of the unlisted maps that nobody builds unless a job of this service does.

        None of a store that several services use, which removes abandoned maps by itself.
        """

    def publish(self, map_id: str) -> Map:
        """List a map that was being built and is now complete; durable when this returns.

        Raises:
            UnknownMap: no map of this id is being built.
            StorageFull, StorageFailure.
        """

    def abandon(self, map_id: str) -> None:
        """Delete a map that was being built; nothing happens if there is none.

        Raises:
            StorageFull, StorageFailure: the map is still there.
        """

    def quarantined(self) -> dict[str, str]:
        """Why maps are out of service, by id; this does not wait."""

    def verify(self, map_id: str, progress: Progress = no_progress) -> VerifyReport:
        """Read all of a map again, whether it is in service or quarantined, and report what is damaged.

        Raises:
            UnknownMap, StorageFailure.
        """

    def check_writable(self) -> None:
        """Raise unless maps could be read and written now.

        Raises:
            StorageFull, StorageFailure.
        """

    def check_pictures(self) -> None:
        """Raise unless pictures could be stored now, if they are stored elsewhere than the rest of the maps.

        Raises:
            StorageFull, StorageFailure.
        """

    def records(self, cursor: str | None, limit: int) -> tuple[list[MapRecord], str | None]:
        """A page of the maps' records by id, and the cursor of the next page.

        Raises:
            InvalidCursor.
        """

    def delete(self, map_id: str) -> None:
        """Delete a map; the deletion is durable when this returns.

        Raises:
            UnknownMap, StorageFull, StorageFailure.
        """

    def close(self) -> None:
        """Wait for the reads and writes under way, and refuse further ones."""
