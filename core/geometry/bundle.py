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
from functools import cached_property

import cv2
import numpy as np
from numpy.typing import NDArray

from core.geometry.pose import BODY, NOISE, NOISE_LIMITS, SharedPoints, mixture_moments
from core.kernels import bundle as kernels

Array = NDArray[np.float64]

MOST_POINTS = 160
"""More points are thinned out evenly, those first that only one place shares."""
LEAST_SHARED = 16
"""Points that the query shares with two places at least: the scale is theirs.  With 12 of them poses were up to 8 m off
on rendered streets; 20 leave more answers to two views and cover no more."""
NEARNESS_DEVIATION = 0.5
"""Prior deviation of a point's nearness, in 1 / m."""
MOST_NEARNESS = 4.0
"""Nothing is seen from nearer than 25 cm."""
LENGTHS = np.linspace(0.25, 15, 60)
"""Metres that the query is tried to be from the best match, in the direction of its shift."""
FACTORS = -0.6, 0.5, 1.0, 1.7
"""Of the length at which the counts of shared points are best explained, the starts."""
DECLINE, DECLINE_DEVIATION = 1.5, 0.3
"""Power of the ratio of counts of shared points that gives the inverse ratio of distances, and the deviation of the
logarithm."""
LEAST_DISTANCE = 0.3
"""Metres to a place from which on fewer points are shared."""
LEAST_LIKENESS = 0.95
"""Of the descriptors of points that another place shares, as a share of the median of those of the best match."""
BLUR = 3.0
"""Factor of the noise at first, so that more observations lead the way to the minimum."""
FIRST_STEPS = 3
"""From each start."""
FOLLOWED = 4
"""The starts that are followed to their minima."""
SAME = 0.02
"""Minima that differ by less, in metres, are one."""
TEMPERATURE = 16.0
"""Minima are weighed by the exponential of half their cost over this, as points are no independent evidence."""
NEGLIGIBLE = 1e-3
"""Weight from which on a minimum is a part of the mixture."""
INFLATION, AGREEING = 2.0, 300.0
"""Factor of the variance of directions, as errors of keypoints are not independent, and the number of points shared
with several places below which it grows in inverse proportion: of few, wrong ones agree.  On rendered streets with
bends (photographs of train/) the normalized error was 3.6 with 12 to 19 points and 0.7 with more than 68.  There 240
and 300 cover 0.93 and 0.94 of the errors, 120 covers 0.88."""
OUTLYING = 2.0
"""Residuals of this many deviations weigh a quarter (Geman and McClure, 1985).

Of matches of frames that are 10 m apart, half are wrong along the epipolar line, where verification cannot tell."""
CASES = 0.5
"""Cases as which the prior of the errors of places' headings and positions counts beside what their pictures show."""
LOOSE_HEADING, LOOSE_POSITION = 3.0, 5.0
"""Factors of these deviations at first: where poses of a map are less exact than is thought, its pictures show it."""
LEAST_VARIANCE = 0.04
"""Share of the prior's variance that is left of it at least."""
LEAST_FITTING = 0.5
"""The share of a place's directions that are within three deviations; with less, the place is left out."""
MOST_STEPS = 8
ENOUGH = 1.0
"""The cost is twice a logarithm of a likelihood; a step that lowers it by less is the last."""


@dataclass(frozen=True)
class Stand:
    """Where a camera is thought to stand.

    position: float64 [3], metres.
    attitude: float64 [3, 3], from the camera's axes (ahead, left, up) to those of the world.
    measured: whether the covariance is known of this pose; else the pictures show how large usual errors are.
    covariance: float64 [6, 6], of a small rotation about the world's axes that follows the attitude (radians), and of
        the position.
    """

    position: Array
    attitude: Array
    covariance: Array
    measured: bool = False


@dataclass(frozen=True)
class _Bundle:
    """The directions of n points in the query and in k places, o observations.

    bearings: of the query, in the camera's axes, [n, 3].
    point: which of the points an observation is of, int64 [o].
    place: which place sees it, from 1, int64 [o].
    seen: its direction in the axes of the place's camera, [o, 3].
    noise: of each place, of a direction, in radians, [k].
    stands: the query's prior, then those of the places.
    counts: of points that the query shares with each place, [k].
    """

    bearings: Array
    point: NDArray[np.int64]
    place: NDArray[np.int64]
    seen: Array
    noise: Array
    stands: list[Stand]
    counts: Array

    @cached_property
    def information(self) -> Array:
        """The inverses of the priors' covariances on a diagonal of blocks, [6 k + 6, 6 k + 6]."""
        size = 6 * len(self.stands)
        made = np.zeros((size, size))
        for at, stand in enumerate(self.stands):
            made[6 * at : 6 * at + 6, 6 * at : 6 * at + 6] = np.linalg.inv(stand.covariance)
        return made

    @cached_property
    def scale(self) -> Array:
        """One by the variance of what an observation misses, [o]: both pictures have noise, hence the two."""
        return 1 / (2 * self.noise[self.place - 1] ** 2)

    def state(self, query: Stand) -> _State:
        """The state with the query's camera at some stand and the places where they are thought to be."""
        stands = [query, *self.stands[1:]]
        attitudes = np.array([stand.attitude for stand in stands], np.float64)
        positions = np.array([stand.position for stand in stands], np.float64)
        nearness = np.empty(len(self.bearings))
        kernels.nearest(self.bearings, self.point, self.place, self.seen, attitudes, positions, MOST_NEARNESS, nearness)
        return _State(attitudes, positions, nearness)

    def squares(self, state: _State) -> Array:
        """The squares of what observations miss, by their variance, [o]."""
        found = np.empty(len(self.point))
        kernels.squares(
            self.bearings, self.point, self.place, self.seen, self.scale,
            state.attitudes, state.positions, state.nearness, found,
        )  # fmt: skip
        return found

    def cost(self, state: _State) -> float:
        """Twice the negative log likelihood with the priors, but for constants."""
        squares, missed = self.squares(state), self.prior_misses(state)
        near = float(state.nearness @ state.nearness) / NEARNESS_DEVIATION**2
        decline, _ = self.declines(state.positions[:1])
        return (
            float((squares / (1 + squares / OUTLYING**2)).sum() + missed @ self.information @ missed)
            + near
            + float(np.square(decline).sum())
        )

    def declines(self, tried: Array) -> tuple[Array, Array]:
        """By how much the counts of shared points miss distances of the query, and the derivatives.

        Args:
            tried: positions of the query, [n, 3].

        Returns:
            [n, k - 1] and [n, k - 1, 3].
        """
        missed, slopes = decline_misses(tried, self.places, self.counts)
        errors = np.array([stand.covariance[3, 3] for stand in self.stands[1:]])
        by = np.sqrt((DECLINE_DEVIATION**2 + decline_variance(self.places, errors)) * (len(self.counts) - 1))
        return missed / by, slopes / by[:, np.newaxis]

    @cached_property
    def places(self) -> Array:
        """Where the places are thought to be, [k, 3]."""
        return np.array([stand.position for stand in self.stands[1:]])

    def prior_misses(self, state: _State) -> Array:
        """By how much the poses miss their priors, [6 k + 6]."""
        turned = state.attitudes @ np.array([stand.attitude.T for stand in self.stands])
        shifted = state.positions - np.array([stand.position for stand in self.stands])
        return np.hstack([[cv2.Rodrigues(turn)[0][:, 0] for turn in turned], shifted]).ravel()

    def normal_equations(self, state: _State, inflation: float = 1.0) -> _Normal:
        """The normal equations at a state, with the variance of observations multiplied by a factor."""
        size, count = 6 * len(self.stands), len(self.bearings)
        poses, gradient = self.information.copy(), self.information @ self.prior_misses(state)
        prior = 1 / NEARNESS_DEVIATION**2
        nearness, mixed, slope = np.full(count, prior), np.zeros((count, size)), state.nearness * prior
        kernels.normal_equations(
            self.bearings, self.point, self.place, self.seen, self.scale / inflation,
            state.attitudes, state.positions, state.nearness, OUTLYING**2 / inflation,
            poses, gradient, nearness, slope, mixed,
        )  # fmt: skip
        (decline,), (by_position,) = self.declines(state.positions[:1])
        poses[3:6, 3:6] += by_position.T @ by_position
        gradient[3:6] += by_position.T @ decline
        return _Normal(poses, nearness, mixed, gradient, slope)

    def loosened(self) -> _Bundle:
        """The bundle with larger errors of places' headings and positions, which their pictures then show.

        Those that were measured stay.
        """
        factors = np.ones(6)
        factors[2], factors[3:5] = LOOSE_HEADING, LOOSE_POSITION
        wide = np.outer(factors, factors)
        loose = [one if one.measured else replace(one, covariance=one.covariance * wide) for one in self.stands[1:]]
        return replace(self, stands=[self.stands[0], *loose])

    def with_measured_noise(self, state: _State) -> _Bundle:
        """The bundle with the noise that directions have, and places' headings and positions.

        Directions: of each place by the median of the squares.  Of each point's values, the free nearness takes one.
        Headings and positions in the plane: by the squares of what they miss, beside which the prior is CASES cases.
        Errors that were measured do not become smaller.
        """
        squares = self.squares(state)
        free = max(0.2, 1 - (len(self.bearings) + 6) / (2 * len(squares)))
        medians = [float(np.median(squares[self.place == at])) for at in range(1, len(self.stands))]
        factors = np.clip(np.sqrt(np.array(medians) / (1.386 * free)), *NOISE_LIMITS)
        misses = np.square(self.prior_misses(state).reshape(-1, 6)[1:])
        stands = [self.stands[0]]
        for stand in self.stands[1:]:
            covariance = stand.covariance.copy()
            least = 1.0 if stand.measured else LEAST_VARIANCE
            for which in ([2], [3, 4]):
                known = covariance[which[0], which[0]]
                total = CASES * known + misses[:, which].sum()
                learnt = max(total / (CASES + (len(misses) - 1) * len(which)), least * known)
                covariance[which, which] = learnt
            stands.append(replace(stand, covariance=covariance))
        return replace(self, noise=self.noise * factors, stands=stands)


@dataclass(frozen=True)
class _State:
    """Attitudes [k + 1, 3, 3] and positions [k + 1, 3] of the query and of the places, and nearnesses, [n]."""

    attitudes: Array
    positions: Array
    nearness: Array

    def moved(self, step: Array, nearer: Array) -> _State:
        """The state after a step of the poses, [6 k + 6], and of the nearnesses, [n]."""
        steps = step.reshape(-1, 6)
        turns = np.array([cv2.Rodrigues(turn)[0] for turn in steps[:, :3]])
        nearness = np.clip(self.nearness + nearer, 0, MOST_NEARNESS)
        return _State(turns @ self.attitudes, self.positions + steps[:, 3:], nearness)


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


def decline_misses(tried: Array, places: Array, counts: Array) -> tuple[Array, Array]:
    """By how much counts of shared points miss the distances of a query from places, and the derivatives.

    Fewer points are shared from farther away, whatever the size of the scene.

    Args:
        tried: positions of the query, [n, 3].
        places: where the places are, the best match first, [k, 3].
        counts: of points that the query shares with each, [k].

    Returns:
        Of the logarithm of the ratio of the query's distances from the best match and from each other place, [n, k - 1]
        and [n, k - 1, 3].
    """
    away = tried[:, np.newaxis] - places
    squares = np.square(away).sum(axis=2) + LEAST_DISTANCE**2
    logarithms, slopes = np.log(squares) / 2, away / squares[:, :, np.newaxis]
    expected = DECLINE * np.log(counts[1:] / counts[0])
    return logarithms[:, :1] - logarithms[:, 1:] - expected, slopes[:, :1] - slopes[:, 1:]


def decline_variance(places: Array, errors: Array) -> Array:
    """The variance that errors of positions give to what counts miss, of a query halfway, float64 [k - 1].

    Args:
        places: where the places are, the best match first, [k, 3].
        errors: variances of a coordinate of each, [k].
    """
    halfway = np.square(places[1:] - places[0]).sum(axis=1) / 4 + LEAST_DISTANCE**2
    return np.asarray((errors[0] + errors[1:]) / halfway, np.float64)


def bundle_stand(
    query: Stand, places: Sequence[Stand], sightings: Sequence[SharedPoints], start: Stand
) -> Stand | None:
    """Where the query's camera stands, by the points that it shares with places.

    Args:
        query: what is known of it otherwise, loosely.
        places: at least one, the best match first.
        sightings: of the points that the query shares with each.
        start: where the search begins: its attitude is nearly right, and so is its direction from the best match.

    Returns:
        None if two places share too few points, or if the best match does not fit.
    """
    used = list(range(len(places)))
    while len(used) > 1:
        bundle = _bundle(query, [places[at] for at in used], [sightings[at] for at in used])
        if bundle is None:
            return None
        found, bundle = _minima(bundle, start)
        fits = bundle.squares(found[0][1]) < 9
        shares = [float(np.mean(fits[bundle.place == at])) for at in range(1, len(used) + 1)]
        worst = int(np.argmin(shares))
        if shares[worst] >= LEAST_FITTING:
            return _mixture([(cost, _stand(bundle, state)) for cost, state in found])
        if worst == 0:
            return None
        used.pop(worst)
    return None


def _bundle(query: Stand, places: Sequence[Stand], sightings: Sequence[SharedPoints]) -> _Bundle | None:
    """The points that are used; None if two places share too few, or a place has none of them."""
    best, *others = sightings
    if not best.usable().any():
        return None
    alike = LEAST_LIKENESS * float(np.median(best.likeness[best.usable()]))
    usable = [np.flatnonzero(best.usable())]
    usable += [np.flatnonzero(sighting.usable() & (sighting.likeness > alike)) for sighting in others]
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
    kept = [rows[points[sighting.numbers[rows]] >= 0] for sighting, rows in zip(sightings, usable, strict=True)]
    if min(map(len, kept)) == 0:
        return None
    pairs = list(zip(sightings, kept, strict=True))
    return _Bundle(
        bearings[chosen],
        np.concatenate([points[sighting.numbers[rows]] for sighting, rows in pairs]),
        np.repeat(np.arange(1, len(kept) + 1), list(map(len, kept))),
        np.ascontiguousarray(np.concatenate([sighting.place[rows] for sighting, rows in pairs]) @ BODY.T),
        np.array([NOISE * sighting.pixel for sighting in sightings]),
        [query, *places],
        np.array([sighting.fitting.sum() for sighting in sightings], np.float64),
    )


def _thinned(values: NDArray[np.int64], most: int) -> NDArray[np.int64]:
    """At most ``most`` of them, evenly."""
    return values[np.linspace(0, len(values) - 1, max(0, min(len(values), most))).round().astype(np.int64)]


def _minima(bundle: _Bundle, start: Stand) -> tuple[list[tuple[float, _State]], _Bundle]:
    """The minima of the cost, best first, and the bundle with the noise that was measured at the best one."""
    best = bundle.stands[1]
    away = start.position - best.position
    length = float(np.linalg.norm(away))
    direction = away / length if length > 1e-9 else start.attitude[:, 0]
    tried = best.position + LENGTHS[:, np.newaxis] * direction
    likely = float(LENGTHS[np.square(bundle.declines(tried)[0]).sum(axis=1).argmin()])
    loose = bundle.loosened()
    blurred = replace(loose, noise=loose.noise * BLUR)
    starts = [start.position, *(best.position + factor * likely * direction for factor in FACTORS)]
    begun = [_minimized(blurred, bundle.state(replace(start, position=position)), FIRST_STEPS) for position in starts]
    begun.sort(key=lambda pair: pair[0])
    followed = _distinct([_minimized(loose, state) for _, state in begun[:FOLLOWED]])
    learnt = bundle.with_measured_noise(followed[0][1])
    return _distinct([_minimized(learnt, state) for _, state in followed]), learnt


def _distinct(minima: list[tuple[float, _State]]) -> list[tuple[float, _State]]:
    """The minima, best first, without those at which the query stands where it does at a better one."""
    found: list[tuple[float, _State]] = []
    for cost, state in sorted(minima, key=lambda pair: pair[0]):
        at = state.positions[0]
        if all(np.linalg.norm(at - other.positions[0]) > SAME for _, other in found):
            found.append((cost, state))
    return found


def _minimized(bundle: _Bundle, state: _State, steps: int = MOST_STEPS) -> tuple[float, _State]:
    """The cost and the state at the minimum that is reached from one (Levenberg and Marquardt)."""
    cost, damping = bundle.cost(state), 1e-3
    normal = bundle.normal_equations(state)
    for _ in range(steps):
        matrix, right, diagonal = normal.reduced(damping)
        step = -np.asarray(np.linalg.solve(matrix, right), np.float64)
        tried = state.moved(step, -(normal.nearness_gradient + normal.mixed @ step) / diagonal)
        less = cost - bundle.cost(tried)
        if less > 0:
            state, cost, damping = tried, cost - less, damping / 5
            if less < ENOUGH:
                break
            normal = bundle.normal_equations(state)
        elif damping > 1e6:
            break
        else:
            damping *= 10
    return cost, state


def _stand(bundle: _Bundle, state: _State) -> Stand:
    shared = int((np.bincount(bundle.point) > 1).sum())
    matrix, _, _ = bundle.normal_equations(state, INFLATION * max(1.0, AGREEING / max(shared, 1))).reduced()
    covariance = np.asarray(np.linalg.inv(matrix), np.float64)
    return Stand(state.positions[0], state.attitudes[0], covariance[:6, :6])


def _mixture(minima: Sequence[tuple[float, Stand]]) -> Stand:
    """The minima as one."""
    least, first = minima[0]
    weights = np.array([np.exp((least - cost) / (2 * TEMPERATURE)) for cost, _ in minima])
    weights = np.where(weights > NEGLIGIBLE, weights, 0) / weights[weights > NEGLIGIBLE].sum()
    at = np.array([np.r_[cv2.Rodrigues(one.attitude @ first.attitude.T)[0][:, 0], one.position] for _, one in minima])
    mean, covariance = mixture_moments(weights, at, np.array([one.covariance for _, one in minima]))
    return Stand(mean[3:], np.asarray(cv2.Rodrigues(mean[:3])[0] @ first.attitude), covariance)
