"""Reads everything that a data directory holds, by the real code, as plain values that can be compared."""

from __future__ import annotations

import hashlib
from typing import Any

import numpy as np

from core.ledger.maps.review import stored_frames
from core.places import Neighborhood, place_and_look
from core.store import Directory, Map
from tests.durability.model import GONE


def sha(data: bytes) -> str:
    """Hexadecimal SHA-256."""
    return hashlib.sha256(data).hexdigest()


def contents(directory: Directory) -> dict[str, Any]:
    """All maps, unlisted ones too, read whole, verified and searched.

    Raises:
        AssertionError: a map is quarantined, damaged, or not searched as it is stored.
    """
    assert directory.quarantined() == {}, directory.quarantined()
    listed = [record.id for record in directory.records(None, 1000)[0]]
    found = {name: map_contents(directory.get(name), True) for name in listed}
    return found | {name: map_contents(map_, False) for name, map_ in directory.unlisted().items()}


def map_contents(map_: Map, listed: bool) -> dict[str, Any]:
    """One map."""
    map_.open()
    status = map_.index_status()
    assert (status.state, status.tier) == ("ready", status.wanted), status
    record = map_.record.model_dump(mode="json")
    settings = map_.record.settings().model_dump(mode="json")
    report = map_.verify()
    assert report.ok, report.problems
    assert report.stale_caches == [], report.stale_caches
    assert map_.count_places() == report.places
    ends: list[list[Any]] = sorted(([name, end] for name, end in map_.transfer.sequence_ends().items()), key=str)
    return {
        "listed": listed,
        "settings": settings,
        **{name: record[name] for name in ("precision", "revision", "created_at", "updated_at", "calibration")},
        "cameras": {one.name: one.mask and one.mask.model_dump(mode="json") for one in map_.cameras.all()},
        "ends": ends,
        "review": _review(map_),
        "places": _places(map_),
    }


def _review(map_: Map) -> list[Any]:
    """The frames that are stored for review, the newest first, with their pictures."""
    found = []
    for frame in stored_frames(map_.review):
        picture = map_.review.picture(frame.number)
        assert (sha(picture), len(picture)) == (frame.digest.hex(), frame.size)
        found.append([frame.digest.hex(), dict(frame.answer), None if frame.label is None else dict(frame.label)])
    return found


def _places(map_: Map) -> list[dict[str, Any]]:
    outline, snapshot = map_.transfer.outline(looks=True), map_.snapshot()
    rows = np.array([place.row for place in outline], np.int64)
    descriptors, local = snapshot.descriptors_at(rows), snapshot.locals_at(rows)
    shown = {place.row: place.digest.hex() for place in outline}
    by_id: dict[str, Any] = {}
    cursor = None
    while True:
        page, cursor = map_.places(cursor, 500)
        by_id |= {place.id: place.model_dump(mode="json") for place in page}
        if cursor is None:
            break
    assert list(by_id) == [place.id for place in outline if not place.is_look], "the two listings differ"
    numbers: dict[str, int] = {}  # the positions of places by id
    found, rankings = [], snapshot.search_batch(descriptors)
    keypoints, where = map_.keypoints_at(rows.tolist()), snapshot.whereabouts.take(rows)
    tracks = {code: place.sequence for code, place in zip(where.sequence.tolist(), outline, strict=True)}
    own = (where.track == where.sequence) & (where.station == where.ordinal)
    other_looks: dict[str, list[Any]] = {place_id: [] for place_id in by_id}
    looks_of = {place_id: {one.name: one for one in map_.looks(place_id)} for place_id in by_id}
    for position, place in enumerate(outline):
        picture, of_frame = map_.picture(place.id), keypoints[position]
        track = [tracks.get(int(where.track[position]), GONE), int(where.station[position])]
        of_row = {
            "kept": None if picture is None else sha(picture),
            "keypoints": None if of_frame is None else sha(of_frame.record()),
            "descriptor": sha(descriptors[position].tobytes()),
            "local": sha(local[position].tobytes()),
            "found_first": shown[int(rankings[position][0][0])],
        }
        place_id, name = place_and_look(place.id)
        if name is not None:
            assert place.digest.hex().startswith(name)
            assert where.take([position, numbers[place_id]]).near(0, Neighborhood(0, 0)).all(), "a look is elsewhere"
            other_looks[place_id].append({**looks_of[place_id].pop(name).model_dump(mode="json"), **of_row})
            continue
        numbers[place_id] = position
        found.append({
            **by_id[place.id],
            "digest": place.digest.hex(),
            "ordinal": place.ordinal,
            "track": None if own[position] else track,
            **of_row,
        })  # fmt: skip
    assert not any(looks_of.values()), looks_of
    return [{**place, "other_looks": other_looks[place["id"]]} for place in found]
