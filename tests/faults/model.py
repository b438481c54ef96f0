"""A model of the maps after each operation, in plain dictionaries, without files."""

from __future__ import annotations

import zlib
from typing import Any

import numpy as np

from core.store import Directory, Map
from tests.core.store.frames import descriptor_of, keypoints_of, local_of, stored_of

State = dict[str, Any]
"""Maps by id: the description, tier setting, cameras, and places in the order of their enrolment."""


def place(shown: str, keep: str = "thumbnail", keypoints: bool = True, **fields: Any) -> State:
    """A place as :func:`told` has it; fields that are not given are empty."""
    pose, sequence, metadata = fields.get("x"), fields.get("sequence"), fields.get("metadata", {})
    picture = {"thumbnail": f"thumbnail of {shown}", "image": f"image of {shown}"}[keep]
    return {
        "x": pose,
        "sequence": sequence,
        "camera": fields.get("camera"),
        "metadata": metadata,
        "picture": picture,
        "regions": len(shown),
        "descriptor": zlib.crc32(stored_of(shown).tobytes()),
        "local": zlib.crc32(local_of(shown).tobytes()),
        "keypoints": zlib.crc32(keypoints_of(shown).record()) if keypoints else None,
        "is_aligned": False,
    }


def told(map_: Map) -> State:
    """A map as its public interface tells it now, with checksums of the stored descriptors."""
    snapshot, listed = map_.snapshot(), map_.places(None, 1000)[0]
    rows = map_.rows_of([found.id for found in listed])
    places = {}
    for found, row in zip(listed, rows, strict=True):
        kept = map_.picture(found.id)
        (keypoints,) = [None] if row is None else map_.keypoints_at([row])
        where = None if row is None else snapshot.whereabouts.take([row])
        places[found.id] = {
            "x": None if found.pose is None else found.pose.x,
            "sequence": found.sequence,
            "camera": found.camera,
            "metadata": found.metadata,
            "picture": None if kept is None else kept.decode(),
            "regions": found.regions,
            "descriptor": None if row is None else zlib.crc32(snapshot.descriptors_at(_rows(row)).tobytes()),
            "local": None if row is None else zlib.crc32(snapshot.locals_at(_rows(row)).tobytes()),
            "keypoints": None if keypoints is None else zlib.crc32(keypoints.record()),
            "is_aligned": where is not None and bool((where.track != where.sequence).any()),
        }
    state: State = {
        "description": map_.record.description,
        "index": map_.record.index,
        "cameras": {camera.name: camera.mask is not None for camera in map_.cameras.all()},
        "places": places,
        "reviewed": [map_.review.picture(one.number).decode() for one in map_.review.page(None, 10).frames],
    }
    # A sound map has as many rows as places; of a damaged one this is another answer.
    return state if len(snapshot) == len(places) else {**state, "rows": len(snapshot)}


def _rows(row: int) -> np.ndarray[tuple[int], np.dtype[np.int64]]:
    return np.array([row], dtype=np.int64)


def all_told(atlas: Directory) -> State:
    """Every map in service."""
    return {record.id: told(atlas.get(record.id)) for record in atlas.records(None, 1000)[0]}


def best_of(map_: Map, shown: str) -> str | None:
    """The place that is found first for a frame that shows ``shown``."""
    rows, _ = map_.snapshot().search(descriptor_of(shown))
    found = map_.places_at(rows[:1].tolist())
    return None if not found or found[0] is None else found[0].id
