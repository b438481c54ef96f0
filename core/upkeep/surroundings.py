"""The frames of a map around a pose: whether the pose is in the map, and how well."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from core.places import GEOGRAPHIC, METRIC, SAME_STOREY, Pose, Whereabouts

FACING = 45.0
"""Degrees from its own direction up to which a camera sees what another one saw, mostly."""

DIRECTIONS = 8
"""Directions in which frames are counted: 0°, 45°, …"""

LONGEST_GAP = 10.0
"""Radii of one place: two successive frames of a traverse that are further apart have no gap between them that a drive
along their line would close."""

State = Literal["covered", "other-direction", "gap", "outside"]


@dataclass(frozen=True)
class Between:
    """Two successive frames of a traverse, between which a pose is.

    before, after: their positions among the frames.
    metres: between them.
    aside: metres from the pose to the line between them.
    """

    before: int
    after: int
    metres: float
    aside: float


@dataclass(frozen=True)
class Surroundings:
    """The frames around a pose.

    distance: float64 [n], metres from the pose to each frame; infinite for frames without a pose of its kind.
    turn: float64 [n], degrees from the heading of the pose to that of each frame, 0 to 180; NaN where one has none.
    order: int64 [m], the frames with a pose of the kind, nearest first.
    near: how many of them are within the radius.
    directions: int64 [DIRECTIONS], how many of those within the radius look in each direction.
    between: the two frames between which the pose is; None if there are none, or frames are within the radius.
    """

    distance: NDArray[np.float64]
    turn: NDArray[np.float64]
    order: NDArray[np.int64]
    near: int
    directions: NDArray[np.int64]
    between: Between | None

    @property
    def state(self) -> State:
        """covered: a frame within the radius looks where the pose does, as far as that is known; other-direction: all
        that are look elsewhere; gap: none is, but the pose is between two successive frames; outside: nothing of it."""
        if self.near:
            turns = self.turn[self.order[: self.near]]
            return "covered" if (np.isnan(turns) | (turns <= FACING)).any() else "other-direction"
        return "outside" if self.between is None else "gap"


def surroundings(where: Whereabouts, pose: Pose, radius: float, height: float = SAME_STOREY) -> Surroundings:
    """The frames of a map around a pose.

    Args:
        where: of the n frames of the map, those of looks included.
        pose: without ``z``, frames of all storeys count.
        radius: metres along the ground within which a frame shows the same place.
        height: metres within which frames are on the storey of the pose.
    """
    kind = METRIC if pose.kind() == "metric" else GEOGRAPHIC
    here, there = pose.position(), where.position
    if kind == METRIC:
        here, there = here[:2], there[:, :2]
    if pose.z is not None:
        where = where.without_poses(np.abs(where.height - pose.z) > height)
    distance = np.where(where.kind == kind, np.sqrt(np.square(there - here).sum(axis=1)), np.inf)
    turn = np.full(len(where), np.nan)
    if pose.heading is not None:
        turn = np.abs((where.heading.astype(np.float64) - pose.heading + 180) % 360 - 180)
    known = np.flatnonzero(np.isfinite(distance))
    order = known[np.argsort(distance[known], kind="stable")]
    near = int((distance <= radius).sum())
    headings = where.heading[order[:near]].astype(np.float64)
    sectors = np.rint(headings[~np.isnan(headings)] / (360 / DIRECTIONS)).astype(np.int64) % DIRECTIONS
    directions = np.bincount(sectors, minlength=DIRECTIONS)
    between = None if near else _between(where, kind, here, there, radius)
    return Surroundings(distance, turn, order, near, directions, between)


def _between(
    where: Whereabouts, kind: int, here: NDArray[np.float64], there: NDArray[np.float64], radius: float
) -> Between | None:
    """The closest pair of successive frames of one traverse between which a position is, within the radius."""
    pairs = [np.stack([walk[:-1], walk[1:]]) for walk in where.walks()]
    if not pairs:
        return None
    before, after = np.concatenate(pairs, axis=1)
    both = (where.kind[before] == kind) & (where.kind[after] == kind)
    before, after = before[both], after[both]
    way = there[after] - there[before]
    length = np.sqrt(np.square(way).sum(axis=1))
    possible = np.flatnonzero((length > 0) & (length <= LONGEST_GAP * radius))
    if not len(possible):
        return None
    before, after, way, length = before[possible], after[possible], way[possible], length[possible]
    share = np.clip(((here - there[before]) * way).sum(axis=1) / np.square(length), 0, 1)
    aside = np.sqrt(np.square(there[before] + share[:, np.newaxis] * way - here).sum(axis=1))
    best = int(aside.argmin())
    if aside[best] > radius:
        return None
    return Between(int(before[best]), int(after[best]), float(length[best]), float(aside[best]))
