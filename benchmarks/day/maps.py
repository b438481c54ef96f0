"""The maps of a walk: of one traverse enrolled once, or in the ways in which maps come about as well."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Literal, TypeAlias

import numpy as np

from benchmarks.day.pictures import another_look, file
from benchmarks.day.walks import PlanarPose, WalkPair, pixels
from placerec_client import Client, Map, NewPlace, parameters

Change: TypeAlias = Literal["plain", "stood", "twice", "look-alike", "cameras"]
Size: TypeAlias = Literal["small", "large", "bare"]
"""Of the walk alone; with the pictures of other environments in traverses of their own; of the walk, without poses."""

STOOD, LOOKS = 0.4, 30
"""Where the mapping robot stood, as a share of the walk, and how many more looks it took there."""

ALIKE = (0.4, 0.55)
"""The stretch that another one looks like, as shares of the walk."""

WHOLE, CUT, LEFT = "whole", "cut", 0.6
"""Cameras of one lens that a map knows, one whose frames are whole, and one whose are cut to a share of their sides."""

TRAVERSE = 400
"""Frames of a traverse of other pictures."""


def fields(pose: PlanarPose | None, sequence: str) -> dict[str, object]:
    """The fields of a place."""
    if pose is None:
        return {"sequence": sequence}
    return {"sequence": sequence, "x": pose.x, "y": pose.y, "heading": float(np.degrees(pose.heading))}


def places(walk: WalkPair, change: Change, size: Size, others: Sequence[bytes]) -> Iterator[NewPlace]:
    """The places of a map; their ids end with the number of the reference that they show, those of others with none."""
    random = np.random.default_rng(3)
    count = len(walk.references)
    stood = walk.reference(round(STOOD * (len(walk.frames) - 1)))

    def place(kind: str, number: int, data: bytes, metres: float, serial: int = 0) -> NewPlace:
        pose = None if size == "bare" else walk.pose(metres)
        camera = {"camera": WHOLE} if change == "cameras" else {}
        return NewPlace(f"{kind}-{serial:03d}-{number:05d}", data, fields(pose, kind) | camera)

    for number, data in enumerate(walk.references):
        yield place("walk", number, data, number * walk.spacing)
        for look in range(LOOKS if change == "stood" and number == stood else 0):
            again = file(another_look(pixels(data), random))
            yield place("walk", number, again, number * walk.spacing, 1 + look)
    if change == "twice":
        for number, data in enumerate(walk.references):
            yield place("again", number, data, number * walk.spacing)
    if change == "look-alike":
        first, last = (round(share * count) for share in ALIKE)
        for offset, data in enumerate(walk.references[first:last]):
            far = (count + 30 + offset) * walk.spacing
            yield NewPlace(
                f"alike-{offset:05d}-other", data, fields(None if size == "bare" else walk.pose(far), "alike")
            )
    if size == "large":
        for offset, data in enumerate(others):
            sequence = f"others-{offset // TRAVERSE}"
            aside = walk.pose(offset % TRAVERSE * walk.spacing, 1000.0 * (1 + offset // TRAVERSE))
            yield NewPlace(f"others-{offset:05d}-other", data, fields(aside, sequence))


def shown_by(place_id: str) -> int | None:
    """The number of the reference that a place of :func:`places` shows; None for another environment or stretch."""
    number = place_id.rpartition("-")[2]
    return int(number) if number.isdigit() else None


def _lens(width: int, height: int, share: float) -> parameters.Intrinsics:
    """The intrinsics of a usual lens, of frames that are cut to a share of their sides."""
    sides = [side - 2 * round((1 - share) * side / 2) for side in (width, height)]
    focal = 0.75 * width
    return {
        "width": sides[0],
        "height": sides[1],
        "fx": focal,
        "fy": focal,
        "cx": (sides[0] - 1) / 2,
        "cy": (sides[1] - 1) / 2,
    }


def make_map(client: Client, map_id: str, walk: WalkPair, change: Change, size: Size, others: Sequence[bytes]) -> None:
    """Enrol a map.

    Raises:
        PlacerecError: a frame was refused.
    """
    made = client.maps.create(map_id)
    if change == "cameras":
        height, width = pixels(walk.references[0]).shape[:2]
        for name, share in ((WHOLE, 1.0), (CUT, LEFT)):
            made.cameras.put(name, intrinsics=_lens(width, height, share))
    fill(made, places(walk, change, size, others))


def fill(made: Map, entries: Iterator[NewPlace]) -> None:
    """Enrol places in an empty map.

    Raises:
        PlacerecError: a frame was refused.
    """
    for one in made.enrol(entries, known=()):
        if one.error is not None:
            raise one.error
