"""The fusion of several frames of one moment into one query, and of several maps' answers into one.

*Cameras of a rig.*  Frames that are near each other by :meth:`Whereabouts.near` are one place.  A camera's best match
has the log odds of its own judgement, and every other place has fewer, by the slope of the curve for each unit by which
its final score is lower: one scale, whether places were verified or not.  The log odds of a place are those of the
camera x that is surest of it, and of each further camera

    (1 - r) · max(log e, x),

where e is the probability that a camera says nothing about the place where it is, as it may look where no frame was
taken; a camera whose own best match is the place takes nothing away from it (0 for log e).  r, the likeness of its
frame to those of the cameras before it, is the cosine of their descriptors: a frame that is sent twice is no second
witness.  A rig of one camera, or of one twice, is a plain query.

Rivals are judged as those of a plain query are, by the difference of the log odds from those of the best place.
Cameras that each recognize places apart contradict each other: the answer is ambiguous, however sure one of them is.
So it is where each camera that sees the place may as well see one on another storey.

*Maps.*  Each map's best match has the log odds x_m of being right.  At most one of the maps' matches can be right, and
perhaps none is: the probability of match m is exp(x_m) / (1 + Σ exp(x_j)).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from core.judgement.geometry import Geometry
from core.judgement.priors import decision_slope, log_odds
from core.judgement.probability import FARTHEST, sigmoid
from core.judgement.verdict import CLEAR_STOREY, EVEN, MOST_RIVALS, Calibration, Judgement, Rivals, Verdict, judge
from core.judgement.verdict import log_odds_of as log_odds_of_stages
from core.places import Neighborhood, Whereabouts

Values = NDArray[np.float64]

BLIND = 0.3
"""e, the probability that a camera of a rig says nothing about the place where it is.  With 0.1 to 0.3 the left
and the right part of corridor's frames are recognized together in the same frames, but for five of 222."""

SHOWS_SOMETHING = 2.0
"""Deviations by which the best score of a map has to exceed the mean of unrelated frames if a frame shows anything.
Noise and a hand on the lens reach at most 1.2 on corridor and lip6, strangers there at least 3.4."""

SAME_FRAME = 0.999
"""From this cosine of their descriptors on two frames are the same."""

LISTED = 50
"""Without a second stage, this many places of each camera's ranking count."""

ALIKE = float(np.log(4))
"""If the log odds of two maps' places differ by less than this (a factor of four in the odds), the answer is
ambiguous."""


@dataclass(frozen=True)
class CameraRanking:
    """The ranking of one camera of a rig.

    rows: int64 [n], rows of the map, best first.
    scores: float32 [n].
    whereabouts: of the n places.
    examined: bool [n], which of them the second stage has compared; none if the encoder has no second stage.
    weights: float64 [n], log prior of the places, the same for all cameras; None: there is no prior.
    geometry: the results of verification for the n places; None: none was verified.
    descriptor: of the frame, float32 [D]; None: not known, and the frame is like none of the others.
    recognized: the row that the camera recognizes as a plain query, which may have needed fewer stages; None: none.
    twins: rows of places on other storeys that the camera may as well see.
    """

    rows: NDArray[np.int64]
    scores: NDArray[np.float32]
    whereabouts: Whereabouts
    examined: NDArray[np.bool_]
    weights: Values | None = None
    geometry: Geometry | None = None
    descriptor: NDArray[np.float32] | None = None
    recognized: int | None = None
    twins: tuple[int, ...] = ()

    @property
    def values(self) -> Values:
        """The scores of all stages, float64 [n]."""
        values = self.scores.astype(np.float64)
        return values if self.geometry is None else values + self.geometry.gain

    def listed(self) -> NDArray[np.int64]:
        """The positions of the places whose scores can be compared with each other, int64."""
        return np.flatnonzero(self.examined) if self.examined.any() else np.arange(min(LISTED, len(self.rows)))


@dataclass(frozen=True)
class Fused:
    """The joint ranking of all cameras.

    rows: int64 [n], rows of the map, best first.
    whereabouts: of the n places.
    scores: float32 [n], the best score of all stages that any camera gives to each place.
    log_odds: float64 [n], descending, by all cameras and the prior.
    weights: float64 [n], log prior of the places; zeros without a prior.
    """

    judgement: Judgement
    rows: NDArray[np.int64]
    whereabouts: Whereabouts
    scores: NDArray[np.float32]
    log_odds: Values
    weights: Values


def shows_something(view: CameraRanking, calibration: Calibration) -> bool:
    """Whether a camera's frame resembles any place more than unrelated frames do; a blocked one does not."""
    least = calibration.background_mean + SHOWS_SOMETHING * calibration.background_deviation
    return float(view.scores.max(initial=-np.inf)) > least


def likeness_of_frames(views: Sequence[CameraRanking]) -> Values:
    """The cosines of the frames' descriptors, float64 [C, C], at least 0; of a frame without one 0 to all others."""
    alike = np.eye(len(views))
    for one, other in combinations(range(len(views)), 2):
        first, second = views[one].descriptor, views[other].descriptor
        if first is not None and second is not None:
            lengths = float(np.linalg.norm(first)) * float(np.linalg.norm(second))
            alike[one, other] = alike[other, one] = min(1.0, max(0.0, float(first @ second) / max(lengths, 1e-12)))
    return alike


def witnesses(views: Sequence[CameraRanking], calibration: Calibration) -> list[int]:
    """The cameras that say something: not blocked, nor with the same frame as one before; the first if all are."""
    alike = likeness_of_frames(views)
    found: list[int] = []
    for camera, view in enumerate(views):
        if shows_something(view, calibration) and not (alike[camera, found] >= SAME_FRAME).any():
            found.append(camera)
    return found or [0]


def fuse(views: Sequence[CameraRanking], calibration: Calibration, neighborhood: Neighborhood) -> Fused:
    """Judge the frames of several cameras of a rig together, against one map.

    Args:
        views: of the cameras whose frames have a region; at least one, each with at least one place.
    """
    listed = [view.listed() for view in views]
    rows, first = np.unique(
        np.concatenate([view.rows[part] for view, part in zip(views, listed, strict=True)]), return_index=True
    )
    parts = [view.whereabouts.take(part) for view, part in zip(views, listed, strict=True)]
    places = Whereabouts.joined(parts).take(first)
    near = np.stack([places.near(i, neighborhood) for i in range(len(rows))])
    steepness, alike = decision_slope(calibration), likeness_of_frames(views)
    values = np.full((len(views), len(rows)), -np.inf)
    evidence = np.full((len(views), len(rows)), np.nan)
    judgements = [_judged_alone(view, calibration, neighborhood) for view in views]
    for camera, view in enumerate(views):
        known = np.flatnonzero(np.isin(view.rows, rows))
        at = np.searchsorted(rows, view.rows[known])
        values[camera, at] = view.values[known]
        if view.geometry is not None:
            evidence[camera, at] = view.geometry.evidence[known]
    lowest = np.where(np.isfinite(values), values, np.inf).min(axis=1, keepdims=True)
    behind = values.max(axis=1, keepdims=True) - np.where(np.isfinite(values), values, lowest)
    surest = np.array([_log_odds_alone(one, calibration) for one in judgements])
    own = surest[:, None] - steepness * behind
    heads = own.argmax(axis=1)
    prior = np.concatenate(
        [
            np.zeros(len(part)) if view.weights is None else view.weights[part]
            for view, part in zip(views, listed, strict=True)
        ]
    )[first]

    def of_places(reach: NDArray[np.bool_]) -> Values:
        """The log odds of places if each has the frames of a row of ``reach``, bool [n, n]."""
        shared = np.stack([np.where(reach, row, -np.inf).max(axis=1) for row in own])
        return _added(shared, near[:, heads].T, alike) + np.where(reach, prior, -np.inf).max(axis=1)

    # The frames of one place share its evidence; among them, those with the best scores of their own come first.
    total = of_places(near)
    alone = _added(own, np.zeros(own.shape, np.bool_), alike) + prior
    order = np.lexsort((-alone, -np.round(total, 9)))
    best = int(order[0])
    others = np.flatnonzero(~near[best])
    # A frame beside the best place has no share in its evidence when it is compared with it.
    total[others] = of_places(near & ~near[best])[others]
    order = np.append(best, order[order != best][np.argsort(-np.round(total[order[order != best]], 9), kind="stable")])
    found = values.max(axis=0)[order].astype(np.float32)
    of_best = evidence[:, near[best]]
    best_evidence = None if np.isnan(of_best).all() else float(np.nanmax(of_best))
    believed = {int(rows[head]) for head, one in zip(heads, judgements, strict=True) if one.verdict == "recognized"}
    believed |= {view.recognized for view in views if view.recognized is not None}
    contradicting = np.flatnonzero(np.isin(rows[order], list(believed)) & ~near[best, order]).tolist()
    seeing = [view.twins for view, head in zip(views, heads, strict=True) if near[best, head]]
    doubles = [row for one in seeing for row in one] if all(seeing) else []
    twins = np.flatnonzero(np.isin(rows[order], doubles))
    left = 1 / (1 + float(np.exp(prior[order][twins] - prior[best]).max(initial=0.0)))
    imagined = judgements[int(surest.argmax())].imagined
    judgement = _judged(
        total[order], found, near[np.ix_(order, order)], contradicting, twins, left, calibration, steepness,
        best_evidence, imagined,
    )  # fmt: skip
    return Fused(judgement, rows[order], places.take(order), found, total[order], prior[order])


def _judged_alone(view: CameraRanking, calibration: Calibration, neighborhood: Neighborhood) -> Judgement:
    """The judgement of one camera's frame as a plain query, without a prior."""
    order = np.argsort(-view.values, kind="stable")
    geometry = None if view.geometry is None else view.geometry.take(order)
    places = view.whereabouts.take(order)
    return judge(view.scores[order], places, calibration, neighborhood, view.examined[order], geometry=geometry)


def _log_odds_alone(judgement: Judgement, calibration: Calibration) -> float:
    """The log odds of a camera's best match by its own judgement; without a curve, by the decision value."""
    decision = 0.0 if judgement.decision is None else judgement.decision
    stated = log_odds_of_stages(decision, judgement.lead, calibration, judgement.imagined, judgement.evidence)
    return log_odds(decision, calibration) if stated is None else float(stated)


def _added(parts: Values, own: NDArray[np.bool_], alike: Values) -> Values:
    """The log odds of places by all cameras (see the module), float64 [n].

    Args:
        parts: float64 [C, n], by each camera.
        own: bool [C, n], whether a camera's own best match is the place.
        alike: float64 [C, C], the likeness of the frames.
    """
    found = np.empty(parts.shape[1])
    for place, (odds, is_own) in enumerate(zip(parts.T, own.T, strict=True)):
        first, *further = np.argsort(-odds, kind="stable").tolist()
        total, before = float(odds[first]), [first]
        for camera in further:
            least = 0.0 if is_own[camera] else float(np.log(BLIND))
            total += (1 - float(alike[camera, before].max())) * max(least, float(odds[camera]))
            before.append(camera)
        found[place] = total
    return found


def _judged(
    log_odds_of_places: Values,
    scores: NDArray[np.float32],
    near: NDArray[np.bool_],
    contradicting: Sequence[int],
    twins: NDArray[np.int64],
    left: float,
    calibration: Calibration,
    steepness: float,
    evidence: float | None,
    imagined: float,
) -> Judgement:
    """Judge the first of the ranked places; ``near`` says which of them are the same place, bool [n, n].

    The verdict is ambiguous if a rival is within the margin, in log odds, a camera recognizes another place, or the
    cameras may as well see a twin.

    Args:
        contradicting: the places that cameras recognize which are not the first.
        twins: int64 [k], places on other storeys that all cameras may as well see, and the probability that is ``left``
            to the first by the likeliest of them.
        imagined: the share of the background that was imagined.
    """
    best = float(log_odds_of_places[0])
    others = np.flatnonzero(~near[0])
    rival, margin = None, None
    if len(others):
        rival = int(others[np.argmax(log_odds_of_places[others])])
        margin = max(0.0, (best - float(log_odds_of_places[rival])) / steepness)
    least = log_odds(calibration.threshold, calibration)
    decision = calibration.threshold + (best - least) / steepness
    least = max(least, 0.0 if evidence is not None else log_odds(calibration.threshold, calibration, imagined))
    close = np.flatnonzero(best - log_odds_of_places < calibration.margin * steepness)
    rivals = np.append(np.array(contradicting, np.int64), np.setdiff1d(np.intersect1d(close, others), contradicting))
    halved = EVEN if len(rivals) else 1.0
    verdict: Verdict = "recognized"
    if best < least and not contradicting:
        verdict = "unknown"
    elif len(rivals) or left < CLEAR_STOREY:
        verdict = "ambiguous"
        rivals = rivals if len(rivals) else twins
    named = tuple(Rivals((head,), False) for head in _heads(rivals, near)) if verdict == "ambiguous" else ()
    probability = None
    if calibration.curve is not None:
        probability = min(left, float(sigmoid(np.array(best))) * halved)
    return Judgement(
        verdict, float(scores[0]), decision, margin, rival, probability, imagined, named, evidence,
        tuple(twins.tolist()),
    )  # fmt: skip


def _heads(places: NDArray[np.int64], near: NDArray[np.bool_]) -> list[int]:
    """The first of some places, int64 [k], without those that are the same place as a better one."""
    heads: list[int] = []
    while len(places) and len(heads) < MOST_RIVALS:
        heads.append(int(places[0]))
        places = places[~near[heads[-1], places]]
    return heads


def joint_probabilities(log_odds_of_matches: Sequence[float]) -> Values:
    """exp(x_m) / (1 + Σ exp(x_j)) of matches that exclude each other; float64 [m], with a sum below 1."""
    x = np.clip(np.asarray(log_odds_of_matches, np.float64), -FARTHEST, FARTHEST)
    total = np.logaddexp.reduce(np.append(x, 0.0))
    return np.asarray(np.exp(x - total), np.float64)


def log_odds_of(judgement: Judgement, calibration: Calibration) -> float:
    """The log odds of a best match, from its probability or, without a calibrated curve, from its decision value."""
    if judgement.probability is not None:
        probability = min(max(judgement.probability, 1e-15), 1 - 1e-15)
        return float(np.log(probability) - np.log1p(-probability))
    return -FARTHEST if judgement.decision is None else log_odds(judgement.decision, calibration)
