"""Reading all places of a map in PostgreSQL again."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

from core.ledger.maps import frames, places, sequences
from core.ledger.maps.places import StoredPlace
from core.maps.records import VerifyReport
from core.maps.status import Progress
from core.postgres import rows
from core.postgres.forms import Form
from core.postgres.map import PostgresMap

AT_ONCE = 128
"""Places that are read together."""

MOST_LISTED = 10

Searched = Callable[[Sequence[StoredPlace], Mapping[int, bytes]], dict[int, str]]
"""Compares some places and their descriptors by row with those that an engine searches; what is wrong, by row."""


def nothing_wrong(_stored: Sequence[StoredPlace], _descriptors: Mapping[int, bytes]) -> dict[int, str]:
    """Nothing: what is searched is read from the same rows."""
    return {}


def inspect(map_: PostgresMap, progress: Progress, searched: Searched = nothing_wrong) -> VerifyReport:
    """Read all places of a map, and compare them with what an engine searches.

    A place that is written meanwhile is left out.  Its rows have checksums, and PostgreSQL may have those of its own
    pages (``initdb --data-checksums``).  Pictures are compared with their digests.

    Raises:
        UnknownMap, StoreUnavailable, StorageFailure.
    """
    problems: list[str] = []
    after, total, looks, count, size = -1, map_.latest().searched, 0, 0, 0
    with map_.viewing() as (connection, _):
        problems += [f"PostgreSQL: place {name!r} does not match its checksum" for name in places.unsound(connection)]
        if problems:
            return _report(problems, count, looks, size)
        problems += [
            f"PostgreSQL: sequence {name!r} is empty, or ends before its last place"
            for name in sequences.wrong(connection)
        ]
        problems += [f"PostgreSQL: {found}" for found in places.stale_tokens(connection)]
    while True:
        with map_.viewing() as (connection, state):
            stored = places.listed_with_looks(connection, after, AT_ONCE)
            numbers = [one.row for one in stored]
            descriptors = rows.both_at(connection, numbers)
            damaged = _Damaged(set(), frames.damaged_keypoints_at(connection, numbers))
            pictures = frames.pictures_at(connection, numbers, damaged.pictures)
        if not stored:
            break
        content = _Content(pictures, descriptors, damaged, Form(state.record))
        wrong = searched(stored, {row: descriptor for row, (descriptor, _) in descriptors.items()})
        found = {one.row: why for one in stored if (why := content.damage(one) or wrong.get(one.row)) is not None}
        if found:
            with map_.viewing() as (connection, _):
                now = places.at_rows(connection, list(found))
            unchanged = {one.row for one in stored if now.get(one.row) == one}
            problems += [why for row, why in found.items() if row in unchanged]
        count += len(stored)
        looks += sum(one.look_of is not None for one in stored)
        size += content.size
        after = stored[-1].number
        progress(min(count, total), total)
    return _report(problems, count, looks, size)


def _report(problems: list[str], count: int, looks: int, size: int) -> VerifyReport:
    listed, more = problems[:MOST_LISTED], len(problems) - MOST_LISTED
    return VerifyReport(
        ok=not problems,
        places=count - looks,
        rows=count,
        checked_bytes=size,
        problems=listed + ([f"the same or another is true of {more} more places"] if more > 0 else []),
        stale_caches=[],
    )


class _Damaged(NamedTuple):
    """Rows that do not match what was recorded of them."""

    pictures: set[int]
    keypoints: set[int]


class _Content:
    """The stored data of the frames of some places."""

    def __init__(
        self,
        pictures: Mapping[int, bytes],
        descriptors: Mapping[int, tuple[bytes, bytes]],
        damaged: _Damaged,
        form: Form,
    ) -> None:
        self._pictures, self._descriptors, self._damaged, self._form = pictures, descriptors, damaged, form
        self.size = sum(map(len, pictures.values())) + sum(len(part) for both in descriptors.values() for part in both)

    def damage(self, stored: StoredPlace) -> str | None:
        """The damage of one place; None if there is none."""
        place, row = stored.place, stored.row
        name = repr(place.id)
        if row not in self._descriptors:
            return f"PostgreSQL: place {name} has no frame"
        if sum(map(len, self._descriptors[row])) != self._form.frame_bytes:
            return f"PostgreSQL: the descriptors of place {name} have another length than they must have"
        if row in self._damaged.pictures:
            return f"PostgreSQL: the {place.picture} of place {name} does not match its digest"
        if (row in self._pictures) != (place.picture != "none"):
            return f"PostgreSQL: place {name} is recorded to keep {place.picture}, which is not true"
        # The digest of a place with a camera covers its image and the camera's mask.
        whole = place.picture == "image" and place.camera is None
        if whole and hashlib.sha256(self._pictures[row]).digest() != stored.digest:
            return f"PostgreSQL: the image of place {name} does not match its digest"
        if row in self._damaged.keypoints:
            return f"PostgreSQL: the keypoints of place {name} are damaged"
        return None
