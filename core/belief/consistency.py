"""Whether the motion that odometry reports agrees with the places that frames show, each recognized by itself.

A *sighting* is such a frame: where its place is, p, and where odometry has led, w, laid onto the map leg by leg, each
from the heading of the place that was seen before it.  Explanations of the last sightings are compared by their
marginal likelihoods, which are Gaussian and in closed form:

* odometry as stated:  p = c + w, with its drift, headings that are known roughly, and the variance that it states, or
  none, whichever fits better;
* odometry of an unknown scale and turn:  p = c + s·w, with any complex s;
* odometry of no use:  p = c + v·k at the k-th sighting, with any velocity v, or none.

Each has the noise of the places and an unknown origin c.  As what is true may have changed at any time, the last four
sightings are tried, and the last five, and so on, and the surest decides (the generalized likelihood ratio of a
sequential test; Basseville and Nikiforov, Detection of abrupt changes, 1993, section 2.4).  After a decision only the
sightings that led to it are left, so that what was before says nothing about what is.

A leap, where a sighting fits neither odometry nor the course of those before, is a robot that was carried off or a
wrong sighting, and no fault of odometry: the sightings before it are left out or, if the next one fits them, it is.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from core.belief.evidence import Evidence
from core.belief.graph import PlaceGraph
from core.belief.motion import DRIFT, HEADING_SPREAD, Odometry
from core.belief.odometry import OdometryPose
from core.judgement.background import GUARD_FACTOR

ContradictionKind = Literal["frozen", "scale", "turned", "units", "inconsistent"]
"""How odometry differs from what frames show: it stands still, goes farther or less far, goes another way, is in
another unit, or has nothing to do with it."""

SURE = 0.5
"""A frame recognized by itself is a sighting from this probability on, as in learning."""

LEAST, MOST = 4, 14
"""Sightings that are needed to decide, and that are remembered."""

PLACED, BETWEEN = 0.25, 0.3
"""Standard deviation of a sighting's place, besides what its evidence leaves open: in same-place radii, and in
distances of the map's places.  The first was chosen on corridor and lip6; 0.2 and 0.3 do as well."""

WHOLE = 1.5
"""What a frame says of the places around, as a multiple of its evidence, which counts less than half of that.  With
2.5, 42 of 1454 frames of true odometry on lip6 are called contradicted, with 1.5 none; faults are noticed as soon."""

SPREADS = (1.0, 3.0, 10.0)
"""Standard deviations of the unknown scale, and of the unknown velocity in distances of the map's places."""

FARTHER, VAGUEST = 10.0, 1e8
"""Odometry that goes this many times farther than frames show is as far as can be, and so is a variance of this many
times that of a sighting: larger numbers say no more, and could not be computed with."""

DENIED, AGREED = 5.0, 3.5
"""Log likelihood ratios from which odometry is contradicted, and from which it agrees again.  On corridor and lip6 the
faults of ``benchmarks.day`` are noticed after 4 frames (median; a scale of 0.3 after 6) and true odometry is never
called contradicted, with 4 to 6 alike.  With 2.5, a scale of 3 agrees now and then; with 4, the end of a fault is
noticed two frames later."""

APART = 0.8
"""A sighting is taken where the robot has moved since the last one, by odometry or by the places, this far in distances
of the map's places or in double deviations of a sighting, whichever is less: more of one spot say nothing."""

STILL = 0.1
"""Odometry stands still if it moves by less than this share of what frames show."""

SCALED, TURNED = 1.25, math.radians(30)
"""A scale or a turn is given as the fault from here on."""

UNITS = {1000.0: "millimetres", 100.0: "centimetres", 0.001: "kilometres"}
"""Units in which a robot may state its odometry by mistake, and how many of them are a metre."""


@dataclass(frozen=True)
class Contradiction:
    """What is wrong with odometry.

    note: a sentence for a person.
    """

    kind: ContradictionKind
    note: str


@dataclass(frozen=True)
class SeenPlace:
    """One sighting, and the leg of odometry that led to it from the one before.

    row: of the map.
    offset, spread: mean of where the frame may have been taken, x + iy from that place, metres, and the variance along
        each axis, metres², by its evidence for the places around.
    leg, by_degrees: x + iy in the map's directions, metres; the second if headings that were given as degrees are
        radians.
    variance: of the leg along each axis, metres², by its length alone; ``stated``: what odometry adds to that.
    """

    row: int
    offset: complex = 0j
    spread: float = 0.0
    leg: complex = 0j
    by_degrees: complex = 0j
    variance: float = 0.0
    stated: float = 0.0


@dataclass(frozen=True)
class OdometryCheck:
    """What is known of a run's odometry.

    seen: the last sightings, the oldest first; ``aside``: those before a leap.
    motion: since the last sighting; None if it is not known.
    path: metres gone since then.
    pose: of odometry at the last sighting; None if there was none.
    contradiction: None while nothing speaks against odometry.
    """

    seen: tuple[SeenPlace, ...] = ()
    aside: tuple[SeenPlace, ...] = ()
    motion: Odometry | None = None
    path: float = 0.0
    pose: OdometryPose | None = None
    contradiction: Contradiction | None = None

    def moved(self, motion: Odometry | None) -> OdometryCheck:
        """After a motion; one that is not known leaves nothing to compare."""
        if motion is None:
            return OdometryCheck(contradiction=self.contradiction)
        if self.motion is None:
            return self
        return replace(self, motion=self.motion.then(motion), path=self.path + motion.distance)

    def sighted(self, seen: Evidence, pose: OdometryPose | None, graph: PlaceGraph) -> OdometryCheck:
        """After a frame that counts.

        Args:
            seen: the evidence of the frame, which is no sighting if it is not recognized by itself.
            pose: of odometry at the frame; None if there is none.
        """
        sighting = seen.sighting
        if sighting is None or sighting.probability < SURE or not _posed(graph, sighting.row):
            return self
        check = self if all(_posed(graph, one.row) for one in (*self.seen, *self.aside)) else replace(self, motion=None)
        if not check.seen or check.motion is None:
            return OdometryCheck((_seen_place(seen, graph),), (), Odometry(0.0), 0.0, pose, self.contradiction)
        new = check._reached(_seen_place(seen, graph), pose, graph)
        step = min(graph.spacing, 2 * _deviation(graph))
        if max(abs(new.leg), abs(_way(graph, [check.seen[-1], new])[1])) < APART * step:
            return self
        retained, aside = check._followed(new, graph)
        return replace(check, seen=retained, aside=aside, motion=Odometry(0.0), path=0.0, pose=pose)._decided(graph)

    def _reached(self, new: SeenPlace, pose: OdometryPose | None, graph: PlaceGraph) -> SeenPlace:
        assert self.motion is not None
        heading = float(graph.heading[_place(graph, self.seen[-1].row)])
        ahead = complex(self.motion.forward, self.motion.left)
        variance, stated = (DRIFT * self.path) ** 2, self.motion.variance
        if math.isnan(heading):
            return replace(new, variance=variance + 0.5 * abs(ahead) ** 2, stated=stated)
        by_degrees = ahead
        if pose is not None and self.pose is not None:
            before = math.degrees(self.pose.heading)
            by_degrees = complex(pose.x - self.pose.x, pose.y - self.pose.y) * np.exp(-1j * before)
        onto = complex(np.exp(1j * heading))
        variance += 0.5 * (HEADING_SPREAD * abs(ahead)) ** 2
        by_degrees = onto * complex(by_degrees)
        return replace(new, leg=onto * ahead, by_degrees=by_degrees, variance=variance, stated=stated)

    def _followed(self, new: SeenPlace, graph: PlaceGraph) -> tuple[tuple[SeenPlace, ...], tuple[SeenPlace, ...]]:
        """The sightings with a new one, and those before a leap."""
        if _fits((*self.seen, new), graph):
            return (*self.seen, new)[-MOST:], ()
        if not self.aside:
            return (replace(new, leg=0j, by_degrees=0j, variance=0.0, stated=0.0),), (*self.seen, new)
        *before, leapt = self.aside
        if _fits((*before, leapt, new), graph):  # a course of long strides
            return (*before, leapt, new)[-MOST:], ()
        skipped = replace(
            new,
            leg=leapt.leg + new.leg,
            by_degrees=leapt.by_degrees + new.by_degrees,
            variance=leapt.variance + new.variance,
            stated=leapt.stated + new.stated,
        )
        if _fits((*before, skipped), graph):  # one wrong sighting
            return (*before, skipped)[-MOST:], ()
        return (replace(new, leg=0j, by_degrees=0j, variance=0.0, stated=0.0),), (*before, skipped)

    def _decided(self, graph: PlaceGraph) -> OdometryCheck:
        if len(self.seen) < LEAST:
            return self
        against = _against(self.seen, graph)
        if self.contradiction is None:
            count = LEAST + int(np.argmax(against))
            if against.max() < DENIED:
                return self
        else:
            count = LEAST + int(np.argmin(against))
            if against.min() <= -AGREED:
                return replace(self, seen=self.seen[-count:], contradiction=None)
            count = len(self.seen)
        seen = self.seen[-count:]
        return replace(self, seen=seen, contradiction=described(seen, graph))


def _place(graph: PlaceGraph, row: int) -> int:
    return int(graph.places_at(np.array([row], np.int64))[0])


def _seen_place(seen: Evidence, graph: PlaceGraph) -> SeenPlace:
    """Where a frame that is recognized by itself was taken, by its evidence for the places around its own."""
    assert seen.sighting is not None
    place = _place(graph, seen.sighting.row)
    places, gains = graph.evidence_at(seen)
    around = graph.displacements(place, places)
    near = graph.posed[places] & (np.abs(around) <= GUARD_FACTOR * graph.neighborhood.radius)
    if not near.any():
        return SeenPlace(seen.sighting.row)
    weights = np.exp(WHOLE * (gains[near] - gains[near].max()).astype(np.float64))
    weights /= weights.sum()
    mean = complex(weights @ around[near])
    spread = 0.5 * float(weights @ np.square(np.abs(around[near] - mean)))
    return SeenPlace(seen.sighting.row, mean, spread)


def _posed(graph: PlaceGraph, row: int) -> bool:
    place = _place(graph, row)
    return place >= 0 and bool(graph.posed[place])


def _deviation(graph: PlaceGraph) -> float:
    return max(math.hypot(PLACED * graph.neighborhood.radius, BETWEEN * graph.spacing), 1e-3)


def _way(graph: PlaceGraph, seen: list[SeenPlace]) -> NDArray[np.complex128]:
    """Metres from the place of the first sighting to that of each, complex128 [n]."""
    places = graph.places_at(np.array([one.row for one in seen], np.int64))
    return graph.displacements(int(places[0]), places) + np.array([one.offset for one in seen])


def _fits(seen: tuple[SeenPlace, ...], graph: PlaceGraph) -> bool:
    """Whether the last sighting is near the one before, near where odometry leads from it, or near their course."""
    way = _way(graph, list(seen[-LEAST:]))
    step, leg = way[-1] - way[-2], seen[-1].leg
    expected = [0j, leg]
    if len(way) > 2:
        expected.append((way[-2] - way[0]) / (len(way) - 2))
    farthest = GUARD_FACTOR * max(graph.neighborhood.radius, graph.spacing) + 3 * math.sqrt(
        seen[-1].variance + seen[-1].stated
    )
    return min(abs(step - one) for one in expected) <= farthest


def _against(seen: tuple[SeenPlace, ...], graph: PlaceGraph) -> NDArray[np.float64]:
    """Log likelihood ratios of odometry being wrong to being as stated, by the last LEAST sightings, and more and more.

    float64 [n - LEAST + 1].  With the latest sighting first and as the origin, the leading minors of each covariance
    are those of fewer sightings, so that one Cholesky decomposition gives the likelihoods of all.
    """
    way = _way(graph, list(seen[::-1]))
    legs, _ = _legs(seen)
    number = np.arange(len(seen), dtype=np.float64)
    placed = _deviation(graph) ** 2
    noise = np.diag([placed + one.spread for one in reversed(seen)]) + 100**2 * placed
    drift, vague = (
        np.minimum(_spread_backwards([getattr(one, name) for one in seen]), VAGUEST * placed)
        for name in ("variance", "stated")
    )
    step = graph.spacing or 1.0
    longest = float(np.abs(legs).max()) / (FARTHER * float(np.abs(way).max() + _deviation(graph)))
    along, across = np.outer(legs, legs.conj()) / max(1.0, longest) ** 2, np.outer(number, number)
    explained: list[NDArray[np.inexact]] = [noise + drift, noise + drift + vague]
    explained += [noise + drift + spread**2 * along for spread in SPREADS]
    explained += [noise] + [noise + (spread * step) ** 2 * across for spread in SPREADS]
    rest = np.stack([way - legs] * 2 + [way] * (len(explained) - 2))
    factors = np.linalg.cholesky(2 * np.stack([one.astype(np.complex128) for one in explained]))
    white = np.linalg.solve(factors, rest[..., np.newaxis])[..., 0]
    scales = np.log(np.einsum("hkk->hk", factors).real)
    likely = -np.cumsum(np.square(np.abs(white)) + 2 * scales, axis=1)[:, LEAST - 1 :]
    others = likely[2:]
    return np.asarray(np.logaddexp.reduce(others, axis=0) - math.log(len(others)) - likely[:2].max(axis=0))


def _spread_backwards(variances: list[float]) -> NDArray[np.float64]:
    """Covariances of the positions from the latest on backwards, by the variance of the leg that led to each."""
    grown = np.concatenate([[0.0], np.cumsum(variances[:0:-1])])
    return np.minimum(grown[:, np.newaxis], grown)


def _legs(seen: tuple[SeenPlace, ...]) -> tuple[NDArray[np.complex128], NDArray[np.complex128]]:
    """Where odometry was at each sighting, from the latest on backwards, as stated and by degrees; complex128 [n]."""

    def back(values: list[complex]) -> NDArray[np.complex128]:
        return -np.concatenate([[0], np.cumsum(values[:0:-1])])

    return back([one.leg for one in seen]), back([one.by_degrees for one in seen])


def described(seen: tuple[SeenPlace, ...], graph: PlaceGraph) -> Contradiction:
    """What odometry looks like beside some sightings: frozen where it stands still by now, whatever it did before."""
    way = _way(graph, list(seen[::-1]))
    legs, by_degrees = _legs(seen)
    for count in (len(seen), LEAST):
        shown, gone = (float(np.linalg.norm(one[:count] - one[:count].mean())) for one in (way, legs))
        if gone < STILL * shown:
            extent = float(np.abs(way[:count]).max())
            return Contradiction("frozen", f"odometry stands still while frames show {extent:.0f} m of motion")
    way, legs, by_degrees = way - way.mean(), legs - legs.mean(), by_degrees - by_degrees.mean()
    shown, gone = float(np.linalg.norm(way)), float(np.linalg.norm(legs))
    missed = [float(np.linalg.norm(way - one)) for one in (legs, by_degrees)]
    ratio = complex(np.vdot(legs, way)) / gone**2
    left = float(np.linalg.norm(way - ratio * legs))
    if missed[1] < 0.5 * missed[0] and missed[1] <= 1.5 * left:
        return Contradiction("units", "the headings of odometry look like radians where degrees are expected")
    if left > 0.7 * shown:
        return Contradiction("inconsistent", "odometry goes another way than frames show, by no one scale or turn")
    scale, turn = 1 / max(abs(ratio), 1e-9), math.degrees(np.angle(ratio))
    for unit, name in UNITS.items():
        if 0.7 < scale / unit < 1.4:
            return Contradiction("units", f"odometry goes {scale:.3g} m for each metre of the map: {name}?")
    length = f"goes {scale:.2g} m for each metre of the map"
    if abs(math.radians(turn)) >= TURNED:
        more = "" if 1 / SCALED < scale < SCALED else f", and it {length}"
        return Contradiction("turned", f"the headings of odometry are turned by {turn:.0f}° against the map{more}")
    if not 1 / SCALED < scale < SCALED:
        return Contradiction("scale", f"odometry {length}")
    return Contradiction("inconsistent", "odometry goes another way than frames show, by no one scale or turn")
