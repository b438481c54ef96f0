"""What is asked of a store of maps, of one of its maps, and of that map at one moment.

These are interfaces; :mod:`core.storage` implements them in a data directory.  Recognition knows nothing else of where
maps are kept, and ``docs/explanation/stores.md`` says why the interfaces are as they are.

Whatever stores it, a descriptor stands in a *row* of its map: a number that is given to one frame of one place and is
never used again.  A search returns rows.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Protocol, overload

import numpy as np
from numpy.typing import NDArray

from core.geometry.keypoints import Keypoints
from core.maps.cameras import KnownCameras
from core.maps.place_filter import EVERY_PLACE, PlaceFilter
from core.maps.records import Change, Enrolment, MapRecord, MapSettings, Outline, SameFrame
from core.maps.selection import Selection
from core.places import Neighborhood, Place, PlaceFields, Whereabouts

Rows = NDArray[np.int64]

Ranking = tuple[Rows, NDArray[np.float32]]
"""Rows, best first, and their inner products."""


def merged(a: Ranking, b: Ranking) -> Ranking:
    """The rows of two rankings of one map, best first."""
    rows, first = np.unique(np.concatenate([a[0], b[0]]), return_index=True)
    products = np.concatenate([a[1], b[1]])[first]
    order = np.argsort(-products, kind="stable")
    return rows[order], products[order]


class Scope(Protocol):
    """The places that a query may find, at one moment, and what speaks for them before the frame is compared."""

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
        self, descriptor: NDArray[np.float32], ranking: Ranking, best: int, neighborhood: Neighborhood
    ) -> Ranking:
        """The best places of the scope that are not in a ranking and not the same place as the row ``best``.

        Args:
            descriptor: of the query, float32 [D].
            ranking: what :meth:`search` returned for it.
            neighborhood: which places are the same place.

        Returns:
            No rows if there are no such places.
        """

    def weights_at(self, rows: Rows) -> NDArray[np.float64] | None:
        """The log prior of rows that a search returned, float64 [n], at most 0; None if nothing speaks for places."""


class Snapshot(Protocol):
    """The places of a map at one moment.  Later writes do not change it; any thread may use it."""

    def __len__(self) -> int:
        """How many places there are."""

    def whereabouts_at(self, rows: Rows) -> Whereabouts:
        """Where and when the frames of some rows were taken, in the order of ``rows``."""

    def descriptors_at(self, rows: Rows) -> NDArray[np.float32]:
        """The descriptors of rows: float32 [k, D].

        Raises:
            UnknownPlace: the place of a row was deleted since, and what was stored of it as well.
        """

    def locals_at(self, rows: Rows) -> NDArray[np.int8]:
        """The local descriptors of rows: int8 [k, C, L].

        Raises:
            UnknownPlace: the place of a row was deleted since, and what was stored of it as well.
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


class Outlines(Protocol):
    """Lists all places of a map in brief."""

    def outline(self) -> list[Outline]:
        """All places in the order of their enrolment."""


class Map(Protocol):
    """The places of one environment.  Any thread may call any method.

    A write that has returned is durable and seen by every later read and search; one that raises has changed nothing.
    Any method may raise MapQuarantined, StorageFailure and UnknownMap; methods that write may also raise StorageFull.
    """

    @property
    def record(self) -> MapRecord:
        """The map's record as of its last edit."""

    @property
    def cameras(self) -> KnownCameras:
        """The cameras of the map."""

    @property
    def transfer(self) -> Outlines:
        """Lists all places in brief."""

    # Searching

    def snapshot(self) -> Snapshot:
        """All places at this moment."""

    def scope(self, selection: Selection | None = None) -> Scope:
        """The places that a query may find at this moment; None: all."""

    def places_at(self, rows: Sequence[int]) -> list[Place | None]:
        """The places of rows that a search returned; None where a place was deleted or got another frame since."""

    def keypoints_at(self, rows: Sequence[int]) -> list[Keypoints | None]:
        """The keypoints of those places; None also where none are kept."""

    def rows_of(self, place_ids: Sequence[str]) -> list[int | None]:
        """The rows of places; None where there is no such place."""

    # Reading

    def count_places(self) -> int:
        """How many places the map has."""

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

    def picture(self, place_id: str) -> bytes | None:
        """The picture kept of a place's frame, as the place's ``picture`` says; None if it is gone or keeps none.

        Raises:
            StorageFailure: the picture is damaged.
        """

    # Writing

    @overload
    def enrol(self, items: Sequence[Enrolment]) -> Sequence[tuple[Place, Change]]: ...

    @overload
    def enrol(self, items: Sequence[Enrolment | SameFrame]) -> Sequence[tuple[Place, Change] | None]: ...

    def enrol(self, items: Sequence[Enrolment | SameFrame]) -> Sequence[tuple[Place, Change] | None]:
        """Store frames as places in the order given, all of them or, if this raises, none.

        An id that exists keeps its place and creation time: if the frame's digest is the same, only its fields are
        stored (``unchanged``, ``updated``), otherwise its frame is ``replaced``.  An id may occur twice.

        Returns:
            The place of each item and what changed.  None for a SameFrame whose place is gone or shows another frame.

        Raises:
            InvalidIdentifier, InvalidField: an id or metadata that cannot be stored.
            NoRegions: a descriptor is all zero.
            ValueError: descriptors or a digest of the wrong kind.
        """

    def set_fields(self, place_id: str, fields: PlaceFields) -> tuple[Place, Change]:
        """Replace all fields of a place; its frame stays.

        Raises:
            UnknownPlace, InvalidField.
        """

    def patch(self, place_id: str, changes: Mapping[str, Any]) -> Place:
        """Apply a merge patch (RFC 7396) to pose, timestamp, sequence and metadata.

        Raises:
            UnknownPlace, InvalidField.
        """

    def forget(self, place_id: str) -> None:
        """Delete a place.

        Raises:
            UnknownPlace.
        """

    def forget_all(self, wanted: PlaceFilter, most: int) -> list[str]:
        """Delete the places that fulfil some conditions, all or none; returns their ids.

        Raises:
            TooManyToForget: there are more than ``most``.
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
    ) -> Map:
        """Make an empty map for the descriptors of one encoder; it is durable when this returns.

        Args:
            dimension, local_shape: of the encoder's descriptors, D and (C, L).

        Raises:
            InvalidIdentifier: the id is malformed.
            MapExists: the id is taken.
            StorageFull, StorageFailure.
        """

    def get(self, map_id: str) -> Map:
        """A map, ready for use.

        Raises:
            UnknownMap, MapQuarantined, StorageFailure.
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
