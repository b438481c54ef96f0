"""The storey of a run's robot: what is stated of it, and what a lift does to the belief.

A belief stays on its storey by itself, as only traverses that climb lead to another one.  What the robot states of its
level is no evidence of one frame, for it is repeated with every frame: it weighs the summary of the belief, once.
Where another level is stated than before, or its height has leapt, the robot was in a lift: it may be anywhere on the
storeys that fit, and the frames say where.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from core.belief.filter import Belief, uninformed
from core.belief.graph import PlaceGraph
from core.judgement.priors import OnLevels
from core.maps.selection import TRUST
from core.places import NO_LEVEL


@dataclass(frozen=True)
class Storey:
    """What is stated of a robot's storey.

    level: its code, or NO_LEVEL.
    height: metres, by a barometer for example, on the storey where the robot is or, while it climbs, was last;
        differences alone count.  None: not stated.
    last: the height that was stated last.
    """

    level: int = NO_LEVEL
    height: float | None = None
    last: float | None = field(default=None, compare=False)

    def climbs(self, limit: float) -> bool:
        """Whether the robot is on the way from its storey, more than so many metres from it."""
        return self.height is not None and self.last is not None and abs(self.last - self.height) > limit

    def arrived(self) -> Storey:
        """The same on the storey whose height was stated last."""
        return Storey(self.level, self.height if self.last is None else self.last, self.last)


UNSTATED = Storey()

LIKELY = 512
"""At most this many of the likeliest places are those from which a robot may have come."""

FOLLOWS = 0.1
"""Share by which the height of a storey follows each height that is stated on it: a barometer that drifts by 0.1 m from
frame to frame climbs no storey, and stairs of 0.25 m from frame to frame do."""

SETTLED = 0.1
"""Metres between two heights from which on a robot climbs on."""


def later(before: Storey, now: Storey, limit: float) -> tuple[Storey, float | None]:
    """What is stated after a frame, and by how many metres the robot has climbed from the last storey.

    Args:
        limit: metres within which two heights may be on one storey.

    Returns:
        The statements that hold now; and NaN for a height that is not known, None where the robot stays on its storey.
    """
    level = before.level if now.level == NO_LEVEL else now.level
    last = before.last if now.height is None else now.height
    if now.level != NO_LEVEL and before.level not in (NO_LEVEL, now.level):
        return Storey(level, now.height, last), float("nan")
    if now.height is None or before.height is None:
        return Storey(level, before.height if now.height is None else now.height, last), None
    climb = now.height - before.height
    if abs(climb) <= limit:
        return Storey(level, before.height + FOLLOWS * climb, last), None
    settled = before.last is not None and abs(now.height - before.last) <= SETTLED
    return Storey(now.level, now.height if settled else before.height, last), climb


def after_lift(belief: Belief, graph: PlaceGraph, before: Storey, now: Storey, climb: float) -> Belief:
    """The belief of a robot that has come to another storey: to the level that it states, if the map has it, else from
    each place where it may have been to those that are as much higher or, where heights are unknown, on any other one.

    Args:
        before, now: what it stated on the storeys.
        climb: metres; NaN: not known.
    """
    if not len(graph):
        return belief
    where, limit = graph.whereabouts, graph.neighborhood.height
    was = weighed(belief, graph, before).given
    likely = np.argsort(-was, kind="stable")[:LIKELY]
    there = np.abs(where.height - where.height[likely, np.newaxis] - climb) <= limit
    heights_are_known = bool(np.isfinite(where.height[likely]).any())
    if not there.any() and not heights_are_known:
        there = where.on_other_levels(slice(None), likely[:, np.newaxis], limit)
    if now.level != NO_LEVEL and (where.level == now.level).any():
        there = np.broadcast_to(where.level == now.level, there.shape)
    if not there.any():  # between storeys, or on one that the map does not have
        return replace(uninformed(len(graph)), unknown=belief.unknown) if heights_are_known else belief
    arrived = was[likely] @ (there / np.maximum(there.sum(axis=1, keepdims=True), 1))
    anywhere = uninformed(len(graph))
    given = (1 - TRUST) * anywhere.given + TRUST * arrived / arrived.sum()
    return replace(anywhere, given=given.astype(np.float32), unknown=belief.unknown)


def undecided(ahead: Belief, seen: Belief, graph: PlaceGraph, rows: NDArray[np.int64]) -> Belief:
    """The belief after a frame that may as well show several storeys: each of them is as probable as before.

    Args:
        ahead, seen: the belief before and after the frame.
        rows: int64 [m], of the map, places on these storeys.
    """
    given = seen.given.copy()
    left, storeys = np.ones(len(graph), np.bool_), []
    for place in graph.places_at(rows).tolist():
        storey = left & ~graph.whereabouts.on_other_levels(slice(None), place, graph.neighborhood.height)
        if place >= 0 and storey.any():
            storeys.append(storey)
            left &= ~storey
    before = np.array([ahead.given[storey].sum(dtype=np.float64) for storey in storeys])
    after = np.array([given[storey].sum(dtype=np.float64) for storey in storeys])
    if len(storeys) > 1 and before.min() > 0 and after.min() > 0:
        for storey, factor in zip(storeys, before / before.sum() * after.sum() / after, strict=True):
            given[storey] *= np.float32(factor)
    return replace(seen, given=given)


def weighed(belief: Belief, graph: PlaceGraph, storey: Storey) -> Belief:
    """The belief by what the robot states of its level (:mod:`core.judgement.priors`)."""
    if storey.level == NO_LEVEL or not len(graph):
        return belief
    given: NDArray[np.float32] = belief.given * (
        1 - TRUST + TRUST * OnLevels((storey.level,)).fit(graph.whereabouts)
    ).astype(np.float32)
    inside = float(given.sum(dtype=np.float64))
    known = (1 - belief.unknown) * inside
    return replace(belief, given=given / np.float32(inside), unknown=belief.unknown / (known + belief.unknown))
