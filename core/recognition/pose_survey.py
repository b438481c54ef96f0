"""How exact the poses of a map are: what the pictures of its places say of one another, against their poses.

Some places of each traverse are asked in the map without themselves.  How their camera stands to those around is known
from the pictures (:mod:`core.geometry.pose`), so three things show.

* The direction in which the camera has moved, in its own axes, against the bearing from pose to pose by the headings.
  Where most differ by one angle, headings are not the directions in which cameras look.  A camera that looks aside and
  whose headings say so differs by none.
* Turns against differences of headings: the errors of headings.
* The pose that the other places give against the stated one: the errors of positions are those that make these misses
  likeliest, beside what the pictures leave open.  Errors that all places around share do not show.

What somebody has stated of a place or of the map goes before what is found.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from threading import Lock, Thread
from typing import NamedTuple
from weakref import WeakKeyDictionary, WeakSet

import numpy as np
from numpy.typing import NDArray

from core.errors import PlacerecError, UnfitIntrinsics
from core.geometry.pose import RelativeView, SharedPoints, relative_view, sighting_of
from core.geometry.verification import verify
from core.judgement.position import (
    APART,
    BUNDLE_REACH,
    PlaceErrors,
    bearing_between,
    estimate_pose,
    places_apart,
    wrapped,
)
from core.maps import own_poses
from core.places import GEOGRAPHIC, NO_POSE, Whereabouts
from core.recognition.self_queries import spread_order
from core.recognition.stages import neighborhood_of
from core.store import Map

log = logging.getLogger(__name__)

Array = NDArray[np.float64]

SAMPLES, MOST_SAMPLES = 12, 36
"""Places of a traverse, and of all, that are asked; each takes some 0.1 s.  With 8 the estimated metres scattered by a
third on rendered streets, with 12 by a quarter."""
NEAREST = 12
"""Places around a sample that its pose may rest on."""
OTHERS = 3
"""How many of them are compared besides the nearest."""
TRIED = np.geomspace(0.06, 4.0, 4)
"""Deviations in metres that are tried; a parabola through the logarithms of likelihoods goes between them."""
USUAL, USUAL_DEVIATION = 0.1, 1.5
"""Metres that are usual, and the deviation of their logarithm: what few samples leave open."""
LEAST_KNOWN = 0.12
"""Metres from which on an estimate is used; with less, pictures hardly tell it from nothing."""
TAIL = 4.0
"""Degrees of freedom of Student's t, by which misses are judged: some are of wrong matches."""
LEAST_PAIRS, AGREED, WITHIN = 5, 0.7, 30.0
"""Directions that have to be known, and the share of them within so many degrees of their median for a turn."""
TURNED = 45.0
"""Degrees from which on headings are turned: less may be the camera's mounting, or noise."""
CLEAR = np.radians(20)
"""Deviation up to which the direction of a shift is known."""
LOOSE, FAR = np.radians(3.5), 1.2
"""Deviation by which directions of shifts are off besides, and how far pairs are whose bearings tell the errors of
positions, in medians: from far away shifts are often wrong, as on kitti_short from 14 m on."""
BACKWARDS = 0.1
"""Share of shifts that point backwards: from some 10 m away wrong matches may say on which side of the camera the scene
is, which has nothing to do with errors of positions."""
SATELLITES = 3.0
"""Metres: poses on the Earth, of which nobody states more, are by a receiver without corrections.  All places around
are off by the same, which no picture shows (GPS Standard Positioning Service, 2020: 95 % within 8 m at worst)."""
GROWN = 1.5
"""Factor of the number of places from which on a map is surveyed again."""


@dataclass(frozen=True)
class TraverseSurvey:
    """What pictures say of the poses of one traverse.

    metres: deviation of a coordinate; None: not known.
    degrees: of the heading; None: not known.
    turned: degrees by which cameras look to the left of the headings; 0: as far as they say, or not known.
    pairs: how many pairs of pictures the turn rests on.
    """

    sequence: str
    metres: float | None = None
    degrees: float | None = None
    turned: float = 0.0
    pairs: int = 0

    @property
    def remark(self) -> str | None:
        """A sentence for a person on headings that are turned; None: they are not."""
        if not self.turned:
            return None
        side = "left" if self.turned > 0 else "right"
        return (
            f"The headings of the traverse {self.sequence!r} are turned by {abs(self.turned):.0f}°: by {self.pairs} "
            f"pairs of its pictures the camera looks that far to the {side} of them. Camera axes? Give headings of the "
            "direction in which the camera looks."
        )


@dataclass(frozen=True)
class PoseSurvey:
    """What pictures say of the poses of a map, by the codes of its traverses."""

    traverses: dict[int, TraverseSurvey] = field(default_factory=dict)


class _Pair(NamedTuple):
    """What the pictures of two places say against their poses; NaN: not known.

    bearing: radians by which the way from pose to pose is to the left of the shift in the pictures, by the headings.
    variance: of it, as far as it is the pictures'.
    metres: from pose to pose.
    turn: radians by which the difference of the headings misses that of the pictures.
    """

    bearing: float
    variance: float
    metres: float
    turn: float


class _Sample(NamedTuple):
    """A place, asked in the map without itself."""

    places: Whereabouts
    views: list[RelativeView | None]
    shared: list[SharedPoints | None]
    where: Whereabouts
    pairs: list[_Pair]


class _Surveyed(NamedTuple):
    state: object
    places: int
    rows: NDArray[np.int64]
    poses: Array
    survey: PoseSurvey


_surveys: WeakKeyDictionary[Map, _Surveyed] = WeakKeyDictionary()
_begun: WeakSet[Map] = WeakSet()
_lock, _surveying = Lock(), Lock()


def pose_survey(map_: Map) -> PoseSurvey:
    """The survey of a map; it is made where there is none, or the map has grown or its poses were changed since.

    Raises:
        StorageFailure: the map's files cannot be read.
    """
    with _surveying:
        known, holds = _at_hand(map_)
        if known is not None and holds:
            return known
        state = map_.state
        survey, rows = _survey(map_)
        snapshot = map_.snapshot()
        made = _Surveyed(state, len(snapshot), rows, _poses(snapshot.whereabouts_at(rows)), survey)
        with _lock:
            _surveys[map_] = made
        return survey


def survey_at_hand(map_: Map) -> PoseSurvey:
    """The last survey of a map, an empty one before the first; a thread makes one that is wanting or does not hold.

    So no answer waits for it: it takes some seconds.
    """
    known, holds = _at_hand(map_)
    if not holds:
        with _lock:
            begins = map_ not in _begun
            _begun.add(map_)
        if begins:
            Thread(target=_survey_later, args=(map_,), name="pose survey", daemon=True).start()
    return known or PoseSurvey()


def _survey_later(map_: Map) -> None:
    try:
        pose_survey(map_)
    except PlacerecError as error:  # the map was closed or deleted meanwhile, or its files cannot be read
        log.info("The poses of map %r are not surveyed: %s", map_.record.id, error)
    except Exception:
        log.exception("The poses of map %r are not surveyed", map_.record.id)
    finally:
        with _lock:
            _begun.discard(map_)


def _at_hand(map_: Map) -> tuple[PoseSurvey | None, bool]:
    """The last survey, None before the first, and whether it still holds."""
    state = map_.state
    with _lock:
        known = _surveys.get(map_)
    if known is None or known.state == state:
        return (None, False) if known is None else (known.survey, True)
    snapshot = map_.snapshot()
    same = known.places / GROWN < len(snapshot) < known.places * GROWN or len(snapshot) == known.places
    if not same or not np.array_equal(_poses(snapshot.whereabouts_at(known.rows)), known.poses, equal_nan=True):
        return known.survey, False
    with _lock:
        _surveys[map_] = known._replace(state=state)
    return known.survey, True


def place_errors(map_: Map, rows: Sequence[int], where: Whereabouts, surveyed: bool) -> PlaceErrors:
    """How exact the poses of places are: as stated of each, of the map, or as pictures show.

    Args:
        rows, where: of the n places, best first.
        surveyed: whether pictures are asked where nobody states it.
    """
    stated = map_.record.pose_accuracy
    errors = PlaceErrors.unknown(len(where))
    metres, radians = where.accuracy.astype(np.float64), errors.radians
    if np.isfinite(metres).any():
        for at, place in enumerate(map_.places_at(list(rows[:NEAREST]))):
            if place is not None and (exact := place.pose_accuracy) is not None and exact.degrees is not None:
                radians[at] = np.radians(exact.degrees)
    if stated is not None:
        metres = np.where(np.isnan(metres), stated.metres, metres)
        if stated.degrees is not None:
            radians[np.isnan(radians)] = np.radians(stated.degrees)
    unstated = np.isnan(metres)
    if surveyed:
        for code, one in survey_at_hand(map_).traverses.items():
            of_it = where.sequence == code
            if one.metres is not None:
                metres[of_it & unstated] = one.metres
            if one.degrees is not None:
                radians[of_it & np.isnan(radians)] = np.radians(one.degrees)
            errors.turned[of_it] = np.radians(one.turned)
    by_satellites = unstated & (where.kind == GEOGRAPHIC)
    metres[by_satellites] = np.fmax(metres[by_satellites], SATELLITES)
    return PlaceErrors(metres, radians, errors.turned)


def turned_note(map_: Map, code: int) -> str | None:
    """What is to be said of the headings of a traverse, by the code of it; None: nothing."""
    one = survey_at_hand(map_).traverses.get(code)
    return None if one is None else one.remark


def _survey(map_: Map) -> tuple[PoseSurvey, NDArray[np.int64]]:
    """The survey, and the rows of the places that were asked, int64 [k]."""
    snapshot = map_.snapshot()
    rows = np.flatnonzero(snapshot.alive)
    where = own_poses(map_.counterparts, snapshot.whereabouts_at(rows), rows)
    found, asked = {}, list[int]()
    ways = [walk for walk in where.walks() if (where.kind[walk] != NO_POSE).any()]
    each = max(LEAST_PAIRS, min(SAMPLES, MOST_SAMPLES // max(1, len(ways))))
    for walk in ways[: MOST_SAMPLES // LEAST_PAIRS]:
        usable = walk[(where.kind[walk] != NO_POSE) & np.isfinite(where.heading[walk])]
        chosen = usable[spread_order(len(usable))[:each]].tolist()
        samples = [one for at in chosen if (one := _sample(map_, rows, where, at)) is not None]
        code = int(where.sequence[walk[0]])
        (first,) = map_.places_at([int(rows[walk[0]])])
        if first is not None and samples:
            found[code] = _judged(map_, first.sequence or "", samples)
        asked += rows[chosen].tolist()
    return PoseSurvey(found), np.array(asked, np.int64)


def _sample(map_: Map, rows: NDArray[np.int64], where: Whereabouts, at: int) -> _Sample | None:
    """A place against those around it; None if none has keypoints."""
    away = np.linalg.norm(where.position - where.position[at], axis=1)
    usable = (where.kind == where.kind[at]) & (away >= APART) & (away <= BUNDLE_REACH) & np.isfinite(where.heading)
    around = np.flatnonzero(usable)
    around = around[np.argsort(away[around], kind="stable")][:NEAREST]
    if not len(around):
        return None
    places = where.take(around)
    order = [0, *places_apart(places, neighborhood_of(map_).radius, range(len(around)), OTHERS)]
    (query,), stored = map_.keypoints_at([int(rows[at])]), map_.keypoints_at(rows[around[order]].tolist())
    known = map_.places_at([int(rows[at]), *rows[around[order]].tolist()])
    compared = [(row, one) for row, one in zip(order, stored, strict=True) if one is not None]
    if query is None or not compared or compared[0][0] != 0 or None in known:
        return None
    cameras = [map_.cameras.intrinsics(None if place is None else place.camera) for place in known]
    by_row = dict(zip(order, cameras[1:], strict=True))
    views: list[RelativeView | None] = [None] * (max(order) + 1)
    shared: list[SharedPoints | None] = [None] * (max(order) + 1)
    results = verify(query, [one for _, one in compared])
    for (row, one), result in zip(compared, results, strict=True):
        with suppress(UnfitIntrinsics):
            views[row] = relative_view(query, one, result, cameras[0], by_row[row])
            if cameras[0] is not None and by_row[row] is not None:
                shared[row] = sighting_of(query, one, result, cameras[0], by_row[row])
    place = where.take([at])
    pairs = [_pair(places.take([row]), place, view) for row, view in enumerate(views) if view is not None]
    return _Sample(places, views[:1], shared, place, pairs)


def _judged(map_: Map, sequence: str, samples: list[_Sample]) -> TraverseSurvey:
    """What samples of one traverse say."""
    pairs = [pair for sample in samples for pair in sample.pairs]
    bearings = np.array([pair.bearing for pair in pairs if np.isfinite(pair.bearing)])
    turns = np.array([pair.turn for pair in pairs if np.isfinite(pair.turn)])
    turned = 0.0
    if len(bearings) >= LEAST_PAIRS:
        middle = float(np.angle(np.exp(1j * bearings).sum()))
        middle += float(np.median(wrapped(bearings - middle)))
        agreed = np.mean(np.abs(wrapped(bearings - middle)) < np.radians(WITHIN))
        turned = float(wrapped(middle)) if agreed >= AGREED and abs(middle) > np.radians(TURNED) else 0.0
    degrees = None
    if len(turns) >= LEAST_PAIRS:  # of two headings, hence the root
        degrees = float(np.degrees(np.median(np.abs(turns)) / 0.6745 / np.sqrt(2)))
    metres = _likeliest(map_, samples, pairs, turned, degrees)
    return TraverseSurvey(sequence, metres, degrees, float(np.degrees(turned)), len(bearings))


def _pair(place: Whereabouts, other: Whereabouts, view: RelativeView) -> _Pair:
    """What the view of the camera of one place from that of another says against their poses."""
    sign = -1 if place.kind[0] == GEOGRAPHIC else 1
    turn = sign * np.radians(float(other.heading[0] - place.heading[0])) - np.radians(view.heading_offset)
    missed = wrapped(turn) if view.source == "intrinsics" else np.nan
    length = float(np.hypot(*view.shift[:2]))
    across = np.array([-view.shift[1], view.shift[0]]) / max(length, 1e-9)
    variance = float(across @ view.covariance[3:5, 3:5] @ across) / max(length, 1e-9) ** 2
    metres = float(np.linalg.norm(other.position[0] - place.position[0]))
    if variance > CLEAR**2:
        return _Pair(np.nan, np.nan, metres, missed)
    looks = np.radians(float(90 - place.heading[0] if sign < 0 else place.heading[0]))
    shown = np.arctan2(view.shift[1], view.shift[0])
    bearing = bearing_between(Whereabouts.joined([place, other]), 0, 1)
    return _Pair(wrapped(bearing - looks - shown), variance, metres, missed)


def _likeliest(
    map_: Map, samples: list[_Sample], pairs: list[_Pair], turned: float, degrees: float | None
) -> float | None:
    """The deviation of positions in metres that makes the stated poses likeliest; None: pictures do not tell it."""
    seen = [sample for sample in samples if sum(one is not None for one in sample.shared) > 1]
    across = [pair for pair in pairs if np.isfinite(pair.bearing) and np.isfinite(pair.turn)]
    across = [pair for pair in across if pair.metres <= FAR * float(np.median([one.metres for one in across]))]
    if len(seen) + len(across) < LEAST_PAIRS or samples[0].where.kind[0] == GEOGRAPHIC:
        return None
    heading = np.nan if degrees is None else np.radians(degrees)
    costs = np.square((np.log(TRIED) - np.log(USUAL)) / USUAL_DEVIATION) / 2
    for at, metres in enumerate(TRIED.tolist()):
        for pair in across:
            variance = pair.variance + LOOSE**2 + np.nan_to_num(heading) ** 2 + 2 * (metres / pair.metres) ** 2
            either = [
                _surprise(wrapped(pair.bearing - turned + about) ** 2 / variance, np.log(variance), 1)
                for about in (0, np.pi)
            ]
            costs[at] -= np.logaddexp(np.log1p(-BACKWARDS) - either[0], np.log(BACKWARDS) - either[1])
        for sample in seen:
            count = len(sample.places)
            errors = PlaceErrors(
                np.full(count, metres), np.full(count, heading), np.full(count, turned), in_common=False
            )
            estimate = estimate_pose(
                sample.places, -np.arange(count), neighborhood_of(map_).radius,
                views=sample.views, sightings=sample.shared, errors=errors,
            )  # fmt: skip
            if estimate is not None and estimate.source == "intrinsics":
                missed = sample.where.position[0, :2] - estimate.pose.position()[:2]
                covariance = estimate.covariance[:2, :2] + np.eye(2) * metres**2
                square = float(missed @ np.linalg.solve(covariance, missed))
                costs[at] += _surprise(square, float(np.linalg.slogdet(covariance)[1]), 2)
    best = int(np.clip(np.argmin(costs), 1, len(TRIED) - 2))
    before, here, after = costs[best - 1 : best + 2].tolist()
    bend = before - 2 * here + after
    step = float(np.clip((before - after) / (2 * bend), -1, 1)) if bend > 0 else float(np.sign(before - after))
    found = float(TRIED[best] * (TRIED[1] / TRIED[0]) ** step)
    return found if found >= LEAST_KNOWN else None


def _surprise(square: float, logarithm: float, values: int) -> float:
    """The negative log likelihood of some values by Student's t, but for constants.

    Args:
        square: their squared Mahalanobis distance.
        logarithm: of the determinant of their covariance.
    """
    return (TAIL + values) / 2 * float(np.log1p(square / TAIL)) + logarithm / 2


def _poses(where: Whereabouts) -> Array:
    return np.column_stack([where.position, where.heading.astype(np.float64)])
