"""Where a query's camera stands among several places whose poses are known: a bundle adjustment.

One place tells in which direction the query's camera stands, and not how far.  Directions from two places meet in a
point, but on a road that point is badly determined, as both places and the query are on one line.  The sizes at which
points are seen tell it all the same: a point that the query shares with two places has one distance, and the known
distance of the places is its scale (Triggs et al., "Bundle adjustment – a modern synthesis", 2000).

The query's camera has the centre c and the attitude A, a place's c_k and A_k; a point that the query sees in the
direction b has the nearness (1 / distance) ρ.  A place sees it in the direction of

    v = A b + ρ (c - c_k),

and what is missed is v / |v| - A_k p, with the direction p in which the place's picture has it.  Poses of places
say neither height nor tilt and have errors, so c_k and A_k are values with priors as well.  The sum of robust squares
is minimized by the method of Levenberg and Marquardt, in which the nearnesses, each of which belongs to one point, are
eliminated (Schur's complement).  The covariance is the inverse of the reduced normal equations.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from core.geometry.pose import BODY, NOISE, NOISE_LIMITS, OUTLYING, Sighting

Array = NDArray[np.float64]

MOST_POINTS = 250
"""More points are thinned out evenly, those first that only one place shares."""
LEAST_SHARED = 12
"""Points that the query shares with two places at least: the scale is theirs."""
NEARNESS_DEVIATION = 0.5
"""Prior deviation of a point's nearness, in 1 / m."""
MOST_NEARNESS = 4.0
"""Nothing is seen from nearer than 25 cm."""
LENGTHS = 0.0, 0.25, 0.5, 1.0, 1.5, 2.0, 3.0, 4.0, 5.0, 6.5, 8.0, 10.0, 13.0, 16.0
"""Metres that the query is tried to be from the best match, in the direction of its shift."""
INFLATION = 1.5
"""Factor of the covariance of directions, as errors of keypoints are not independent."""
LEAST_FITTING = 0.5
"""The share of a place's directions that are within three deviations; with less, the place is left out."""
MOST_STEPS = 12
ENOUGH = 0.05
"""The cost is twice a logarithm of a likelihood; a step that lowers it by less is the last."""


@dataclass(frozen=True)
class Stand:
    """Where a camera is thought to stand.

    position: float64 [3], metres.
    attitude: float64 [3, 3], from the camera's axes (ahead, left, up) to those of the world.
    covariance: float64 [6, 6], of a small rotation about the world's axes that follows the attitude (radians), and of
        the position.
    """

    position: Array
    attitude: Array
    covariance: Array


@dataclass(frozen=True)
class _Bundle:
    """The directions of n points in the query and in k places.

    bearings: of the query, in the camera's axes, [n, 3].
    numbers: of each place, which of the points it sees, [m].
    seen: of each place, their directions in the camera's axes, [m, 3].
    noise: of each place, of a direction, in radians.
    stands: the query's prior, then those of the places.
    """

    bearings: Array
    numbers: list[NDArray[np.int64]]
    seen: list[Array]
    noise: list[float]
    stands: list[Stand]

    @property
    def information(self) -> Array:
        """The inverses of the priors' covariances on a diagonal of blocks, [6 k + 6, 6 k + 6]."""
        size = 6 * len(self.stands)
        made = np.zeros((size, size))
        for at, stand in enumerate(self.stands):
            made[6 * at : 6 * at + 6, 6 * at : 6 * at + 6] = np.linalg.inv(stand.covariance)
        return made


@dataclass(frozen=True)
class _State:
    """Attitudes [k + 1, 3, 3] and positions [k + 1, 3] of the query and of the places, and nearnesses, [n]."""

    attitudes: Array
    positions: Array
    nearness: Array


def bundle_stand(query: Stand, places: Sequence[Stand], sightings: Sequence[Sighting], start: Stand) -> Stand | None:
    """Where the query's camera stands, by the points that it shares with places.

    Args:
        query: what is known of it otherwise, loosely.
        places: at least one, the best match first.
        sightings: of the points that the query shares with each.
        start: where the search begins: its attitude is nearly right, and so is its direction from the best match.

    Returns:
        None if two places share too few points, if they do not differ in position, or if the best match does not fit.
    """
    used = list(range(len(places)))
    while len(used) > 1:
        bundle = _bundle(query, [places[at] for at in used], [sightings[at] for at in used])
        if bundle is None:
            return None
        state = _minimized(bundle, _start(bundle, start))
        bundle = _with_measured_noise(bundle, state)
        state = _minimized(bundle, state)
        shares = [float(np.mean(squares < 9)) for squares in _squares(bundle, state)]
        worst = int(np.argmin(shares))
        if shares[worst] >= LEAST_FITTING:
            return _stand(bundle, state)
        if worst == 0:
            return None
        used.pop(worst)
    return None


def _bundle(query: Stand, places: Sequence[Stand], sightings: Sequence[Sighting]) -> _Bundle | None:
    """The points that are used; None if two places share too few."""
    usable = [np.flatnonzero(sighting.usable()) for sighting in sightings]
    most = 1 + max(int(sighting.numbers.max(initial=0)) for sighting in sightings)
    count, bearings = np.zeros(most, np.int64), np.zeros((most, 3))
    for sighting, rows in zip(sightings, usable, strict=True):
        count[sighting.numbers[rows]] += 1
        bearings[sighting.numbers[rows]] = sighting.query[rows] @ BODY.T
    shared, single = np.flatnonzero(count > 1), np.flatnonzero(count == 1)
    if len(shared) < LEAST_SHARED:
        return None
    chosen = _thinned(shared, MOST_POINTS)
    chosen = np.r_[chosen, _thinned(single, MOST_POINTS - len(chosen))]
    points = np.full(most, -1)
    points[chosen] = np.arange(len(chosen))
    numbers, seen = [], []
    for sighting, rows in zip(sightings, usable, strict=True):
        rows = rows[points[sighting.numbers[rows]] >= 0]
        numbers.append(points[sighting.numbers[rows]])
        seen.append(sighting.place[rows] @ BODY.T)
    noise = [NOISE * sighting.pixel for sighting in sightings]
    if min(len(rows) for rows in numbers) == 0:
        return None
    return _Bundle(bearings[chosen], numbers, seen, noise, [query, *places])


def _thinned(values: NDArray[np.int64], most: int) -> NDArray[np.int64]:
    """At most ``most`` of them, evenly."""
    return values[np.linspace(0, len(values) - 1, max(0, min(len(values), most))).round().astype(np.int64)]


def _start(bundle: _Bundle, start: Stand) -> _State:
    """The best state on the way from the best match to where the search begins."""
    _, *places = bundle.stands
    away = start.position - places[0].position
    length = float(np.linalg.norm(away))
    directions = [away / length, -away / length] if length > 1e-9 else [start.attitude[:, 0], -start.attitude[:, 0]]
    tried = [start.position, *(places[0].position + far * way for way in directions for far in LENGTHS)]
    attitudes = np.array([start.attitude, *(place.attitude for place in places)])
    best, least = None, np.inf
    for position in tried:
        positions = np.array([position, *(place.position for place in places)])
        state = _State(attitudes, positions, np.zeros(len(bundle.bearings)))
        state = replace(state, nearness=_nearness(bundle, state))
        cost = _cost(bundle, state)
        if cost < least:
            best, least = state, cost
    assert best is not None
    return best


def _nearness(bundle: _Bundle, state: _State) -> Array:
    """The nearness of each point at which its directions come nearest to each other, [n]."""
    ahead = bundle.bearings @ state.attitudes[0].T
    above, below = np.zeros(len(ahead)), np.full(len(ahead), 1e-9)
    for at, (numbers, seen) in enumerate(zip(bundle.numbers, bundle.seen, strict=True), 1):
        ray = seen @ state.attitudes[at].T
        crossed = np.cross(ray, ahead[numbers])
        moved = np.cross(ray, state.positions[0] - state.positions[at])
        above[numbers] -= (crossed * moved).sum(axis=1)
        below[numbers] += np.square(moved).sum(axis=1)
    return np.clip(above / below, 0, MOST_NEARNESS)


def _missed(bundle: _Bundle, state: _State, at: int) -> tuple[Array, Array, Array]:
    """v / |v| - A_k p of a place's points, [m, 3], |v|, [m, 1], and A_k p, [m, 3]."""
    numbers = bundle.numbers[at]
    ahead = bundle.bearings[numbers] @ state.attitudes[0].T
    v = ahead + state.nearness[numbers, np.newaxis] * (state.positions[0] - state.positions[at + 1])
    length = np.maximum(np.linalg.norm(v, axis=1, keepdims=True), 1e-9)
    ray = bundle.seen[at] @ state.attitudes[at + 1].T
    return v / length - ray, length, ray


def _squares(bundle: _Bundle, state: _State) -> list[Array]:
    """The squares of what is missed by the noise, of each place [m]; both pictures have noise, hence the two."""
    return [
        np.square(_missed(bundle, state, at)[0]).sum(axis=1) / (2 * noise**2) for at, noise in enumerate(bundle.noise)
    ]


def _prior_misses(bundle: _Bundle, state: _State) -> Array:
    """By how much the poses miss their priors, [6 k + 6]."""
    return np.concatenate(
        [
            np.r_[cv2.Rodrigues(attitude @ stand.attitude.T)[0][:, 0], position - stand.position]
            for stand, attitude, position in zip(bundle.stands, state.attitudes, state.positions, strict=True)
        ]
    )


def _cost(bundle: _Bundle, state: _State) -> float:
    """Twice the negative log likelihood with the priors, but for constants."""
    robust = sum(float((squares / (1 + squares / OUTLYING**2)).sum()) for squares in _squares(bundle, state))
    missed = _prior_misses(bundle, state)
    near = float(np.square(state.nearness / NEARNESS_DEVIATION).sum())
    return robust + float(missed @ bundle.information @ missed) + near


@dataclass(frozen=True)
class _Normal:
    """The normal equations: of poses [6 k + 6] squared, of nearnesses, a diagonal [n], and of both, [n, 6 k + 6]."""

    poses: Array
    nearness: Array
    mixed: Array
    poses_gradient: Array
    nearness_gradient: Array

    def reduced(self, damping: float = 0.0) -> tuple[Array, Array, Array]:
        """The equations without nearnesses, their right side, and the damped diagonal of the nearnesses."""
        diagonal = self.nearness * (1 + damping)
        shared = self.mixed / diagonal[:, np.newaxis]
        matrix = self.poses + damping * np.diag(np.diag(self.poses)) - self.mixed.T @ shared
        return matrix, self.poses_gradient - shared.T @ self.nearness_gradient, diagonal


def _normal_equations(bundle: _Bundle, state: _State, inflation: float = 1.0) -> _Normal:
    size, count = 6 * len(bundle.stands), len(bundle.bearings)
    information = bundle.information
    poses, gradient = information.copy(), information @ _prior_misses(bundle, state)
    prior = 1 / NEARNESS_DEVIATION**2
    nearness, mixed, slope = np.full(count, prior), np.zeros((count, size)), state.nearness * prior
    for at, (numbers, noise) in enumerate(zip(bundle.numbers, bundle.noise, strict=True)):
        missed, length, ray = _missed(bundle, state, at)
        seen = missed + ray
        squares = np.square(missed).sum(axis=1) / (2 * noise**2)
        weights = 1 / np.square(1 + squares / OUTLYING**2) / (2 * noise**2 * inflation)
        tangent = (np.eye(3) - seen[:, :, np.newaxis] * seen[:, np.newaxis]) / length[:, :, np.newaxis]
        near = state.nearness[numbers, np.newaxis, np.newaxis]
        ahead = bundle.bearings[numbers] @ state.attitudes[0].T
        jacobian = np.empty((len(numbers), 3, 12))
        jacobian[:, :, :3] = -tangent @ _crossing(ahead)
        jacobian[:, :, 3:6] = near * tangent
        jacobian[:, :, 6:9] = _crossing(ray)
        jacobian[:, :, 9:] = -near * tangent
        by_nearness = tangent @ (state.positions[0] - state.positions[at + 1])
        weighted = jacobian * weights[:, np.newaxis, np.newaxis]
        which = np.r_[0:6, 6 * at + 6 : 6 * at + 12]
        flat = weighted.reshape(-1, 12)
        poses[np.ix_(which, which)] += flat.T @ jacobian.reshape(-1, 12)
        gradient[which] += flat.T @ missed.reshape(-1)
        nearness[numbers] += weights * np.square(by_nearness).sum(axis=1)
        slope[numbers] += weights * (by_nearness * missed).sum(axis=1)
        mixed[numbers[:, np.newaxis], which] += np.einsum("mij,mi->mj", weighted, by_nearness)
    return _Normal(poses, nearness, mixed, gradient, slope)


def _crossing(vectors: Array) -> Array:
    """The matrices of v ×, [m, 3, 3]."""
    made = np.zeros((len(vectors), 3, 3))
    x, y, z = vectors.T
    made[:, 0, 1], made[:, 0, 2], made[:, 1, 2] = -z, y, -x
    made[:, 1, 0], made[:, 2, 0], made[:, 2, 1] = z, -y, x
    return made


def _minimized(bundle: _Bundle, state: _State) -> _State:
    """The state at the minimum of the cost that is reached from one (Levenberg and Marquardt)."""
    cost, damping = _cost(bundle, state), 1e-3
    normal = _normal_equations(bundle, state)
    for _ in range(MOST_STEPS):
        matrix, right, diagonal = normal.reduced(damping)
        step = -np.linalg.solve(matrix, right)
        nearer = -(normal.nearness_gradient + normal.mixed @ step) / diagonal
        tried = _moved(state, step, nearer)
        less = cost - _cost(bundle, tried)
        if less > 0:
            state, cost, damping = tried, cost - less, damping / 5
            if less < ENOUGH:
                break
            normal = _normal_equations(bundle, state)
        elif damping > 1e6:
            break
        else:
            damping *= 10
    return state


def _moved(state: _State, step: Array, nearer: Array) -> _State:
    """The state after a step of the poses, [6 k + 6], and of the nearnesses, [n]."""
    steps = step.reshape(-1, 6)
    attitudes = np.array(
        [cv2.Rodrigues(turn)[0] @ attitude for turn, attitude in zip(steps[:, :3], state.attitudes, strict=True)]
    )
    nearness = np.clip(state.nearness + nearer, 0, MOST_NEARNESS)
    return _State(attitudes, state.positions + steps[:, 3:], nearness)


def _with_measured_noise(bundle: _Bundle, state: _State) -> _Bundle:
    """The bundle with the noise that directions have, by the median of the squares.

    Of each place's two values for a point, the free nearness takes a part.
    """
    squares = np.concatenate(_squares(bundle, state))
    free = max(0.2, 1 - (len(bundle.bearings) + 6) / (2 * len(squares)))
    low, high = NOISE_LIMITS
    factor = float(np.clip(np.sqrt(np.median(squares) / (1.386 * free)), low, high))
    return replace(bundle, noise=[factor * noise for noise in bundle.noise])


def _stand(bundle: _Bundle, state: _State) -> Stand:
    matrix, _, _ = _normal_equations(bundle, state, INFLATION).reduced()
    covariance = np.asarray(np.linalg.inv(matrix), np.float64)
    return Stand(state.positions[0], state.attitudes[0], covariance[:6, :6])
