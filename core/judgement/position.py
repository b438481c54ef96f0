"""The pose of a query frame, estimated from the poses of the places that it matches.

Without a look at the geometry, the estimate is the mean of the poses of the best match and of the matches within reach
of it, weighted by their odds.  Places further away that look alike are other answers and take no part.  On the Earth,
the mean is taken of points in space and projected back to the surface, and headings are directions in space, so that
nothing jumps at ±180° or at a pole.

Where verified places give the relative pose of the query's camera (:mod:`core.geometry.pose`), that mean is the prior
of a least squares problem: the position x, the heading ψ and the logarithm of the scene's typical distance ζ are to
agree with each place's shift s and turn t,

    s = W^T (x - a) exp(-ζ),    t = ψ - φ,

with the place's position a, its heading φ and its attitude W.  The errors of views are not independent, as they share
the query, so n of them count as one (covariance intersection with equal weights; Julier and Uhlmann, 1997).  Given ζ,
the problem is linear.  As ζ is hardly known from one view and the position depends on its exponential, it is solved for
a row of values, which make a mixture.  They are weighed by the prior of ζ, by the evidence of the view, and by how many
points the query shares with each place where that is known: fewer are shared from farther away.

Where the best match and another place share points with the query and the intrinsics are known, that estimate is only
where a bundle adjustment begins (:mod:`core.geometry.bundle`).  It gets the mean of the places as a prior that is wide.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from core.geometry.bundle import Stand, bundle_stand, decline_misses, decline_variance
from core.geometry.pose import RelativeView, SharedPoints, mixture_moments
from core.places import EARTH_RADIUS, GEOGRAPHIC, NO_POSE, NO_SEQUENCE, Pose, Whereabouts

Vectors = NDArray[np.float64]
PoseSource = Literal["places", "intrinsics", "field-of-view"]

UNKNOWN_HEIGHT = 1e6
"""Variance of a height that nothing is known of, in m²."""
UNKNOWN_ANGLE = float(np.pi**2 / 3)
"""Variance of an angle that nothing is known of: that of a uniform distribution over the circle, in rad²."""
TURN = float(np.radians(20))
"""Deviation of a query's heading from that of a place which it matches, if no view of both gives it."""
PLACE_HEADING = float(np.radians(2))
"""Deviation of the errors of places' headings."""
PLACE_POSITION = 0.05
"""Deviation of the errors of places' positions, in metres."""
LEVEL = float(np.radians(8))
"""Deviation of a place's pitch and roll, which poses do not give: it tilts a shift by as much."""
DISTANCE, DISTANCE_DEVIATION = float(np.log(8)), 1.0
"""Mean and deviation of the logarithm of the typical distance of a scene in metres: mostly 3 to 22 m."""
DISTANCES = np.linspace(-2.5, 2.5, 11)
"""Deviations from that mean at which the pose is computed; the answers make a mixture."""
UNUSED = 1e4
"""Variance by which the shift of a view without intrinsics takes no part: on real traverses it was further off than its
covariance says."""
CONTRADICTION = 30.0
"""Squared Mahalanobis distance from which on a view of four values contradicts the places, and is not used."""
WRONG_SHARE, WRONG_SLOPE = 0.115, 0.016
"""The share of keypoints that fit at which half of the shifts are wrong, and how fast that changes; looked at on a
street, where frames were recognized from up to 25 m away, and most matches that fit were wrong there."""
SHARING_DEVIATION = 0.4
"""Deviation of the logarithm of the ratio of distances that counts of shared points tell where no points are adjusted;
they are no independent evidence, so those of several places count as one."""
WIDEST_GAP = 16.0
"""Metres between places from which on a frame halfway shows neither; on a street it still did at 14."""
BUNDLED = 4
"""The most places whose points are adjusted together."""
BUNDLE_REACH = 30.0
"""Metres from the best match within which places are."""
APART = 0.2
"""Metres that they are apart at least: looks from one position say nothing of distances."""
BUNDLE_HEADING = float(np.radians(0.5))
"""Deviation of the errors of places' headings, where several places show them."""
FARTHEST = 2.0
"""Factor of the distance from the nearest place that is likely, from which on an adjusted pose is refused."""
HEIGHT_SLOPE = 0.2
"""Slope of the ground by which the height of a frame differs from that of its place on the Earth: few roads are
steeper."""
SLOPE = float(np.radians(4))
"""Deviation of the slope of the ground, by which heights of places that poses do not give are off."""


def _unknown() -> Vectors:
    return np.diag([UNKNOWN_HEIGHT] * 3 + [UNKNOWN_ANGLE] * 3)


@dataclass(frozen=True)
class PlaceErrors:
    """How exact the poses of n places are.

    metres: float64 [n], the deviation of a coordinate along the ground; NaN where it is not known.
    radians: float64 [n], that of the heading; NaN where it is not known.
    turned: float64 [n], by how much their cameras look to the left of their headings, in radians, as pictures show.
    in_common: whether places that stand together may be off by the same, so that all are no surer than one.
    """

    metres: Vectors
    radians: Vectors
    turned: Vectors
    in_common: bool = True

    @classmethod
    def unknown(cls, count: int) -> PlaceErrors:
        """Those of places of which nothing is known."""
        return cls(np.full(count, np.nan), np.full(count, np.nan), np.zeros(count))

    def take(self, rows: ArrayLike) -> PlaceErrors:
        """Those of some places."""
        chosen = np.asarray(rows)
        return replace(self, metres=self.metres[chosen], radians=self.radians[chosen], turned=self.turned[chosen])

    def position(self) -> Vectors:
        """The deviations of positions, [n], with the usual one where none is known."""
        return np.where(np.isfinite(self.metres), self.metres, PLACE_POSITION)

    def heading(self, usual: float) -> Vectors:
        """The deviations of headings, [n], with a usual one where none is known; none is less."""
        return np.fmax(self.radians, usual)


@dataclass(frozen=True)
class PoseEstimate:
    """An estimated pose, with a heading if the places have any, and its uncertainty.

    spread: metres, the standard deviation of the distance; see :func:`estimate_pose`.
    heading_spread: degrees.  The circular standard deviation of the places' headings, None with fewer than two; or, if
        views give the heading, the standard deviation of its error.
    places: how many places the estimate rests on.
    covariance: float64 [6, 6], of errors in x, y, z (metres) and of rotations about x, y and z (radians), as in ROS.
        The axes are those of the map's frame or, for a pose on the Earth, east, north and up at the pose.  The rotation
        about z is counter-clockwise, also where headings are clockwise.  Unknown components have a large variance.
    heading_offset, offset_spread: degrees, by which the heading differs from that of the best match, counted as
        headings are, and its standard deviation; None if no view gives it.
    source: the basis of the covariance: the poses of places alone, or also views with intrinsics, or without.
    """

    pose: Pose
    spread: float
    heading_spread: float | None
    places: int
    covariance: Vectors = field(default_factory=_unknown)
    heading_offset: float | None = None
    offset_spread: float | None = None
    source: PoseSource = "places"

    def at_height(self, height: float | None) -> PoseEstimate:
        """The same at the height of a place, which is known as well as the ground is level; None: it is not known."""
        found = self.without_height()
        if height is None:
            return found
        found.covariance[2, 2] = PLACE_POSITION**2 + (HEIGHT_SLOPE * self.spread) ** 2
        return replace(found, pose=found.pose.model_copy(update={"z": height}))

    def without_height(self) -> PoseEstimate:
        """The same where places have no height: the pose has none, and its variance is that of one not known."""
        covariance = self.covariance.copy()
        covariance[2], covariance[:, 2] = 0, 0
        covariance[2, 2] = UNKNOWN_HEIGHT
        return replace(self, pose=self.pose.model_copy(update={"z": None}), covariance=covariance)


def circular_mean(degrees: ArrayLike, weights: ArrayLike) -> tuple[float, float]:
    """Mean direction and circular standard deviation √(-2 ln R), degrees (Fisher, Statistical analysis of circular
    data, 1993, eqs. 2.9 and 2.12).

    Args:
        degrees: [n], n >= 1.
        weights: [n], not negative, not all 0.

    Returns:
        The mean in [0, 360) and the deviation, which is infinite if the directions cancel out.
    """
    angles, share = np.radians(np.asarray(degrees, np.float64)), np.asarray(weights, np.float64)
    share = share / share.sum()
    x, y = float(share @ np.cos(angles)), float(share @ np.sin(angles))
    return float(np.degrees(np.arctan2(y, x))) % 360, _deviation(float(np.hypot(x, y)))


def _deviation(length: float) -> float:
    """The circular standard deviation in degrees, from the length R of the mean of unit vectors."""
    length = min(length, 1.0)
    return float("inf") if length <= 1e-12 else float(np.degrees(np.sqrt(max(0.0, -2 * np.log(length)))))


def _north_east(position: Vectors) -> tuple[Vectors, Vectors]:
    """Unit vectors to the north and to the east at points of the sphere, each [n, 3].

    At a pole they are those of the meridian with which the point was computed.
    """
    x, y, z = position.T
    theta, phi = np.arctan2(y, x), np.arctan2(z, np.hypot(x, y))
    north = np.stack([-np.sin(phi) * np.cos(theta), -np.sin(phi) * np.sin(theta), np.cos(phi)], axis=1)
    east = np.stack([-np.sin(theta), np.cos(theta), np.zeros_like(theta)], axis=1)
    return north, east


def _geographic_heading(places: Whereabouts, weights: Vectors, at: Vectors) -> tuple[float, float]:
    """The mean heading at a point of the sphere, and its circular standard deviation, in degrees."""
    angles = np.radians(places.heading.astype(np.float64))[:, np.newaxis]
    north, east = _north_east(places.position)
    direction = weights @ (np.cos(angles) * north + np.sin(angles) * east)
    (north_here,), (east_here,) = _north_east(at[np.newaxis])
    along, across = float(direction @ north_here), float(direction @ east_here)
    return float(np.degrees(np.arctan2(across, along))) % 360, _deviation(float(np.hypot(along, across)))


def estimate_pose(
    places: Whereabouts,
    log_weights: ArrayLike,
    reach: float,
    used: int = 20,
    views: Sequence[RelativeView | None] | None = None,
    sightings: Sequence[SharedPoints | None] | None = None,
    errors: PlaceErrors | None = None,
) -> PoseEstimate | None:
    """Estimate the pose of a frame from its matches.

    Without views, the square of the spread is the weighted mean square distance of the poses from their mean, plus the
    square of half the distance from the best match to its neighbour (:func:`gap_around`): a frame taken between two
    places looks like one of them, and its distance from that one is not known.
    With views, it is the sum of the variances of x and y.

    Args:
        places: of n matches, best first; only the first ``used`` count for the mean.
        log_weights: [n], the log odds of each match; only their differences matter.
        reach: metres from the best match within which other matches belong to its answer.
        views: how the query's camera stands to those of the first places, in their order; None where a place was not
            verified.  The heading of a place is taken for the direction in which its camera looks.
        sightings: the points that the query shares with the first places, however far they are from the best match, by
            the intrinsics of both cameras; None where these are not known or a place was not verified.
        errors: how exact the poses of the places are; None: nothing is known.  An answer is no surer than its best
            match, for places that stand together may all be off by the same.  Where cameras look aside of the headings,
            shifts are taken in the directions in which they look, and the heading's variance has the square of that.

    Returns:
        None if there is no match, or the best one has no pose.
    """
    if len(places) == 0 or places.kind[0] == NO_POSE:
        return None
    errors = errors or PlaceErrors.unknown(len(places))
    if errors.turned.any():
        return _turned_back(places, log_weights, reach, used, views, sightings, errors)
    distance = np.sqrt(np.square(places.position - places.position[0]).sum(axis=1))
    distance[places.kind != places.kind[0]] = np.inf
    part = np.flatnonzero(distance[:used] <= reach)
    odds = np.asarray(log_weights, np.float64)[part]
    weights = np.exp(np.minimum(odds - odds[0], 0.0))
    weights /= weights.sum()
    chosen, exact = places.take(part), errors.take(part)
    mean = weights @ chosen.position
    on_earth = bool(places.kind[0] == GEOGRAPHIC)
    if on_earth:
        length = float(np.linalg.norm(mean))
        mean = chosen.position[0] if length < 1 else mean * (EARTH_RADIUS / length)
    squares = weights @ np.square(chosen.position - mean).sum(axis=1)
    gap = gap_around(places, reach)
    heading, heading_spread = _heading(chosen, weights, mean, on_earth)
    axes = _axes(mean) if on_earth else np.eye(3)
    local = (chosen.position - mean) @ axes.T
    covariance = _unknown()
    covariance[:3, :3] = local.T @ (weights[:, np.newaxis] * local) + np.eye(3) * (
        gap**2 / 8 + exact.position()[0] ** 2
    )
    if heading is not None:
        covariance[5, 5] = np.radians(heading_spread or 0.0) ** 2 + TURN**2 + np.nan_to_num(exact.radians[0]) ** 2
    pose = _geographic(mean, heading) if on_earth else Pose(x=mean[0], y=mean[1], z=mean[2], heading=heading)
    off = 2 * np.nan_to_num(exact.metres[0]) ** 2
    found = PoseEstimate(pose, float(np.sqrt(squares + (gap / 2) ** 2 + off)), heading_spread, len(part), covariance)
    seen = {row: view for row, view in enumerate(views or ()) if view is not None}
    if 0 in seen:
        sign = -1 if on_earth else 1
        found = replace(found, heading_offset=sign * seen[0].heading_offset, offset_spread=seen[0].heading_spread)
    directions = _directions(chosen, axes, on_earth)
    rows = [place for place, row in enumerate(part) if row in seen and np.isfinite(directions[place])]
    shared = _points_of_places(places, mean, axes, on_earth, reach, sightings or (), errors)
    if rows and heading is not None:
        yaw = float(np.radians(90 - heading if on_earth else heading))
        place_views = _PlaceViews(
            local[rows], directions[rows], [seen[int(part[row])] for row in rows], exact.take(rows)
        )
        found = _fused(found, place_views, yaw, mean, axes, on_earth, shared)
    if heading is not None and shared is not None:
        likely = max(gap / 2, reach)
        standing = (places.position[places.kind == places.kind[0]] - mean) @ axes.T
        found = _bundled(found, covariance, mean, axes, on_earth, seen.get(0), shared, standing, likely)
    found = _no_surer(found, exact) if exact.in_common else found
    return found.without_height() if on_earth else found


def _turned_back(
    places: Whereabouts,
    log_weights: ArrayLike,
    reach: float,
    used: int,
    views: Sequence[RelativeView | None] | None,
    sightings: Sequence[SharedPoints | None] | None,
    errors: PlaceErrors,
) -> PoseEstimate | None:
    """The estimate by the directions in which cameras look, with a heading as those of the places are."""
    sign = -1 if places.kind[0] == GEOGRAPHIC else 1
    heading = ((places.heading + sign * np.degrees(errors.turned)) % 360).astype(np.float32)
    straight = replace(errors, turned=np.zeros(len(places)))
    looking = replace(places, heading=heading)
    found = estimate_pose(looking, log_weights, reach, used, views, sightings, straight)
    if found is None or found.pose.heading is None:
        return found
    turn, covariance = float(errors.turned[0]), found.covariance.copy()
    covariance[5, 5] += turn**2
    return replace(
        found,
        pose=found.pose.model_copy(update={"heading": (found.pose.heading - sign * np.degrees(turn)) % 360}),
        heading_spread=float(np.degrees(np.sqrt(covariance[5, 5]))),
        covariance=covariance,
    )


def _no_surer(found: PoseEstimate, exact: PlaceErrors) -> PoseEstimate:
    """The estimate with variances along the ground and of the heading that are no less than those of the best match."""
    covariance = found.covariance.copy()
    if np.isfinite(metres := exact.metres[0]):
        values, vectors = np.linalg.eigh(covariance[:2, :2])
        raised = np.maximum(values, metres**2)
        covariance[:2, :2] = vectors @ np.diag(raised) @ vectors.T
    covariance[5, 5] = np.fmax(covariance[5, 5], exact.radians[0] ** 2)
    if found.source == "places":
        return replace(found, covariance=covariance)
    spread, heading_spread = np.sqrt(covariance[0, 0] + covariance[1, 1]), np.degrees(np.sqrt(covariance[5, 5]))
    return replace(found, covariance=covariance, spread=float(spread), heading_spread=float(heading_spread))


def gap_around(places: Whereabouts, reach: float) -> float:
    """Metres between the best match, the first of n places, and its neighbour in its traverse.

    Where its traverse has no other place, or it is of none, that is the nearest place of all.  Places less than APART
    away are no neighbours, and a traverse beside it says nothing of the frames between those of its own.  More than
    WIDEST_GAP or the reach, whichever is more, counts as that.
    """
    distance = np.linalg.norm(places.position - places.position[0], axis=1)
    usable = (places.kind == places.kind[0]) & (distance >= APART)
    own = usable & (places.sequence == places.sequence[0]) & (places.sequence != NO_SEQUENCE)
    nearest = float(distance[own if own.any() else usable].min(initial=np.inf))
    return min(nearest, max(reach, WIDEST_GAP))


def places_apart(places: Whereabouts, reach: float, order: Sequence[int], most: int) -> list[int]:
    """The first rows of an order whose places tell, with the best match, how far a query is, at most ``most``.

    They are within BUNDLE_REACH of it, and it and they stand half the gap around it apart: frames that were taken side
    by side say nothing of distances.
    """
    least = max(APART, gap_around(places, reach) / 2)
    chosen = [0]
    for row in order:
        if len(chosen) > most:
            break
        away = np.linalg.norm(places.position[chosen] - places.position[row], axis=1)
        if places.kind[row] == places.kind[0] and away[0] <= BUNDLE_REACH and away.min() >= least:
            chosen.append(row)
    return chosen[1:]


@dataclass(frozen=True)
class _PlaceViews:
    """Positions of n places from the mean, [n, 3], headings counter-clockwise from x, [n], their views and errors."""

    positions: Vectors
    directions: Vectors
    views: list[RelativeView]
    errors: PlaceErrors


def _fused(
    found: PoseEstimate,
    place_views: _PlaceViews,
    yaw: float,
    mean: Vectors,
    axes: Vectors,
    on_earth: bool,
    shared: _PlacePoints | None,
) -> PoseEstimate:
    """The estimate fused with the views; unchanged if all of them contradict it.

    Args:
        shared: the points of several places, whose counts say how far the query is; None: not known.
    """
    prior = np.zeros((5, 5))  # of x, y, z, ψ and ζ
    prior[:3, :3] = found.covariance[:3, :3]
    prior[3, 3], prior[4, 4] = found.covariance[5, 5], DISTANCE_DEVIATION**2
    begin = np.r_[np.zeros(3), yaw, DISTANCE]
    retained = [
        number
        for number in range(len(place_views.views))
        if _contradiction(begin, prior, place_views, number) < CONTRADICTION
    ]
    if not retained:
        return found
    information = np.linalg.inv(prior[:4, :4])
    states, covariances, costs = [], [], []
    for deviations in DISTANCES:
        # With the distance of the scene given, the problem is linear.  Its evidence has the room that x and y have in
        # it; a robot drives on the ground, so z does not count, which the prior leaves as free.
        at = begin + np.r_[np.zeros(4), deviations * DISTANCE_DEVIATION]
        normal, gradient, cost = information.copy(), np.zeros(4), float(deviations**2)
        for number in retained:
            residual, jacobian, noise = _missed(at, place_views, number)
            precision = np.linalg.inv(noise * len(retained))
            weighed = jacobian[:, :4].T @ precision
            normal, gradient = normal + weighed @ jacobian[:, :4], gradient + weighed @ residual
            cost += float(residual @ precision @ residual + np.linalg.slogdet(noise)[1])
        covariance = np.linalg.inv(normal)
        states.append(begin[:4] - covariance @ gradient)
        covariances.append(covariance)
        costs.append(cost - float(gradient @ covariance @ gradient + np.linalg.slogdet(covariance[:2, :2])[1]))
    total = np.array(costs)
    if shared is not None:
        missed, _ = decline_misses(np.array(states)[:, :3], shared.positions, shared.counts)
        variance = SHARING_DEVIATION**2 + decline_variance(shared.positions, shared.errors.position() ** 2)
        total += (np.square(missed) / variance).mean(axis=1)
    weights = np.exp((total.min() - total) / 2)
    state, posterior = mixture_moments(weights / weights.sum(), np.array(states), np.array(covariances))
    # A wrong view, whose turn is mostly right all the same, leaves the position where the places put it.
    wrong = float(np.prod([_wrong(place_views.views[number]) for number in retained]))
    positions, spreads = np.array([state[:3], begin[:3]]), np.array([posterior[:3, :3], prior[:3, :3]])
    state[:3], posterior[:3, :3] = mixture_moments(np.array([1 - wrong, wrong]), positions, spreads)
    posterior[:3, 3] *= 1 - wrong
    posterior[3, :3] *= 1 - wrong
    covariance = found.covariance.copy()
    which = [0, 1, 2, 5]
    covariance[np.ix_(which, which)] = posterior
    pose = _pose_at(mean + state[:3] @ axes, float(np.degrees(state[3])), on_earth)
    sources = {place_views.views[number].source for number in retained}
    return replace(
        found,
        pose=pose,
        spread=float(np.sqrt(covariance[0, 0] + covariance[1, 1])),
        heading_spread=float(np.degrees(np.sqrt(covariance[5, 5]))),
        covariance=covariance,
        source="field-of-view" if "field-of-view" in sources else "intrinsics",
    )


def _wrong(view: RelativeView) -> float:
    """The probability that the shift of a view is wrong, by the share of keypoints that fit."""
    return float(1 / (1 + np.exp((view.share - WRONG_SHARE) / WRONG_SLOPE)))


@dataclass(frozen=True)
class _PlacePoints:
    """The points that the query shares with k places, the best match first.

    positions: from the mean, [k, 3].
    directions: headings counter-clockwise from x, [k].
    counts: of points that fit, [k].
    """

    positions: Vectors
    directions: Vectors
    counts: Vectors
    sightings: list[SharedPoints]
    errors: PlaceErrors


def _points_of_places(
    places: Whereabouts,
    mean: Vectors,
    axes: Vectors,
    on_earth: bool,
    reach: float,
    sightings: Sequence[SharedPoints | None],
    errors: PlaceErrors,
) -> _PlacePoints | None:
    """The points of the places that share most with the query; None where these are not two that stand apart."""
    if not sightings or sightings[0] is None:
        return None
    local = (places.position - mean) @ axes.T
    directions = _directions(places, axes, on_earth)
    counts = {
        row: int(sighting.fitting.sum())
        for row, sighting in enumerate(sightings)
        if sighting is not None and np.isfinite(directions[row])
    }
    counts = {row: count for row, count in counts.items() if count}
    if 0 not in counts:
        return None
    rows = [0, *places_apart(places, reach, sorted(counts, key=lambda row: -counts[row]), BUNDLED - 1)]
    if len(rows) < 2:
        return None
    number = np.array([counts[row] for row in rows], np.float64)
    seen = [one for row in rows if (one := sightings[row])]
    return _PlacePoints(local[rows], directions[rows], number, seen, errors.take(rows))


def _bundled(
    found: PoseEstimate,
    prior: Vectors,
    mean: Vectors,
    axes: Vectors,
    on_earth: bool,
    view: RelativeView | None,
    shared: _PlacePoints,
    standing: Vectors,
    likely: float,
) -> PoseEstimate:
    """The estimate by the points of several places together; unchanged if they do not tell it.

    Args:
        standing: where places are, [k, 3].
        likely: metres from the nearest of them within which a frame is recognized.  A pose that is farther away is
            off by the rest, as far as anyone knows, and refused from FARTHEST times that on.
    """

    def stand_of(position: Vectors, direction: float, metres: float, heading: float, measured: bool) -> Stand:
        height = PLACE_POSITION + SLOPE * float(np.linalg.norm(position - shared.positions[0]))
        covariance = np.diag(np.square([LEVEL, LEVEL, heading, metres, metres, height]))
        return Stand(position, _level(direction), covariance, measured)

    exact = shared.errors
    columns = exact.position(), exact.heading(BUNDLE_HEADING), np.isfinite(exact.metres)
    stands = [stand_of(*one) for one in zip(shared.positions, shared.directions, *columns, strict=True)]
    position, yaw = _of(found.pose, mean, axes, on_earth)
    attitude = _level(yaw) if view is None else stands[0].attitude @ view.turn
    loose = np.zeros((6, 6))
    loose[:3, :3] = np.diag(np.full(3, LEVEL**2))
    loose[2, 2] = TURN**2
    loose[3:, 3:] = prior[:3, :3] * 4 + np.eye(3)
    best = Stand(np.zeros(3), _level(yaw), loose)
    stand = bundle_stand(best, stands, shared.sightings, Stand(position, attitude, loose))
    if stand is None:
        return found
    beyond = float(np.linalg.norm((standing - stand.position)[:, :2], axis=1).min()) - likely
    if beyond > (FARTHEST - 1) * likely:
        return found
    covariance = found.covariance.copy()
    which = [3, 4, 5, 2]
    covariance[np.ix_([0, 1, 2, 5], [0, 1, 2, 5])] = stand.covariance[np.ix_(which, which)]
    covariance[:2, :2] += np.eye(2) * max(beyond, 0.0) ** 2
    ahead = stand.attitude[:, 0]
    made = _pose_at(mean + stand.position @ axes, float(np.degrees(np.arctan2(ahead[1], ahead[0]))), on_earth)
    return replace(
        found,
        pose=made,
        spread=float(np.sqrt(covariance[0, 0] + covariance[1, 1])),
        heading_spread=float(np.degrees(np.sqrt(covariance[5, 5]))),
        covariance=covariance,
        places=len(stands),
        source="intrinsics",
    )


def _pose_at(position: Vectors, degrees: float, on_earth: bool) -> Pose:
    """The pose at a position, [3], with a heading counter-clockwise from the first axis."""
    if on_earth:
        return _geographic(position, (90 - degrees) % 360)
    return Pose(x=position[0], y=position[1], z=position[2], heading=degrees % 360)


def _level(angle: float) -> Vectors:
    """The attitude of a level camera that looks in a direction counter-clockwise from x, [3, 3]."""
    cos, sin = np.cos(angle), np.sin(angle)
    return np.array([[cos, -sin, 0], [sin, cos, 0], [0, 0, 1]])


def _of(pose: Pose, mean: Vectors, axes: Vectors, on_earth: bool) -> tuple[Vectors, float]:
    """The position of a pose from the mean, [3], and its heading counter-clockwise from x, in radians."""
    assert pose.heading is not None
    return (pose.position() - mean) @ axes.T, float(np.radians(90 - pose.heading if on_earth else pose.heading))


def _missed(state: Vectors, place_views: _PlaceViews, number: int) -> tuple[Vectors, Vectors, Vectors]:
    """By how much a state misses a view's shift and turn, [4], the derivatives, [4, 5], and the covariance, [4, 4]."""
    position, angle, view = place_views.positions[number], place_views.directions[number], place_views.views[number]
    cos, sin, nearness = np.cos(angle), np.sin(angle), np.exp(-state[4])
    back = np.array([[cos, sin, 0], [-sin, cos, 0], [0, 0, 1]])  # W^T
    shift = back @ (state[:3] - position) * nearness
    turn = wrapped(state[3] - angle - np.radians(view.heading_offset))
    jacobian = np.zeros((4, 5))
    jacobian[:3, :3], jacobian[:3, 4], jacobian[3, 3] = back * nearness, -shift, 1
    which = [3, 4, 5, 2]
    turned = np.r_[view.shift[1], -view.shift[0], 0, -1]  # by an error of the place's heading
    noise = (
        view.covariance[np.ix_(which, which)]
        + np.outer(turned, turned) * place_views.errors.heading(PLACE_HEADING)[number] ** 2
    )
    level = np.square(view.shift).sum() * LEVEL**2
    noise = (
        noise
        + np.diag([0, 0, level, 0])
        + np.diag([1, 1, 1, 0]) * (place_views.errors.position()[number] * nearness) ** 2
    )
    if view.source == "field-of-view":
        noise = noise + np.diag([UNUSED, UNUSED, UNUSED, 0])
    return np.r_[shift - view.shift, turn], jacobian, noise


def _contradiction(state: Vectors, prior: Vectors, place_views: _PlaceViews, number: int) -> float:
    """The squared Mahalanobis distance of a view from what a state with a prior lets expect."""
    residual, jacobian, noise = _missed(state, place_views, number)
    return float(residual @ np.linalg.solve(jacobian @ prior @ jacobian.T + noise, residual))


def _axes(at: Vectors) -> Vectors:
    """Unit vectors to the east, to the north and up at a point of the sphere, [3, 3]."""
    (north,), (east,) = _north_east(at[np.newaxis])
    return np.stack([east, north, np.cross(east, north)])


def bearing_between(places: Whereabouts, one: int, other: int) -> float:
    """The direction from a place to another counter-clockwise from the first axis, or from the east, in radians."""
    away = places.position[other] - places.position[one]
    if places.kind[one] == GEOGRAPHIC:
        away = _axes(places.position[one]) @ away
    return float(np.arctan2(away[1], away[0]))


def _directions(places: Whereabouts, axes: Vectors, on_earth: bool) -> Vectors:
    """Headings counter-clockwise from the first axis, in radians, [n]; NaN where they are not known."""
    angles = np.radians(places.heading.astype(np.float64))
    if not on_earth:
        return angles
    north, east = _north_east(places.position)
    ahead = np.cos(angles)[:, np.newaxis] * north + np.sin(angles)[:, np.newaxis] * east
    x, y, _ = (ahead @ axes.T).T
    return np.asarray(np.arctan2(y, x))


def _heading(places: Whereabouts, weights: Vectors, mean: Vectors, on_earth: bool) -> tuple[float | None, float | None]:
    known = np.flatnonzero(np.isfinite(places.heading))
    if not len(known):
        return None, None
    shares = weights[known] / weights[known].sum()
    found = places.take(known)
    heading, spread = _geographic_heading(found, shares, mean) if on_earth else circular_mean(found.heading, shares)
    if not np.isfinite(spread):  # they point anywhere
        return None, None
    return heading % 360, spread if len(known) > 1 else None


def _geographic(position: Vectors, heading: float | None) -> Pose:
    x, y, z = position.tolist()
    latitude = float(np.degrees(np.arctan2(z, np.hypot(x, y))))
    longitude = float(np.degrees(np.arctan2(y, x)))
    return Pose(latitude=latitude, longitude=longitude, heading=heading)


def wrapped(angle: ArrayLike) -> Any:
    """Angles in radians in [-π, π), as they are given: a number or an array."""
    return (np.asarray(angle) + np.pi) % (2 * np.pi) - np.pi
