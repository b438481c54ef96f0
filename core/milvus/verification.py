"""Comparing a map in PostgreSQL with its entities in Milvus."""

from __future__ import annotations

import hashlib

import numpy as np
from numpy.typing import NDArray

from core.errors import InvalidKeypoints
from core.geometry.keypoints import keypoints_of
from core.maps.place_filter import EVERY_PLACE
from core.maps.records import VerifyReport
from core.maps.status import Progress
from core.milvus import ledger
from core.milvus.forms import Form
from core.milvus.ledger import PlaceEntry
from core.milvus.map import MilvusMap
from core.milvus.pictures.stored import read_pictures

AT_ONCE = 128
"""Places that are read together; Milvus waits up to 0.2 s for the next tick of its clock each time."""

MOST_LISTED = 10


def inspect(map_: MilvusMap, progress: Progress) -> VerifyReport:
    """Read all places of a map, and compare their descriptors with those that Milvus has.

    A place that is written meanwhile is left out.  PostgreSQL has checksums of its own pages (``initdb
    --data-checksums``), so this checks only what it cannot know: that pictures are those of their digests, also where
    they are in the object store, that keypoints can be read, and that Milvus finds what PostgreSQL has.

    Raises:
        UnknownMap, StoreUnavailable, StorageFailure.
    """
    report = _Report()
    after, total = -1, map_.count_places()
    while True:
        with map_.viewing() as (connection, state):
            entries = ledger.entries_after(connection, map_.number, after, AT_ONCE, EVERY_PLACE)
            rows = [entry.row for entry in entries]
            stored = {name: ledger.of_frames(connection, map_.number, name, rows) for name in _COLUMNS}
            pictures = ledger.pictures_of(connection, map_.number, rows)
        if not entries:
            break
        stored["picture"] = read_pictures(map_.objects, pictures)
        there = map_.collection.descriptors_of([entry.key for entry in entries])
        damaged = [(entry, why) for entry in entries if (why := _damage(entry, stored, there, Form(state.record)))]
        if damaged:
            with map_.viewing() as (connection, _):
                now = ledger.entries_by(connection, map_.number, "key", [entry.key for entry, _ in damaged])
            unchanged = {entry.key for entry in now}
            report.problems += [why for entry, why in damaged if entry.key in unchanged]
        report.places += len(entries)
        report.bytes += sum(len(value or b"") for column in stored.values() for value in column.values())
        after = entries[-1].number
        progress(min(report.places, total), total)
    listed, more = report.problems[:MOST_LISTED], len(report.problems) - MOST_LISTED
    return VerifyReport(
        ok=not report.problems,
        places=report.places,
        rows=report.places,
        checked_bytes=report.bytes,
        problems=listed + ([f"the same or another is true of {more} more places"] if more > 0 else []),
        stale_caches=[],
    )


_COLUMNS = ("descriptor", "local", "keypoints")


class _Report:
    def __init__(self) -> None:
        self.places = self.bytes = 0
        self.problems: list[str] = []


def _damage(
    entry: PlaceEntry, stored: dict[str, dict[int, bytes]], there: dict[int, NDArray[np.float32]], form: Form
) -> str | None:
    name, row = repr(entry.place.id), entry.row
    if row not in stored["descriptor"]:
        return f"PostgreSQL: place {name} has no frame"
    if len(stored["descriptor"][row]) + len(stored["local"][row]) != form.frame_bytes:
        return f"PostgreSQL: the descriptors of place {name} have another length than they must have"
    if row not in stored["picture"]:
        return f"object store: the picture of place {name} is missing, or is not the one that was stored"
    picture, keypoints = stored["picture"][row], stored["keypoints"][row]
    if (picture is None) != (entry.place.picture == "none"):
        return f"PostgreSQL: place {name} is recorded to keep {entry.place.picture}, which is not true"
    # The digest of a place with a camera covers its image and the camera's mask.
    whole = entry.place.picture == "image" and entry.place.camera is None
    if whole and picture is not None and hashlib.sha256(picture).digest() != entry.digest:
        return f"PostgreSQL: the image of place {name} does not match its digest"
    if keypoints is not None:
        try:
            keypoints_of(keypoints)
        except InvalidKeypoints:
            return f"PostgreSQL: the keypoints of place {name} are damaged"
    if entry.key not in there:
        return f"Milvus: place {name} is missing; rebuild the index"
    if not np.array_equal(there[entry.key], form.descriptors([stored["descriptor"][row]])[0]):
        return f"Milvus: the descriptor of place {name} is not the one in PostgreSQL; rebuild the index"
    return None
