"""The pose of a query frame, estimated from the poses of the places that it matches.

The estimate is the mean of the poses of the best match and of the matches within reach of it, weighted by their odds.
Places further away that look alike are other answers and take no part.  On the Earth, the mean is taken of points in
space and projected back to the surface, and headings are directions in space, so that nothing jumps at ±180° or at a
pole.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from core.places import EARTH_RADIUS, GEOGRAPHIC, NO_POSE, Pose, Whereabouts

Vectors = NDArray[np.float64]


@dataclass(frozen=True)
class PoseEstimate:
    """An estimated pose, with a heading if the places have any, and its uncertainty.

    spread: metres, the standard deviation of the distance; see :func:`estimate_pose`.
    heading_spread: degrees, the circular standard deviation; None with fewer than two headings.
    places: how many places the estimate rests on.
    """

    pose: Pose
    spread: float
    heading_spread: float | None
    places: int


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


def estimate_pose(places: Whereabouts, log_weights: ArrayLike, reach: float, used: int = 20) -> PoseEstimate | None:
    """Estimate the pose of a frame from its matches.

    The square of the spread is the weighted mean square distance of the poses from their mean, plus the square of half
    the distance from the best match to its nearest neighbour among the places (half the reach if none is within it): a
    frame taken between two places looks like one of them, and its distance from that one is not known.

    Args:
        places: of n matches, best first; only the first ``used`` count for the mean.
        log_weights: [n], the log odds of each match; only their differences matter.
        reach: metres from the best match within which other matches belong to its answer.

    Returns:
        None if there is no match, or the best one has no pose.
    """
    if len(places) == 0 or places.kind[0] == NO_POSE:
        return None
    distance = np.sqrt(np.square(places.position - places.position[0]).sum(axis=1))
    distance[places.kind != places.kind[0]] = np.inf
    part = np.flatnonzero(distance[:used] <= reach)
    odds = np.asarray(log_weights, np.float64)[part]
    weights = np.exp(np.minimum(odds - odds[0], 0.0))
    weights /= weights.sum()
    chosen = places.take(part)
    mean = weights @ chosen.position
    on_earth = bool(places.kind[0] == GEOGRAPHIC)
    if on_earth:
        length = float(np.linalg.norm(mean))
        mean = chosen.position[0] if length < 1 else mean * (EARTH_RADIUS / length)
    squares = weights @ np.square(chosen.position - mean).sum(axis=1)
    apart = distance[(distance > 0) & (distance <= reach)]
    gap = float(apart.min()) if len(apart) else reach
    heading, heading_spread = _heading(chosen, weights, mean, on_earth)
    pose = _geographic(mean, heading) if on_earth else Pose(x=mean[0], y=mean[1], z=mean[2], heading=heading)
    return PoseEstimate(pose, float(np.sqrt(squares + (gap / 2) ** 2)), heading_spread, len(part))


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
