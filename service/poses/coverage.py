"""Whether a pose is in a map, and how well: the places around it, and what is known of them."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field

from core.places import Coordinate, Pose, check_coordinates, pose_kinds
from core.recognition.stages import neighborhood_of
from core.store import Map
from core.upkeep.surroundings import State, Surroundings, surroundings
from service.http.schemas import validated
from service.places.parameters import PoseParameters

MOST_FRAMES = 1000
"""Frames within the radius that are read to tell places and traverses, the nearest ones."""

COVERAGE_EXAMPLE: dict[str, Any] = {
    "map": "lab",
    "state": "covered",
    "radius": 5.0,
    "places": 4,
    "looks": 5,
    "sequences": ["monday", "tuesday"],
    "directions": [4, 0, 0, 0, 1, 0, 0, 0],
    "distance": 0.8,
    "turn": 3.5,
    "nearest": [{"place": "p17", "distance": 0.8, "turn": 3.5, "sequence": "monday"}],
    "gap": None,
}


class CoverageParameters(PoseParameters):
    """A pose."""

    z: Coordinate | None = Field(
        default=None,
        description="Metres. Beside x and y distances without it are those in the plane; on the Earth it does nothing.",
    )
    k: int = Field(default=5, ge=0, le=100, description="How many of the nearest places to list.")

    def pose(self) -> Pose:
        """The pose.

        Raises:
            InvalidRequest: it is incomplete, or both metric and geographic.
        """
        return validated(Pose, self.given_pose())


class NearPlace(BaseModel):
    """A place near a pose."""

    place: str
    distance: float = Field(description="Metres from the pose.")
    turn: float | None = Field(
        description="Degrees between the headings of the two, 0 to 180; null if one of them has none."
    )
    sequence: str | None


class CoverageGap(BaseModel):
    """Two successive places of a traverse between which a pose is, too far from either."""

    before: str
    after: str
    metres: float = Field(description="Metres between the two.")
    aside: float = Field(description="Metres from the pose to the line between them.")


class CoverageView(BaseModel):
    """Whether a pose is in a map, and how well."""

    model_config = ConfigDict(json_schema_extra={"examples": [COVERAGE_EXAMPLE]})

    map: str
    state: State = Field(
        description="covered: a place within `radius` looks where the pose does, as far as headings are known; "
        "other-direction: places are within it, but all of them look more than 45° elsewhere; gap: none is, but the "
        "pose is between two successive places of a traverse; outside: the map has nothing there."
    )
    radius: float = Field(description="Metres: the map's `same_place_radius`, within which a place shows the same.")
    places: int = Field(description="How many places are within the radius.")
    looks: int = Field(description="How many frames they have, further looks included.")
    sequences: list[str] = Field(description="The traverses of these places.")
    directions: list[int] = Field(
        description="How many of these frames look at 0°, 45°, … 315°, each counted where its heading is closest."
    )
    distance: float | None = Field(description="Metres to the nearest place; null if no place has a pose.")
    turn: float | None = Field(
        description="Degrees to the closest heading within the radius; null if it or that of the pose is not known."
    )
    nearest: list[NearPlace] = Field(description="The nearest places, within the radius or not.")
    gap: CoverageGap | None = Field(description="With the state `gap`: the two places.")


def coverage_of(map_: Map, options: CoverageParameters) -> CoverageView:
    """Whether a pose is in a map; it reads what is in memory of all places, and blocks.

    Raises:
        InvalidRequest: the pose is none.
        MixedCoordinates: it is of the kind that the map's poses are not.
        UnknownMap, MapQuarantined, StorageFailure.
    """
    pose = options.pose()
    snapshot = map_.snapshot()
    rows = np.flatnonzero(snapshot.alive)
    where = snapshot.whereabouts_at(rows)
    check_coordinates(pose_kinds(where.kind), pose.kind(), "The pose")
    radius = neighborhood_of(map_).radius
    found = surroundings(where, pose, radius, neighborhood_of(map_).height)
    near = found.order[: min(found.near, MOST_FRAMES)]
    within = [one for one in map_.places_at(rows[near].tolist()) if one is not None]
    turns = found.turn[near]
    return CoverageView(
        map=map_.record.id,
        state=found.state,
        radius=radius,
        places=len({place.id for place in within}),
        looks=found.near,
        sequences=sorted({place.sequence for place in within if place.sequence is not None}),
        directions=found.directions.tolist(),
        distance=float(found.distance[found.order[0]]) if len(found.order) else None,
        turn=None if np.isnan(turns).all() else float(np.nanmin(turns)),
        nearest=_nearest(map_, found, rows, options.k),
        gap=_gap(map_, found, rows),
    )


def _nearest(map_: Map, found: Surroundings, rows: NDArray[np.int64], k: int) -> list[NearPlace]:
    """The nearest places, each once, by its nearest frame."""
    listed: dict[str, NearPlace] = {}
    step = max(4 * k, 16)
    for at in range(0, min(len(found.order), MOST_FRAMES), step):
        if len(listed) >= k:
            break
        members = found.order[at : at + step]
        for member, place in zip(members.tolist(), map_.places_at(rows[members].tolist()), strict=True):
            if place is not None and len(listed) < k:
                turn = float(found.turn[member])
                one = NearPlace(
                    place=place.id,
                    distance=float(found.distance[member]),
                    turn=None if np.isnan(turn) else turn,
                    sequence=place.sequence,
                )
                listed.setdefault(place.id, one)
    return list(listed.values())


def _gap(map_: Map, found: Surroundings, rows: NDArray[np.int64]) -> CoverageGap | None:
    if found.between is None:
        return None
    before, after = map_.places_at(rows[[found.between.before, found.between.after]].tolist())
    if before is None or after is None:
        return None
    return CoverageGap(before=before.id, after=after.id, metres=found.between.metres, aside=found.between.aside)
