"""Reading all of a map again to see whether its database still has what was written."""

from __future__ import annotations

import hashlib
import sqlite3
from collections.abc import Iterator, Sequence
from contextlib import contextmanager

import numpy as np

from core.disk.files import Damage
from core.errors import StorageFailure
from core.index.flat import vectors
from core.ledger.maps import cameras, frames, places, record, review, rows, sequences
from core.ledger.maps.columns import read_columns
from core.ledger.maps.connection import MapConnection
from core.ledger.maps.places import StoredPlace
from core.ledger.maps.record import MapState
from core.maps.forms import Form
from core.maps.records import VerifyReport
from core.maps.status import Progress, no_progress
from core.store.database import MapDatabase
from core.store.following import Followed

AT_ONCE = 64
"""Places that are read together."""

CHECKED_TABLES = ("maps", "places", "tokens", "sequences", "cameras", "dead_rows", "review_frames")
"""The tables that SQLite checks when a map is opened; long values are checked when they are read."""

_MOST_LISTED = 10  # damaged rows of one kind that are listed one by one; further ones are counted


def inspect(
    database: MapDatabase, map_id: str, held: Followed | None = None, progress: Progress = no_progress
) -> VerifyReport:
    """Check the rows of a map against their checksums and each other, and against what is searched.

    A place that is written meanwhile is left out.

    Args:
        held: the snapshot that is searched; None: the map is not in memory.
        progress: called with the number of places done and of all; its exceptions end the work.
    """
    return _Inspection(database, map_id, held, progress).report()


class _Inspection:
    def __init__(self, database: MapDatabase, map_id: str, held: Followed | None, progress: Progress) -> None:
        self._database, self._map, self._held, self._progress = database, map_id, held, progress
        self._problems: list[str] = []
        self._stale: list[str] = []
        self._places = self._rows = self._bytes = 0

    def report(self) -> VerifyReport:
        with self._noting():
            self._note("", self._database.check())
        with self._noting(), self._database.reading() as connection:
            self._check_rows(connection)
        with self._noting(), self._database.reading() as connection:
            self._check_references(connection, record.state_of(connection, self._map))
        with self._noting():
            self._check_frames()
        with self._noting():
            self._check_review()
        return VerifyReport(
            ok=not self._problems,
            places=self._places,
            rows=self._rows,
            checked_bytes=self._bytes,
            problems=self._problems,
            stale_caches=self._stale,
        )

    @contextmanager
    def _noting(self) -> Iterator[None]:
        """Note an error that ends the block as a problem, and go on after it."""
        try:
            yield
        except (Damage, StorageFailure, OSError, sqlite3.Error, ValueError, TypeError) as error:
            self._note("", [str(error)])

    def _note(self, kind: str, found: Sequence[str]) -> None:
        """Note problems of one kind one by one, and the number of those that are too many."""
        name = self._database.name
        self._problems += [f"{name}: {one}".replace(f"{name}: {name}", name) for one in found[:_MOST_LISTED]]
        if len(found) > _MOST_LISTED:
            self._problems.append(f"{name}: the same is true of {len(found) - _MOST_LISTED} more {kind}")

    def _check_rows(self, connection: MapConnection) -> None:
        for kind, names in (("place", places.unsound(connection)), ("camera", cameras.unsound(connection))):
            self._note(f"{kind}s", [f"{kind} {name!r} does not match its checksum" for name in names])

    def _check_references(self, connection: MapConnection, state: MapState) -> None:
        self._note("rows", wrong_references(connection) + places.stale_tokens(connection))
        self._places, looks = places.count(connection)
        self._rows = state.rows
        if (state.places, state.looks) != (self._places, looks):
            counted = f"{state.places} places and {state.looks} looks"
            self._note("", [f"its record counts {counted}, but there are {self._places} and {looks}"])
        if strays := rows.of_no_place(connection):
            self._note("", [f"the descriptors, pictures or keypoints of {len(strays)} rows belong to no place"])
        self._note("rows", [f"row {row} has a place and is noted as dead" for row in rows.dead_of_places(connection)])
        columns = read_columns(connection, state.rows)
        if (held := self._held) is None or (held.revision, held.stamp) != (state.revision, state.stamp):
            return  # it was written to meanwhile
        searched, same = held.snapshot.whereabouts.take(columns.rows), held.snapshot.alive[columns.rows]
        for name, column in vars(columns.whereabouts).items():
            found = getattr(searched, name)
            if name == "position":  # the computation of a point on the sphere may differ in its last bits
                same &= np.isclose(found, column, rtol=0, atol=1e-6).all(axis=1)
            else:
                same &= (found == column) | ((found != found) & (column != column))
        self._note("rows", [f"row {row} is searched elsewhere than it is" for row in columns.rows[~same].tolist()])
        if len(held.snapshot) != len(columns.rows):
            self._note("", [f"{len(held.snapshot)} places and looks are searched, {len(columns.rows)} are stored"])

    def _check_frames(self) -> None:
        """Check what is stored of the frame of each place."""
        after, done, found = -1, 0, dict[str, list[str]]()
        while True:
            with self._database.reading() as connection:
                state = record.state_of(connection, self._map)
                page = places.listed_with_looks(connection, after, AT_ONCE)
                wrong = dict(self._wrong(connection, state, page))
            if not page:
                break
            if wrong:
                with self._database.reading() as connection:
                    now = places.at_rows(connection, list(wrong))
                for one in page:
                    if one.row in wrong and now.get(one.row) == one:
                        found.setdefault(wrong[one.row], []).append(f"place {one.place.id!r} {wrong[one.row]}")
            after, done = page[-1].number, done + len(page)
            self._progress(min(done, state.searched), state.searched)
        for problems in found.values():
            self._note("places", problems)

    def _wrong(
        self, connection: MapConnection, state: MapState, page: Sequence[StoredPlace]
    ) -> Iterator[tuple[int, str]]:
        """The rows of some places of which something is damaged, each with what it is."""
        wanted = [one.row for one in page]
        damaged: dict[str, set[int]] = {kind: set() for kind in (*rows.OF_FRAMES, "codes", "pictures")}
        descriptors, local = (rows.at(connection, kind, wanted, damaged[kind]) for kind in rows.OF_FRAMES)
        codes = rows.at(connection, "codes", wanted, damaged["codes"])
        pictures = frames.pictures_at(connection, wanted, damaged["pictures"])
        bad_keypoints = frames.damaged_keypoints_at(connection, wanted)
        self._bytes += sum(len(one) for found in (descriptors, local, codes, pictures) for one in found.values())
        form = Form.of(state.record)
        for one in page:
            row, picture, place = one.row, pictures.get(one.row), one.place
            lost = row not in descriptors or row not in local
            if row in damaged["codes"]:
                self._stale.append(f"the code of place {place.id!r} does not match its checksum; rebuild the index")
            if row in damaged["descriptors"] | damaged["locals"]:
                yield row, "has descriptors that do not match their checksum"
            elif lost:
                yield row, "has no descriptors"
            elif len(descriptors[row]) + len(local[row]) != form.frame.itemsize:
                yield row, "has descriptors of another length than they must have"
            elif self._is_searched_otherwise(row, form, descriptors[row], local[row]):
                yield row, "is not what is searched"
            elif row in damaged["pictures"]:
                yield row, f"has a stored {place.picture} that does not match its digest"
            elif (picture is not None) != (place.picture != "none"):
                yield row, f"is recorded to keep {place.picture}, which is not true"
            # The digest of a place with a camera covers its image and the camera's mask.
            elif (
                picture is not None
                and (place.picture, place.camera) == ("image", None)
                and hashlib.sha256(picture).digest() != one.digest
            ):
                yield row, "has an image that does not match its digest"
            elif row in bad_keypoints:
                yield row, "has keypoints that do not match their checksum"

    def _is_searched_otherwise(self, row: int, form: Form, descriptor: bytes, local: bytes) -> bool:
        """Whether the descriptors of a row in memory, if it is there, are others; a flipped bit counts."""
        snapshot = None if self._held is None else self._held.snapshot
        if snapshot is None or row >= snapshot.rows or not snapshot.alive[row]:
            return False
        number, offset = divmod(row, snapshot.rows_per_segment)
        if (held := snapshot.segments[number].held) is None:
            return False
        here = vectors(held.index)[offset].astype(np.float32, copy=False), held.local[offset]
        there = form.descriptors([descriptor])[0], form.locals([local])[0]
        return [one.tobytes() for one in here] != [one.tobytes() for one in there]

    def _check_review(self) -> None:
        with self._database.reading() as connection:
            self._note(
                "frames", [f"frame {one} for review does not match its checksum" for one in review.unsound(connection)]
            )
        number = 0
        while True:
            with self._database.reading() as connection:  # for one picture after the other
                if (frame := review.first_after(connection, number)) is None:
                    return
            number, digest, picture = frame
            self._bytes += len(picture or b"")
            if picture is None or hashlib.sha256(picture).digest() != digest:
                self._note("", [f"the picture of frame {number} for review does not match its digest"])


def damage_of_places(database: MapDatabase, connection: MapConnection) -> Iterator[str]:
    """What is damaged of the places of a map and of its sequences, without what is stored of their frames."""
    yield from database.check(*CHECKED_TABLES)
    yield from (f"place {place_id!r} does not match its checksum" for place_id in places.unsound(connection))
    yield from wrong_references(connection)


def wrong_references(connection: MapConnection) -> list[str]:
    """Where sequences and counters contradict the places."""
    wrong = [f"sequence {name!r} is empty, or ends before its last place" for name in sequences.wrong(connection)]
    lost = [f"place {place_id!r} is of a sequence that is missing" for place_id in sequences.lost(connection)]
    return wrong + lost + record.wrong_counters(connection)
