"""What a map has already of a traverse that is to be enrolled: by ids, and by digests of frames, before any is sent."""

from __future__ import annotations

import re
from collections.abc import Mapping
from collections.abc import Sequence as SequenceOf
from itertools import chain, count, islice
from typing import Annotated, Any

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from core.frames.masks import Mask, with_range
from core.names import LONGEST, composed
from core.places import Camera, Place, PoseKind, Sequence, check_coordinates, pose_kinds
from core.recognition.recognition import frame_digest
from core.store import Map

MOST_COMPARED = 4000
"""Frames of one request: with ids of full length and digests they fit into a body of JSON."""

NAMES_AT_ONCE = 50

OTHERWISE = "by another camera, mask or range of values"
"""What else may differ of a frame whose picture is the same."""

COMPARISON_EXAMPLE: dict[str, Any] = {
    "sequence": "day-left",
    "named": True,
    "places": [{"id": "day-left-000", "sha256": "5c0f2b6a39d1e7784f1f8f6f0c1a2b3d" * 2}, {"id": "day-left-001"}],
}
COMPARED_EXAMPLE: dict[str, Any] = {
    "sequence": "day-left",
    "free": "day-left~2",
    "known": 0,
    "taken": [{"id": "day-left-000", "sequence": "day-left", "same": False}],
}


class FrameToCompare(BaseModel):
    """A frame that would be enrolled."""

    model_config = ConfigDict(extra="forbid")

    id: Annotated[str, Field(max_length=128)] = Field(description="Id of its place.")
    sha256: str | None = Field(
        default=None, pattern="^[0-9a-f]{64}$", description="The digest of its bytes, where they were read already."
    )


class TraverseToCompare(BaseModel):
    """A traverse that would be enrolled."""

    model_config = ConfigDict(extra="forbid", json_schema_extra={"examples": [COMPARISON_EXAMPLE]})

    places: list[FrameToCompare] = Field(min_length=1, max_length=MOST_COMPARED)
    sequence: Sequence | None = Field(default=None, description="The traverse's name; null: it has none.")
    named: bool = Field(
        default=True,
        strict=True,
        description="Whether somebody chose this name. Another one, such as that of a folder, is made unique: NAME~2 "
        "and so on, unless the map has these very frames under such a name already.",
    )
    camera: Camera | None = Field(default=None, description="The camera of the map that took the frames.")
    coordinates: PoseKind | None = Field(
        default=None, description="What the frames' poses are in: metric or geographic; null: they have none."
    )


class TakenPlace(BaseModel):
    """A place that would be replaced, or would get into another traverse."""

    id: str
    sequence: str | None = Field(description="The traverse that it belongs to.")
    same: bool | None = Field(description="Whether it shows the very frame; null: no digest was sent, so it may.")
    picture: bool | None = Field(
        default=None,
        description="Of a frame that is not the same: whether it is this picture by another camera, mask or range of "
        "values; null: that is not known, as its camera may have had others.",
    )


class TraverseComparison(BaseModel):
    """What a map has already of a traverse."""

    model_config = ConfigDict(json_schema_extra={"examples": [COMPARED_EXAMPLE]})

    sequence: str | None = Field(description="The name under which to enrol it.")
    free: str | None = Field(description="The first of NAME, NAME~2 and so on that no traverse of the map has.")
    known: int = Field(description="How many of the frames are places of this traverse already.")
    taken: list[TakenPlace] = Field(description="Places of other frames or other traverses that have these ids.")


def compare(
    map_: Map, frames: Mapping[str, bytes | None], sequence: str | None, named: bool, mask: Mask | None
) -> TraverseComparison:
    """Compare a traverse with what a map has; nothing is stored.

    Args:
        frames: for each id the SHA-256 of the frame's bytes, 32 bytes; None if they were not read.
        sequence: the traverse's name, as somebody chose it if it is ``named``.
        mask: of the camera.

    Raises:
        UnknownMap, MapQuarantined, StorageFailure.
    """
    map_.open()
    rows = [row for row in map_.rows_of(list(frames)) if row is not None]
    there = [place for place in map_.places_at(rows) if place is not None]
    names = {place.id: composed(place.sequence) for place in there}
    same = {place.id: _shows(map_, place, frames[place.id], mask) for place in there}
    free = None if sequence is None else _free_name(map_, sequence)
    name = sequence
    if sequence is not None and not named:
        begun = (one for place_id, one in names.items() if same[place_id] and _continues(one, sequence))
        name = next(begun, free)
    taken = [
        TakenPlace(id=place.id, sequence=one, same=same[place.id], picture=_pictures(map_, place, frames[place.id]))
        for place, one in ((place, names[place.id]) for place in there)
        if not same[place.id] or not (one == name or _continues(one, name))
    ]
    return TraverseComparison(sequence=name, free=free, known=len(there) - len(taken), taken=taken)


def expect_coordinates(map_: Map, kind: PoseKind | None) -> None:
    """Check that a traverse has coordinates of the kind that the places of a map have; None: it has none.

    Raises:
        MixedCoordinates: they are of the other kind.
        UnknownMap, MapQuarantined, StorageFailure.
    """
    if kind is not None:
        snapshot = map_.snapshot()
        where = snapshot.whereabouts_at(np.flatnonzero(snapshot.alive))
        check_coordinates(pose_kinds(where.kind), kind, "The traverse")


def _shows(map_: Map, place: Place, sha256: bytes | None, mask: Mask | None) -> bool | None:
    return None if sha256 is None else map_.digest(place.id) == frame_digest(sha256, mask)


def _pictures(map_: Map, place: Place, sha256: bytes | None) -> bool | None:
    """Whether a place was made of a file, under whichever mask; None if that is not known.

    The digest that is stored tells it of a place without a camera, and of one whose camera is as it was.
    """
    if sha256 is None:
        return None
    known = None if place.camera is None else map_.cameras.known(place.camera)
    masks = [None] if known is None else [None, with_range(known.mask, known.value_range)]
    if any(_shows(map_, place, sha256, mask) for mask in masks):
        return True
    return False if place.camera is None else None


def _continues(name: str | None, first: str | None) -> bool:
    """Whether a traverse is ``first`` or one after it that was named by it, such as ``first~2``."""
    return name is not None and first is not None and re.fullmatch(re.escape(first) + r"(~\d+)?", name) is not None


def _free_name(map_: Map, name: str) -> str:
    """The first of NAME, NAME~2, NAME~3 and so on that no traverse has."""
    stem, _, digits = name.rpartition("~")
    if not (stem and digits.isdecimal()):
        stem, digits = name, ""
    candidates = chain([name], (f"{stem[: LONGEST - 8]}~{one}" for one in count(int(digits or 1) + 1)))
    while True:  # a map has a bounded number of traverses
        names = list(islice(candidates, NAMES_AT_ONCE))
        free = map_.unknown_sequences(names)
        if found := next((one for one in names if one in free), None):
            return found


def taken_text(taken: SequenceOf[TakenPlace], frames: int) -> str:
    """A sentence on places that have the ids of ``frames`` frames."""
    names = list(dict.fromkeys(one.sequence for one in taken if one.sequence is not None))
    where = f" in the traverse {names[0]!r}" if len(names) == 1 else f" in {len(names)} traverses" if names else ""
    others = [one.picture for one in taken if one.same is False]
    how = "these very pictures"
    if others:
        how = f"these pictures, but {OTHERWISE}" if all(others) else "other pictures"
        how += f", or these {OTHERWISE}" if None in others else ""
    which = f", {len(others)} of them" if 0 < len(others) < len(taken) else ","
    return f"{len(taken)} of {frames} frames exist already{where}{which} with {how}."
